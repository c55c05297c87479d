"""Weights: means are divided by the total weight, and errors know it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.models.prediction_powered.bootstrap import bootstrap_draws
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.losses import CustomLoss
from dtprob.models.prediction_powered.quantile import Quantile, quantile_problem
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.tuning import CAREFUL, PUBLISHED, Practice

KEY = jax.random.key(4)
N, COUNT = 60, 900


def weighted(bias=0.0, *, count=COUNT, folds=2, contexts=1, chunk=None):
    """Labels, predictions with a constant bias, and weights that go with neither."""
    random = np.random.default_rng(12)
    y = random.normal(size=N + count)
    guess = y[:, None] + bias + 0.5 * random.normal(size=(N + count, folds))
    context = random.integers(0, contexts, N + count)
    return Sample(
        y=y[:N],
        prediction=guess[:N, 0],
        prediction_unlabelled=guess[N:],
        weight=random.exponential(size=N),
        weight_unlabelled=random.exponential(size=count),
        context=context[:N],
        context_unlabelled=context[N:],
        chunk=chunk,
    )


def mean_square(weight, values):
    """Of what each row adds to the error of a mean that is divided by the total weight."""
    return np.mean((weight * (values - np.mean(weight * values))) ** 2)


def kish(weight):
    return np.sum(weight) ** 2 / np.sum(weight**2)


@pytest.mark.parametrize("practice", [CAREFUL, PUBLISHED], ids=["careful", "published"])
@pytest.mark.parametrize("scheme", ["cppi", "tuned_cppi"])
def test_a_bias_of_the_predictor_changes_nothing(scheme, practice):
    plain, biased = (estimate("mean", weighted(bias), scheme, practice=practice) for bias in (0.0, 100.0))
    for name in ("theta", "covariance", "low", "high", "degrees"):
        np.testing.assert_allclose(getattr(biased, name), getattr(plain, name), rtol=1e-8, err_msg=name)
    np.testing.assert_allclose(biased.lam.raw, plain.lam.raw, rtol=1e-8)
    np.testing.assert_allclose(biased.lam.standard_error, plain.lam.standard_error, rtol=1e-8)


@pytest.mark.parametrize("count", [COUNT, 6000])  # resampled as they are, and by their normal law
def test_a_bias_of_the_predictor_does_not_change_resamples(count):
    draws = []
    for bias in (0.0, 100.0):
        sample = weighted(bias, count=count)
        found = estimate("mean", sample, "cppi")
        draws.append(bootstrap_draws(KEY, "mean", sample, found, 1000)[:, 0])
        assert np.std(draws[-1]) == pytest.approx(found.standard_error[0], rel=0.1)
    np.testing.assert_allclose(draws[0], draws[1], atol=1e-6)


def test_the_variance_is_that_of_the_weighted_means():
    sample = weighted()
    average = sample.prediction_unlabelled.mean(axis=1)
    effective = kish(sample.weight)
    own = mean_square(sample.weight, sample.y - sample.prediction) / N * effective / (effective - 1)
    rest = mean_square(sample.weight_unlabelled, average) / (COUNT - 1)
    assert estimate("mean", sample, "cppi").covariance[0, 0] == pytest.approx(own + rest, rel=1e-10)


@pytest.mark.parametrize("chunk", [None, 400])
def test_a_loss_of_the_user_has_the_same_variance(chunk):
    loss = CustomLoss(lambda theta, x, y: 0.5 * (theta[0] - y) ** 2, jnp.zeros(1))
    own, expected = (estimate(one, weighted(3.0, chunk=chunk), "tuned_cppi") for one in (loss, "mean"))
    np.testing.assert_allclose(own.covariance, expected.covariance, rtol=1e-8)


@pytest.mark.parametrize("pooled", [False, True])
def test_lambda_of_each_context_and_its_variance(pooled):
    sample = weighted(2.0, contexts=3)
    practice = Practice(guard=False, rounds=1, pilot=0.0, pooled_spread=pooled)
    found = estimate("mean", sample, by="context", practice=practice)
    inside = sample.context[:, None] == np.arange(3)
    other = sample.context_unlabelled[:, None] == np.arange(3)
    pilot = np.mean(sample.weight * sample.y)

    def rows(weight, values):
        values = values.reshape(len(weight), -1)
        return weight[:, None] * (values - weight @ values / len(weight))

    g = rows(sample.weight, pilot - sample.y)
    average = sample.prediction_unlabelled.mean(axis=1)
    own = inside * (pilot - sample.prediction)[:, None]
    rest = other * (pilot - average)[:, None]
    f, u = rows(sample.weight, own), rows(sample.weight_unlabelled, rest)
    quadratic = f.T @ f / N + N / COUNT * u.T @ u / COUNT
    if pooled:
        together = rows(
            np.concatenate([sample.weight, sample.weight_unlabelled]), np.concatenate([own, rest])
        )
        quadratic = (1 + N / COUNT) * together.T @ together / (N + COUNT - 1)
    np.testing.assert_allclose(found.lam.raw[0], np.linalg.solve(quadratic, f.T @ g[:, 0] / N), rtol=1e-8)
    lam = found.lam.value[0]
    own = rows(sample.weight, sample.y - inside @ lam * (sample.prediction - found.theta))
    rest = rows(sample.weight_unlabelled, other @ lam * (average - found.theta))
    effective = kish(sample.weight)
    variance = np.sum(own**2) / N**2 * effective / (effective - 1 - 2 * np.sum((lam > 0) & (lam < 1)))
    variance += np.sum(rest**2) / COUNT / (COUNT - 1)
    assert found.covariance[0, 0] == pytest.approx(variance, rel=1e-8)


@pytest.mark.parametrize("level", [0.2, 0.9])
def test_quantiles_know_it_too(level):
    sample, loss = weighted(), Quantile(level)
    practice = Practice(guard=False, rounds=1, pilot=0.0)
    theta = float(estimate(loss, sample, "erm").theta[0])
    found = estimate(loss, sample, "tuned_cppi", practice=practice)

    def below(values, weight):
        share = (values <= theta).reshape(len(values), -1).mean(axis=1)
        return weight * (share - np.mean(weight * share))

    g, f = (below(values, sample.weight) for values in (sample.y, sample.prediction))
    u = below(sample.prediction_unlabelled, sample.weight_unlabelled)
    best = np.mean(g * f) / (np.mean(f**2) + N / COUNT * np.mean(u**2))
    assert found.lam.raw[0, 0] == pytest.approx(best, rel=1e-8)
    problem = quantile_problem(loss, sample, found.scheme)
    variance = problem.variance(problem.steps.at(theta), (1.0, 0.7, 0.7))
    expected = np.mean((g - 0.7 * f) ** 2) / N + 0.49 * np.mean(u**2) / COUNT
    assert variance[0] == pytest.approx(expected, rel=1e-8)


def test_whole_weights_have_the_degrees_of_freedom_of_the_labels_that_they_leave():
    """Weights 1 and 0 are the same as leaving labels out, but for the note."""
    y = np.random.default_rng(3).normal(size=40)
    found = estimate("mean", Sample(y=y, weight=(np.arange(40) < 10).astype(float)), "erm")
    expected = estimate("mean", Sample(y=y[:10]), "erm")
    for name in ("theta", "low", "high", "degrees"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-10)
    assert any("10 effective labels of 40" in note for note in found.notes)
    assert any("With 10 labels the interval may be" in note for note in expected.notes)


@pytest.mark.study
def test_intervals_cover_under_uneven_weights():
    """Importance weights of which 8 labels of 40 are worth most; 4000 times, by an exact binomial bound against .86."""
    random, covered = np.random.default_rng(5), 0
    for _ in range(4000):
        weight = np.exp(1.2 * random.normal(size=40))
        found = estimate("mean", Sample(y=random.normal(size=40), weight=weight), "erm")
        covered += found.low[0] <= 0 <= found.high[0]
    assert covered > stats.binom.isf(1e-3, 4000, 0.855)
