"""Distributions that effects put in the place of a model's own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import lax
from numpyro.distributions import Distribution, constraints

from dtprob.wrapping import unwrapped, wrapped


class ComplexStudentT(Distribution):
    """Circularly symmetric complex Student t with 2 / tail degrees of freedom; complex normal at tail 0.

    Density: (1 / (pi s)) (1 + tail q)^(-1 - 1/tail), q = |x - loc|^2 / s, s = variance / (1 + tail). The
    scale is chosen so that, to first order in `tail`, E |x - loc|^2 = variance. Source: Ollila et al.,
    Complex elliptically symmetric distributions, IEEE Trans. Signal Process. 60 (2012), sec. IV.A.

    Args:
        loc: complex mean.
        variance: positive, in the square of the unit of x. Broadcast against `loc`.
        tail: 2 / degrees of freedom, zero or more.
    """

    arg_constraints = {  # noqa: RUF012
        "loc": constraints.complex,
        "variance": constraints.positive,
        "tail": constraints.nonnegative,
    }
    support: Any = constraints.complex  # pyright: ignore[reportIncompatibleMethodOverride]
    reparametrized_params = ["loc", "variance"]  # noqa: RUF012
    pytree_data_fields = ("loc", "_variance", "tail")

    def __init__(self, loc: Any, variance: Any, tail: Any, *, validate_args: bool | None = None) -> None:
        self.loc, self._variance, self.tail = map(jnp.asarray, (loc, variance, tail))
        shape = lax.broadcast_shapes(jnp.shape(loc), jnp.shape(variance), jnp.shape(tail))
        super().__init__(batch_shape=shape, validate_args=validate_args)

    def sample(self, key: jax.Array | None, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws of shape sample_shape + batch_shape; q is Pareto, whose quantiles have a closed form."""
        turn_key, size_key = jax.random.split(cast("jax.Array", key))
        shape, dtype = sample_shape + self.batch_shape, jnp.result_type(self.variance, jnp.float32)
        exponential = jax.random.exponential(size_key, shape, dtype)
        square = exponential * _ratio(jnp.expm1, self.tail * exponential)
        turn = jax.random.uniform(turn_key, shape, dtype, 0.0, 2 * math.pi)
        size = jnp.sqrt(square * self.variance / (1.0 + self.tail))
        return self.loc + lax.complex(size * jnp.cos(turn), size * jnp.sin(turn))

    def log_prob(self, value: Any, intermediates: Any = None) -> jax.Array:  # noqa: ARG002
        """Log density per entry, in nats."""
        residual = value - self.loc
        scale = self.variance / (1.0 + self.tail)
        square = (jnp.real(residual) ** 2 + jnp.imag(residual) ** 2) / scale
        spread = self.tail * square
        return -square * _ratio(jnp.log1p, spread) - jnp.log1p(spread) - jnp.log(scale) - math.log(math.pi)

    @property
    def variance(self) -> jax.Array:
        """The parameter `variance`: E |x - loc|^2 where the tail is light."""
        return self._variance

    @property
    def mean(self) -> jax.Array:
        """The location, broadcast to the batch shape; the mean where tail < 2."""
        return jnp.broadcast_to(self.loc, self.batch_shape)


def replace_base(fn: Any, make: Callable[[Any], Distribution]) -> Distribution:
    """A distribution with its innermost part replaced; events, expansions by plates and masks stay.

    Args:
        fn: the distribution at a sample site.
        make: gives the new innermost distribution, of the same batch and event shape, from the old one.
    """
    inner, mask = unwrapped(fn)
    return wrapped(make(inner), fn, mask)


_SERIES = {jnp.log1p: (1.0, -1 / 2, 1 / 3, -1 / 4), jnp.expm1: (1.0, 1 / 2, 1 / 6, 1 / 24)}


def _ratio(function: Any, x: jax.Array) -> jax.Array:
    """function(x) / x, by its series near 0, where the quotient loses digits and its derivative is 0 / 0."""
    near = jnp.abs(x) < 1e-3
    safe = jnp.where(near, 1.0, x)
    small = jnp.where(near, x, 0.0)
    series = jnp.polyval(jnp.asarray(_SERIES[function][::-1], small.dtype), small)
    return jnp.where(near, series, function(safe) / safe)
