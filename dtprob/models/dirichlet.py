"""Tables of probabilities with Dirichlet priors, held as logarithms, so that a concentration of .01 does not underflow.

A table's last axis runs over outcomes and each of its other entries is a row of its own. Outcomes that cannot happen
have log-probability -inf and no coordinate. Densities are with respect to the probabilities, not their logarithms, so
a mode is the textbook's: (n + a - 1) / sum (n + a - 1).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from numpyro.distributions import Distribution, biject_to, constraints
from numpyro.distributions.transforms import Transform
from scipy import special

from dtprob.errors import InputError


class LogSimplices(constraints.Constraint[Any]):
    """Tables whose rows are logarithms of probabilities, -inf exactly where an outcome cannot happen.

    Args:
        allowed: which outcomes can happen; every row has one or more.
    """

    def __init__(self, allowed: Bool[np.ndarray, "*row outcome"]) -> None:
        self.allowed = allowed
        self.event_dim = allowed.ndim

    def __call__(self, x: Any) -> jax.Array:
        """Whether each table of a batch is one, to 1e-4 in the sums."""
        x = jnp.asarray(x)
        rows = jax.nn.logsumexp(jnp.where(self.allowed, x, -jnp.inf), axis=-1)
        inside = jnp.all((x <= 1e-6) & (self.allowed | jnp.isneginf(x)), axis=-1) & (jnp.abs(rows) < 1e-4)
        return jnp.all(inside, axis=tuple(range(-(self.event_dim - 1), 0)))

    def feasible_like(self, prototype: Any) -> jax.Array:
        """The uniform table."""
        return jnp.broadcast_to(_uniform(self.allowed), jnp.shape(prototype))

    def tree_flatten(self) -> tuple[tuple[()], tuple[tuple[()], dict[str, Any]]]:
        """No arrays that are traced."""
        return (), ((), {"allowed": self.allowed, "event_dim": self.event_dim})

    def eq(self, other: object, static: bool = False) -> bool:  # noqa: ARG002  (NumPyro's signature)
        """Whether the other allows the same outcomes."""
        return isinstance(other, LogSimplices) and np.array_equal(self.allowed, other.allowed)


class LogRatios(Transform[Any]):
    """Log-ratios to the first outcome that can happen in each row, as one vector, to log-probabilities.

    Args:
        allowed: which outcomes can happen.
    """

    domain: Any = constraints.real_vector  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(self, allowed: Bool[np.ndarray, "*row outcome"]) -> None:
        self._allowed = allowed
        self._first = np.argmax(allowed, axis=-1)
        free = allowed.copy()
        np.put_along_axis(free, self._first[..., None], values=False, axis=-1)
        self._free = np.flatnonzero(free)

    @property
    def codomain(self) -> constraints.Constraint[Any]:
        """The tables."""
        return LogSimplices(self._allowed)

    def __call__(self, x: Any) -> jax.Array:
        """The table of a vector (..., coordinate)."""
        x = jnp.asarray(x)
        flat = jnp.zeros((*x.shape[:-1], self._allowed.size), x.dtype).at[..., self._free].set(x)
        table = jnp.where(self._allowed, flat.reshape(*x.shape[:-1], *self._allowed.shape), -jnp.inf)
        return table - jax.nn.logsumexp(table, axis=-1, keepdims=True)

    def _inverse(self, y: Any) -> jax.Array:
        y = jnp.asarray(y)
        first = np.broadcast_to(self._first[..., None], (*y.shape[:-1], 1))
        ratio = jnp.where(self._allowed, y, 0.0) - jnp.take_along_axis(y, first, axis=-1)
        return ratio.reshape(*y.shape[: y.ndim - self._allowed.ndim], -1)[..., self._free]

    def log_abs_det_jacobian(self, x: Any, y: Any, intermediates: Any = None) -> jax.Array:  # noqa: ARG002
        """Log volume of probabilities per unit of the vector: sum of the log-probabilities."""
        axes = tuple(range(-self._allowed.ndim, 0))
        return jnp.sum(jnp.where(self._allowed, y, 0.0), axis=axes)

    def forward_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of tables from that of vectors."""
        return (*shape[:-1], *self._allowed.shape)

    def inverse_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of vectors from that of tables."""
        return (*shape[: len(shape) - self._allowed.ndim], len(self._free))

    def tree_flatten(self) -> tuple[tuple[()], tuple[tuple[()], dict[str, Any]]]:
        """No arrays that are traced."""
        return (), ((), {"_allowed": self._allowed, "_first": self._first, "_free": self._free})

    def eq(self, other: object, static: bool = False) -> bool:  # noqa: ARG002  (NumPyro's signature)
        """Whether the other makes the same tables."""
        return isinstance(other, LogRatios) and self.codomain == other.codomain


_register = cast("Callable[[Any], Callable[[Any], Any]]", biject_to.register)
_register(LogSimplices)(lambda constraint: LogRatios(constraint.allowed))


class LogDirichlet(Distribution):
    """Rows of log-probabilities, each the logarithm of a Dirichlet variable, independent of one another.

    Args:
        concentration: of each outcome, broadcast over the table.
        allowed: which outcomes can happen.

    Raises:
        InputError: a row in which nothing can happen, or a concentration that is not above 0.
    """

    arg_constraints = {"concentration": constraints.positive}  # noqa: RUF012
    pytree_data_fields = ("concentration",)
    pytree_aux_fields = ("allowed",)

    def __init__(
        self,
        concentration: Any,
        allowed: Bool[np.ndarray, "*row outcome"],
        *,
        validate_args: bool | None = None,
    ) -> None:
        if isinstance(concentration, int | float) and not 0 < concentration < float("inf"):
            got = f"{concentration:g}"
            raise InputError("concentration of a Dirichlet law", "a finite number above 0", got, "Correct it")
        self.allowed = np.asarray(allowed, dtype=bool)
        if not self.allowed.any(axis=-1).all():
            row = tuple(int(i) for i in np.argwhere(~self.allowed.any(axis=-1))[0])
            remedy = "Allow an outcome in every row"
            raise InputError(
                "allowed outcomes of a table", "one or more in each row", f"none in {row}", remedy
            )
        self.concentration = jnp.broadcast_to(jnp.asarray(concentration, float), self.allowed.shape)
        super().__init__((), self.allowed.shape, validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint[Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Tables of log-probabilities."""
        return LogSimplices(self.allowed)

    def sample(self, key: jax.Array | None, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Tables of shape sample_shape + table, drawn in log space."""
        return log_draws(cast("jax.Array", key), self.concentration, self.allowed, sample_shape)

    def log_prob(self, value: Any, intermediates: Any = None) -> jax.Array:  # noqa: ARG002
        """Log density with respect to the probabilities, (batch,)."""
        axes = tuple(range(-self.allowed.ndim, 0))
        weighted = jnp.where(
            self.allowed, (self.concentration - 1) * jnp.where(self.allowed, value, 0.0), 0.0
        )
        kept = jnp.where(self.allowed, self.concentration, 0.0)
        normal = gammaln(kept.sum(-1)) - jnp.where(self.allowed, gammaln(self.concentration), 0.0).sum(-1)
        return jnp.sum(weighted, axis=axes) + jnp.sum(normal)


def log_draws(
    key: PRNGKeyArray,
    concentration: Float[Array, "*row outcome"],
    allowed: Bool[np.ndarray, "*row outcome"],
    sample_shape: tuple[int, ...] = (),
) -> Float[Array, "*draw_row outcome"]:
    """Logarithms of Dirichlet draws, exact however small the concentration.

    Args:
        key: typed JAX key.
        concentration: of each outcome.
        allowed: which outcomes can happen; the others are -inf.
        sample_shape: how many tables.
    """
    shape = (*sample_shape, *jnp.shape(concentration))
    gamma = jax.random.loggamma(key, jnp.where(allowed, concentration, 1.0), shape)
    gamma = jnp.where(allowed, gamma, -jnp.inf)
    return gamma - jax.nn.logsumexp(gamma, axis=-1, keepdims=True)


def log_marginal(
    concentration: Float[np.ndarray, "*row outcome"], counts: Float[np.ndarray, "*batch_row outcome"]
) -> Float[np.ndarray, "*batch_row"]:
    """Log-probability of outcomes with these counts, in their order, where each row has a Dirichlet law of its own.

    Args:
        concentration: of each outcome; 0 where it cannot happen.
        counts: how often each happened; -inf is the answer where one happened that cannot.
    """
    possible = concentration > 0
    inside = np.where(possible, concentration, 1.0)
    seen = np.where(possible, counts, 0.0)
    each = special.gammaln(inside + seen) - special.gammaln(inside)
    total, number = np.sum(np.where(possible, inside, 0.0), axis=-1), np.sum(seen, axis=-1)
    value = np.sum(np.where(possible, each, 0.0), axis=-1)
    value = value - (special.gammaln(total + number) - special.gammaln(total))
    return np.where(np.any((counts > 0) & ~possible, axis=-1), -np.inf, value)


def log_shares(
    weight: Float[np.ndarray, "*row outcome"], allowed: Bool[np.ndarray, "*row outcome"]
) -> Float[np.ndarray, "*row outcome"]:
    """Logarithms of each row's weights as shares of their sum; uniform over what can happen where all are zero.

    Args:
        weight: zero or more; counts give the maximum-likelihood table, counts + a - 1 the mode under
            concentration a, counts + a the posterior mean.
        allowed: which outcomes can happen.
    """
    weight = np.where(allowed, weight, 0.0)
    total = weight.sum(axis=-1, keepdims=True)
    share = np.where(total > 0, weight / np.where(total > 0, total, 1.0), np.exp(_uniform(allowed)))
    with np.errstate(divide="ignore"):
        return np.log(share)


def _uniform(allowed: Bool[np.ndarray, "*row outcome"]) -> Float[np.ndarray, "*row outcome"]:
    return np.where(allowed, -np.log(allowed.sum(axis=-1, keepdims=True)), -np.inf)
