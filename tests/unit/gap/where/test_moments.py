"""Skewness, tails and dependence of observations: noticed and named where they are there, silent where they are not."""

import contextlib
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats
from scipy.special import ndtr

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import more, replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.settings import Settings
from dtprob.gap.tails import family_wise
from dtprob.gap.where.bounded import skewness, tails
from dtprob.gap.where.families import Family, Pattern
from dtprob.gap.where.family_test import family_test
from dtprob.gap.where.locate import locate
from dtprob.gap.where.moments import _delayed, _kept, _shape, further_moments
from dtprob.gap.where.site_finding import SiteFinding, likely_left, most_left
from dtprob.models.declaration import model

LINKS, TIMES, OUTPUTS = 30, 20, 3
SHAPE = (LINKS, TIMES, OUTPUTS)
AXES = ("link", "time", "output")


@model(cluster="link", axes={"expected": AXES, "y": AXES, "z": AXES})
def two(load, y=None, z=None):
    """Two things seen of one load, with unknown slope, levels and noise."""
    slope = numpyro.sample("slope", dist.Normal(0.0, 10.0))
    level = numpyro.sample("level", dist.Normal(0.0, 10.0).expand([2]).to_event(1))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0).expand([2]).to_event(1))
    numpyro.deterministic("expected", level[0] + slope * load)
    plates = (numpyro.plate(axis, n, dim=i - 3) for i, (axis, n) in enumerate(zip(AXES, SHAPE, strict=True)))
    with contextlib.ExitStack() as stack:
        for plate in plates:
            stack.enter_context(plate)
        numpyro.sample("y", dist.Normal(level[0] + slope * load, noise[0]), obs=y)
        numpyro.sample("z", dist.LogNormal(level[1] - slope * load, noise[1]), obs=z)


def replicated(noise):
    """Fit and replicates at data with this noise (y or z, link, time, output), of unit variance where the twin is right."""
    load = np.random.default_rng(99).normal(size=SHAPE)
    data = {
        "load": load,
        "y": 2.0 + 0.7 * load + 0.5 * noise[0],
        "z": np.exp(1.0 - 0.7 * load + 0.3 * noise[1]),
    }
    problem = Problem(two, {name: jnp.asarray(value) for name, value in data.items()}, [])
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    settings = Settings()
    drawn = replicate(problem, fitted, projection, jax.random.key(0), settings)
    return problem, fitted, projection, drawn, settings


def normal(seed):
    return np.random.default_rng(seed).normal(size=(2, *SHAPE))


def skewed(seed):
    noise = normal(seed)
    noise[0] = (np.random.default_rng(seed + 50).gamma(4.0, size=SHAPE) - 4.0) / 2.0
    return noise


def heavy(seed):
    noise = normal(seed)
    noise[1] = np.random.default_rng(seed + 50).standard_t(5, size=SHAPE) / np.sqrt(5 / 3)
    return noise


def remembered(seed):
    noise = normal(seed)
    for t in range(1, TIMES):
        noise[0, :, t] = 0.3 * noise[0, :, t - 1] + np.sqrt(1 - 0.3**2) * noise[0, :, t]
    return noise


def across(seed):
    noise = normal(seed)
    noise[1, ..., 2] = 0.4 * noise[1, ..., 0] + np.sqrt(1 - 0.4**2) * noise[1, ..., 2]
    return noise


def shared(seed):
    noise = normal(seed)
    noise[1] = 0.3 * noise[0] + np.sqrt(1 - 0.3**2) * noise[1]
    return noise


def echoed(seed):
    """The first output comes back in the last one, three times later."""
    noise = normal(seed)
    noise[0, :, 3:, 2] = 0.4 * noise[0, :, :-3, 0] + np.sqrt(1 - 0.4**2) * noise[0, :, 3:, 2]
    return noise


def recurring(seed):
    noise = normal(seed)
    for t in range(2, TIMES):
        noise[0, :, t] = 0.3 * noise[0, :, t - 2] + np.sqrt(1 - 0.3**2) * noise[0, :, t]
    return noise


