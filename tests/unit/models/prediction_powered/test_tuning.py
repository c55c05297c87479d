"""Lambda: where it lies, per parameter and per context, guarded and clipped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.tuning import Practice, tune, tuning_cost
from dtprob.physical.labels import QUALITIES, Setting, label_study
from dtprob.reproduce.label_grid import evaluation_of
from tests.unit.models.prediction_powered.examples import linear, scalar

EXACT = Practice(guard=False)


def lambdas(quality, practice, *, runs=400, n=60, count=500):
    setting = Setting(quality, n, count, 5)

    def one(key):
        evaluation = evaluation_of(label_study(key, setting), jnp.asarray(float(count)))
        return tune(evaluation, jnp.ones((1, 1)), "overall", practice)

    return jax.tree.map(np.ravel, jax.vmap(one)(jax.random.split(jax.random.key(5), runs)))


@pytest.mark.study
@pytest.mark.parametrize("quality", QUALITIES)
def test_lambda_stays_within_its_bounds(quality):
    found = lambdas(quality, Practice())
    assert found.value.min() >= 0
    assert found.value.max() <= 1


@pytest.mark.study
def test_lambda_tells_good_predictors_from_bad_ones():
    perfect, useless = (lambdas(quality, Practice()) for quality in ("perfect", "useless"))
    np.testing.assert_allclose(perfect.raw.mean(), 1 / (1 + 60 / 500), rtol=0.01)
    assert np.median(useless.value) < 0.05
    assert lambdas("anti-correlated", Practice()).value.max() == 0


def test_the_guard_pulls_useless_lambdas_towards_zero():
    guarded, plain = (lambdas("useless", Practice(guard=on)) for on in (True, False))
    np.testing.assert_array_equal(plain.value, np.clip(plain.raw, 0, 1))
    assert np.mean(guarded.value**2) < 0.6 * np.mean(plain.value**2)


@pytest.mark.study
def test_the_standard_error_of_lambda_is_its_spread():
    found = lambdas("useless", Practice(), runs=1000, n=200)
    # The standard deviation over 1000 runs is known to 2.2%; 15% leaves room for the delta method.
    assert np.median(found.standard_error) == pytest.approx(found.raw.std(), rel=0.15)


def test_the_tuned_variance_is_below_that_of_both_ends():
    sample = linear(n=150, count=400, quality=1.6)
    variances = {
        lam: np.trace(estimate("ols", sample, "tuned_cppi", lam=lam).covariance) for lam in (0.0, 1.0)
    }
    tuned = estimate("ols", sample, "tuned_cppi", practice=EXACT)
    assert np.trace(tuned.covariance) < 1.01 * min(variances.values())
    assert 0 < tuned.lam.value[0, 0] < 1


def test_by_parameter_each_lambda_is_best_for_its_own():
    sample = linear(n=150, quality=0.5)
    own = estimate("ols", sample, by="parameter", practice=EXACT)
    together = estimate("ols", sample, practice=EXACT)
    assert len(np.unique(own.lam.value)) == 3
    assert np.all(np.diagonal(own.covariance) <= 1.01 * np.diagonal(together.covariance))


def two_contexts():
    """The predictor is good in the first context and useless in the second."""
    rng = np.random.default_rng(8)
    context = rng.integers(0, 2, 1200)
    y = rng.normal(size=1200)
    guess = np.where(context == 0, y, 3 * rng.normal(size=1200))
    n = 200
    return Sample(
        y=y[:n],
        prediction=guess[:n],
        prediction_unlabelled=guess[n:],
        context=context[:n],
        context_unlabelled=context[n:],
    )


def test_by_context_only_the_good_context_is_used():
    sample = two_contexts()
    found = estimate("mean", sample, by="context")
    good, useless = found.lam.value[0]
    assert good > 0.7
    assert useless < 0.15
    overall = estimate("mean", sample)
    assert len(set(overall.lam.value[0])) == 1
    assert found.covariance[0, 0] < 0.9 * overall.covariance[0, 0]


def test_by_context_needs_contexts():
    with pytest.raises(InputError, match=r"sample: expected contexts of all samples.*Give context"):
        estimate("mean", scalar(), by="context")


@pytest.mark.parametrize("settings", [{"rounds": 0}, {"pilot": 1.5}])
def test_a_practice_that_cannot_work_is_refused(settings):
    with pytest.raises(InputError, match="practice: expected rounds from 1"):
        Practice(**settings)


def by_context(random, n, contexts):
    """A mean of 0 whose predictor is good in every other context and bad in the rest."""
    context, rest = random.integers(0, contexts, n), random.integers(0, contexts, 2000)
    context[:contexts] = np.arange(contexts)
    noise = np.where(np.arange(contexts) % 2, 2.0, 0.3)
    y, other = random.normal(size=n), random.normal(size=2000)
    return Sample(
        y=y,
        prediction=y + noise[context] * random.normal(size=n),
        prediction_unlabelled=other + noise[rest] * random.normal(size=2000),
        context=context,
        context_unlabelled=rest,
    )


def test_lambdas_of_contexts_cost_degrees_of_freedom():
    sample = by_context(np.random.default_rng(6), 60, 10)
    found = estimate("mean", sample, "tuned_ppi", by="context")
    lost = 1 + 2 * np.sum((found.lam.value[0] > 0) & (found.lam.value[0] < 1))
    expected = estimate("mean", sample, "tuned_ppi", by="context", practice=Practice(lost=lost))
    for name in ("theta", "covariance", "low", "high"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12)
    (note,) = found.notes
    assert note.startswith("Fewer than 20 labels in contexts 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, so that")
    many = by_context(np.random.default_rng(6), 600, 3)
    assert estimate("mean", many, "tuned_ppi", by="context").notes == ()


@pytest.mark.parametrize("n", [5, 10])
def test_intervals_cover_with_few_labels(n):
    """Of 90%, 2000 times, by an exact binomial bound against .9; predictions have correlation .5."""
    random, covered = np.random.default_rng(8), 0
    for _ in range(2000):
        y = random.normal(size=n + 500)
        guess = 0.5 * y + np.sqrt(0.75) * random.normal(size=n + 500)
        found = estimate("mean", Sample(y=y[:n], prediction=guess[:n], prediction_unlabelled=guess[n:]))
        covered += found.low[0] <= 0 <= found.high[0]
    assert covered >= stats.binom.ppf(1e-4, 2000, 0.9)


@pytest.mark.parametrize("lam", [0.0, 1.0])
def test_a_lambda_at_an_end_costs_nothing(lam):
    assert tuning_cost(np.full((3, 1), lam), "overall") == 0
    assert tuning_cost(np.full((3, 2), 0.5), "overall") == 2
    assert tuning_cost(np.array([[0.5, lam, 0.3]]), "context") == 4


@pytest.mark.study
@pytest.mark.parametrize(("n", "contexts"), [(40, 10), (60, 10), (100, 20)])
def test_intervals_cover_with_few_labels_per_context(n, contexts):
    """Of 90%, 4000 times, by an exact binomial bound against .86."""
    random, covered = np.random.default_rng(7), 0
    for _ in range(4000):
        found = estimate("mean", by_context(random, n, contexts), "tuned_ppi", by="context")
        covered += found.low[0] <= 0 <= found.high[0]
    assert covered > stats.binom.isf(1e-3, 4000, 0.86)
