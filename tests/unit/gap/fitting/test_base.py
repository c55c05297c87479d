"""The fit that a diagnosis starts from leaves local optima, and stops looking where all ways lead to one mode."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize, stats

from dtprob.gap.fitting import base
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.model.problem import Problem
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import model

PLACES, TRUE, NOISE = np.linspace(0.0, 1.0, 40), 11.3, 0.5


@model(cluster="place", axes={"expected": ("place",), "y": ("place",)})
def tone(place, y=None):
    """A wave of unknown frequency: its likelihood has a peak every few radians."""
    frequency = numpyro.sample("frequency", dist.Normal(8.0, 8.0))
    expected = numpyro.deterministic("expected", jnp.sin(frequency * place))
    with numpyro.plate("place", len(PLACES)):
        numpyro.sample("y", dist.Normal(expected, NOISE), obs=y)


@pytest.fixture(scope="module")
def problem():
    y = np.sin(TRUE * PLACES) + NOISE * np.random.default_rng(1).normal(size=PLACES.size)
    return Problem(tone, {"place": jnp.asarray(PLACES), "y": jnp.asarray(y)}, [])


@pytest.fixture(scope="module")
def curve(problem):
    """Frequencies and the log density there, up to a constant, by its own formula."""
    grid = np.linspace(-24.0, 40.0, 12_801)
    misses = np.asarray(problem.data["y"]) - np.sin(np.outer(grid, PLACES))
    return grid, -0.5 * (misses**2).sum(1) / NOISE**2 - 0.5 * ((grid - 8.0) / 8.0) ** 2


def at(problem, frequency):
    x = problem.null()
    x[problem.layout["frequency"].index[0]] = frequency
    return x


def frequency(problem, fitted):
    return float(fitted.x[problem.layout["frequency"].index[0, 0]])


def test_the_curve_has_several_peaks(curve):
    assert len(base.local_maxima(curve[1])) >= 5


@pytest.mark.parametrize("seed", range(4))
def test_the_best_peak_is_found_from_any_draws(problem, curve, seed):
    grid, density = curve
    best = grid[density.argmax()]
    assert frequency(problem, base.fit_base(problem, jax.random.key(seed))) == pytest.approx(best, abs=0.02)


def test_one_start_at_a_wrong_peak_is_freed(problem, curve):
    grid, density = curve
    tops = base.local_maxima(density)
    wrong = grid[tops[np.argsort(density[tops])[-2]]]
    fitted = fitting.fit(problem, at(problem, wrong))
    assert frequency(problem, fitted) == pytest.approx(wrong, abs=0.05)
    freed = base.polish(problem, fitted)
    assert frequency(problem, freed) == pytest.approx(grid[density.argmax()], abs=0.02)
    assert freed.log_posterior > fitted.log_posterior + 1.0


def test_the_search_is_over_where_a_mode_that_was_freed_is_reached(problem, curve, monkeypatch):
    grid, density = curve
    tops = base.local_maxima(density)
    best = base.polish(problem, fitting.fit(problem, at(problem, grid[density.argmax()])))
    wrong = fitting.fit(problem, at(problem, grid[tops[np.argsort(density[tops])[-2]]]))
    looks = counted(monkeypatch, "_other_peaks")
    alone = base.polish(problem, wrong)
    without = len(looks)
    looks.clear()
    beside = base.polish(problem, wrong, freed=[best])
    assert len(looks) == without - 1  # no last look from the best mode
    assert frequency(problem, beside) == pytest.approx(frequency(problem, alone), abs=1e-6)
    looks.clear()
    assert base.polish(problem, best, freed=[best]) is best
    assert not looks


def test_no_third_start_is_freed_where_two_end_in_one_mode(problem, curve, monkeypatch):
    grid, density = curve
    tops = base.local_maxima(density)
    highest = tops[np.argsort(-density[tops])[:4]]
    fits = [fitting.fit(problem, at(problem, frequency)) for frequency in grid[highest]]
    monkeypatch.setattr(base, "_apart", lambda _: fits)
    freed = counted(monkeypatch, "polish")
    found = base.fit_base(problem, jax.random.key(0), polished=4)
    assert len(freed) == 2
    assert frequency(problem, found) == pytest.approx(grid[density.argmax()], abs=0.02)


@model(cluster="position", axes={"expected": ("position", "tone"), "channel": ("position", "tone")})
def echo(distance, frequency, channel=None):
    """An echo of unknown extra way, whose phase turns by a whole turn in each 5 cm: its gain's phase must turn with it."""
    gain = numpyro.sample("gain", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
    way = numpyro.sample("way", dist.Normal(20.0, 2.0))
    wave = jnp.exp(-2j * jnp.pi * frequency * (distance[:, None] + way) / 3e8) / distance[:, None]
    expected = numpyro.deterministic("expected", (gain[0] + 1j * gain[1]) * wave)
    with numpyro.plate("position", distance.size, dim=-2), numpyro.plate("tone", frequency.size, dim=-1):
        numpyro.sample("channel", ComplexNormal(expected, 1e-4), obs=channel)


@pytest.mark.study
def test_a_fit_that_crawls_along_a_ridge_is_followed_to_its_end():
    rng = np.random.default_rng(5)
    distance, frequency = rng.uniform(1, 3, 20), 6e9 + np.linspace(-5e7, 5e7, 12)
    true = 20.6
    wave = np.exp(-2j * np.pi * frequency * (distance[:, None] + true) / 3e8) / distance[:, None]
    noise = 1e-2 * (rng.normal(size=wave.shape) + 1j * rng.normal(size=wave.shape)) / np.sqrt(2)
    data = {"distance": distance, "frequency": frequency, "channel": 0.5 * wave + noise}
    problem = Problem(echo, {name: jnp.asarray(value) for name, value in data.items()}, [])
    start = problem.null()
    start[problem.layout["way"].index[0]] = 20.2
    crawling = fitting.fit(problem, start)
    assert not crawling.converged
    found = base.followed(problem, crawling)
    assert found.converged
    assert found.x[problem.layout["way"].index[0, 0]] == pytest.approx(true, abs=0.05)
    fitted = base.fit_base(problem, jax.random.key(0))
    assert fitted.converged
    assert fitted.log_posterior == pytest.approx(found.log_posterior, abs=0.1)


def counted(monkeypatch, name):
    """The calls of a function of the module, as they come."""
    calls, real = [], getattr(base, name)

    def call(*arguments, **named):
        calls.append(name)
        return real(*arguments, **named)

    monkeypatch.setattr(base, name, call)
    return calls


def tailed(x, offset, y=None):
    """A line whose errors have tails of an unknown power, at least `offset`."""
    level, slope = numpyro.sample("a", dist.Normal(0.0, 20.0)), numpyro.sample("b", dist.Normal(0.0, 10.0))
    spread, power = numpyro.sample("s", dist.HalfNormal(5.0)), numpyro.sample("nu", dist.Gamma(2.0, 0.1))
    mean = numpyro.deterministic("mean", level + slope * x)
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.StudentT(power + offset, mean, spread), obs=y)


