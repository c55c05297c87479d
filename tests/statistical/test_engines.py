"""Engines against each other, and simulation-based calibration, with declared failure rates at fixed keys."""

import jax
import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy import stats

from dtprob.inference import HMC, LATENTS_ONLY, NUTS, SMC, SVI, BlackJAXNUTS, Ensemble, Exact, Laplace
from dtprob.testing.calibration import DRAWS, judge, simulated_ranks
from dtprob.testing.calibration_cases import CASES
from tests.unit.inference.examples import logistic, logistic_data

RATE = 1e-3


def standard_error(values):
    return values.std() / array_stats.ess(values, chain_axis=0, draw_axis=1, method="mean") ** 0.5


def test_exact_engines_agree():
    """z-scores of means and second moments of every entry; two-sided, all together at the declared rate."""
    data = logistic_data()
    engines = (
        NUTS(draws=1500, warmup=500, chains=4),
        BlackJAXNUTS(draws=1500, warmup=500, chains=4),
        SMC(draws=1500, chains=4, moves=3, leapfrog=6),
    )
    first, *others = (engine(jax.random.key(7), logistic, data, options=LATENTS_ONLY) for engine in engines)
    scores = []
    for second in others:
        for name in ("scale", "weight"):
            a, b = (p.draws[name].reshape(4, 1500, -1) for p in (first, second))
            for entry in range(a.shape[2]):
                for power in (1, 2):
                    x, y = a[..., entry] ** power, b[..., entry] ** power
                    scores.append((x.mean() - y.mean()) / np.hypot(standard_error(x), standard_error(y)))
    assert len(scores) == 16
    limit = stats.norm.isf(RATE / 2 / len(scores))
    assert np.max(np.abs(scores)) < limit


SHORT = {"warmup": 150, "draws": 95, "chains": 1}
ENGINES = {
    "nuts, circular": (NUTS(**SHORT), 120),
    "blackjax_nuts, hierarchical": (BlackJAXNUTS(**SHORT), 120),
    "smc, circular": (SMC(draws=190, chains=1, moves=3, leapfrog=5), 120),
    "svi, normal": (SVI(draws=DRAWS, starts=1, falls=1, particles=4), 60),
    "laplace, normal": (Laplace(draws=DRAWS, starts=1), 120),
    "ensemble, normal": (Ensemble(members=DRAWS, starts=1), 120),
    "exact, normal": (Exact(draws=DRAWS), 120),
    "hmc, circular": (HMC(**SHORT), 60),
    "exact, multi_access": (Exact(draws=DRAWS), 60),
    "exact, prediction_powered": (Exact(draws=DRAWS), 60),
    "nuts, custom": (NUTS(**SHORT), 60),
    "blackjax_nuts, phase_error_channel": (BlackJAXNUTS(**SHORT), 30),
}
LONG = {
    "exact, multi_access",
    "blackjax_nuts, phase_error_channel",
    "nuts, circular",
    "nuts, custom",
    "smc, circular",
    "svi, normal",
    "ensemble, normal",
    "hmc, circular",
    "blackjax_nuts, hierarchical",
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.study) if name in LONG else name for name in ENGINES]
)
def test_ranks_are_uniform(name):
    """Ranks of true values are even (simulated null) and 90% intervals hold them (exact), at the declared rate."""
    engine, runs = ENGINES[name]
    ranks = simulated_ranks(engine, CASES[name.split(", ")[1]](), jax.random.key(3), range(runs))
    for site, found in ranks.items():
        verdict = judge(found)
        assert verdict.p_value > RATE / len(ranks), site
        assert verdict.coverage_p_value > RATE / len(ranks), site


def test_a_wrong_posterior_is_found_out():
    """Uniform ranks pass; those of draws that are too narrow, or too high, do not."""
    ranks = np.random.default_rng(1).integers(0, DRAWS + 1, 60)
    assert judge(ranks).p_value > RATE
    assert judge(ranks).coverage_p_value > RATE
    narrow = np.where(ranks < 8, 0, np.where(ranks > 11, DRAWS, ranks))
    assert judge(narrow).p_value < RATE
    assert judge(narrow).coverage_p_value < RATE
    assert judge(np.maximum(ranks - 6, 0)).p_value < RATE