@pytest.mark.parametrize(
    ("noise", "site", "expected"),
    [
        (echoed, "y", "dependence on those 3 before along time"),
        pytest.param(recurring, "y", "dependence on those 2 before along time", marks=pytest.mark.study),
        (skewed, "y", "skewness"),
        (heavy, "z", "tails"),  # the spread of single entries follows them
        (remembered, "y", "dependence on the one before along time"),
        pytest.param(across, "z", "dependence from output to output", marks=pytest.mark.study),
        (shared, "y", "dependence on z"),
    ],
)
def test_what_is_wrong_with_the_noise_is_named(noise, site, expected):
    first = locate(*replicated(noise(3))).sites[0]
    assert (first.site, first.moment) == (site, expected)
    assert first.p_value < 1e-4


@pytest.mark.study
def test_nothing_is_noticed_where_nothing_is_wrong():
    """Each of 120 other replicates taken as the data: family-wise, no more small p-values than chance lets there be."""
    problem, fitted, _, drawn, _ = replicated(normal(0))
    rows = more(drawn, 4).rows[1:]
    null, data = rows[:199], rows[199:319]
    assert len(data) == 120
    found = []
    for row in data:
        stacked = np.concatenate([row[None], null])
        tests = [
            family_test(family, scores) for _, family, scores in further_moments(problem, fitted.x, stacked)
        ]
        assert len(tests) == 2 * (6 * 4 + 2 * 4 + 1) + 4
        smallest = np.stack([test.null for test in tests], axis=1).min(axis=1)
        found.append(family_wise(np.array([min(test.p_value for test in tests)]), smallest)[0])
    for level in (0.01, 0.1):
        assert (np.array(found) <= level).sum() <= stats.binom.isf(1e-3, len(found), 1.3 * level)
    assert min(found) > 1e-5


@pytest.mark.parametrize(
    ("rate", "links"), [(0.02, 6), *(pytest.param(0.1, links, marks=pytest.mark.study) for links in (6, 60))]
)
def test_rare_outcomes_that_nothing_ties_together_go_by_no_later_one(rate, links):
    """With the 99 replicates of a first look; where coincidences are too few they are not looked at."""
    rng, found = np.random.default_rng(5), []
    for _ in range(150):
        drawn = rng.uniform(size=(100, 1, links, 12, 4)) < rate
        row = (drawn - rate) / np.sqrt(rate * (1 - rate))
        tests = [
            family_test(Family(kind, Pattern("each", ()), np.ones(())), scores)
            for kind, scores in _delayed(row, ("link", "time", "output"), is_outcome=True)
        ]
        smallest = np.stack([test.null for test in tests], axis=1).min(axis=1)
        found.append(family_wise(np.array([min(test.p_value for test in tests)]), smallest)[0])
    assert (np.array(found) <= 0.01).sum() <= stats.binom.isf(1e-3, len(found), 0.013)
    assert min(found) > 1e-5


def test_an_outcome_that_follows_another_three_later_is_noticed_by_its_pair():
    rng = np.random.default_rng(6)
    drawn = rng.uniform(size=(100, 1, 60, 12, 4)) < 0.2
    drawn[0, 0, :, 3:, 1] |= drawn[0, 0, :, :-3, 2] & (rng.uniform(size=(60, 9)) < 0.4)
    row = (drawn - 0.2) / 0.4
    every = dict(_delayed(row, ("link", "time", "output"), is_outcome=True))
    scores = every["dependence on those 3 before along time"]
    z = scores[0] / scores[1:].std(axis=0)
    assert np.unravel_index(np.argmax(np.abs(z)), (4, 4)) == (1, 2)
    assert z.max() > 5
    assert len(every) == 8


