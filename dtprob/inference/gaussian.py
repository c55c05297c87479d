"""The exact posterior where the log density is quadratic: linear models with normal priors and known noise.

That it is quadratic is not read off the names of distributions but checked on the density itself, at points
near and far; a model where it is not is refused.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.laplace import LARGEST, Gaussian, approximate
from dtprob.inference.optimise import gradient_and_hessian
from dtprob.inference.target import Inputs, Target

_RADII = (0.3, 1.0, 3.0, 10.0)  # in units of the prior
_DIRECTIONS = 4


def gaussian_posterior(target: Target, inputs: Inputs, key: PRNGKeyArray) -> Gaussian:
    """The posterior over the coordinates, a normal distribution, with its evidence.

    Args:
        target: the model on data.
        inputs: its arrays.
        key: for the points at which the density is checked.

    Raises:
        InputError: an angle among the latent sites, too many coordinates, or a density that is not quadratic.
    """
    what = f"model {target.declaration.name} for engine exact"
    remedy = "Use another engine, such as nuts or laplace"
    if any(site.distribution == "Dirichlet" for site in target.declaration.latent.values()):
        remedy = "Sample tables of log probabilities from dtprob.models.dirichlet.LogDirichlet, or use nuts"
    expected = "Dirichlet tables under counts, or a normal posterior"
    if target.angles.size:
        raise InputError(what, expected, "an angle", remedy)
    if target.dimension > LARGEST:
        raise InputError(what, f"at most {LARGEST} coordinates", str(target.dimension), remedy)
    mode, departure = target.compiled(_quadratic)(key, inputs)
    tolerance = 100 * np.finfo(np.asarray(departure).dtype).eps ** 0.5
    if not np.all(np.asarray(departure) <= tolerance):
        raise InputError(what, expected, "a log density that is not quadratic", remedy)
    found: Gaussian = target.compiled(approximate)(mode, inputs)
    if int(found.replaced):
        raise InputError(what, expected, "a density that does not fall off everywhere", remedy)
    return found


def _quadratic(
    target: Target, key: PRNGKeyArray, inputs: Inputs
) -> tuple[Float[Array, " dimension"], Float[Array, " point"]]:
    """Where a quadratic's mode would be, and how far the slope is from linear at points, each entry by its own size."""

    def function(u: Array) -> Array:
        return -target.log_density(u, inputs)

    zero = jnp.zeros(target.dimension)
    slope, hessian = gradient_and_hessian(function, zero)
    mode = -jnp.linalg.solve(hessian, slope)
    # a coordinate that the data tell sharply must not hide another one
    size = 1 + jnp.abs(slope) + jnp.max(jnp.abs(hessian), axis=1)

    def look(radius: Array, key: PRNGKeyArray) -> Array:
        direction = jax.random.normal(key, zero.shape)
        u = radius * direction / jnp.sqrt(jnp.mean(direction**2))
        error = jnp.abs(jax.grad(function)(u) - slope - hessian @ u)
        return jnp.nan_to_num(jnp.max(error / size), nan=jnp.inf) / (1 + jnp.abs(radius))

    radii = jnp.tile(jnp.asarray([*_RADII, *(-radius for radius in _RADII)]), _DIRECTIONS)
    keys = jax.random.split(key, _DIRECTIONS)
    departure = jax.lax.map(lambda pair: look(*pair), (radii, jnp.repeat(keys, 2 * len(_RADII))))
    return mode, departure
