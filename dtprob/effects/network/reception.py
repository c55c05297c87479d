"""A shared channel whose law of deliveries is not as the twin learned it: its table, capture, near and far devices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.common import Data, Family, Sites, half_normal, normal, offers, told
from dtprob.effects.effect import Effect
from dtprob.effects.network.laws import at
from dtprob.effects.network.slots import mixed, sender_count


def reception_shift(sites: Sites, _data: Data) -> list[Effect]:
    """With a given number of senders more or fewer packets are delivered: all of a slot's together, or one by one."""
    if not offers(sites, "reception_logits"):
        return []
    effects: list[Effect] = []
    for count in range(1, sites["reception_logits"].shape[-1]):

        def tilt(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], count: int = count) -> Any:
            deliveries = np.arange(value.shape[-1])
            change = p["log_odds_of_any"] * (deliveries > 0)
            if count > 1:
                change = change + p["log_odds_of_further"] * np.maximum(deliveries - 1, 0)
            return value + (sender_count(context) == count)[..., None] * change

        first = told(normal("log_odds_of_any", 1.0), "factor of the odds of a delivery", "factor")
        more = told(normal("log_odds_of_further", 1.0), "factor of the odds of each further one", "factor")
        further = (more,) if count > 1 else ()
        effects.append(
            Effect(
                "reception_shift",
                {"reception_logits": tilt},
                (first, *further),
                instance=f"{count}_senders",
                physics=f"The odds of a delivery, and of each further one, change when {count} devices send.",
                source="Exponential tilt: P(d) exp(a [d > 0] + c max(d - 1, 0)).",
                requires=("sending",),
            )
        )
    return effects


def capture(sites: Sites, _data: Data) -> list[Effect]:
    """The strongest of colliding packets is received after all."""
    if not offers(sites, "reception_logits"):
        return []

    def other(value: Any, context: Mapping[str, Any]) -> Any:
        p = jax.nn.softmax(value)
        captured = jnp.concatenate(
            [jnp.zeros_like(p[..., :1]), (p[..., :1] + p[..., 1:2]), p[..., 2:]], axis=-1
        )
        return jnp.where((sender_count(context) >= 2)[..., None], captured, p)

    return [
        Effect(
            "capture",
            {"reception_logits": mixed(other, "capture")},
            (told(half_normal("capture", 1.0), "collisions that a packet survives", "share"),),
            physics="With probability 1 - exp(-capture) one packet of a collision without delivery is received.",
            source="Capture effect: Zorzi and Rao, IEEE J. Sel. Areas Commun. 12 (1994).",
            requires=("sending",),
        )
    ]


def near_far(sites: Sites, _data: Data) -> list[Effect]:
    """A device is heard rather than the others that send with it, or is not."""
    if not offers(sites, "device_advantage"):
        return []
    devices = sites["device_advantage"].shape[-1]
    return [
        Effect(
            "near_far",
            {
                "device_advantage": lambda value, p, _, device=device: (
                    value + p["advantage"] * at(device, devices)
                )
            },
            (told(normal("advantage", 1.0), "factor of the odds to be heard rather than another", "factor"),),
            instance=f"device_{device}",
            physics=f"Log-odds that device {device} is delivered rather than another sender.",
            source="Conditional Bernoulli law of the delivered set: Chen and Liu, Statistica Sinica 7 (1997).",
        )
        for device in range(devices)
    ]


FAMILIES: Final[dict[str, Family]] = {
    "reception_shift": reception_shift,
    "capture": capture,
    "near_far": near_far,
}
