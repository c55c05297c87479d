"""Counts that stand out: zeros of lost reports and counters at their end, not what another law makes frequent as well."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

import dtprob
from dtprob.gap.where.count_piles import count_piles
from dtprob.gap.where.site_finding import SURE

N = 400
COUNTS = np.arange(60)


def rates(seed):
    return np.exp(np.random.default_rng(seed).normal(2.3, 0.4, N))


def smallest(count, rate):
    """The smallest chance, times the number of counts that are seen, and the count it is of."""
    seen = np.bincount(count.astype(int), minlength=len(COUNTS))[: len(COUNTS)].astype(float)
    found = count_piles(seen, stats.poisson.pmf(COUNTS[:, None], rate).sum(1))
    return found.min() * (seen > 0).sum(), int(found.argmin())


@pytest.mark.parametrize(("value", "share"), [(0, 0.08), (31, 0.08), (10, 0.2)])
def test_a_count_that_is_filed_instead_of_others_is_told(value, share):
    for seed in range(10):
        rng, rate = np.random.default_rng(seed), rates(seed)
        count = np.where(rng.uniform(size=N) < share, value, rng.poisson(rate))
        p_value, told = smallest(count, rate)
        assert (told, p_value < SURE) == (value, True)


@pytest.mark.parametrize("scale", [0.01, 0.1, 1.0, 3.0])
def test_counts_of_a_right_twin_are_silent(scale):
    """Of 400 data sets of 400 counts, at rates from .1 to 30."""
    rng = np.random.default_rng(1)
    p = [smallest(rng.poisson(rate), rate)[0] for rate in (scale * rates(seed) for seed in range(400))]
    for level in (SURE, 0.05):
        assert (np.array(p) <= level).sum() <= stats.binom.isf(1e-3, len(p), level)


@pytest.mark.parametrize("shape", [1.0, 2.0, 5.0, 20.0])
def test_a_law_that_is_wider_than_the_twin_knows_makes_no_pile(shape):
    """Rates that vary beyond what the twin says make zeros frequent that it hardly knows, and ones, and twos."""
    rng = np.random.default_rng(2)
    wide = [smallest(rng.poisson(r * rng.gamma(shape, 1 / shape, N)), r)[0] for r in map(rates, range(200))]
    assert (np.array(wide) <= SURE).sum() <= 3


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.25, 2.0])
def test_rates_that_are_wrong_make_no_pile(factor):
    rng = np.random.default_rng(3)
    wrong = [smallest(rng.poisson(factor * rate), rate)[0] for rate in map(rates, range(200))]
    assert (np.array(wrong) <= SURE).sum() <= 3


def test_a_series_that_goes_on_is_no_pile():
    """Each count half as often as the one before, though the twin knows of none of the first ones."""
    seen = np.array([64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1.0])
    assert count_piles(seen, np.full(7, 2.0)).min() == 1.0
    seen[0] += 40.0
    assert count_piles(seen, np.full(7, 2.0))[0] < 1e-3


def arrivals(load, sent=None, arrived=None):
    """Packets at a rate that grows with the load; of so many that were sent, if that is known."""
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("window", load.shape[0]):
        x = numpyro.deterministic("x", level + slope * load)
        law = dist.Poisson(jnp.exp(x)) if sent is None else dist.Binomial(sent, logits=x)
        numpyro.sample("arrived", law, obs=arrived)


@pytest.mark.parametrize(
    ("most", "spoilt", "verdict", "place"),
    [
        (0, lambda y, n, lost: np.where(lost, 0, y), "UNLISTED", "the value 0, read "),
        (40, lambda y, n, lost: np.where(lost, n, y), "UNLISTED", "the value 40, read "),
        pytest.param(0, lambda y, n, lost: y, "NO_GAP", None, marks=pytest.mark.study),
    ],
    ids=["lost", "all", "right"],
)
def test_a_diagnosis_says_it_first(most, spoilt, verdict, place):
    rng = np.random.default_rng(4)
    load, lost = rng.normal(size=N), rng.uniform(size=N) < 0.06
    if most:
        data = {"load": load, "sent": np.full(N, most)}
        count = rng.binomial(most, 1 / (1 + np.exp(-0.4 * load)))
    else:
        data = {"load": load}
        count = rng.poisson(np.exp(2.3 + 0.4 * load))
    data["arrived"] = spoilt(count, most, lost)
    given = {name: jnp.asarray(value) for name, value in data.items()}
    found = dtprob.diagnose(arrivals, given, [], key=jax.random.key(0))
    assert found.verdict == verdict
    if place:
        first = found.to_report()["where"]["sites"][0]
        assert (first["site"], first["family"]) == ("arrived", "repeats, each")
        assert first["place"].startswith(place)