@pytest.mark.study
@pytest.mark.parametrize("seed", range(3))
def test_a_step_does_not_lead_where_a_logarithm_is_endless(seed):
    """At nu = exp(-77) nothing leads back: fits ended 25 to 141 nats below the mode."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, 600)
    y = 30 + 8 * x + 3 * rng.standard_t(5, 600)

    def loss(at):
        spread, power = np.exp(at[2]), np.exp(at[3])
        likelihood = stats.t.logpdf(y, power + 1, at[0] + at[1] * x, spread).sum()
        prior = stats.norm.logpdf(at[0], 0, 20) + stats.norm.logpdf(at[1], 0, 10)
        prior += stats.halfnorm.logpdf(spread, 0, 5) + stats.gamma.logpdf(power, 2, scale=10) + at[2] + at[3]
        return -(likelihood + prior)

    known = optimize.minimize(loss, [30.0, 8.0, 1.0, 1.5], method="Nelder-Mead", options={"maxiter": 4000})
    problem = Problem(tailed, {"x": jnp.asarray(x), "offset": 1.0, "y": jnp.asarray(y)}, [], "row")
    found = base.fit_base(problem, jax.random.key(seed))
    assert found.log_posterior == pytest.approx(-known.fun, abs=0.1)
    assert found.converged


ANCHORS = jnp.array([[0.0, 0.0], [20.0, 0.0], [20.0, 12.0], [0.0, 12.0], [10.0, 6.0], [3.0, 6.0]])
EPOCHS = 40


@model(axes={"range": ("row",)}, cluster="epoch")
def ranging(epoch, anchor, measured=None):
    """A tag somewhere in a room, from ranges to six anchors at another height."""
    spread = numpyro.sample("spread", dist.HalfNormal(0.3))
    with numpyro.plate("epochs", EPOCHS):
        place = [numpyro.sample(name, dist.Uniform(0.0, side)) for name, side in (("x", 20.0), ("y", 12.0))]
    flat = [(p[epoch] - a[anchor]) ** 2 for p, a in zip(place, ANCHORS.T, strict=True)]
    expected = numpyro.deterministic("range", jnp.sqrt(sum(flat) + 4.0))
    with numpyro.plate("row", len(anchor)):
        numpyro.sample("measured", dist.Normal(expected, spread), obs=measured)


def test_places_at_the_wall_of_a_room_are_found():
    """Their coordinates ran away to where a uniform prior has no curvature, and nothing led back."""
    rng = np.random.default_rng(0)
    epoch, anchor = (i.reshape(-1) for i in np.meshgrid(np.arange(EPOCHS), np.arange(6), indexing="ij"))
    place = rng.uniform(0, [20.0, 12.0], (EPOCHS, 2))
    place[:6, 1] = 0.02
    flat = ((place[epoch] - np.asarray(ANCHORS)[anchor]) ** 2).sum(1)
    measured = np.sqrt(flat + 4.0) + 0.1 * rng.normal(size=len(epoch))
    data = {"epoch": jnp.asarray(epoch), "anchor": jnp.asarray(anchor), "measured": jnp.asarray(measured)}
    problem = Problem(ranging, data, [], "epoch")
    found = base.fit_base(problem, jax.random.key(0))
    sites = problem.compiled.sites(found.x)
    assert found.converged
    assert float(sites["spread"]) == pytest.approx(0.1 * (1 - 2 / 6) ** 0.5, rel=0.15)
    np.testing.assert_allclose(np.stack([sites["x"], sites["y"]], axis=1), place, atol=0.4)
