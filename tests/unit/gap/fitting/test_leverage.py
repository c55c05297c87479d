"""What fitting clusters' own unknowns takes off rows, and the scores beside them."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import special, stats

from dtprob.effects import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.leverage import lost
from dtprob.gap.fitting.marginal import own_mode
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import view
from dtprob.inference.laplace import Laplace
from dtprob.models.declaration import model

KEY = jax.random.key(0)
PRIOR = 3.0
SOUND = {"slope": 1.0, "noise": 1.0, "own": np.zeros((30, 1))}


def levels(x, seen, y=None):
    """Readings about levels of a known spread; some are not taken."""
    slope = numpyro.sample("slope", dist.Normal(0.0, 3.0))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.7))
    with numpyro.plate("link", x.shape[0], dim=-2):
        own = numpyro.sample("own", dist.Normal(0.0, PRIOR))
        with numpyro.plate("reading", x.shape[1], dim=-1):
            mean = numpyro.deterministic("mean", own + slope * x)
            deviation = numpyro.deterministic("deviation", noise * jnp.ones(x.shape))
            numpyro.sample("y", dist.Normal(mean, deviation).mask(seen), obs=y)


def noisier(which):
    return Effect(
        "noisier",
        {"deviation": lambda v, p, c: v * jnp.exp(p["size"] * jnp.asarray(which)[:, None])},
        (Parameter("size", dist.Normal(0.0, 0.5)),),
    )


def hill():
    return Effect(
        "hill",
        {"mean": lambda value, p, context: value + p["size"] * (context["x"] ** 2 - 1)},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
        requires=("x",),
    )


def drawn(links, readings, seed, few=()):
    """Data of the model; links of `few` have two readings only."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(links, readings))
    y = PRIOR * rng.normal(size=(links, 1)) + x + rng.normal(size=x.shape)
    seen = np.ones(x.shape, bool)
    seen[list(few), 2:] = False
    return {"x": jnp.asarray(x), "seen": jnp.asarray(seen), "y": jnp.asarray(y)}


@pytest.mark.study
def test_squares_are_lower_by_the_leverage():
    """Mean of the rows at modes of the levels, over data sets, with the noise as it is."""
    few, sets, rows = range(15), 20, 0.0
    for seed in range(sets):
        problem = Problem(levels, drawn(30, 6, seed, few), [])
        x, _ = own_mode(problem, activate(problem), problem.start(SOUND))
        held = Fit(x, (), {}, 0.0, 0.0, np.eye(2), activate(problem).global_index, True)
        taken = lost(problem, held, project(problem, held))
        rows = rows + (np.asarray(problem.compiled.residual(x)) + taken) / sets
    spreads = problem.rows.by_cluster(problem.rows.located) == 0
    for part in (range(15), range(15, 30)):
        mean = rows[list(part)][spreads[list(part)]]
        counted = mean[mean != 0]
        assert abs(counted.mean()) < 4 / np.sqrt(sets * counted.size)


def test_scores_are_those_of_generalised_least_squares():
    """Levels of a known spread integrated out: u = W' V^-1 (y - G g), V = noise + levels."""
    problem = Problem(levels, drawn(12, 3, 4), [])
    at = fitting.fit(problem, problem.start({**SOUND, "own": np.zeros((12, 1))}))
    projection = project(problem, at)
    rng = np.random.default_rng(1)
    w, e = rng.normal(size=(*projection.columns.shape[:2], 2)), rng.normal(size=projection.columns.shape[:2])
    flat = lambda a: a.reshape(-1, a.shape[-1])  # noqa: E731
    own = projection.local_columns
    blocks = [np.eye(own.shape[1]) + PRIOR**2 * one @ one.T for one in own]
    sites = problem.compiled.sites(at.x)
    assert float(sites["noise"]) > 0
    inverse = np.zeros((own.shape[0] * own.shape[1],) * 2)
    for c, block in enumerate(blocks):
        part = slice(c * own.shape[1], (c + 1) * own.shape[1])
        inverse[part, part] = np.linalg.inv(block)
    columns = flat(projection.columns)
    prior = np.linalg.inv(projection.global_inverse) - columns.T @ inverse @ columns
    estimate = np.linalg.solve(columns.T @ inverse @ columns + prior, columns.T @ inverse @ e.reshape(-1))
    expected = flat(w).T @ inverse @ (e.reshape(-1) - columns @ estimate)
    np.testing.assert_allclose(np.einsum("cmk,cm->k", w, projection.adjoint(e[None])[0]), expected, rtol=1e-6)
    cross = columns.T @ inverse @ flat(w)
    information = flat(w).T @ inverse @ flat(w) - cross.T @ projection.global_inverse @ cross
    np.testing.assert_allclose(projection.information(w)[0], information, rtol=1e-6)


