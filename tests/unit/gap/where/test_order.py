"""Of sites that a gap shows at alike, the one nearest to the data is named first, whatever rounding says."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.gap.where.site_finding import SiteFinding, rank, shadows_last
from dtprob.inference import Laplace
from dtprob.models.declaration import model
from tests.unit.gap.examples import line


@model(axes={"distance": ("segment", "sample"), "power": ("segment", "sample")}, cluster="segment")
def path_loss(length, seen=None):
    """A power law of a distance: a relative error of the one is an additive error of the other."""
    level = numpyro.sample("level", dist.Normal(0.0, 30.0))
    distance = numpyro.deterministic("distance", length)
    power = numpyro.deterministic("power", level - 30.0 * jnp.log10(distance))
    with numpyro.plate("segment", length.shape[0], dim=-2), numpyro.plate("sample", length.shape[1], dim=-1):
        numpyro.sample("reading", dist.Normal(power, 2.0), obs=seen)


@pytest.mark.study
@pytest.mark.parametrize(("seed", "alike"), [(0, False), (1, True)])
def test_a_site_that_acts_through_another_alone_comes_after_it(seed, alike):
    """Where the same family shows at both; replicates give two families of one sum p-values that differ far out."""
    rng = np.random.default_rng(seed)
    length = rng.uniform(10.0, 400.0, (20, 10))
    seen = -30.0 * np.log10(length) + 2.0 * np.sin(length / 20.0) + 2.0 * rng.normal(size=length.shape)
    settings = Settings(replicates=100, site_replicates=50)
    data = {"length": jnp.asarray(length), "seen": jnp.asarray(seen)}
    found = diagnose(path_loss, data, [], key=jax.random.key(seed), engine=Laplace(), settings=settings)
    assert found.verdict == "UNLISTED"
    both = ["power", "distance"]
    told = [
        found.sections["unlisted"]["sites"][:2],
        [one["site"] for one in found.sections["where"]["sites"][:2]],
    ]
    assert told == [both, both] if alike else [sorted(names) for names in told] == [sorted(both)] * 2


@pytest.mark.parametrize(("of_spread", "first"), [(1e-3, "mean"), (1e-6, "mean"), (1e-12, "deviation")])
def test_a_site_that_only_spreads_comes_after_values_that_are_surely_wrong(of_spread, first):
    """By whatever name; unless it is more than twice as surely wrong."""
    mean = SiteFinding("mean", "additive", "common", 1e-4, 20.0)
    deviation = SiteFinding("deviation", "relative", "common", of_spread, 20.0, spreads=True)
    assert min(shadows_last([deviation, mean], 4.0), key=lambda found: found.last).site == first


@pytest.mark.parametrize(("beyond", "first"), [(85.0, "mean"), (5.0, "y")])
def test_a_level_that_is_far_off_is_no_noise_however_large_its_squares(beyond, first):
    """One of twelve devices off by three deviations: the squares are surer than the level, and explained by it."""
    mean = SiteFinding("mean", "additive", "device", 1e-21, 90.0, beyond_noise=beyond)
    spread = SiteFinding("y", "spread", "device", 1e-90, 67.0)
    assert min(shadows_last([spread, mean], 1.75), key=rank).site == first


@pytest.mark.parametrize(("score", "first"), [(40.0, "spread"), (200.0, "mean")])
def test_where_p_values_end_values_with_scores_that_noise_makes_come_last(score, first):
    """Noise of four times the energy makes squared scores of four on average, and some of 40 among many."""
    mean = SiteFinding("mean", "relative", "row", 1e-200, 800.0, score=score)
    spread = SiteFinding("y", "spread", "common", 3e-285, 8000.0)
    assert min(shadows_last([mean, spread], 4.0), key=lambda found: found.last) == replace(
        mean if first == "mean" else spread, last=False
    )


@pytest.mark.study
@pytest.mark.parametrize("what", ["mean", "spread"])
def test_far_off_it_is_still_told_whether_the_mean_or_its_noise_is_wrong(what):
    """Noise of ten times the deviation at a fifth of the readings, or a mean that bends by as much."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.0, 1.0, (30, 20))
    noise = np.where((what == "spread") & (np.arange(20) % 5 == 0), 5.0, 0.5)
    y = x + noise * rng.normal(size=x.shape) + (5.0 * x**2 if what == "mean" else 0.0)
    settings = Settings(replicates=100, site_replicates=50)
    data = {"x": jnp.asarray(x), "y": jnp.asarray(y)}
    found = diagnose(line, data, [], key=jax.random.key(0), engine=Laplace(), settings=settings)
    site = found.sections["unlisted"]["located"][0]
    assert (site["site"], site["family"].startswith("spread")) == (
        ("mean", False) if what == "mean" else ("y", True)
    )


def test_what_is_read_again_and_again_comes_first() -> None:
    """A default of 3% spreads the readings far more surely than it is counted."""
    alike = SiteFinding("y", "repeats", "each", 1e-6, None, place="the value 0, read 17 times")
    spread, mean = (
        SiteFinding("y", "spread", "y", 1e-200, None),
        SiteFinding("mean", "additive", "y", 1e-90, 5.0),
    )
    assert min(shadows_last([mean, spread, alike], 4.0), key=rank) == alike
    assert not any(found.repeats for found in (spread, mean))


@pytest.mark.parametrize(
    ("pattern", "p_of_tails", "is_first"),
    [
        ("ripple in time, 33 to 64 half waves", 1e-30, False),
        ("ripple in time, 33 to 64 half waves", 1e-6, True),
        ("by group", 1e-30, True),
        ("by ripple_counter", 1e-30, True),
    ],
)
def test_ripples_of_a_spread_follow_far_readings(pattern: str, p_of_tails: float, is_first: bool) -> None:
    """The finest ripples are surely wrong wherever some readings are far off; a group that is louder is not."""
    is_ripple = pattern.startswith("ripple in")
    spread, tails = (
        SiteFinding("y", "spread", pattern, 1e-70, 0.0, is_ripple=is_ripple),
        SiteFinding("y", "tails", "each", p_of_tails, None),
    )
    deviation = SiteFinding("sd", "additive", pattern, 1e-70, 0.0, spreads=True, is_ripple=is_ripple)
    found = sorted(shadows_last([spread, deviation, tails], 1.0), key=rank)
    assert (found[0].moment != "tails") == is_first
    assert [f.last for f in found if f.moment != "tails"] == [not is_first] * 2
    assert [f.can_be_modelled for f in found if f.moment != "tails"] == [is_first] * 2
    assert not any(f.can_be_modelled for f in found if f.moment == "tails")


@pytest.mark.parametrize(("moment", "p", "is_first"), [("skewness", 1e-16, False), ("tails", 1e-6, True)])
def test_what_varies_from_reading_to_reading_follows_far_readings(
    moment: str, p: float, is_first: bool
) -> None:
    """Delays that are now and then far too late: an amount of its own for each reading says no more than that."""
    each = SiteFinding("m", "additive", "packet", 1e-66, 90.0, is_of_each=True)
    law = SiteFinding("delay", moment, "common", p, None)
    found = sorted(shadows_last([each, law], 1.0), key=rank)
    assert (found[0].site == "m") == is_first
