"""Models whose shared hierarchies are drawn in standard units, so that a joint mode exists.

Levels a_k ~ N(mu, tau) that several clusters share have no joint mode with tau: as all a_k come together the density grows
without bound. Of (a_k - mu) / tau it has one (Papaspiliopoulos, Roberts and Skoeld, Stat. Sci. 22 (2007) 59).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from numpyro import handlers
from numpyro.distributions import constraints
from numpyro.infer.reparam import LocScaleReparam

from dtprob.models.declaration import Data, Model, base_constraint, innermost, split_static, trace_model

_SCALED = {"loc", "scale"}


def decentred(model: Model, data: Data, shared: Collection[str]) -> Model:
    """The model with levels whose spread is unknown drawn in units of that spread; itself where there are none.

    A level `a` becomes a deterministic site, and `a_decentered` the latent one.

    Args:
        model: any model.
        data: its arguments by name.
        shared: names of latent sites without entries for each cluster.
    """
    arrays, static = split_static(data)
    ways: dict[str, LocScaleReparam] = {}

    def spreads(key: jax.Array, arrays: Any) -> dict[str, jax.Array]:
        trace = trace_model(model, eqx.combine(arrays, static), key)
        found = {n: _way(trace[n]["fn"]) for n in shared}
        ways.update({n: way for n, way in found.items() if way is not None})
        return {n: jnp.asarray(innermost(trace[n]["fn"]).scale) for n in ways}

    jax.eval_shape(spreads, jax.random.key(0), arrays)
    if not ways:
        return model
    told = jax.jit(jax.vmap(spreads, in_axes=(0, None)))(jax.random.split(jax.random.key(0)), arrays)
    ways = {n: way for n, way in ways.items() if bool((told[n][0] != told[n][1]).any())}
    if not ways:
        return model

    @functools.wraps(model)
    def drawn(*args: Any, **given: Any) -> Any:
        with handlers.reparam(config=lambda site: ways.get(site["name"])):
            return model(*args, **given)

    drawn.__signature__ = inspect.signature(model)  # pyright: ignore[reportAttributeAccessIssue]
    return drawn


def _way(fn: Any) -> LocScaleReparam | None:
    """How to draw from a distribution in standard units, where it has a location and a scale that something tells."""
    names = set(innermost(fn).arg_constraints)
    if not names >= _SCALED or base_constraint(fn.support) is not constraints.real:
        return None
    if not isinstance(innermost(fn).scale, Tracer):
        return None
    return LocScaleReparam(0.0, shape_params=sorted(names - _SCALED))
