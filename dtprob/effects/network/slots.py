"""Slots of a shared channel: who sends in them, and another law of what is delivered in a share of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from dtprob.effects.network.laws import mix

_LEAST: Final = 1e-12
"""Probability below which the twin holds a number of deliveries impossible."""

type Other = Callable[[Any, Mapping[str, Any]], Float[Array, "episode slot delivery_count"]]
"""(logits, data) -> probabilities of the number of deliveries where another law holds."""


def mixed(other: Other, parameter: str) -> Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Any]:
    """A rewrite of a law's logits: another law holds in a share 1 - exp(-parameter) of the slots, at random."""

    def rewrite(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return mix(value, other(value, context), p[parameter])

    return rewrite


def sender_count(context: Mapping[str, Any]) -> Array:
    """How many devices send, (episode, slot)."""
    return jnp.sum(jnp.asarray(context["sending"]), axis=-1)


def sends(context: Mapping[str, Any], device: int | None) -> Array:
    """Whether the device sends, (episode, slot, 1); whether any does without one."""
    sending = jnp.asarray(context["sending"], bool)
    return (jnp.any(sending, axis=-1) if device is None else sending[..., device])[..., None]


def likelihood_ratio(
    law: Float[Array, "episode slot delivery_count"],
    usual: Float[Array, "episode slot delivery_count"],
    context: Mapping[str, Any],
) -> Float[Array, "episode slot"]:
    """Probability of what was delivered in each slot under a law, over that under the usual one."""
    delivered = jnp.asarray(context["deliveries"])[..., None]
    here, there = (jnp.take_along_axis(p, delivered, axis=-1)[..., 0] for p in (law, usual))
    return here / jnp.maximum(there, _LEAST)


def one_fewer(mass: Float[Array, "*batch delivery_count"]) -> Float[Array, "*batch delivery_count"]:
    """Mass moved to one delivery fewer; that of none is gone."""
    return jnp.concatenate([mass[..., 1:], jnp.zeros_like(mass[..., :1])], axis=-1)
