"""The six schemes and their lambda against formulas written out by hand, for the mean."""

import numpy as np
import pytest

from dtprob.models.prediction_powered.estimate import BIASED, NO_UNLABELLED, estimate
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.tuning import Practice
from tests.unit.models.prediction_powered.examples import linear, scalar

EXACT = Practice(guard=False)


def parts(sample):
    """Means of labels, of predictions at labelled samples, and at unlabelled ones."""
    return sample.y.mean(), sample.prediction.mean(), sample.prediction_unlabelled.mean()


def best_lambda(sample):
    """Cov(g, f) / (Var f + n/N Var fbar), as in the derivation for the mean."""
    n, count = sample.n, sample.n_unlabelled
    covariance = np.cov(sample.y, sample.prediction, ddof=0)
    average = sample.prediction_unlabelled.mean(axis=1)
    return covariance[0, 1] / (covariance[1, 1] + n / count * average.var())


def test_every_scheme_is_its_formula():
    sample = scalar()
    y, f, unlabelled = parts(sample)
    n, count = sample.n, sample.n_unlabelled
    expected = {
        "erm": y,
        "ss": (n * y + count * unlabelled) / (n + count),
        "ppi": y + unlabelled - f,
        "cppi": y + unlabelled - f,
        "tuned_ppi": y + best_lambda(sample) * (unlabelled - f),
        "tuned_cppi": y + best_lambda(sample) * (unlabelled - f),
    }
    for scheme, value in expected.items():
        found = estimate("mean", sample, scheme, practice=EXACT)
        assert found.theta == pytest.approx([value], rel=1e-12), scheme


def test_lambda_is_its_formula():
    found = estimate("mean", scalar(), practice=EXACT)
    assert float(found.lam.value[0, 0]) == pytest.approx(best_lambda(scalar()), rel=1e-12)
    assert 0 < best_lambda(scalar()) < 1


def test_variance_is_its_formula():
    sample = scalar()
    n, count = sample.n, sample.n_unlabelled
    average = sample.prediction_unlabelled.mean(axis=1)
    variances = {
        "erm": sample.y.var(ddof=1) / n,
        "cppi": (sample.y - sample.prediction).var(ddof=1) / n + average.var(ddof=0) / (count - 1),
    }
    for scheme, variance in variances.items():
        assert estimate("mean", sample, scheme).covariance[0, 0] == pytest.approx(variance, rel=1e-12)


@pytest.mark.parametrize("scheme", ["erm", "ss", "ppi", "tuned_ppi", "cppi", "tuned_cppi"])
def test_labels_alone_have_their_own_variance_under_every_scheme(scheme):
    sample = scalar()
    found = estimate("mean", sample, scheme)
    assert found.labels_only_variance == pytest.approx([sample.y.var(ddof=1) / sample.n], rel=1e-12)


@pytest.mark.parametrize("lam", [0.0, 0.4, 1.0])
def test_a_given_lambda_is_used(lam):
    sample = scalar()
    y, f, unlabelled = parts(sample)
    found = estimate("mean", sample, "tuned_cppi", lam=lam)
    assert found.theta == pytest.approx([y + lam * (unlabelled - f)], rel=1e-12)


def test_the_ends_of_lambda_are_erm_and_cppi():
    sample = linear(kind="logistic")
    for lam, scheme in ((0.0, "erm"), (1.0, "cppi")):
        ends = estimate("logistic", sample, "tuned_cppi", lam=lam), estimate("logistic", sample, scheme)
        np.testing.assert_allclose(ends[0].theta, ends[1].theta, rtol=1e-10)
        np.testing.assert_allclose(ends[0].covariance, ends[1].covariance, rtol=1e-8)


@pytest.mark.parametrize("scheme", ["ppi", "tuned_ppi", "cppi", "tuned_cppi"])
def test_least_squares_solve_the_corrected_normal_equations(scheme):
    sample = linear()
    found = estimate("ols", sample, scheme)
    lam = float(found.lam.value[0, 0])
    x, other, n, count = sample.x, sample.x_unlabelled, sample.n, sample.n_unlabelled
    average = sample.prediction_unlabelled.mean(axis=1)
    gram = (1 - lam) * x.T @ x / n + lam * other.T @ other / count
    moment = x.T @ sample.y / n + lam * (other.T @ average / count - x.T @ sample.prediction / n)
    np.testing.assert_allclose(found.theta, np.linalg.solve(gram, moment), rtol=1e-10)