def test_what_goes_together_leaves_what_its_chance_tells_unless_it_is_a_shadow():
    values = SiteFinding("y", "additive", "along time", 1e-9, 12.0)
    together = SiteFinding("y", "dependence along time", "common", 1e-20, None)
    assert most_left([values, together]) == pytest.approx(20 * np.log(10))
    assert most_left([values, replace(together, last=True)]) == 12.0
    assert most_left([]) == 0.0
    small = replace(values, kind="spread", pattern="by group", p_value=1e-40, gain=12.0)
    assert most_left([small]) == pytest.approx(40 * np.log(10))


@pytest.mark.parametrize(("p", "share"), [(1e-9, 1.0), (0.01, 0.875), (0.1, 0.374), (0.4, 0.0), (1.0, 0.0)])
def test_what_is_not_surely_wrong_leaves_its_gain_as_far_as_it_is_likely_to_be_wrong(p, share):
    found = SiteFinding("y", "additive", "along time", p, 12.0)
    assert likely_left([found]) == pytest.approx(12.0 * share, abs=0.02)
    assert likely_left([found, replace(found, gain=None)]) == likely_left([found])
    assert likely_left([]) == 0.0


@pytest.mark.parametrize(("far", "readings"), [(5.0, 24), (5.0, 2000), (300.0, 2000)])
def test_one_far_row_is_no_tail(far, readings):
    """The farthest of thousands in a right twin, and one that is a mistake: by itself it is no shape of the others."""
    rows = np.random.default_rng(6).normal(size=(400, readings))
    rows[0, 7] = far
    for kind, function in (("tails", tails), ("skewness", skewness)):
        scores = function(rows).sum(1, keepdims=True)
        common = Family(kind, Pattern("common", ()), np.ones(()))
        assert family_test(common, scores - scores[1:].mean(0)).p_value > 1e-3


@pytest.mark.parametrize(("seed", "readings"), [(0, 24), (1, 200)])
def test_shapes_of_few_readings_are_as_rare_as_they_say(seed, readings):
    """Sums of so many functions of a right twin's rows; 4,000 data sets against 400 others."""
    rng, null = np.random.default_rng(seed), np.random.default_rng(10 + seed).normal(size=(400, readings))
    for function in (skewness, tails):
        own = function(null).sum(1)
        deviation, mean = own.std(), own.mean()
        sums = function(rng.normal(size=(4000, readings))).sum(1)
        p = 2 * stats.norm.sf(np.abs(sums - mean) / deviation)
        for level in (0.01, 0.001):
            assert (p <= level).sum() <= stats.binom.isf(1e-4, 4000, 3 * level)


def test_a_few_percent_that_err_to_one_side_are_noticed():
    """Ranges of which one in fifteen came by a reflection: their ranks say little, their size says it."""
    rng = np.random.default_rng(8)
    error = rng.normal(size=(200, 600)) + rng.exponential(2.0, (200, 600)) * (
        rng.uniform(size=(200, 600)) < 0.066
    )
    rows = (error - error.mean(1, keepdims=True)) / error.std(1, keepdims=True)
    noticed = skewness(rows).sum(1) / np.sqrt(600)
    ranks = (5 * (2 * ndtr(rows) - 1) ** 3 - 3 * (2 * ndtr(rows) - 1)).sum(1) / 2 * np.sqrt(7 / 600)
    assert np.median(noticed) > 3.5
    assert np.median(ranks) < 2.0


def test_values_and_moments_are_told_apart():
    dependence = SiteFinding("y", "dependence along link", "common", 1e-9, None)
    assert dependence.moment == "dependence along link"
    assert replace(dependence, kind="spread", pattern="by weekday").moment == "spread"
    assert replace(dependence, kind="from the next spread", pattern="by spread").moment is None


@pytest.mark.parametrize("shape", [skewness, tails])
def test_what_a_mean_or_a_scale_moves_does_not_count(shape):
    at = np.linspace(-12, 12, 1_000_001)
    weight = stats.norm.pdf(at) * (at[1] - at[0])
    for moved in (1.0, at, at**2 - 1.0):
        assert abs(np.sum(weight * moved * shape(at))) < 1e-6
    assert np.sum(weight * shape(at) ** 2) == pytest.approx(1.0, abs=1e-6)
    assert np.abs(shape(np.array([-100.0, 100.0]))).max() < 12.0


