"""Factored transition models T(s' | s, a): subsets of the state, each drawn from its own law given its parents.

A factor says which column of a log it explains (its child), which columns that depends on (its parents: subsets of
the state and actions now, or children of earlier factors), and the law between them. A law is any function from the
parents' columns to logits over outcomes; it may draw unknown parameters of its own. Tables, logistic and neural laws
are here; a user's own is a function.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol, cast, final

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float

from dtprob.errors import InputError, nearest
from dtprob.models.arguments import Model
from dtprob.models.declaration import model
from dtprob.models.dirichlet import LogDirichlet

type Columns = Mapping[str, Array]

NEVER = -1e3
"""Logit of what cannot happen: its probability rounds to zero, and sums and derivatives stay finite."""


class Law(Protocol):
    """From the parents' columns (episode, slot, ...) to logits (episode, slot, ..., outcome)."""

    def __call__(self, columns: Columns) -> Array:
        """The logits; unknown parameters are drawn inside, outside of all plates."""
        ...


@final
@dataclass(frozen=True)
class Factor:
    """One factor of a transition model.

    Attributes:
        name: of the factor; its logits are the site `name_logits`.
        child: the column that it explains, whole numbers from 0.
        parents: the columns that the child depends on, in the law's order.
        law: from the parents to logits; without parents it may give those of one slot, (outcome,).
        axes: the child's axes after `episode` and `slot`.
        where: a column that is true where the child counts; everywhere if none is named.
    """

    name: str
    child: str
    parents: tuple[str, ...]
    law: Law | Callable[[Columns], Array]
    axes: tuple[str, ...] = ()
    where: str | None = None

    @property
    def site_axes(self) -> dict[str, tuple[str, ...]]:
        """Names of the axes of the factor's sites."""
        own = ("episode", "slot", *self.axes)
        parameters: Mapping[str, tuple[str, ...]] = getattr(self.law, "axes", {})
        return {f"{self.name}_logits": (*own, "outcome"), self.child: own, **parameters}


@final
@dataclass(frozen=True)
class Table:
    """A table of probabilities with a Dirichlet prior, one row per joint value of the parents.

    Attributes:
        site: name of the table of log-probabilities, (*parents, outcome).
        parents: the columns that index its rows, each with its number of values.
        outcomes: number of the child's values.
        concentration: of the prior.
        allowed: which entries can happen, (*parents, outcome); all where None.
    """

    site: str
    parents: Mapping[str, int]
    outcomes: int
    concentration: float = 0.01
    allowed: Bool[np.ndarray, "*parent outcome"] | None = None

    @property
    def axes(self) -> dict[str, tuple[str, ...]]:
        """Names of the table's axes."""
        return {self.site: (*self.parents, f"{self.site}_outcome")}

    def __call__(self, columns: Columns) -> Array:
        """Rows of the table."""
        shape = (*self.parents.values(), self.outcomes)
        allowed = np.ones(shape, dtype=bool) if self.allowed is None else self.allowed
        return look_up(log_table(self.site, self.concentration, allowed), [columns[p] for p in self.parents])


@final
@dataclass(frozen=True)
class Logistic:
    """Multinomial logistic regression on the parents' values.

    Attributes:
        site: name of its weights, (outcome, feature); the first feature is constant.
        parents: the columns that are its features.
        outcomes: number of the child's values; the first is the reference.
        scale: prior standard deviation of the weights, logits per unit of the feature.
    """

    site: str
    parents: tuple[str, ...]
    outcomes: int
    scale: float = 2.0

    @property
    def axes(self) -> dict[str, tuple[str, ...]]:
        """Names of the axes of its weights."""
        return {self.site: (f"{self.site}_outcome", f"{self.site}_feature")}

    def __call__(self, columns: Columns) -> Array:
        """Weights times features."""
        x = _features(columns, self.parents)
        shape = (self.outcomes - 1, x.shape[-1])
        weight = numpyro.sample(self.site, dist.Normal(0.0, self.scale).expand(shape).to_event(2))
        return _with_reference(x @ jnp.asarray(weight).T)


@final
@dataclass(frozen=True)
class Neural:
    """A network with one hidden layer of tanh units, weights N(0, 1 / fan-in) times `scale`.

    Attributes:
        site: its weights are the sites `site_hidden` and `site_output`.
        parents: the columns that are its features.
        outcomes: number of the child's values; the first is the reference.
        hidden: number of hidden units.
        scale: prior standard deviation of logits, roughly.
    """

    site: str
    parents: tuple[str, ...]
    outcomes: int
    hidden: int = 8
    scale: float = 2.0

    @property
    def axes(self) -> dict[str, tuple[str, ...]]:
        """Names of the axes of its weights."""
        unit, feature = f"{self.site}_unit", f"{self.site}_feature"
        outcome = f"{self.site}_outcome"
        return {f"{self.site}_hidden": (unit, feature), f"{self.site}_output": (outcome, f"{unit}_or_bias")}

    def __call__(self, columns: Columns) -> Array:
        """The network's outputs."""
        x = _features(columns, self.parents)
        hidden = _weights(f"{self.site}_hidden", (self.hidden, x.shape[-1]), 1.0)
        active = jnp.tanh(x @ hidden.T)
        active = jnp.concatenate([jnp.ones_like(active[..., :1]), active], axis=-1)
        output = _weights(f"{self.site}_output", (self.outcomes - 1, self.hidden + 1), self.scale)
        return _with_reference(active @ output.T)


