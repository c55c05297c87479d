"""Devices of which a part is not heard: packets that are not acknowledged, radios that sleep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, half_normal, offers, told
from dtprob.effects.effect import Effect, Parameter
from dtprob.effects.network.laws import at
from dtprob.effects.network.slots import likelihood_ratio, mixed, one_fewer, sender_count, sends

type Unheard = Callable[[Any, Mapping[str, Any], int], Float[Array, "episode slot delivery_count"]]


def ack_loss(sites: Sites, _data: Data) -> list[Effect]:
    """Deliveries of a device are not acknowledged."""

    def other(value: Any, context: Mapping[str, Any], device: int) -> Any:
        p, senders = jax.nn.softmax(value), jnp.maximum(sender_count(context), 1)
        share = np.arange(p.shape[-1]) / senders[..., None]
        law = p * jnp.maximum(1.0 - share, 0.0) + one_fewer(p * share)
        return jnp.where(sends(context, device), law, p)

    return _unheard(
        sites,
        "ack_loss",
        told(half_normal("loss", 0.5), "deliveries that are not acknowledged", "share"),
        other,
        physics="A delivery of device {device} goes unacknowledged with probability 1 - exp(-loss).",
        source="Thinning of the deliveries; exact for one delivery per slot.",
    )


def duty_cycle(sites: Sites, _data: Data) -> list[Effect]:
    """A device's radio sleeps in part of the slots in which it is to send."""

    def other(value: Any, context: Mapping[str, Any], device: int) -> Any:
        law = jnp.exp(context["log_reception"])[jnp.maximum(sender_count(context) - 1, 0)]
        return jnp.where(sends(context, device), law, jax.nn.softmax(value))

    return _unheard(
        sites,
        "duty_cycle",
        told(half_normal("sleep", 0.5), "slots in which its radio is off", "share"),
        other,
        physics="Device {device} does not transmit in a share 1 - exp(-sleep) of the slots in which it is to.",
        source="P_s becomes P_{s-1}, and none of the deliveries is the device's.",
    )


def _unheard(
    sites: Sites,
    family: str,
    size: Parameter,
    other: Unheard,
    *,
    physics: str,
    source: str,
) -> list[Effect]:
    """A part of what a device sends is not heard: another law of deliveries in that part, and fewer are its own.

    Args:
        sites: what the model offers.
        family: of the effects, one per device.
        size: of the effect; its share of slots is 1 - exp(-size).
        other: (logits, context, device) -> probabilities of the number of deliveries in those slots.
        physics: with {device} where the device's number belongs.
        source: of the formula.
    """
    if not offers(sites, "reception_logits", "device_advantage"):
        return []
    devices = sites["device_advantage"].shape[-1]

    def of(device: int) -> Effect:
        return Effect(
            family,
            {
                "reception_logits": mixed(lambda value, context: other(value, context, device), size.name),
                "device_advantage": lambda value, p, context: (
                    value + _set_back(p[size.name], context, device, other)[..., None] * at(device, devices)
                ),
            },
            (size,),
            instance=f"device_{device}",
            physics=physics.format(device=device),
            source=source,
            requires=("sending", "deliveries", "log_reception"),
        )

    return [of(device) for device in range(devices)]


def _set_back(
    amount: Any, context: Mapping[str, Any], device: int, other: Unheard
) -> Float[Array, "episode slot"]:
    """What a device's log-odds of being heard change by, given how many are delivered in the slot.

    In a share of the slots it is not heard. Given d deliveries of s senders it is heard with probability r d / s, r the
    chance that the slot is none of these: odds of r (s - d) / (s - r d) over the others'.
    """
    senders, delivered = sender_count(context), jnp.asarray(context["deliveries"])
    logits = jnp.asarray(context["log_reception"])[senders]
    ratio = likelihood_ratio(other(logits, context, device), jax.nn.softmax(logits), context)
    own = 1.0 / (1.0 + jnp.expm1(amount) * ratio)
    is_open = (delivered > 0) & (delivered < senders) & sends(context, device)[..., 0]
    senders, delivered = jnp.where(is_open, senders, 2), jnp.where(is_open, delivered, 1)
    return jnp.where(is_open, jnp.log(own * (senders - delivered) / (senders - own * delivered)), 0.0)


FAMILIES: Final[dict[str, Family]] = {"ack_loss": ack_loss, "duty_cycle": duty_cycle}