def test_shapes_have_the_sign_that_they_say():
    rng = np.random.default_rng(2)
    right = (rng.gamma(4.0, size=100_000) - 4.0) / 2.0
    assert abs(skewness(right).mean() + skewness(-right).mean()) < 1e-12
    assert skewness(right).mean() > 0.1
    assert tails(rng.standard_t(5, size=100_000) / np.sqrt(5 / 3)).mean() > 0.05


@model(cluster="user", axes={"range": ("user", "anchor"), "range_m": ("user", "anchor")})
def ranging(distance, range_m=None):
    """Ranges with heavy tails to both sides."""
    spread = numpyro.sample("spread", dist.LogNormal(-1.0, 0.5))
    bias = numpyro.sample("bias", dist.Normal(0.0, 0.5).expand([distance.shape[1]]).to_event(1))
    users, anchors = distance.shape
    with numpyro.plate("user", users, dim=-2), numpyro.plate("anchor", anchors, dim=-1):
        expected = numpyro.deterministic("range", distance + bias)
        numpyro.sample("range_m", dist.StudentT(4.0, expected, spread), obs=range_m)


@pytest.mark.parametrize(("late", "moments"), [(0.0, set()), (0.06, {"skewness"})])
def test_far_readings_on_one_side_are_no_heavy_tails(late, moments):
    """A twin that knows outliers, but on both sides; of 1,200 ranges 6% are too long by a metre or so."""
    rng = np.random.default_rng(7)
    distance = rng.uniform(3.0, 30.0, (200, 6))
    error = 0.3 * rng.standard_t(4, distance.shape)
    error += rng.exponential(1.2, distance.shape) * (rng.uniform(size=distance.shape) < late)
    problem = Problem(ranging, {"distance": distance, "range_m": jnp.asarray(distance + error)}, [])
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(0), Settings())
    found = locate(problem, fitted, projection, drawn, Settings())
    assert {f.moment for f in found.sites if f.p_value < 0.0025} & {"skewness", "tails"} == moments


