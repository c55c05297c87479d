"""A fit that took a loading, and the factors that it loads, for their mirror image is led to the other mode."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.fitting import base
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.mirrored import mirrored
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

DEVICES, READINGS = 40, 6


@model(axes={"delay": ("row",), "loss": ("row",)}, cluster="device")
def loaded(device, slow=None, lost=None):
    """Delays tell little of what each device has of its own, losses much; the loading tells how both go together."""
    loading = numpyro.sample("loading", dist.Normal(0.0, 1.0))
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    strength = numpyro.sample("strength", dist.HalfNormal(1.0))
    with numpyro.plate("devices", DEVICES):
        u = numpyro.sample("u", dist.Normal(0.0, 1.0))
    delay = numpyro.deterministic("delay", level + strength * u[device])
    loss = numpyro.deterministic("loss", loading * u[device])
    with numpyro.plate("row", len(device)):
        numpyro.sample("slow", dist.Normal(delay, 1.0), obs=slow)
        numpyro.sample("lost", dist.Normal(loss, 0.1), obs=lost)


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    device = np.repeat(np.arange(DEVICES), READINGS)
    u = rng.normal(size=DEVICES)[device]
    data = {
        "device": device,
        "slow": 0.3 + 0.5 * u + rng.normal(size=len(u)),
        "lost": 0.8 * u + 0.1 * rng.normal(size=len(u)),
    }
    return Problem(loaded, {n: jnp.asarray(v) for n, v in data.items()}, [], "device")


def loading_of(problem, fitted):
    return float(problem.compiled.sites(fitted.x)["loading"])


def wrong_mode(problem):
    start = problem.null()
    start[problem.layout.indices(["loading"])] = -0.8
    start[problem.layout.indices(["strength"])] = -3.0
    return fitting.fit(problem, start)


def test_the_mirror_image_of_a_mode_is_left(problem):
    wrong = wrong_mode(problem)
    assert loading_of(problem, wrong) < -0.5
    right = base.polish(problem, wrong)
    assert loading_of(problem, right) > 0.5
    assert right.log_posterior > wrong.log_posterior + 20


def test_only_what_multiplies_own_unknowns_is_mirrored(problem):
    x = wrong_mode(problem).x
    (other,) = mirrored(problem, x)
    u, loading = (problem.layout[name].index.reshape(-1) for name in ("u", "loading"))
    np.testing.assert_allclose(other[loading], -x[loading])
    np.testing.assert_allclose(other[u], -x[u], atol=0.1)  # about the median of prior draws
    rest = np.setdiff1d(np.arange(len(x)), [*u, *loading])
    np.testing.assert_array_equal(other[rest], x[rest])


@pytest.mark.study
@pytest.mark.parametrize("seed", range(4))
def test_the_base_fit_finds_the_right_mode(problem, seed):
    found = base.fit_base(problem, jax.random.key(seed))
    assert loading_of(problem, found) > 0.5
