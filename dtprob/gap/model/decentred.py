"""Models whose shared hierarchies are drawn in standard units, so that a joint mode exists.

Levels a_k ~ N(mu, tau) that several clusters share have no joint mode with tau: as all a_k come together the density grows
without bound. Of (a_k - mu) / tau it has one (Papaspiliopoulos, Roberts and Skoeld, Stat. Sci. 22 (2007) 59). So it is with
random walks, Gaussian processes and the states of a `scan`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jax.core import Tracer
from numpyro.distributions import constraints
from numpyro.infer.reparam import LocScaleReparam, Reparam

from dtprob.effects.redrawn import Redrawn
from dtprob.models.arguments import Data, Model, split_static, within
from dtprob.models.declaration import base_constraint
from dtprob.models.execution import trace_model
from dtprob.wrapping import unwrapped

_SCALED = {"loc", "scale"}


class _Whitened(Reparam):
    """Draws independent standard normal numbers and makes of them what a joint normal distribution would draw."""

    def __call__(self, name: str, fn: Any, obs: Any) -> tuple[None, jax.Array]:  # noqa: ARG002  (latent sites only)
        own, batch, _ = self._unwrap(fn)
        normal = dist.Normal(0.0, 1.0).expand((*batch, *own.event_shape)).to_event(fn.event_dim)
        z = jnp.asarray(numpyro.sample(f"{name}_decentered", normal))
        if isinstance(own, dist.MultivariateNormal):
            return None, jnp.asarray(own.loc) + jnp.einsum("...ij,...j->...i", own.scale_tril, z)
        return None, jnp.cumsum(_spread(own)[..., None] * z, axis=-1)


def decentred(model: Model, data: Data, shared: Collection[str], own: Collection[str] = ()) -> Model:
    """The model with levels whose spread is unknown drawn in units of that spread; itself where there are none.

    A level `a` becomes a deterministic site, and `a_decentered` the latent one.

    Args:
        model: any model.
        data: its arguments by name.
        shared: names of latent sites without entries for each cluster.
        own: names of those with entries for each; heavy-tailed ones are drawn about zero, too.
    """
    arrays, static = split_static(data)
    ways: dict[str, Reparam] = {}

    def spreads(key: jax.Array, arrays: Any) -> dict[str, jax.Array]:
        trace = trace_model(model, eqx.combine(arrays, static), key)
        heavy = [n for n in own if _is_heavy(trace[n]["fn"])]
        found = {n: _way(trace[n]["fn"]) for n in (*shared, *heavy)}
        ways.update({n: way for n, way in found.items() if way is not None})
        return {n: _spread(unwrapped(trace[n]["fn"])[0]) for n in ways}

    jax.eval_shape(spreads, jax.random.key(0), arrays)
    if not ways:
        return model
    told = jax.jit(jax.vmap(spreads, in_axes=(0, None)))(jax.random.split(jax.random.key(0)), arrays)
    ways = {n: way for n, way in ways.items() if bool((told[n][0] != told[n][1]).any())}
    return within(model, lambda: Redrawn(ways)) if ways else model


def _way(fn: Any) -> Reparam | None:
    """How to draw from a distribution in standard units, where its spread is not the same always."""
    own, _ = unwrapped(fn)
    if isinstance(own, dist.GaussianRandomWalk | dist.MultivariateNormal):
        return _Whitened() if isinstance(_spread(own), Tracer) else None
    names = set(own.arg_constraints)
    if not names >= _SCALED or base_constraint(fn.support) is not constraints.real:
        return None
    if not isinstance(own.scale, Tracer):
        return None
    return LocScaleReparam(0.0, shape_params=sorted(names - _SCALED))


def _is_heavy(fn: Any) -> bool:
    """Whether a distribution is one of location and scale that is not normal, as that of levels with outliers."""
    own, _ = unwrapped(fn)
    return set(own.arg_constraints) >= _SCALED and not isinstance(own, dist.Normal)


def _spread(fn: Any) -> jax.Array:
    """What scales a distribution."""
    return jnp.asarray(fn.scale_tril if isinstance(fn, dist.MultivariateNormal) else fn.scale)
