"""Effects at work: the handler that rewrites a model's sites while it runs, and models extended by effects."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

from dtprob.effects.changing import Changing, is_scanned
from dtprob.effects.distributions import replace_base
from dtprob.effects.effect import FIELD, Context, Effect, Model
from dtprob.effects.redrawn import drawn_apart
from dtprob.errors import InputError

_ADDED = "__dtprob_effects__"


class Rewriting(Changing):
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
        self._drawn: dict[str, dist.Distribution] = {}

    def __enter__(self) -> Any:
        """Start a run: nothing seen, no field drawn."""
        self._seen, self._fields, self._drawn = {}, {}, {}
        return super().__enter__()

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Rewrite the value of a deterministic site, or the distribution of a sampled one."""
        super().process_message(msg)
        if msg["type"] != "sample":
            return
        if msg["name"] in self._drawn:
            # a field counts once, whatever masks and scales the model has around the site
            msg["fn"], msg["scale"] = self._drawn[msg["name"]], None
        context = Context(self._data, self._seen)
        for effect in self._effects:
            if msg["name"] in effect.distributions:
                if is_scanned(msg) and not msg["is_observed"]:
                    raise InputError(
                        f"effect {effect.name}, distribution of site {msg['name']!r} in a scan",
                        "a site that is observed",
                        "one that is drawn there, before the effect can act",
                        "Give the data, or rewrite a deterministic site.",
                    )
                given = self._given(effect, msg, context)
                change = functools.partial(_changed, effect, msg["name"], given, context)
                msg["fn"] = replace_base(msg["fn"], change)

    def touches(self, name: str) -> bool:
        """Whether an effect rewrites a deterministic site."""
        return any(name in effect.rewrites for effect in self._effects)

    def change(self, msg: Mapping[str, Any]) -> Any:
        """The value that the effects give a site, one after another."""
        context, value = Context(self._data, self._seen), msg["value"]
        for effect in self._effects:
            if msg["name"] in effect.rewrites:
                given = self._given(effect, {**msg, "value": value}, context)
                new = rewritten(effect, msg["name"], value, given, context)
                value = _fit(effect.name, msg["name"], value, new)
        return value

    def remember(self, msg: Mapping[str, Any]) -> None:
        """Keep the value for later sites."""
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
            self._drawn[name] = normal
            drawn = numpyro.sample(name, normal, infer={"block_plates": plates})
            self._fields[effect.name] = jnp.asarray(drawn)
        return {**given, FIELD: self._fields[effect.name]}


def _changed(effect: Effect, site: str, given: Mapping[str, Any], context: Context, fn: Any) -> Any:
    return rewritten(effect, site, fn, given, context)


def rewritten(effect: Effect, site: str, value: Any, given: Mapping[str, Any], context: Context) -> Any:
    """What an effect makes of a site's value or distribution.

    Raises:
        InputError: the rewrite fails; it is named.
    """
    rewrite = {**effect.distributions, **effect.rewrites}[site]
    try:
        return rewrite(value, given, context)
    except KeyError as error:
        own = (
            f"; it looks for its own site, which is its first argument {site!r}"
            if error.args == (site,)
            else ""
        )
        raise InputError(
            f"effect {effect.name}, rewrite of site {site!r}",
            f"its parameters ({', '.join(given)}), arguments of the model and earlier sites ({', '.join(context)})",
            f"{error}{own}",
            "Correct the name, or give the model what the effect needs.",
        ) from error
    except (AttributeError, TypeError, ValueError) as error:
        said = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise InputError(
            f"effect {effect.name}, rewrite of site {site!r}",
            f"a function that can be traced, on a value of shape {jnp.shape(value) if hasattr(value, 'shape') else ()}",
            said,
            "Correct it; --debug shows where it fails.",
        ) from error


def may_become(old: Sequence[int], new: Sequence[int]) -> bool:
    """Whether a site of one shape may take a value of another: only axes of size 1 grow."""
    return len(old) == len(new) and all(before in (1, after) for before, after in zip(old, new, strict=True))


def _fit(effect: str, site: str, old: Any, new: Any) -> jax.Array:
    """The new value in the old dtype, after a check that it can stand where the old one stood.

    Real numbers in the place of whole ones stay real: cut off to whole ones, a small effect would be none.
    """
    old, new = jnp.asarray(old), jnp.asarray(new)
    if not may_become(old.shape, new.shape):
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
    whole = not jnp.issubdtype(old.dtype, jnp.inexact) and jnp.issubdtype(new.dtype, jnp.inexact)
    return new.astype(jnp.result_type(old.dtype, float) if whole else old.dtype)


def with_effects(model: Model, effects: Sequence[Effect]) -> Model:
    """The model extended by effects whose parameters are latent sites named `effect.parameter`.

    The extended model has the signature, axes and cluster of the base model, and is as much a model as it.

    Effects apply in the order listed, and those of the model that is extended before those of the extension,
    so nesting makes no difference: with_effects(with_effects(m, a), b) has the sites of
    with_effects(m, a + b) with the same values and densities. The order matters where several effects
    rewrite one site. What the model draws and an effect rewrites is drawn apart; see `drawn_apart`.
    """
    effects, signature = tuple(effects), inspect.signature(model)
    rewritten_sites = {site for effect in effects for site in effect.rewrites}

    @functools.wraps(model)
    def extended(*args: Any, **data: Any) -> Any:
        data = {**dict(zip(signature.parameters, args, strict=False)), **data}
        parameters = {
            effect.name: {
                p.name: numpyro.sample(effect.site_name(p.name), p.prior) for p in effect.parameters
            }
            for effect in effects
        }
        with Rewriting(None, effects, parameters, data), drawn_apart(rewritten_sites):
            return model(**data)

    extended.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
    setattr(extended, _ADDED, (*effects_of(model), *effects))
    return extended


def effects_of(model: Model) -> tuple[Effect, ...]:
    """The effects that `with_effects` has extended a model by, the first added first."""
    while isinstance(model, functools.partial):
        model = model.func
    return getattr(model, _ADDED, ())
