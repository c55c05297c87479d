"""Mixtures of parts of several families, or of one whose mixtures have no rows of their own: a class for each such list."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from numpyro.distributions import constraints

from dtprob.gap.observation.likelihood import Likelihood


class Mixed(dist.Distribution):
    """One of several parts, each with parameters of its own.

    Parameters are those of the parts, "0_loc", "1_rate", and "odds_1", "odds_2": the logarithms of the later parts' chances
    over that of the first.
    """

    members: ClassVar[Sequence[Likelihood]] = ()

    def __init__(self, *, validate_args: bool | None = None, **given: Any) -> None:
        for name, value in given.items():
            setattr(self, name, value)
        shape = jnp.broadcast_shapes(*(jnp.shape(value) for value in given.values()))
        super().__init__(batch_shape=shape, validate_args=validate_args)

    def parts(self) -> list[tuple[Any, Any]]:
        """The chance of each part, and the part."""
        odds = [getattr(self, f"odds_{k}") for k in range(1, len(self.members))]
        chances = jax.nn.softmax(jnp.stack([jnp.zeros(self.batch_shape), *odds]), axis=0)
        return [
            (chance, one.make(**{n: getattr(self, f"{k}_{n}") for n in one.parameters}))
            for k, (chance, one) in enumerate(zip(chances, self.members, strict=True))
        ]

    def log_prob(self, value: Any, intermediates: Any = None) -> jax.Array:  # noqa: ARG002
        """Logarithm of the density, a part's none outside its support."""
        terms = []
        for chance, part in self.parts():
            inside = part.support(value)
            safe = jnp.where(inside, value, part.support.feasible_like(value))
            terms.append(jnp.where(inside, jnp.log(chance) + part.log_prob(safe), -jnp.inf))
        return jax.nn.logsumexp(jnp.stack(terms), axis=0)

    def sample(self, key: jax.Array | None, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws."""
        if key is None:
            raise TypeError("key: a JAX random key is needed")
        parts = self.parts()
        keys = jax.random.split(key, len(parts) + 1)
        draws = jnp.stack(
            [part.sample(k, sample_shape) for k, (_, part) in zip(keys[1:], parts, strict=True)]
        )
        odds = jnp.log(jnp.stack([chance for chance, _ in parts]))
        which = jax.random.categorical(keys[0], odds, axis=0, shape=draws.shape[1:])
        return jnp.take_along_axis(draws, which[None], axis=0)[0]

    @property
    def mean(self) -> jax.Array:
        """Expected value."""
        return sum((chance * part.mean for chance, part in self.parts()), jnp.zeros(()))


_MET: Final[dict[tuple[str, ...], tuple[list[Likelihood], type[Mixed]]]] = {}


def mixed(families: Sequence[str], members: Sequence[Likelihood]) -> type[Mixed] | None:
    """The class of mixtures of these, the same at every call; None where some count and others do not."""
    known = _MET.get(tuple(families))
    if known is not None and all(one is other for one, other in zip(known[0], members, strict=True)):
        return known[1]
    anywhere = [one.make(**{name: jnp.ones(()) for name in one.parameters}) for one in members]
    discrete = {bool(part.support.is_discrete) for part in anywhere}
    if len(discrete) > 1:
        return None
    declared = {
        f"{k}_{name}": type(part).arg_constraints[name]
        for k, (one, part) in enumerate(zip(members, anywhere, strict=True))
        for name in one.parameters
    }
    declared |= {f"odds_{k}": constraints.real for k in range(1, len(members))}
    support = constraints.nonnegative_integer if discrete == {True} else constraints.real
    given = {"members": members, "arg_constraints": declared, "support": support}
    kind = type(f"Mixture of {', '.join(families)}", (Mixed,), given)
    _MET[tuple(families)] = list(members), kind
    return kind
