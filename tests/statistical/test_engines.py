"""Engines against each other, and simulation-based calibration, with declared failure rates at fixed keys."""

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from arviz_stats.base import array_stats
from scipy import stats

from dtprob.inference import NUTS, BlackJAXNUTS, Laplace, RunOptions
from tests.unit.inference.examples import logistic, logistic_data

RUNS, RANKS, RATE = 120, 20, 1e-3
LEAN = RunOptions(pointwise=False, deterministics=False)


def standard_error(values):
    return values.std() / array_stats.ess(values, chain_axis=0, draw_axis=1, method="mean") ** 0.5


def test_the_two_nuts_agree():
    """z-scores of means and second moments of every entry; two-sided, all together at the declared rate."""
    data = logistic_data()
    first, second = (
        engine(draws=1500, warmup=500, chains=4)(jax.random.key(7), logistic, data, options=LEAN)
        for engine in (NUTS, BlackJAXNUTS)
    )
    scores = []
    for name in ("scale", "weight"):
        a, b = (p.draws[name].reshape(4, 1500, -1) for p in (first, second))
        for entry in range(a.shape[2]):
            for power in (1, 2):
                x, y = a[..., entry] ** power, b[..., entry] ** power
                scores.append((x.mean() - y.mean()) / np.hypot(standard_error(x), standard_error(y)))
    limit = stats.norm.isf(RATE / 2 / len(scores))
    assert np.max(np.abs(scores)) < limit


def normal(x, y=None):
    level = numpyro.sample("level", dist.Normal(1.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", 6):
        numpyro.sample("y", dist.Normal(level + slope * x, 1.0), obs=y)


def spread(x, y=None):
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    angle = numpyro.sample("angle", dist.VonMises(np.pi, 1.0))
    with numpyro.plate("row", 6):
        numpyro.sample("y", dist.Normal(scale * jax.numpy.cos(angle - x), 0.7), obs=y)


def ranks(engine, model, thin):
    """Rank of the true value among thinned draws, for every latent site, over runs on data from the prior."""
    x = np.linspace(-1, 2, 6)
    found = {}
    for key in jax.random.split(jax.random.key(3), RUNS):
        true_key, fit_key = jax.random.split(key)
        trace = numpyro.handlers.trace(numpyro.handlers.seed(model, true_key)).get_trace(x)
        truth = {n: np.asarray(m["value"]) for n, m in trace.items() if m["type"] == "sample"}
        posterior = engine(fit_key, model, {"x": x, "y": truth["y"]}, options=LEAN)
        for name in posterior.latent:
            draws = posterior.draws[name].reshape(-1)[::thin][: RANKS - 1]
            assert draws.size == RANKS - 1
            # An angle is ranked from the cut of its prior, where there is least mass.
            turn = (lambda z: np.mod(z, 2 * np.pi)) if name == "angle" else (lambda z: z)
            found.setdefault(name, []).append(int(np.sum(turn(draws) < turn(truth[name]))))
    return found


CASES = {
    "nuts": (NUTS(warmup=150, draws=95, chains=1), spread, 5),
    "laplace on a normal": (Laplace(draws=19, starts=1), normal, 1),
}


@pytest.mark.parametrize("name", CASES)
def test_ranks_are_uniform(name):
    """Exact bounds: a bin count is binomial; the chi-square statistic is simulated from uniform ranks."""
    engine, model, thin = CASES[name]
    random = np.random.default_rng(0)

    def departure(values):
        counts = np.bincount(values, minlength=RANKS)
        return np.sum((counts - RUNS / RANKS) ** 2)

    null = np.sort([departure(random.integers(0, RANKS, RUNS)) for _ in range(20_000)])
    for site, found in ranks(engine, model, thin).items():
        counts = np.bincount(found, minlength=RANKS)
        low, high = stats.binom.interval(1 - RATE / RANKS, RUNS, 1 / RANKS)
        assert low <= counts.min() <= counts.max() <= high, site
        assert departure(np.asarray(found)) < np.quantile(null, 1 - RATE), site
        halves = stats.binomtest(int(np.sum(np.asarray(found) < RANKS // 2)), RUNS, 0.5).pvalue
        assert halves > RATE, site