@pytest.mark.parametrize("loss", ["logistic", "poisson"])
@pytest.mark.parametrize("scheme", ["erm", "ss", "cppi", "tuned_cppi"])
def test_the_corrected_gradient_vanishes(loss, scheme):
    sample = linear(n=80, kind=loss)
    found = estimate(loss, sample, scheme)
    mean = {"logistic": lambda eta: 1 / (1 + np.exp(-eta)), "poisson": np.exp}[loss]
    x, other, n, count = sample.x, sample.x_unlabelled, sample.n, sample.n_unlabelled
    average = sample.prediction_unlabelled.mean(axis=1)
    own = x.T @ (mean(x @ found.theta) - sample.y) / n
    predicted = x.T @ (mean(x @ found.theta) - sample.prediction) / n
    unlabelled = other.T @ (mean(other @ found.theta) - average) / count
    lam = float(found.lam.value[0, 0])
    share = count / (n + count)
    total = (1 - share) * own + share * unlabelled if scheme == "ss" else own + lam * (unlabelled - predicted)
    np.testing.assert_allclose(total, 0, atol=1e-8)


def test_means_of_vectors_are_those_of_their_entries():
    first, second = scalar(seed=1), scalar(seed=2)
    both = Sample(
        y=np.stack([first.y, second.y], axis=1),
        prediction=np.stack([first.prediction, second.prediction], axis=1),
        prediction_unlabelled=np.stack([first.prediction_unlabelled, second.prediction_unlabelled], axis=2),
    )
    found = estimate("mean", both, by="parameter", practice=EXACT)
    for column, one in enumerate((first, second)):
        alone = estimate("mean", one, practice=EXACT)
        assert found.theta[column] == pytest.approx(alone.theta[0], rel=1e-12)
        assert found.lam.value[column, 0] == pytest.approx(alone.lam.value[0, 0], rel=1e-12)


def test_one_lambda_for_all_weighs_all_parameters():
    first, second = scalar(seed=1, noise=3.0), scalar(seed=2)
    y = np.stack([first.y, second.y], axis=1)
    f = np.stack([first.prediction, second.prediction], axis=1)
    unlabelled = np.stack([first.prediction_unlabelled, second.prediction_unlabelled], axis=2)
    found = estimate(
        "mean", Sample(y=y, prediction=f, prediction_unlabelled=unlabelled), "tuned_cppi", practice=EXACT
    )
    average = unlabelled.mean(axis=1)
    top = sum(np.cov(y[:, i], f[:, i], ddof=0)[0, 1] for i in range(2))
    bottom = (f.var(axis=0) + len(y) / len(average) * average.var(axis=0)).sum()
    assert float(found.lam.value[0, 0]) == pytest.approx(top / bottom, rel=1e-12)


def test_chunks_change_nothing():
    sample = linear()
    fields = ("y", "x", "prediction", "x_unlabelled", "prediction_unlabelled")
    chunked = Sample(**{name: getattr(sample, name) for name in fields}, chunk=77)
    for loss in ("ols", "mean"):
        a, b = (estimate(loss, one) for one in (sample, chunked))
        np.testing.assert_allclose(a.theta, b.theta, rtol=1e-10)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-8)


def test_weights_are_repetitions():
    sample = linear(n=30, count=200)
    fields = ("y", "x", "prediction", "x_unlabelled", "prediction_unlabelled")
    values = {name: getattr(sample, name) for name in fields}
    times = np.arange(30) % 3
    repeated = {**values, **{name: np.repeat(values[name], times, axis=0) for name in fields[:3]}}
    weighted = estimate("ols", Sample(**values, weight=times), "ppi")
    np.testing.assert_allclose(weighted.theta, estimate("ols", Sample(**repeated), "ppi").theta, rtol=1e-9)


def test_without_unlabelled_samples_it_is_erm_and_says_so():
    sample = linear()
    alone = estimate("ols", Sample(x=sample.x, y=sample.y), "tuned_cppi")
    np.testing.assert_allclose(alone.theta, np.linalg.lstsq(sample.x, sample.y)[0], rtol=1e-10)
    assert alone.notes == (NO_UNLABELLED,)
    assert alone.scheme.name == "erm"


@pytest.mark.parametrize("loss", ["mean", Quantile(0.5)])
def test_semi_supervised_warns_of_its_bias(loss):
    assert estimate(loss, scalar(), "ss").notes == (BIASED,)


@pytest.mark.parametrize("entries", [1, 5, 20])
def test_the_error_of_a_mean_does_not_depend_on_other_entries(entries):
    y = np.random.default_rng(4).normal(size=(30, entries))
    found = estimate("mean", Sample(y=y), "erm")
    assert np.atleast_1d(found.standard_error)[0] == pytest.approx(y[:, 0].std(ddof=1) / np.sqrt(30))


def test_as_many_labels_as_parameters_leave_no_interval():
    one = estimate("mean", Sample(y=np.array([1.0])), "erm")
    assert np.isinf([one.low, one.high]).all()
    x = np.array([[1.0, 0.3], [1.0, -0.4]])
    both = estimate("ols", Sample(x=x, y=np.array([1.0, 2.0])), "erm")
    assert np.isinf([both.low, both.high]).all()
    np.testing.assert_allclose(x @ both.theta, [1.0, 2.0])
