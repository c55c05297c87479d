"""Which unknowns belong to clusters: the model is asked, whatever their plate is called."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

LINKS, READINGS, NOISE = 40, 4, 0.5
_APART = np.abs(np.arange(LINKS)[:, None] - np.arange(LINKS))
ROOT = 2.0 * np.linalg.cholesky(np.exp(-0.5 * (_APART / 5.0) ** 2) + 1e-4 * np.eye(LINKS))


def observe(level, y):
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        expected = numpyro.deterministic("expected", level[:, None] + jnp.zeros((LINKS, READINGS)))
        numpyro.sample("y", dist.Normal(expected, noise), obs=y)


def independent(y=None):
    with numpyro.plate("link", LINKS):
        level = numpyro.sample("level", dist.Normal(0.0, 2.0))
    observe(level, y)


def elsewhere(y=None):
    """The levels' plate has another name, and other levels of that many entries act the other way round."""
    with numpyro.plate("where it is", LINKS):
        level = numpyro.sample("level", dist.Normal(0.0, 2.0))
        other = numpyro.sample("other", dist.Normal(0.0, 2.0))
    observe(level + other[::-1], y)


def process(y=None):
    """Independent draws in the links' plate that are made into a Gaussian process along them."""
    with numpyro.plate("link", LINKS):
        draws = numpyro.sample("draws", dist.Normal(0.0, 1.0))
    observe(jnp.asarray(ROOT) @ draws, y)


@model(axes={"level": ("link",)}, cluster="link")
def joint(y=None):
    observe(
        numpyro.sample("level", dist.MultivariateNormal(jnp.zeros(LINKS), scale_tril=jnp.asarray(ROOT))), y
    )


def data(seed):
    rng = np.random.default_rng(seed)
    level = ROOT @ rng.standard_normal(LINKS)
    return {"y": jnp.asarray(level[:, None] + NOISE * rng.standard_normal((LINKS, READINGS)))}


@pytest.mark.parametrize(
    ("made", "own"), [(independent, {"level"}), (elsewhere, {"level"}), (process, set()), (joint, set())]
)
def test_an_entry_belongs_to_a_cluster_if_nothing_else_depends_on_it(made, own):
    assert set(Problem(made, data(0), []).own) == own


def test_a_process_made_of_independent_draws_is_fitted_as_one():
    problem = Problem(process, data(0), [])
    fitted = fit_base(problem, jax.random.key(0))
    noise = float(problem.compiled.sites(fitted.x)["noise"])
    assert noise == pytest.approx(NOISE, rel=0.25)  # as each link's own, they left seven times as much


def test_a_column_that_fits_several_axes_names_none():
    def square(day, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("link", 16, dim=-2), numpyro.plate("time", 16, dim=-1):
            numpyro.sample("y", dist.Normal(level + 0.0 * day, 1.0), obs=y)

    given = {"day": jnp.arange(16.0) // 4, "y": jnp.zeros((16, 16))}
    with pytest.raises(InputError, match="'day', as long as link and time"):
        Problem(square, given, [], cluster="day")