@model(cluster="cell", axes={"log_rate": ("cell", "hour"), "packets": ("cell", "hour")})
def counted(load, packets=None):
    """Packets at a rate that grows with the load."""
    level = numpyro.sample("level", dist.Normal(2.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    cells, hours = load.shape
    with numpyro.plate("cell", cells, dim=-2), numpyro.plate("hour", hours, dim=-1):
        log_rate = numpyro.deterministic("log_rate", level + slope * load)
        numpyro.sample("packets", dist.Poisson(jnp.exp(log_rate)), obs=packets)


@pytest.mark.parametrize(
    ("spread", "site", "expected"),
    [(0.5, "packets", "dispersion"), (1.0, None, None), (1.4, "log_rate", None)],
)
def test_counts_that_are_more_even_than_chance_are_noticed_and_wider_ones_show_at_their_rate(
    spread, site, expected
):
    rng = np.random.default_rng(9)
    load = rng.normal(size=(20, 20))
    mean = np.exp(2.5 + 0.3 * load)
    packets = np.maximum(np.round(mean + spread * np.sqrt(mean) * rng.normal(size=mean.shape)), 0.0)
    problem = Problem(counted, {"load": load, "packets": jnp.asarray(packets, int)}, [])
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(0), Settings())
    found = locate(problem, fitted, projection, drawn, Settings()).sites
    first = found[0]
    assert (min(f.p_value for f in found if f.moment != "dispersion") < 1e-3) == (site == "log_rate")
    scores = {
        f.label: s for n, f, s in further_moments(problem, fitted.x, drawn.rows) if f.kind == "dispersion"
    }
    assert (scores["dispersion, common"][0] == 0) == (spread > 1)
    if site is None:
        assert first.p_value > 0.05
    else:
        assert (first.site, first.moment) == (site, expected)
        assert first.p_value < 1e-3


def test_no_shape_is_told_by_a_few_readings():
    """Of ten users with six anchors each the shapes of all and of none alone."""
    rng = np.random.default_rng(7)
    distance = rng.uniform(3.0, 30.0, (10, 6))
    data = {"distance": distance, "range_m": jnp.asarray(distance + 0.3 * rng.standard_t(4, distance.shape))}
    problem = Problem(ranging, data, [])
    rows = rng.normal(size=(20, *problem.compiled.residual(problem.null()).shape))
    told = [family.label for _, family, _ in further_moments(problem, problem.null(), rows)]
    assert [label for label in told if "skewness" in label or "tails" in label] == [
        "skewness, common",
        "tails, common",
    ]
    assert "dependence along anchor, user" in told


def test_what_is_masked_and_has_no_parameters_tells_nothing():
    rows = np.random.default_rng(3).normal(size=(50, 1, 40))
    rows[..., 5] = 0.0
    rate = np.where(np.arange(40) == 5, np.nan, 4.0)
    found = dict(_shape(likelihood("Poisson"), {"rate": jnp.asarray(rate)}, rows[:, 0], rows))
    assert set(found) == {"skewness", "tails", "dispersion"}
    assert all(np.isfinite(values).all() for values in found.values())


def test_counts_that_states_of_their_own_follow_have_no_shape():
    rows = 0.8 * np.random.default_rng(3).normal(size=(50, 1, 40))
    assert not list(_shape(likelihood("Poisson"), {"rate": jnp.full(40, 4.0)}, rows[:, 0], rows))


@pytest.mark.parametrize(
    ("shape", "kept"),
    [
        ((30, 40), [(), (0,), (1,)]),
        ((30, 20), [(), (1,)]),
        ((24, 1), [()]),
        ((2, 12), [()]),
        ((2, 11), []),
    ],
)
def test_shapes_are_pooled_over_24_readings_or_more(shape, kept):
    assert list(_kept(shape, 24)) == kept


WAITING = {
    "Gamma": (lambda mean, shape: dist.Gamma(shape, shape / mean), stats.gamma(4.0, scale=0.25)),
    "Exponential": (lambda mean, _: dist.Exponential(1 / mean), stats.expon()),
}
LAWS = ["Exponential", pytest.param("Gamma", marks=pytest.mark.study)]


def waited(law, noise):
    """The sites of a fit to readings (40, 25) that are a mean with a slope times noise."""
    make = WAITING[law][0]

    def waits(load, y=None):
        slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
        level = numpyro.sample("level", dist.Normal(0.0, 3.0))
        shape = numpyro.sample("shape", dist.LogNormal(1.0, 1.0))
        with numpyro.plate("link", load.shape[0], dim=-2), numpyro.plate("time", load.shape[1], dim=-1):
            mean = numpyro.deterministic("mean", jnp.exp(level + slope * load))
            numpyro.sample("y", make(mean, shape), obs=y)

    load = np.random.default_rng(5).normal(size=noise.shape)
    problem = Problem(waits, {"load": load, "y": np.exp(0.3 * load) * noise}, [])
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(0), Settings())
    return locate(problem, fitted, projection, drawn, Settings())


@pytest.mark.parametrize("law", LAWS)
def test_delays_of_another_law_are_noticed_by_their_shape(law):
    """Log-normal noise with the spread of the law's logarithm."""
    true = WAITING[law][1]
    probability = (np.arange(1000) + 0.5) / 1000
    spread = np.log(true.ppf(probability)).std()
    found = waited(law, np.exp(spread * np.random.default_rng(3).normal(size=(40, 50))))
    assert {f.moment for f in found.sites if f.p_value < 0.0025} & {"skewness", "tails"}


@pytest.mark.study
@pytest.mark.parametrize("law", LAWS)
def test_delays_of_their_own_law_are_not(law):
    p = [waited(law, WAITING[law][1].rvs(size=(40, 25), random_state=seed)).site_p_value for seed in range(4)]
    assert stats.binom.sf(np.sum(np.array(p) < 0.05) - 1, len(p), 0.05) > 1e-3
