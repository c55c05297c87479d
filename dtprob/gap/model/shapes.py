"""Shapes of a model's observations, unknowns and sites, found without computing anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.effect import FIELD, Context, Effect
from dtprob.effects.rewriting import Rewriting, rewritten
from dtprob.errors import InputError
from dtprob.gap.model.declared import Declared
from dtprob.gap.model.layout import transform_of
from dtprob.gap.model.running import Arrays, Runner, observations
from dtprob.gap.observation import whiten

_LARGEST: Final = 8_000_000
"""Bytes of a site that may be perturbed in any case."""
_PER_OBSERVATION: Final = 2
"""Entries of a larger one for each observed value, at most."""


def observed_shapes(
    declared: Declared, arrays: Any, live: Sequence[Effect]
) -> tuple[dict[str, tuple[int, ...]], dict[str, str]]:
    """(component, *site shape) of each observed site's whitened rows, and its family, under live effects."""
    families: dict[str, str] = {}
    means = [e for e in live if e.kind == "mean"]

    def run(arrays: Any) -> dict[str, jax.Array]:
        with Rewriting(None, means, {e.name: e.null() for e in means}, declared.data(arrays)):
            trace = declared.trace(arrays)
        observed = observations(declared.declaration, trace)
        families.update({n: o.family for n, o in observed.items()})
        return {n: whiten.residual(o, trace[n]["value"]) for n, o in observed.items()}

    shapes = _shapes(run, arrays)
    return {name: shapes[name] for name in families}, families


def latent_shapes(declared: Declared, arrays: Any) -> dict[str, tuple[int, ...]]:
    """Unconstrained shape of each latent site."""

    def run(arrays: Any) -> dict[str, jax.Array]:
        trace = declared.trace(arrays)
        return {
            n: jnp.zeros(transform_of(trace[n]["fn"]).inverse_shape(jnp.shape(trace[n]["value"])))
            for n in declared.declaration.latent
        }

    return _shapes(run, arrays)


def shapes_of_fields(
    declared: Declared, arrays: Any, fields: Sequence[Effect], sites: Mapping[str, jax.ShapeDtypeStruct]
) -> dict[str, tuple[int, ...]]:
    """Shape of the field of each variance effect, its site in the shape given."""

    def run(arrays: Any) -> dict[str, jax.Array]:
        trace = declared.trace(arrays)
        context = Context(declared.data(arrays), {n: m["value"] for n, m in trace.items()})
        shapes = {}
        for effect in fields:
            value, grown = trace[effect.sites[0]]["value"], sites.get(effect.sites[0])
            value = value if grown is None else jnp.broadcast_to(value, grown.shape)
            shapes[effect.name] = jnp.zeros(effect.shape_of_field(value, context))
        return shapes

    return _shapes(run, arrays)


def perturbed_sites(
    runner: Runner, effects: Sequence[Effect], arrays: Arrays
) -> dict[str, jax.ShapeDtypeStruct]:
    """Deterministic sites on which a perturbation makes sense, in the largest shape that an effect gives them.

    Large ones beside the data (an entry for every path at every subcarrier) only where an effect moves them: their
    gradients are kept for a hundred replicates.
    """
    declared = runner.declared
    names = declared.declaration.deterministic

    def run(arrays: Arrays) -> dict[str, Any]:
        data, grown = declared.data(arrays.data), dict[str, Any]()
        while True:  # a site may grow because one before it has
            found = runner.run(jnp.zeros(runner.layout.dimension), arrays, grown)
            values = {n: found.sites[n] for n in names}
            shapes = _largest(effects, values, data, found.everything, list(declared.declaration.sites))
            grown = {n: jnp.zeros(s, values[n].dtype) for n, s in shapes.items()}
            if all(grown[n].shape == values[n].shape for n in values):
                return grown

    sites = cast("dict[str, Any]", jax.eval_shape(run, arrays))
    observed = sum(site.size for site in declared.declaration.observed.values())
    rewritten_ones = {site for effect in effects for site in effect.sites}

    def is_kept(name: str, site: jax.ShapeDtypeStruct) -> bool:
        small = site.size * site.dtype.itemsize <= _LARGEST or site.size <= _PER_OBSERVATION * observed
        return jnp.issubdtype(site.dtype, jnp.inexact) and site.size > 0 and (small or name in rewritten_ones)

    return {name: site for name, site in sites.items() if is_kept(name, site)}


def _largest(
    effects: Sequence[Effect],
    values: Mapping[str, Any],
    data: Mapping[str, Any],
    everything: Mapping[str, Any],
    order: Sequence[str],
) -> dict[str, tuple[int, ...]]:
    """The largest shape that any effect gives each site, what it looks at having come before the site."""
    shapes = {name: value.shape for name, value in values.items()}
    before = {name: {n: everything[n] for n in order[:i]} for i, name in enumerate(order)}
    for effect in effects:
        parameters = effect.null()
        if effect.kind == "variance":
            context = Context(data, everything)
            parameters[FIELD] = jnp.zeros(effect.shape_of_field(values[effect.sites[0]], context))
        for site in effect.rewrites:
            new = rewritten(effect, site, values[site], parameters, Context(data, before[site]))
            try:
                grown = np.broadcast_shapes(shapes[site], jnp.shape(new))
            except ValueError:
                what, wanted = f"effect {effect.name}", f"site {site!r} of a shape that fits {shapes[site]}"
                remedy = "Return a value for each entry of the site, or one for all"
                raise InputError(what, wanted, f"{jnp.shape(new)}", remedy) from None
            if len(grown) > len(shapes[site]):
                what, wanted = f"effect {effect.name}", f"site {site!r} with {len(shapes[site])} axes"
                remedy = f"Let the model compute it for each entry: numpyro.deterministic(..., {site} * jnp.ones({grown}))"
                raise InputError(what, wanted, f"{len(grown)}, of shape {jnp.shape(new)}", remedy)
            shapes[site] = grown
    return shapes


def _shapes(run: Any, arrays: Any) -> dict[str, tuple[int, ...]]:
    found = cast("dict[str, Any]", jax.eval_shape(run, arrays))
    return {name: tuple(value.shape) for name, value in found.items()}