def log_table(
    site: str, concentration: float, allowed: Bool[np.ndarray, "*row outcome"]
) -> Float[Array, "*row outcome"]:
    """An unknown table of log-probabilities, drawn at the site of that name."""
    return jnp.asarray(numpyro.sample(site, LogDirichlet(concentration, allowed)))


def look_up(table: Float[Array, "*row outcome"], index: Sequence[Array]) -> Float[Array, "*batch outcome"]:
    """Rows of a table of log-probabilities by one index per axis, finite where an outcome cannot happen."""
    return jnp.where(jnp.isneginf(table), NEVER, table)[tuple(jnp.asarray(i, jnp.int32) for i in index)]


def draw_factors(factors: Sequence[Factor], columns: Columns) -> dict[str, Array]:
    """Run the factors in order, inside a NumPyro model: logits as deterministic sites, children as samples.

    Args:
        factors: a child may be a parent of later factors.
        columns: parents, and those children that were observed.

    Returns:
        The columns with all children.
    """
    known = dict(columns)
    for factor in factors:
        logits = jnp.asarray(factor.law(known))
        if logits.ndim == 1:  # a law without parents: the same in every slot
            logits = jnp.broadcast_to(logits, (*next(iter(known.values())).shape[:2], len(logits)))
        logits = cast("Array", numpyro.deterministic(f"{factor.name}_logits", logits))
        law: Any = dist.Categorical(logits=logits)
        with ExitStack() as plates:
            batch = logits.shape[:-1]
            for place, (axis, size) in enumerate(zip(("episode", "slot", *factor.axes), batch, strict=True)):
                plates.enter_context(numpyro.plate(axis, size, dim=place - len(batch)))
            if factor.where is not None:
                counted = jnp.asarray(known[factor.where], bool)
                law = law.mask(counted.reshape(counted.shape + (1,) * (len(batch) - counted.ndim)))
            known[factor.child] = cast(
                "Array", numpyro.sample(factor.child, law, obs=columns.get(factor.child))
            )
    return known


def factored(factors: Sequence[Factor], *, name: str = "factored") -> Model:
    """A NumPyro model from factors; its arguments are the columns by name, children default to None.

    Episodes are its clusters: given the columns, slots are independent, so windows of an episode may be episodes.

    Args:
        factors: in an order in which no parent is a later child.
        name: of the model.

    Raises:
        InputError: a child of two factors, or a parent that is the child of a later factor.
    """
    factors = tuple(factors)
    children = _checked(factors)
    required = dict.fromkeys(
        column
        for factor in factors
        for column in (*factor.parents, *([factor.where] if factor.where else []))
        if column not in children
    )
    axes = {site: names for factor in factors for site, names in factor.site_axes.items()}

    def run(**columns: Any) -> dict[str, Array]:
        return draw_factors(factors, {k: v for k, v in columns.items() if v is not None})

    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [inspect.Parameter(column, keyword) for column in required]
    parameters += [inspect.Parameter(child, keyword, default=None) for child in children]
    run.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    run.__name__ = name
    return model(axes=axes, cluster="episode")(run)


def _checked(factors: Sequence[Factor]) -> list[str]:
    children = [factor.child for factor in factors]
    for place, factor in enumerate(factors):
        if factor.child in children[:place]:
            remedy = "Give each column one factor"
            raise InputError("factors", "one factor per child", f"two for {factor.child!r}", remedy)
        for parent in factor.parents:
            if parent in children[place:]:
                remedy = "List the factor of the parent first; within a slot, parents come before children"
                raise InputError(
                    f"factor {factor.name!r}", "parents of earlier factors", repr(parent), remedy
                )
        own = set(getattr(factor.law, "parents", ()))
        for parent in own - set(factor.parents):
            close = nearest(parent, factor.parents)
            remedy = f"Did you mean {close!r}?" if close else "Name it among the factor's parents"
            raise InputError(
                f"law of factor {factor.name!r}", "columns among its parents", repr(parent), remedy
            )
    return children


def _features(columns: Columns, parents: Sequence[str]) -> Float[Array, "*batch feature"]:
    values = [jnp.asarray(columns[parent], float) for parent in parents]
    return jnp.stack([jnp.ones_like(values[0]), *values], axis=-1)


def _weights(site: str, shape: tuple[int, int], scale: float) -> Float[Array, "out in"]:
    prior = dist.Normal(0.0, scale / np.sqrt(shape[1])).expand(shape).to_event(2)
    return jnp.asarray(numpyro.sample(site, prior))


def _with_reference(logits: Float[Array, "*batch other"]) -> Float[Array, "*batch outcome"]:
    return jnp.concatenate([jnp.zeros_like(logits[..., :1]), logits], axis=-1)
