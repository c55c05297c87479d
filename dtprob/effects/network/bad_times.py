"""Times in which a shared channel is another one: outages, and a stranger that sends too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, half_normal, offers, told
from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.effects.network.laws import at, mix
from dtprob.effects.network.slots import Other, likelihood_ratio, mixed, one_fewer, sender_count, sends

_DURATION: Final = Parameter("log_duration", dist.Normal(1.6, 1.0), -1.0, is_place=True)
"""Logarithm of the number of slots over which bad times are correlated; tells nothing where there are none.

Looked for from nearly no memory: the derivative in a share of bad times of nearly 0 grows without limit in long silences.
"""

_SURE: Final = 1e3
"""Odds that one slot can give to one state of the channel over the other."""

_FILTER: Final = (
    "Markov chain of two states, integrated out exactly by its filter (Hamilton, Econometrica 57 (1989) 357)."
)

_ONE_MORE: Final = (
    "P_s becomes P_{s+1}; one of its d deliveries is the stranger's with probability d / (s + 1)"
)


def bursty_channel(sites: Sites, _data: Data) -> list[Effect]:
    """The channel has good and bad times: nothing is heard in outages that last, or windows differ."""
    if not offers(sites, "reception_logits"):
        return []

    def silence(value: Any, _: Mapping[str, Any]) -> Any:
        return jnp.broadcast_to(at(0, value.shape[-1]).astype(float), value.shape)

    return [
        Effect(
            "bursty_channel",
            {"reception_logits": _at_times(silence, "loss")},
            (
                told(half_normal("loss", 0.5), "slots in outages", "share"),
                told(_DURATION, "slots of an outage", "factor"),
            ),
            physics="Nothing is heard in a share 1 - exp(-loss) of the slots, in outages of about exp(log_duration) slots.",
            source="Channel of Gilbert (1960) and Elliott (1963), " + _FILTER,
            requires=("sending", "deliveries", "log_reception"),
        ),
        Effect(
            "bursty_channel",
            {
                "reception_logits": lambda value, p, _: (
                    value + p["scale"] * p[FIELD] * np.arange(value.shape[-1])
                )
            },
            (told(half_normal("scale", 1.0), "spread of the log-odds of deliveries between windows"),),
            instance="each_window",
            kind="variance",
            physics="The channel differs at random between windows.",
            source="P(d) exp(s z d), z standard normal per window.",
            field_shape=lambda value, _: (value.shape[0], 1, 1),
        ),
    ]


def interferer(sites: Sites, _data: Data) -> list[Effect]:
    """A transmitter that the log does not know sends too, in bouts, or near one device."""
    if not offers(sites, "reception_logits", "device_advantage"):
        return []
    devices = sites["device_advantage"].shape[-1]
    effects: list[Effect] = []
    for device in (None, *range(devices)):

        def other(value: Any, context: Mapping[str, Any], device: int | None = device) -> Any:
            table = jnp.exp(context["log_reception"])
            more = jnp.concatenate([table[1:], jnp.eye(1, table.shape[1])])
            share = np.arange(table.shape[1]) / np.arange(1, len(table) + 1)[:, None]
            law = (more * jnp.maximum(1.0 - share, 0.0) + one_fewer(more * share))[sender_count(context)]
            return jnp.where(sends(context, device), law, jax.nn.softmax(value))

        effects.append(_stranger(other) if device is None else _stranger_near(device, other))
    return effects


def _stranger(other: Other) -> Effect:
    return Effect(
        "interferer",
        {"reception_logits": _at_times(other, "activity")},
        (
            told(half_normal("activity", 0.5), "slots in which it sends", "share"),
            told(_DURATION, "slots of a bout", "factor"),
        ),
        physics="In a share 1 - exp(-activity) of the slots, in bouts of about exp(log_duration) slots,"
        " one sender more takes part.",
        source=f"{_ONE_MORE}; the bouts are a {_FILTER}",
        requires=("sending", "deliveries", "log_reception"),
    )


def _stranger_near(device: int, other: Other) -> Effect:
    return Effect(
        "interferer",
        {"reception_logits": mixed(other, "activity")},
        (told(half_normal("activity", 0.5), "slots of the device in which it sends", "share"),),
        instance=f"device_{device}",
        physics=f"In a share 1 - exp(-activity) of the slots in which device {device} sends one sender more takes part.",
        source=f"{_ONE_MORE}.",
        requires=("sending", "log_reception"),
    )


def _at_times(other: Other, parameter: str) -> Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Any]:
    """Another law in bad times, which come and go as a Markov chain of two states does."""

    def rewrite(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        law = other(value, context)
        odds = jnp.minimum(likelihood_ratio(law, jax.nn.softmax(value), context), _SURE)
        chance = _bad_times(odds, -jnp.expm1(-p[parameter]), jnp.exp(-jnp.exp(-p["log_duration"])))
        return mix(value, law, -jnp.log1p(-chance)[..., None])

    return rewrite


def _bad_times(odds: Float[Array, "episode slot"], share: Any, memory: Any) -> Float[Array, "episode slot"]:
    """Chance of bad times in each slot, given the slots before it.

    Args:
        odds: what each slot says, its probability in bad times over that in good ones.
        share: of bad times on average.
        memory: correlation of neighbouring slots.
    """

    def pass_on(chance: Array, odds: Array) -> tuple[Array, Array]:
        after = chance * odds / (1.0 + chance * (odds - 1.0))
        return share + memory * (after - share), chance

    first = jnp.broadcast_to(jnp.asarray(share, odds.dtype), odds.shape[:1])
    return jax.lax.scan(pass_on, first, odds.T)[1].T


FAMILIES: Final[dict[str, Family]] = {"bursty_channel": bursty_channel, "interferer": interferer}
