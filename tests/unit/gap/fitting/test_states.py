"""One series with a state for each reading: the fit, scores and sizes, against closed forms where all is normal."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize, stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting.bootstrap import observed_rows
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.projection import project
from dtprob.gap.fitting.states import held, states, states_following, states_mode
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace

COUNT = 160
SETTINGS = Settings(replicates=200, site_replicates=39, candidates=2, max_effects=1, polished=1)
TIMES = np.arange(1, COUNT + 1)
WALK = np.minimum.outer(TIMES, TIMES)
"""Covariance of a walk of unit steps."""
DOOR = Effect(
    "door",
    {"level": lambda level, p, context: level - p["loss"] * context["door"]},
    (Parameter("loss", dist.Normal(0.0, 5.0), unit="dB"),),
    physics="A door is shut.",
    source="A constant loss.",
    requires=("door",),
)
WIDE = {"slope": 1.0, "step": 3.0, "noise": 3.0}
"""Of the priors."""


def survey(distance, door, y=None):
    """dB along a drive; the shadowing walks from reading to reading."""
    step = numpyro.sample("step", dist.HalfNormal(WIDE["step"]))
    noise = numpyro.sample("noise", dist.HalfNormal(WIDE["noise"]))
    slope = numpyro.sample("slope", dist.Normal(0.0, WIDE["slope"]))
    shadowing = numpyro.sample("shadowing", dist.GaussianRandomWalk(step, num_steps=len(distance)))
    level = numpyro.deterministic("level", -slope * distance + shadowing)
    with numpyro.plate("time", len(distance)):
        numpyro.sample("y", dist.Normal(level, noise), obs=y)


def packets(distance, door, y=None):
    """Counts whose rate walks."""
    step = numpyro.sample("step", dist.HalfNormal(0.3))
    offset = numpyro.sample("offset", dist.Normal(2.0, 2.0))
    shadowing = numpyro.sample("shadowing", dist.GaussianRandomWalk(step, num_steps=len(distance)))
    level = numpyro.deterministic("level", offset - 0.2 * distance + shadowing)
    with numpyro.plate("time", len(distance)):
        numpyro.sample("y", dist.Poisson(jnp.exp(level)), obs=y)


def drive(loss, seed, model=survey):
    """Data by NumPy alone."""
    rng = np.random.default_rng(seed)
    distance = 2 * np.sin(TIMES / 17) + 0.3 * rng.standard_normal(COUNT)
    door = ((TIMES // 11) % 3 == 1).astype(float)
    walk = np.cumsum(rng.standard_normal(COUNT))
    if model is survey:
        y = -1.3 * distance + 0.3 * walk - loss * door + rng.standard_normal(COUNT)
    else:
        y = rng.poisson(np.exp(2.0 - 0.2 * distance + 0.1 * walk - loss * door))
    return {"distance": jnp.asarray(distance), "door": jnp.asarray(door), "y": jnp.asarray(y)}


def log_marginal(data, step, noise, slope):
    """Log density of data and priors, walk integrated out, in the unconstrained coordinates of a fit."""
    y = np.asarray(data["y"]) + slope * np.asarray(data["distance"])
    density = stats.multivariate_normal(np.zeros(COUNT), step**2 * WALK + noise**2 * np.eye(COUNT)).logpdf(y)
    priors = stats.halfnorm(0, WIDE["step"]).logpdf(step) + np.log(step)
    priors += stats.halfnorm(0, WIDE["noise"]).logpdf(noise) + np.log(noise)
    return density + priors + stats.norm(0, WIDE["slope"]).logpdf(slope)


@pytest.fixture(scope="module")
def fitted():
    """The data, the problem with its states integrated out, its fit."""
    data = drive(1.5, seed=3)
    start = based(Problem(survey, data, (DOOR,)), jax.random.key(0), polished=1)
    return data, start.problem, start.fitted


@pytest.mark.study
def test_the_walk_is_what_is_integrated_out(fitted):
    _, problem, _ = fitted
    assert [b.name for b in states(problem).blocks] == ["shadowing_decentered"]
    assert len(held(problem)) == 3


def test_the_fit_is_the_mode_of_the_marginal_density(fitted):
    data, problem, fit = fitted
    sites = problem.compiled.sites(fit.x)
    found = [float(sites[name]) for name in ("step", "noise", "slope")]

    def loss(u):
        return -log_marginal(data, np.exp(u[0]), np.exp(u[1]), u[2])

    best = optimize.minimize(
        loss, [np.log(found[0]), np.log(found[1]), found[2]], method="Nelder-Mead", options={"xatol": 1e-4}
    )
    assert loss([np.log(found[0]), np.log(found[1]), found[2]]) - best.fun < 0.05
    assert np.allclose(found, [*np.exp(best.x[:2]), best.x[2]], rtol=0.1)


def test_score_and_information_are_those_of_the_marginal_density(fitted):
    data, problem, fit = fitted
    sites = problem.compiled.sites(fit.x)
    step, noise = float(sites["step"]), float(sites["noise"])
    inverse = np.linalg.inv(step**2 * WALK + noise**2 * np.eye(COUNT))
    x, door = np.asarray(data["distance"]), np.asarray(data["door"])
    precision = x @ inverse @ x + WIDE["slope"] ** -2.0
    slope = -x @ inverse @ np.asarray(data["y"]) / precision
    score = -door @ inverse @ (np.asarray(data["y"]) + slope * x)
    information = door @ inverse @ door - (door @ inverse @ x) ** 2 / precision

    projection = project(problem, fit)
    tangent = np.zeros((COUNT, 2))
    tangent[:, 0] = -door / noise
    raw, rows = observed_rows(problem, fit, projection)
    assert (tangent * rows).sum() == pytest.approx(score, rel=2e-3)
    assert (tangent * projection.adjoint(raw[None])[0]).sum() == pytest.approx(score, rel=2e-3)
    found, _ = projection.information(tangent[..., None])
    assert found[0, 0] == pytest.approx(information, rel=2e-3)


def test_states_follow_what_is_fitted(fitted):
    """As their mode does, found again a small step away."""
    _, problem, fit = fitted
    bare = problem.with_volume(None)
    free = held(bare)
    x, _ = states_mode(bare, states(bare), fit.x, tolerance=1e-12)
    along = states_following(bare, x, free)
    for i, unit in enumerate(np.eye(len(free))):
        up, down = (x.copy() for _ in range(2))
        up[free] += 0.03 * unit
        down[free] -= 0.03 * unit
        apart = np.subtract(*(states_mode(bare, states(bare), at, tolerance=1e-14)[0] for at in (up, down)))
        np.testing.assert_allclose(along[:, i], apart / 0.06, atol=2e-3)


def test_squares_lose_their_leverage(fitted):
    """Residuals at the mode of the walk are smaller than the noise; data sets drawn at the fit are not."""
    _, problem, fit = fitted
    projection = project(problem, fit)
    squares = observed_rows(problem, fit, projection)[0][:, 1]
    residual = np.asarray(problem.compiled.residual(fit.x))[:, 1]
    assert residual.mean() < -0.1
    assert abs(squares.mean()) < 0.1


@pytest.mark.study
@pytest.mark.parametrize("model", [survey, packets], ids=lambda m: m.__name__)
def test_a_right_series_has_no_gap_and_a_door_is_named(model):
    engine = Laplace(draws=300)
    right, wrong = drive(0.0, 5, model), drive(1.6 if model is survey else 0.8, 6, model)
    said = diagnose(model, right, (DOOR,), key=jax.random.key(1), engine=engine, settings=SETTINGS)
    assert said.verdict == "NO_GAP"
    said = diagnose(model, wrong, (DOOR,), key=jax.random.key(1), engine=engine, settings=SETTINGS)
    assert said.verdict == "LISTED"
    size = said.causes[0].size[0]
    assert size.low < (1.6 if model is survey else 0.8) < size.high


def test_more_parameters_than_data_are_refused():
    def model(table, y=None):
        weight = numpyro.sample("weight", dist.Cauchy(0.0, 1.0).expand([40]).to_event(1))
        level = numpyro.deterministic("level", table @ weight)
        with numpyro.plate("row", 20):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    data = {"table": jnp.ones((20, 40)), "y": jnp.zeros(20)}
    shift = Effect(
        "shift",
        {"level": lambda level, p, _: level + p["size"]},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
    )
    with pytest.raises(InputError, match="fewer unknowns"):
        diagnose(model, data, (shift,), key=jax.random.key(0), engine=Laplace(draws=10))
