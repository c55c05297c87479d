"""Steps by the curvature of the log posterior itself arrive beside a wrong twin, where those of Gauss and Newton do not."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.fitting import marginal
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.density import cluster_terms, curved, system_at, terms_of
from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.marginal import following, own_mode
from dtprob.gap.model.problem import Problem

LINKS, PATHS, READINGS = 12, 4, 24


def waves(delay, y=None):
    """Paths of unknown phases over a band, and one unknown strength."""
    strength = numpyro.sample("strength", dist.LogNormal(0.0, 0.3))
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("path", PATHS, dim=-1):
        phase = numpyro.sample("phase", dist.Normal(0.0, 1.0))
    turn = phase[..., None] - delay[..., None] * jnp.arange(READINGS)
    mean = strength * jnp.cos(turn).sum(1)
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        numpyro.sample("y", dist.Normal(mean, 0.1), obs=y)


@pytest.fixture(scope="module")
def problem():
    """Its delays are far too short: no phases fit."""
    rng = np.random.default_rng(0)
    delay = np.linspace(0.1, 1.0, PATHS) + 0.1 * rng.random((LINKS, PATHS))
    phase = rng.normal(size=(LINKS, PATHS))
    y = np.cos(phase[..., None] - 1.7 * delay[..., None] * np.arange(READINGS)).sum(1)
    y += 0.1 * rng.normal(size=y.shape)
    return Problem(waves, {"delay": jnp.asarray(delay), "y": jnp.asarray(y)}, [])


@pytest.fixture(scope="module")
def point(problem):
    return problem.null() + 0.2 * np.random.default_rng(1).normal(size=problem.dimension)


def differences(problem, active, x, step=1e-4):
    """Minus the Hessian of the weighted log posterior, by differences of its values."""

    def value(x):
        terms = terms_of(problem, active, x)
        return terms[0] + np.asarray(active.weights) @ terms[1:]

    units = step * np.eye(len(x))
    corners = [[[value(x + s * a + t * b) for t in (1, -1)] for s in (1, -1)] for a in units for b in units]
    (up, mixed), (other, down) = np.moveaxis(np.array(corners), 0, -1)
    return -(up - mixed - other + down).reshape(len(x), len(x)) / (4 * step**2)


def test_curvature_is_that_of_the_log_posterior(problem, point):
    weights = np.array([1.0, 0.5, *np.ones(LINKS - 2)])
    active = activate(problem, weights=weights)
    expected = differences(problem, active, point)
    everywhere = np.eye(problem.dimension)
    np.testing.assert_allclose(
        problem.compiled.curvature(point, weights, everywhere), expected, atol=2e-3 * np.abs(expected).max()
    )
    system = curved(problem, active, point, system_at(problem, active, point))
    index, own = active.global_index, active.local_index
    np.testing.assert_allclose(system.curvature, expected[np.ix_(index, index)], rtol=1e-3)
    for c, weight in enumerate(weights):
        size = np.abs(expected).max()
        np.testing.assert_allclose(
            system.local[c], expected[np.ix_(own[c], own[c])] / weight, atol=4e-3 * size
        )
        np.testing.assert_allclose(
            system.cross[c], expected[np.ix_(index, own[c])] / weight, atol=4e-3 * size
        )


def test_clusters_that_are_left_out_keep_their_curvatures(problem, point):
    weights = np.array([0.0, *np.ones(LINKS - 1)])
    active = activate(problem, weights=weights)
    system = system_at(problem, active, point)
    np.testing.assert_array_equal(curved(problem, active, point, system).local[0], system.local[0])


def test_own_unknowns_arrive_beside_a_wrong_twin(problem):
    active = activate(problem)
    x, _ = own_mode(problem, active, problem.null(), tolerance=1e-9)
    system = curved(problem, active.own, x, system_at(problem, active.own, x))
    left = np.linalg.solve(system.local, system.local_gradient[..., None])[..., 0]
    assert np.abs(left * np.sqrt(np.einsum("cii->ci", system.local))).max() < 1e-3


def test_fit_arrives_beside_a_wrong_twin(problem):
    found = fit(problem, problem.null(), steps=100)
    assert found.converged
    active = activate(problem)
    system = system_at(problem, active, found.x)
    curvature = differences(problem, active, found.x)
    gradient = np.zeros(problem.dimension)
    gradient[active.global_index], gradient[active.local_index] = system.gradient, system.local_gradient
    assert gradient @ np.linalg.solve(curvature, gradient) < 1e-2
    assert np.linalg.eigvalsh(curvature).min() > 0


def readings(angle, y=None):
    """Some hundred readings a link of a tiny unit: a log density of thousands of nats, whose last digits say nothing."""
    scale = 1e-8
    spread = numpyro.sample("spread", dist.LogNormal(0.0, 0.1))
    with numpyro.plate("link", LINKS, dim=-2):
        turn = numpyro.sample("turn", dist.Normal(0.0, 1.0))
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", angle.shape[0], dim=-1):
        numpyro.sample("y", dist.Normal(scale * jnp.sin(turn + angle), scale * spread), obs=y)


def test_rounding_holds_no_mode_back(monkeypatch):
    """In single precision steps near the mode gain less than the log density can show; without that they take 11."""
    taken = []
    step = marginal.local_step
    monkeypatch.setattr(marginal, "local_step", lambda *given: taken.append(1) or step(*given))
    rng = np.random.default_rng(3)
    angle = rng.uniform(-1.0, 1.0, 400)
    with jax.enable_x64(False):
        y = 1e-8 * (np.sin(0.5 * rng.normal(size=(LINKS, 1)) + angle) + rng.normal(size=(LINKS, 400)))
        single = Problem(readings, {"angle": jnp.asarray(angle), "y": jnp.asarray(y)}, [])
        own_mode(single, activate(single), single.null(), tolerance=1e-7)
    assert len(taken) <= 7


def test_own_modes_follow_what_is_shared(problem):
    active = activate(problem)
    x, _ = own_mode(problem, active, problem.null(), tolerance=1e-12)
    index = active.global_index
    system, follow = following(problem, x, (), index)
    expected = []
    for sign in (1, -1):
        moved = x.copy()
        moved[index] += sign * 1e-4
        expected.append(own_mode(problem, active, moved, tolerance=1e-14, near=system)[0][active.local_index])
    told = follow[..., 0]
    np.testing.assert_allclose(told, (expected[0] - expected[1]) / 2e-4, atol=1e-3 * np.abs(told).max())


@pytest.mark.parametrize("far", [1e-3, 0.1, 0.3])
def test_kept_curvatures_lead_to_the_same_mode(problem, far):
    active = activate(problem)
    x, _ = own_mode(problem, active, problem.null(), tolerance=1e-12)
    system, _ = following(problem, x, (), active.global_index)
    moved = x.copy()
    moved[active.global_index] += far
    by_kept, kept = own_mode(problem, active, moved, tolerance=1e-12, near=system, steps=200)
    by_new, new = own_mode(problem, active, moved, tolerance=1e-12)
    np.testing.assert_allclose(
        cluster_terms(problem, active, by_kept), cluster_terms(problem, active, by_new), atol=1e-6
    )
    np.testing.assert_allclose(kept, new, rtol=1e-4, atol=1e-4 * np.abs(new).max())
