"""The contract of an effect: a transform of a model's named sites that does nothing at its null value.

An effect never sees the model's code. It rewrites the values of deterministic sites, and the distributions of
sampled ones, while the model runs, so the same effect works on every model that has a site of that name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from scipy import stats

from dtprob.errors import InputError

type Rewrite = Callable[[Any, Mapping[str, Any], "Context"], Any]
type FieldShape = Callable[[Any, "Context"], tuple[int, ...]]
type Model = Callable[..., Any]
type EffectKind = Literal["mean", "variance"]
type ToldAs = Literal["number", "percent", "factor", "share"]

FIELD = "field"
_PRIOR_DRAWS: Final = 4001
"""Draws that tell how far a prior without a variance reaches."""
_QUARTILE: Final = float(stats.norm.ppf(0.75))
"""Median distance of a standard normal from its middle."""


@dataclass(frozen=True)
class Meaning:
    """How the size of a parameter x is told to people, where that is another number than x itself.

    Attributes:
        words: what the told number is, e.g. "slots in which its radio is off".
        told_as: "number" x, "percent" 100 x, "factor" exp(x), "share" 1 - exp(-x) in percent.
    """

    words: str
    told_as: ToldAs = "number"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name: its name in results, e.g. "delay".
        prior: which sizes are plausible; the event and batch shape are the parameter's shape.
        null: the value at which the model is unchanged, the same for every entry.
        unit: SI unit as text, "1" for a pure number.
        is_place: whether it says where an effect acts, such as the edge of a region, and not how much: it does nothing as
            long as the effect's sizes are at their null, and its prior holds as it stands, however small the effect.
        tried: values of a place at which an effect of one size is looked for before it is fitted; its prior, a normal one,
            is then centred at the best of them. Without them it is looked for at its null or, where data tell nothing of
            the effect there, at quantiles of its prior, which stays as it is.
        labels: what its entries are called in a report, one after another; their indices where none are given.
        meaning: how its size is told to people; by its name and unit where none is given.
    """

    name: str
    prior: dist.Distribution
    null: float = 0.0
    unit: str = "1"
    is_place: bool = False
    tried: tuple[float, ...] = ()
    labels: tuple[str, ...] = ()
    meaning: Meaning | None = None

    def __post_init__(self) -> None:
        """Check its unit and labels, that what is tried is one place, and that no size can only be below its null."""
        if not isinstance(self.unit, str):
            remedy = 'Write "1" for a pure number.'
            raise InputError(f"unit of parameter {self.name}", "text", repr(self.unit), remedy)
        if self.labels and len(self.labels) != self.size:
            got = f"{len(self.labels)}"
            raise InputError(
                f"labels of parameter {self.name}", f"{self.size}, one for each entry", got, "Correct them."
            )
        if len(self.tried) and not (self.is_place and not self.shape and isinstance(self.prior, dist.Normal)):
            expected = "is_place=True and a normal prior of one number where values are tried"
            got = f"is_place={self.is_place}, {type(self.prior).__name__} of shape {self.shape}"
            raise InputError(f"parameter {self.name}", expected, got, "Leave tried out, or make it a place.")
        if not self.is_place and np.any(self.limits[1] == self.null):
            expected = f"a prior that reaches above the null {self.null:g}"
            remedy = f"Write the effect with the other sign, so that {self.name} is at its null or above."
            raise InputError(f"parameter {self.name}", expected, "one that ends there", remedy)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter."""
        return tuple(self.prior.batch_shape) + tuple(self.prior.event_shape)

    @property
    def size(self) -> int:
        """Number of its entries."""
        return int(np.prod(self.shape, dtype=int))

    @cached_property
    def scale(self) -> np.ndarray:
        """How far from the null the prior puts a size: the root mean square, or a normal one's of the same median."""
        base = self.prior
        while isinstance(base, dist.ExpandedDistribution | dist.Independent):
            base = base.base_dist
        if isinstance(base, dist.HalfNormal | dist.HalfCauchy):
            return np.asarray(base.scale) * _stray(base)
        if isinstance(base, dist.Normal | dist.StudentT | dist.Cauchy):
            away = 0.0 if self.is_place else np.asarray(base.loc) - self.null
            return np.hypot(np.asarray(base.scale) * _stray(base), away)
        try:
            square = np.asarray(self.prior.variance) + (np.asarray(self.prior.mean) - self.null) ** 2
        except NotImplementedError:
            square = np.full(self.shape, np.inf)
        if np.isfinite(square).all():
            return np.sqrt(square)
        strays = np.abs(np.asarray(self.prior.sample(jax.random.key(0), (_PRIOR_DRAWS,))) - self.null)
        return np.median(strays, axis=0) / _QUARTILE

    @property
    def is_one_sided(self) -> bool:
        """Whether the null lies at the lower edge of what the prior allows, as for an attenuation."""
        return bool(np.all(self.limits[0] == self.null))

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest value that the prior allows an entry; infinite where there is no limit."""
        support: Any = self.prior.support
        while hasattr(support, "base_constraint"):
            support = support.base_constraint
        low, high = (getattr(support, f"{end}_bound", None) for end in ("lower", "upper"))
        return np.asarray(-np.inf if low is None else low), np.asarray(np.inf if high is None else high)


def _stray(base: Any) -> Any:
    """Root mean square distance from the middle, or a normal one's of the same median, in units of the scale."""
    if isinstance(base, dist.Cauchy | dist.HalfCauchy):
        return 1.0 / _QUARTILE
    if not isinstance(base, dist.StudentT):
        return 1.0
    freedom = np.asarray(base.df, float)
    has_square = freedom > 2
    square = freedom / np.where(has_square, freedom - 2, 1.0)
    return np.where(has_square, np.sqrt(square), stats.t.ppf(0.75, freedom) / _QUARTILE)