@pytest.mark.study
@pytest.mark.parametrize(("links", "readings", "few"), [(400, 5, 0), (300, 10, 150)])
def test_many_small_clusters_ring_no_alarm(links, readings, few):
    which = np.arange(links) < links // 2
    data = drawn(links, readings, 7, range(few))
    settings = Settings(replicates=200)
    found = diagnose(levels, data, [noisier(which), hill()], key=KEY, engine=Laplace(), settings=settings)
    assert found.verdict == "NO_GAP"


@model(axes={"delay": ("row",), "offset": ("row",)}, cluster="device")
def of_two_kinds(device, warm, time=None, frequency=None):
    """Two readings of each kind, the one observed first coming later in the alphabet, and levels of one of them."""
    noise = {n: numpyro.sample(f"noise_{n}", dist.LogNormal(0.0, 0.7)) for n in ("time", "frequency")}
    slope = numpyro.sample("slope", dist.Normal(0.0, 3.0))
    with numpyro.plate("devices", 300):
        own = numpyro.sample("own", dist.Normal(0.0, PRIOR))
    delay = numpyro.deterministic("delay", own[device] + slope * warm)
    offset = numpyro.deterministic("offset", 0.0 * warm)
    with numpyro.plate("row", len(device)):
        numpyro.sample("time", dist.Normal(delay, noise["time"]), obs=time)
        numpyro.sample("frequency", dist.Normal(offset, noise["frequency"]), obs=frequency)


@pytest.mark.study
def test_what_levels_take_is_taken_from_the_site_that_they_act_on():
    """Where observed sites are not in the order of the alphabet it was given to another: 11 of 11 right twins rang."""
    rng = np.random.default_rng(0)
    device = np.repeat(np.arange(300), 3)
    warm, time, frequency = rng.normal(size=(3, len(device)))
    data = {
        "device": device,
        "warm": warm,
        "time": time + PRIOR * rng.normal(size=300)[device],
        "frequency": frequency,
    }
    data = {n: jnp.asarray(v) for n, v in data.items()}
    problem = Problem(of_two_kinds, data, [], "device")
    at = fitting.fit(problem, problem.null())
    taken = problem.rows.by_site(lost(problem, at, project(problem, at)))
    assert np.abs(taken["frequency"]).max() == 0
    assert taken["time"][problem.located["time"]].mean() > 0.1
    found = diagnose(
        of_two_kinds, data, [], key=KEY, engine=Laplace(), settings=Settings(replicates=200), cluster="device"
    )
    assert found.verdict == "NO_GAP"


@pytest.mark.study
def test_scores_beside_levels_have_the_spread_that_they_claim():
    """z of a candidate over data sets without it, with two readings of each level."""
    z = []
    for seed in range(12):
        problem = Problem(levels, drawn(60, 2, 100 + seed), [hill()])
        start = based(problem, KEY)
        seen = view(start.problem, start.fitted, KEY, Settings(replicates=50, site_replicates=39))
        z.append(float(seen.screening.z[0]))
    low, high = stats.chi2.ppf([0.0005, 0.9995], len(z)) / len(z)
    assert low < np.mean(np.square(z)) < high


LAWS = {
    "Gamma": lambda mean: dist.Gamma(5.0 * jnp.ones(()), 5.0 / mean),
    "Poisson": dist.Poisson,
    "Normal": lambda mean: dist.Normal(mean, 2.0),
    "LogNormal": lambda mean: dist.LogNormal(jnp.log(mean), 0.4),
    "NegativeBinomial": lambda mean: dist.NegativeBinomial2(mean, 6.0),
}


def within_an_exponential(law):
    """Levels of devices act within an exponential, of which the site is."""

    def model(queue, y=None):
        common = numpyro.sample("common", dist.Normal(2.0, 1.0))
        slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
        with numpyro.plate("device", queue.shape[0], dim=-2):
            own = numpyro.sample("own", dist.Normal(0.0, 0.4))
            with numpyro.plate("packet", queue.shape[1], dim=-1):
                mean = numpyro.deterministic("mean", jnp.exp(common + own + slope * queue))
                numpyro.sample("y", LAWS[law](mean), obs=y)

    return model


