"""What fitting clusters' own unknowns does to residuals: their squares, and scores beside an informative prior."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.leverage import lost_spread
from dtprob.gap.fitting.marginal import own_mode
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.volume import Volume
from dtprob.gap.settings import Settings
from dtprob.gap.view import view
from dtprob.inference.laplace import Laplace

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


def test_squares_are_lower_by_the_leverage():
    """Mean of the rows at modes of the levels, over data sets, with the noise as it is."""
    few, sets, rows = range(15), 20, 0.0
    volume = Volume(np.zeros(2), np.zeros(30), np.zeros((30, 2)), np.zeros((30, 2, 2)))
    for seed in range(sets):
        problem = Problem(levels, drawn(30, 6, seed, few), [])
        x, _ = own_mode(problem, activate(problem), problem.start(SOUND))
        held = Fit(x, (), {}, 0.0, 0.0, np.eye(2), activate(problem).global_index, True)
        lost = lost_spread(problem.with_volume(volume), project(problem, held))
        rows = rows + (np.asarray(problem.compiled.residual(x)) + lost) / sets
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


@pytest.mark.parametrize(("links", "readings", "few"), [(400, 5, 0), (300, 10, 150)])
def test_many_small_clusters_ring_no_alarm(links, readings, few):
    which = np.arange(links) < links // 2
    data = drawn(links, readings, 7, range(few))
    settings = Settings(replicates=200)
    found = diagnose(levels, data, [noisier(which), hill()], key=KEY, engine=Laplace(), settings=settings)
    assert found.verdict == "NO_GAP"


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
