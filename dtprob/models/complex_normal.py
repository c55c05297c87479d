"""Circularly symmetric complex normal distribution, the noise of a complex baseband measurement."""

from __future__ import annotations

import math
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import lax
from numpyro.distributions import Distribution, constraints
from numpyro.distributions.util import promote_shapes


class ComplexNormal(Distribution):
    """CN(loc, variance): independent real and imaginary parts, each of variance `variance` / 2.

    Density (per entry): exp(-|x - loc|^2 / variance) / (pi variance).

    Args:
        loc: complex mean.
        variance: E |x - loc|^2, positive, in the square of the unit of x. Broadcast against `loc`.
    """

    arg_constraints = {"loc": constraints.complex, "variance": constraints.positive}  # noqa: RUF012
    support = constraints.complex  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]
    reparametrized_params = ["loc", "variance"]  # noqa: RUF012
    pytree_data_fields = ("loc", "_variance")

    def __init__(self, loc: Any, variance: Any, *, validate_args: bool | None = None) -> None:
        self.loc: Any
        self._variance: Any
        self.loc, self._variance = promote_shapes(loc, variance)
        shape = lax.broadcast_shapes(jnp.shape(loc), jnp.shape(variance))
        super().__init__(batch_shape=shape, validate_args=validate_args)

    def sample(self, key: jax.Array | None, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws of shape sample_shape + batch_shape; the key is needed."""
        dtype = jnp.result_type(self.loc, jnp.complex64)
        noise = jax.random.normal(cast("jax.Array", key), sample_shape + self.batch_shape, dtype)
        return self.loc + jnp.sqrt(self.variance) * noise

    def log_prob(self, value: Any) -> jax.Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density per entry, in nats."""
        residual = value - self.loc
        square = jnp.real(residual) ** 2 + jnp.imag(residual) ** 2
        return -square / self.variance - jnp.log(self.variance) - math.log(math.pi)

    @property
    def variance(self) -> jax.Array:
        """E |x - loc|^2."""
        return self._variance

    @property
    def mean(self) -> jax.Array:
        """The location, broadcast to the batch shape."""
        return jnp.broadcast_to(self.loc, self.batch_shape)