def offset():
    return Effect(
        "offset",
        {"mean": lambda value, p, context: value + p["size"] * (1 + context["queue"] ** 2)},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
        requires=("queue",),
    )


def factor():
    return Effect(
        "factor",
        {"mean": lambda value, p, context: value * jnp.exp(p["size"] * context["queue"] ** 2)},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
        requires=("queue",),
    )


def power():
    return Effect(
        "power",
        {"mean": lambda value, p, _: value * jnp.exp(p["size"] * jnp.log(value) ** 2)},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
    )


def waits(law, seed, devices=60, packets=8):
    rng = np.random.default_rng(seed)
    queue = rng.uniform(-1, 1, (devices, packets))
    mean = np.exp(2.0 + 0.4 * rng.normal(size=(devices, 1)) + 0.5 * queue)
    y = LAWS[law](jnp.asarray(mean)).sample(jax.random.key(seed))
    return {"queue": jnp.asarray(queue), "y": y}


def of_counts(mean, concentration):
    """Root of the information that a negative binomial count has on its concentration, by enumeration."""
    count = np.arange(2000.0)
    probability = stats.nbinom.pmf(count, concentration, concentration / (concentration + mean))
    score = special.digamma(count + concentration) - special.digamma(concentration)
    score += np.log(concentration / (concentration + mean)) + (mean - count) / (concentration + mean)
    return np.sqrt((probability * score**2).sum())


def information(law, mean):
    """Of one reading on the logarithm of its mean, and its slope in whitened steps of the spread."""
    if law == "LogNormal":
        return np.full(mean.shape, 0.4**-2), np.full(mean.shape, -np.sqrt(2) * 0.4**-2)
    if law == "Gamma":
        return np.full(mean.shape, 5.0), np.full(mean.shape, (special.polygamma(1, 5.0) - 1 / 5.0) ** -0.5)
    total = 6.0 + mean
    return mean * 6.0 / total, mean**2 / total**2 / np.vectorize(of_counts)(mean, 6.0)


@pytest.mark.study
@pytest.mark.parametrize("law", ["Gamma", "LogNormal", "NegativeBinomial"])
def test_what_is_lost_is_the_slope_of_the_curvature_of_own_unknowns(law):
    """Of -1/2 log H, H the information on a level within an exponential and its prior's, by the closed form of each law."""
    problem = Problem(within_an_exponential(law), waits(law, 3, 5, 4), [])
    x = problem.start({"common": 1.8, "slope": 0.4, "own": np.linspace(-0.5, 0.5, 5)[:, None]})
    held = Fit(x, (), {}, 0.0, 0.0, np.eye(2), activate(problem).global_index, True)
    rows = lost(problem, held, project(problem, held))
    own, by_spread = information(law, np.asarray(problem.compiled.sites(x)["mean"]))
    expected = -0.5 * by_spread / (own.sum(axis=1, keepdims=True) + 0.4**-2)
    is_location = problem.rows.by_cluster(problem.rows.located) == 1
    np.testing.assert_allclose(rows[~is_location], expected.reshape(-1), rtol=1e-3)  # of a quadrature
    assert (rows[is_location] == 0).all()


@pytest.mark.study
@pytest.mark.parametrize("law", ["Normal", "Gamma", "Poisson"])
def test_scores_beside_levels_within_an_exponential_have_mean_zero(law):
    """z of a candidate that adds to the site, and of the site itself, over data sets without it."""
    z, p = [], []
    for seed in range(6):
        problem = Problem(within_an_exponential(law), waits(law, 100 + seed), [offset(), factor(), power()])
        start = based(problem, KEY)
        seen = view(start.problem, start.fitted, KEY, Settings(replicates=99, site_replicates=99))
        z.append(seen.screening.z)
        p.append(seen.location.site_p_value)
    _, high = stats.chi2.ppf([0.0005, 0.9995], len(z)) / len(z)
    assert (np.mean(np.square(z), axis=0) < high).all()
    assert (np.abs(np.mean(z, axis=0)) < stats.norm.isf(0.0005) / np.sqrt(len(z))).all()
    assert stats.binom.sf(np.sum(np.array(p) < 0.05) - 1, len(p), 0.05) > 1e-3