class Context(Mapping[str, Any]):
    """What an effect may look at: the data by argument name and the sites already computed in this run."""

    def __init__(self, data: Mapping[str, Any], sites: Mapping[str, Any]) -> None:
        self._data, self._sites = data, sites

    def __getitem__(self, name: str) -> Any:
        """A site's value, or an entry of the data."""
        return self._sites[name] if name in self._sites else self._data[name]

    def __iter__(self) -> Iterator[str]:
        """Names of data and sites."""
        return iter({**self._data, **self._sites})

    def __len__(self) -> int:
        """Number of names."""
        return len({**self._data, **self._sites})


@dataclass(frozen=True)
class Effect:
    """A candidate cause of a gap.

    Attributes:
        family: name of the physics, e.g. "timing_offset".
        rewrites: for each deterministic site, the function (value, parameters, context) -> new value. The new
            value has the rank of the old one and its shape, except that an axis of size 1 may grow (as when a
            phase that was the same in all snapshots starts to turn); it is cast to the old dtype, whole numbers
            becoming real ones.
        parameters: the effect's parameters.
        instance: which object, antenna, band or device; None where there is only one.
        kind: "mean" for parameters that shift the site's value; "variance" for a random field whose standard
            deviation is the (single, non-negative) size, beside places perhaps that it is looked for at: the rewrites
            then also get parameters["field"], standard normal, drawn once per run and shared by all the sites that
            the effect rewrites.
        physics: one line of what it is.
        source: where the formula comes from.
        requires: names of data or sites that the rewrites look up in the context.
        distributions: for each sampled site (an observation, mostly), the function (distribution, parameters,
            context) -> new distribution of the same shape. It is given what lies within plates, events and masks,
            which the new one keeps.
        field_shape: shape of the field of a "variance" effect from the value of its first site and the
            context; by default that of the value, to be given where a distribution is rewritten. The leading
            axes are the site's (full size, or 1 where the field is shared along the axis), further axes are free.
    """

    family: str
    rewrites: Mapping[str, Rewrite]
    parameters: tuple[Parameter, ...]
    instance: str | None = None
    kind: EffectKind = "mean"
    physics: str = ""
    source: str = ""
    requires: tuple[str, ...] = field(default=())
    distributions: Mapping[str, Rewrite] = field(default_factory=dict)
    field_shape: FieldShape | None = None

    def __post_init__(self) -> None:
        """Check that there is something to rewrite and something to find."""
        if not self.sites:
            raise InputError(
                f"effect {self.name}", "a site to rewrite", "none", "Give rewrites or distributions."
            )
        names = [p.name for p in self.parameters]
        if not names or len(set(names)) < len(names):
            got = ", ".join(names) or "none"
            raise InputError(f"effect {self.name}", "parameters of different names", got, "Name each once.")
        n_size = sum(p.size for p in self.parameters if not p.is_place)
        if self.is_looked_for and (self.distributions or n_size != 1):
            raise InputError(
                f"effect {self.name} with places that are tried",
                "an effect of one size that rewrites deterministic sites",
                f"{n_size} sizes, distributions of {', '.join(self.distributions) or 'no site'}",
                "Leave tried out, or split the effect.",
            )
        shapeless = bool(self.distributions) and self.field_shape is None
        fixed = any(p.is_place and not p.tried for p in self.parameters)
        spread_out = self.is_looked_for and len(self.rewrites) != 1
        if self.kind == "variance" and (n_size != 1 or fixed or spread_out or shapeless):
            raise InputError(
                f"variance effect {self.name}",
                "one size, the field's standard deviation, tried values of each place and then one site, and a field_shape"
                " where it rewrites a distribution",
                f"{', '.join(names)}; distributions of {', '.join(self.distributions) or 'no site'}",
                "Split it into several effects, say the shape of its field, or make it a mean effect.",
            )

    @property
    def name(self) -> str:
        """`family` or `family[instance]`."""
        return self.family if self.instance is None else f"{self.family}[{self.instance}]"

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites that the effect rewrites, deterministic ones first."""
        return (*self.rewrites, *self.distributions)

    @property
    def is_looked_for(self) -> bool:
        """Whether it may act anywhere, and is looked for at many places before it is fitted."""
        return any(p.tried for p in self.parameters)

    @property
    def fitted(self) -> tuple[Parameter, ...]:
        """Parameters that a fit moves: of a variance effect the places, since its size is the spread of its field."""
        return tuple(p for p in self.parameters if self.kind == "mean" or p.is_place)

    @property
    def dimension(self) -> int:
        """Number of scalar parameters."""
        return sum(p.size for p in self.parameters)

    def site_name(self, parameter: str) -> str:
        """Name of the sample site of a parameter, or of the field, in an extended model."""
        return f"{self.name}.{parameter}"

    def shape_of_field(self, value: Any, context: Mapping[str, Any]) -> tuple[int, ...]:
        """Shape of a variance effect's field.

        Args:
            value: the value of the first site that the effect rewrites.
            context: data and sites by name.
        """
        if self.field_shape is None:
            return tuple(jnp.shape(value))
        return self.field_shape(value, Context(context, {}))

    def null(self) -> dict[str, Any]:
        """The parameters at which the effect does nothing."""
        return {p.name: jnp.full(p.shape, p.null) for p in self.parameters}
