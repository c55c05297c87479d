"""A distribution of a user's own: the envelope of a line of sight in Rayleigh fading, which NumPyro lacks."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax.scipy.special import i0e
from numpyro.distributions import constraints
from numpyro.distributions.util import promote_shapes


class Rice(dist.Distribution):
    """The length of a complex number of mean `sight` and of standard deviation `scatter` along each axis."""

    arg_constraints: ClassVar = {"sight": constraints.positive, "scatter": constraints.positive}
    support = constraints.positive

    def __init__(self, sight, scatter, *, validate_args=None):
        self.sight, self.scatter = promote_shapes(sight, scatter)
        shape = jax.lax.broadcast_shapes(jnp.shape(sight), jnp.shape(scatter))
        super().__init__(batch_shape=shape, validate_args=validate_args)

    def sample(self, key, sample_shape=()):
        parts = jax.random.normal(key, (2, *sample_shape, *self.batch_shape)) * self.scatter
        return jnp.hypot(parts[0] + self.sight, parts[1])

    def log_prob(self, value):
        power = self.scatter**2
        away = (value - self.sight) ** 2 / (2 * power)
        return jnp.log(value / power) - away + jnp.log(i0e(value * self.sight / power))
