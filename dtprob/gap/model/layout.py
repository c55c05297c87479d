"""Coordinates of a fit: latent sites, effect parameters and random fields as one flat vector."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.distributions import biject_to, constraints
from numpyro.distributions.transforms import IdentityTransform

from dtprob.effects.effect import Effect
from dtprob.errors import InputError
from dtprob.gap.model.own import Own
from dtprob.models.declaration import base_constraint

_TOGETHER: Final = 0.25
"""Correlation of two entries from which their sites are taken together; a thousand draws make .15 of chance."""


@dataclass(frozen=True)
class Block:
    """Coordinates that belong together.

    Attributes:
        name: the latent site, effect parameter or field.
        owner: the effect's name; None for a nuisance of the base model.
        shape: of the block's value.
        index: positions in the flat vector, (cluster, size) if local to clusters, else (1, size).
        local: whether each cluster has its own entries.
    """

    name: str
    owner: str | None
    shape: tuple[int, ...]
    index: np.ndarray
    local: bool

    @property
    def size(self) -> int:
        """Entries per cluster, or in all if not local."""
        return int(self.index.shape[1])

    @property
    def offset(self) -> int:
        """Position of the first entry."""
        return int(self.index.min()) if self.index.size else 0


@dataclass(frozen=True)
class Layout:
    """All blocks of a flat vector."""

    blocks: tuple[Block, ...]
    dimension: int

    def __getitem__(self, name: str) -> Block:
        return next(b for b in self.blocks if b.name == name)

    def part(self, x: Any, name: str) -> jax.Array:
        """The value of one block of a flat vector, or of blocks by their names."""
        if isinstance(x, Mapping):
            return cast("Mapping[str, jax.Array]", x)[name]
        block = self[name]
        size = int(np.prod(block.shape, dtype=int))
        if size == 0:
            return jnp.zeros(block.shape)
        return jax.lax.dynamic_slice_in_dim(x, block.offset, size).reshape(block.shape)

    def split(self, x: Any) -> dict[str, jax.Array]:
        """The values of all blocks, by name."""
        return {block.name: self.part(x, block.name) for block in self.blocks}

    def indices(self, names: Iterable[str]) -> np.ndarray:
        """Positions of some blocks that are not local to clusters, one after another."""
        return np.concatenate([self[name].index[0] for name in names])

    def of(self, effect: Effect) -> np.ndarray:
        """Positions of a live mean effect's parameters, one after another."""
        return self.indices(effect.site_name(p.name) for p in effect.parameters)

    def put(self, x: np.ndarray, name: str, value: Any) -> None:
        """Write the value of one block into x."""
        flat = np.asarray(value).reshape(-1)
        x[self[name].offset : self[name].offset + flat.size] = flat

    def copy_into(self, x: np.ndarray, source: Layout, values: np.ndarray) -> None:
        """Write every block that another layout also has."""
        theirs = {b.name: b for b in source.blocks}
        for block in self.blocks:
            other = theirs.get(block.name)
            if other is not None and other.shape == block.shape and block.index.size:
                x[block.index] = values[other.index]


def make_layout(entries: Iterable[tuple[str, str | None, tuple[int, ...]]], own: Mapping[str, Own]) -> Layout:
    """Lay out (name, owner, shape) entries one after another; `own` tells which have entries for each cluster."""
    blocks: list[Block] = []
    offset = 0
    for name, owner, shape in entries:
        size = int(np.prod(shape, dtype=int))
        index = offset + np.arange(size).reshape(shape)
        local = name in own
        arranged = own[name].arranged(index) if local else index.reshape(1, -1)
        blocks.append(Block(name, owner, shape, arranged, local))
        offset += size
    return Layout(tuple(blocks), offset)


class _Wrap(IdentityTransform):
    """Any real number to the angle in [-pi, pi) that it stands for; a density is -inf outside of its support."""

    def __call__(self, x: Any) -> jax.Array:
        return jnp.mod(x + jnp.pi, 2 * jnp.pi) - jnp.pi


def transform_of(fn: Any) -> Any:
    """Unconstrained to constrained values of a distribution; angles are coordinates without a cut, wrapped as values."""
    if base_constraint(fn.support) is constraints.circular:
        return _Wrap()
    return biject_to(fn.support)


def fold(jacobian: jax.Array, fn: Any, value: jax.Array) -> jax.Array:
    """Sum a log Jacobian at a value over the event dimensions of its distribution, as the log density is."""
    extra = jnp.ndim(jacobian) - (jnp.ndim(value) - len(fn.event_shape))
    return jnp.sum(jacobian, axis=tuple(range(-extra, 0))) if extra > 0 else jacobian


_DRAWS_OF_EACH: Final = 2
"""Different draws of each entry that a covariance takes at least."""
type Known = dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]]
"""Mean and precision of sites together, each flattened, by their names."""


def normal_of(draws: Mapping[str, np.ndarray]) -> Known:
    """Normal approximation of draws (draw, size) of sites; those that go together, as slope and intercept do, are one.

    The inverse of a covariance that is told by n draws of d entries is too large by (n - 1) / (n - d - 2), as an inverse
    Wishart is (Hartlap, Simon and Schneider, Astron. Astrophys. 464 (2007) 399), unless they are all the same.

    Raises:
        InputError: fewer different draws than tell the covariance of so many entries.
    """
    result: Known = {}
    for names in _groups(draws):
        u = np.concatenate([draws[name] for name in names], axis=1)
        n, d = len(np.unique(u, axis=0)), u.shape[1]  # what is drawn again weighs more, and tells no more
        least = max(_DRAWS_OF_EACH * d, d + 3)
        if 1 < n < least:
            expected = f"{least} different draws or more, for {d} unknowns that hang together"
            raise InputError(f"reference, {', '.join(names)}", expected, str(n), "Let its engine draw more")
        size = np.mean(u**2, axis=0)
        floor = 1e-10 * np.where(size > 0, size, 1.0)  # in the unit of each entry
        share = (n - d - 2) / (n - 1) if n > 1 else 1.0
        precision = np.linalg.inv(np.cov(u.T).reshape(d, d) + np.diag(floor))
        result[names] = (u.mean(0), share * precision)
    return result


def _groups(draws: Mapping[str, np.ndarray]) -> list[tuple[str, ...]]:
    """Sites joined by correlations that are more than chance makes of so many draws."""
    names = list(draws)
    label = {name: k for k, name in enumerate(names)}
    for one, other in combinations(names, 2):
        if label[one] != label[other] and _correlation(draws[one], draws[other]) > _TOGETHER:
            label = {name: label[one] if k == label[other] else k for name, k in label.items()}
    return [tuple(n for n in names if label[n] == k) for k in sorted(set(label.values()))]


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """The largest of any two entries (draw, size)."""
    scaled = [(u - u.mean(0)) / np.maximum(u.std(0), 1e-300) for u in (one, other)]
    return float(np.abs(scaled[0].T @ scaled[1]).max(initial=0.0) / len(one))
