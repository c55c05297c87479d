"""The contract of an effect: a transform of a model's named sites that does nothing at its null value.

An effect never sees the model's code. It rewrites the values of deterministic sites, and the distributions of
sampled ones, while the model runs, so the same effect works on every model that has a site of that name.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.primitives import Messenger

from dtprob.errors import InputError

type Rewrite = Callable[[Any, Mapping[str, Any], "Context"], Any]
type FieldShape = Callable[[Any, "Context"], tuple[int, ...]]
type Model = Callable[..., Any]
type EffectKind = Literal["mean", "variance"]

FIELD = "field"
_ADDED = "__dtprob_effects__"


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
            is then centred at the best of them.
    """

    name: str
    prior: dist.Distribution
    null: float = 0.0
    unit: str = "1"
    is_place: bool = False
    tried: tuple[float, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter."""
        return tuple(self.prior.batch_shape) + tuple(self.prior.event_shape)

    @property
    def is_one_sided(self) -> bool:
        """Whether the null lies at the lower edge of what the prior allows, as for an attenuation."""
        support: Any = self.prior.support
        while hasattr(support, "base_constraint"):
            support = support.base_constraint
        if support in (constraints.positive, constraints.nonnegative):
            return self.null == 0.0
        lower = getattr(support, "lower_bound", None)
        return lower is not None and bool(np.all(np.asarray(lower) == self.null))


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
            phase that was the same in all snapshots starts to turn); it is cast to the old dtype.
        parameters: the effect's parameters.
        instance: which object, antenna, band or device; None where there is only one.
        kind: "mean" for parameters that shift the site's value; "variance" for a random field whose standard
            deviation is the (single, non-negative) parameter: the rewrites then also get parameters["field"],
            standard normal, drawn once per run and shared by all the sites that the effect rewrites.
        physics: one line of what it is.
        source: where the formula comes from.
        requires: names of data or sites that the rewrites look up in the context.
        distributions: for each sampled site (an observation, mostly), the function (distribution, parameters,
            context) -> new distribution of the same batch and event shape.
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
        shapeless = bool(self.distributions) and self.field_shape is None
        if self.kind == "variance" and (len(names) != 1 or shapeless):
            raise InputError(
                f"variance effect {self.name}",
                "one parameter, the field's standard deviation, and a field_shape where it rewrites a distribution",
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
    def dimension(self) -> int:
        """Number of scalar parameters."""
        return sum(int(np.prod(p.shape, dtype=int)) for p in self.parameters)

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


class Rewriting(Messenger):
    """NumPyro handler that applies effects with given parameters to every site they name.

    Args:
        fn: the model.
        effects: applied in this order where several rewrite one site; those of a handler inside this one
            come before. Whatever the order, an effect finds in its context the final values of earlier sites.
        parameters: for each effect's name, its parameters by name. A variance effect without an entry
            "field" draws it.
        data: the model's data, for the effects' context.

    Raises:
        InputError: an effect returns a value whose shape or dtype the site cannot take.
    """

    def __init__(
        self,
        fn: Model | None,
        effects: Sequence[Effect],
        parameters: Mapping[str, Mapping[str, Any]],
        data: Mapping[str, Any],
    ) -> None:
        super().__init__(fn)
        self._effects, self._parameters, self._data = tuple(effects), parameters, data
        self._seen: dict[str, Any] = {}
        self._fields: dict[str, jax.Array] = {}

    def __enter__(self) -> Any:
        """Start a run: nothing seen, no field drawn."""
        self._seen, self._fields = {}, {}
        return super().__enter__()

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Rewrite the value of a deterministic site, or the distribution of a sampled one."""
        if msg["type"] not in ("deterministic", "sample"):
            return
        context = Context(self._data, self._seen)
        for effect in self._effects:
            if msg["type"] == "sample":
                rewrite = effect.distributions.get(msg["name"])
                if rewrite is not None:
                    msg["fn"] = rewrite(msg["fn"], self._given(effect, msg, context), context)
            elif (rewrite := effect.rewrites.get(msg["name"])) is not None:
                value = rewrite(msg["value"], self._given(effect, msg, context), context)
                msg["value"] = _fit(effect.name, msg["name"], msg["value"], value)

    def postprocess_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Remember the value, after all handlers have seen it, for later sites."""
        if msg["type"] in ("deterministic", "sample"):
            self._seen[msg["name"]] = msg["value"]

    def _given(self, effect: Effect, msg: Mapping[str, Any], context: Context) -> Mapping[str, Any]:
        given = self._parameters[effect.name]
        if effect.kind == "mean" or FIELD in given:
            return given
        if effect.name not in self._fields:
            shape = effect.shape_of_field(msg["value"], context)
            normal = dist.Normal(0.0, 1.0).expand(shape).to_event(len(shape))
            # The field has its own shape, so the plates around the site must not expand it.
            plates = [frame.name for frame in msg["cond_indep_stack"]]
            name = effect.site_name(FIELD)
            drawn = numpyro.sample(name, normal, infer={"block_plates": plates})
            self._fields[effect.name] = jnp.asarray(drawn)
        return {**given, FIELD: self._fields[effect.name]}


def _fit(effect: str, site: str, old: Any, new: Any) -> jax.Array:
    """The new value in the old dtype, after a check that it can stand where the old one stood."""
    old, new = jnp.asarray(old), jnp.asarray(new)
    pairs = zip(old.shape, new.shape, strict=True) if old.ndim == new.ndim else [(0, 1)]
    if not all(before in (1, after) for before, after in pairs):
        raise InputError(
            f"effect {effect}, new value of site {site!r}",
            f"shape {old.shape}, axes of size 1 allowed to grow",
            f"{new.shape}",
            "Return an array of the site's shape.",
        )
    if jnp.iscomplexobj(new) and not jnp.iscomplexobj(old):
        raise InputError(
            f"effect {effect}, new value of site {site!r}",
            str(old.dtype),
            str(new.dtype),
            "Return real values.",
        )
    return new.astype(old.dtype)


def with_effects(model: Model, effects: Sequence[Effect]) -> Model:
    """The model extended by effects whose parameters are latent sites named `effect.parameter`.

    The extended model has the signature, axes and cluster of the base model, and is as much a model as it.

    Effects apply in the order listed, and those of the model that is extended before those of the extension,
    so nesting makes no difference: with_effects(with_effects(m, a), b) has the sites of
    with_effects(m, a + b) with the same values and densities. The order matters where several effects
    rewrite one site.
    """
    effects, signature = tuple(effects), inspect.signature(model)

    @functools.wraps(model)
    def extended(*args: Any, **data: Any) -> Any:
        data = {**dict(zip(signature.parameters, args, strict=False)), **data}
        parameters = {
            effect.name: {
                p.name: numpyro.sample(effect.site_name(p.name), p.prior) for p in effect.parameters
            }
            for effect in effects
        }
        with Rewriting(None, effects, parameters, data):
            return model(**data)

    extended.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
    setattr(extended, _ADDED, (*effects_of(model), *effects))
    return extended


def effects_of(model: Model) -> tuple[Effect, ...]:
    """The effects that `with_effects` has extended a model by, the first added first."""
    while isinstance(model, functools.partial):
        model = model.func
    return getattr(model, _ADDED, ())
