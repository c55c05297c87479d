"""Samples that depend on each other within clusters: variances by hand, coverage, folds, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.models.prediction_powered.bootstrap import bootstrap
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.losses import CustomLoss
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.training import train
from dtprob.models.prediction_powered.tuning import PUBLISHED

ROUTES, STOPS = 12, 6


def routes(bias=0.0, seed=1, chunk=None):
    """Labels on the first stops of 12 of 40 routes; stops of a route have a common part."""
    random = np.random.default_rng(seed)
    route = np.repeat(np.arange(40), STOPS)
    y = random.normal(size=40)[route] + 0.3 * random.normal(size=len(route))
    guess = y + bias + 0.5 * random.normal(size=40)[route] + 0.1 * random.normal(size=len(route))
    labelled = (route < ROUTES) & (np.arange(len(route)) % STOPS <= route % 4)
    names = np.array([f"route {number}" for number in route])
    return Sample(
        y=y[labelled],
        prediction=guess[labelled],
        prediction_unlabelled=guess[~labelled],
        cluster=names[labelled],
        cluster_unlabelled=names[~labelled],
        chunk=chunk,
    )


@pytest.mark.parametrize("bias", [0.0, 100.0])
def test_the_variance_is_that_of_sums_over_clusters(bias):
    sample = routes(bias)
    found = estimate("mean", sample, "cppi")
    total = 0.0
    residual, rest = sample.y - sample.prediction, sample.prediction_unlabelled
    for name in np.unique(sample.cluster_unlabelled):
        own = residual[sample.cluster == name] - residual.mean()
        other = rest[sample.cluster_unlabelled == name] - rest.mean()
        total += (own.sum() / sample.n + other.sum() / len(rest)) ** 2
    counts = np.unique(sample.cluster, return_counts=True)[1]
    effective = counts.sum() ** 2 / np.sum(counts**2)
    assert found.theta[0] == pytest.approx(rest.mean() + residual.mean(), rel=1e-10)
    assert found.covariance[0, 0] == pytest.approx(total * effective / (effective - 1), rel=1e-8)


@pytest.mark.parametrize("chunk", [None, 50])
def test_a_loss_of_the_user_has_the_same_variance(chunk):
    loss = CustomLoss(lambda theta, x, y: 0.5 * (theta[0] - y) ** 2, jnp.zeros(1))
    own, expected = (estimate(one, routes(chunk=chunk), "tuned_cppi") for one in (loss, "mean"))
    np.testing.assert_allclose(own.covariance, expected.covariance, rtol=1e-8)
    np.testing.assert_allclose(own.lam.value, expected.lam.value, rtol=1e-8)


def test_regressions_have_the_usual_cluster_robust_variance():
    random = np.random.default_rng(2)
    route = np.repeat(np.arange(30), 5)
    x = np.column_stack([np.ones(150), random.normal(size=30)[route]])
    y = x @ [1.0, 2.0] + random.normal(size=30)[route] + random.normal(size=150)
    found = estimate("ols", Sample(x=x, y=y, cluster=route), "erm")
    bread = np.linalg.inv(x.T @ x)
    sums = np.add.reduceat(x * (y - x @ found.theta)[:, None], np.arange(0, 150, 5))
    np.testing.assert_allclose(found.covariance, bread @ sums.T @ sums @ bread * 30 / 28, rtol=1e-8)


@pytest.mark.parametrize("loss", ["mean", "ols"])
def test_clusters_of_one_sample_are_samples(loss):
    random = np.random.default_rng(4)
    x, y = np.ones((2060, 1)), random.normal(size=2060)
    guess = y + 0.5 * random.normal(size=2060)
    given = {"x": x[:60], "y": y[:60], "prediction": guess[:60]}
    given |= {"x_unlabelled": x[60:], "prediction_unlabelled": guess[60:]}
    plain = estimate(loss, Sample(**given))
    found = estimate(loss, Sample(**given, cluster=np.arange(60), cluster_unlabelled=np.arange(60, 2060)))
    np.testing.assert_allclose(found.theta, plain.theta, atol=0.01 * plain.standard_error[0])
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=0.01)


def test_intervals_cover_where_stops_of_a_route_are_alike():
    """Of 90%, 600 times, by an exact binomial bound; without clusters they cover about half of the time."""
    covered = np.zeros(2)
    for seed in range(600):
        sample = routes(seed=seed)
        alone = Sample(
            y=sample.y, prediction=sample.prediction, prediction_unlabelled=sample.prediction_unlabelled
        )
        found = [estimate("mean", one) for one in (sample, alone)]
        covered += [one.low[0] <= 0 <= one.high[0] for one in found]
    assert covered[0] >= stats.binom.ppf(1e-4, 600, 0.9)
    assert covered[1] <= stats.binom.ppf(1 - 1e-4, 600, 0.6)


def test_few_clusters_are_noted():
    (note,) = estimate("mean", routes()).notes
    assert note.startswith("With 10 effective clusters of labels the interval may be too narrow")


class Recorder:
    """Keeps what it is trained on."""

    seen: list

    def __init__(self):
        self.seen = []

    def __deepcopy__(self, memo):
        return self

    def fit(self, X, y, /):
        del y
        self.seen.append(set(X[:, 0]))
        return self

    def predict(self, X, /):
        return np.zeros(len(X))


@pytest.mark.parametrize(("scheme", "trainings"), [("tuned_cppi", 4), ("tuned_ppi", 1)])
def test_a_cluster_is_in_one_fold_or_half(scheme, trainings):
    route, predictor = np.repeat(np.arange(8), 5), Recorder()
    x = route[:, None].astype(float)
    sample = train(
        jax.random.key(0), scheme, predictor, x=x, y=x[:, 0], x_unlabelled=x, folds=4,
        cluster=route, cluster_unlabelled=route,
    )  # fmt: skip
    assert [len(seen) for seen in predictor.seen] == [6 if trainings == 4 else 4] * trainings
    if trainings == 1:
        assert not predictor.seen[0] & set(sample.y)


Y = np.arange(6.0)
GIVEN = {"y": Y, "prediction": Y, "prediction_unlabelled": Y}
CLUSTERS = {"cluster": np.arange(6) // 2, "cluster_unlabelled": np.arange(6) // 2}
WRONG = {
    "no other": ({"cluster": Y.astype(int)}, "cluster_unlabelled: expected clusters of labelled and"),
    "a fraction": (CLUSTERS | {"cluster": Y + 0.5}, "cluster: expected shape .*whole numbers or names"),
    "names and numbers": (CLUSTERS | {"cluster": np.array(list("aabbcc"))}, "expected names or numbers"),
    "contexts": (CLUSTERS | {"context": np.arange(6) % 2}, "cluster: expected one context, got 2 contexts"),
}
CALLS = {
    "all in one": (lambda one: estimate("mean", one), {"cluster": np.zeros(6, int)}, "labels in 2 clusters or"),
    "quantile": (lambda one: estimate(Quantile(0.5), one), {}, "got clusters with a quantile"),
    "ss": (lambda one: estimate("mean", one, "ss"), {}, "got clusters with scheme ss"),
    "published": (lambda one: estimate("mean", one, practice=PUBLISHED), {}, "clusters with pooled_spread"),
    "bootstrap": (
        lambda one: bootstrap(jax.random.key(0), "mean", one, estimate("mean", one)), {}, "with the bootstrap"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_clusters_that_say_nothing_are_refused(case):
    with pytest.raises(InputError, match=WRONG[case][1]):
        Sample(**GIVEN, **WRONG[case][0])


@pytest.mark.parametrize("case", CALLS)
def test_what_takes_samples_one_by_one_is_refused(case):
    call, changes, message = CALLS[case]
    with pytest.raises(InputError, match=message):
        call(Sample(**(GIVEN | CLUSTERS | changes)))
