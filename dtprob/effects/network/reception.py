"""A shared channel that is not as the twin learned it: capture, near and far devices, interference, losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, half_normal, normal, offers
from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.effects.network.laws import at, mix

_DURATION: Final = Parameter("log_duration", dist.Normal(1.6, 1.0), -1.0, is_place=True)
"""Logarithm of the number of slots over which bad times are correlated; tells nothing where there are none.

Looked for from nearly no memory: the derivative in a share of bad times of nearly 0 grows without limit in long silences.
"""

_LEAST: Final = 1e-12
"""Probability below which the twin holds a number of deliveries impossible."""

_SURE: Final = 1e3
"""Odds that one slot can give to one state of the channel over the other."""

_FILTER: Final = (
    "Markov chain of two states, integrated out exactly by its filter (Hamilton, Econometrica 57 (1989) 357)."
)

type Unheard = Callable[[Any, Mapping[str, Any], int], Float[Array, "episode slot delivery_count"]]
type Other = Callable[[Any, Mapping[str, Any]], Float[Array, "episode slot delivery_count"]]


def reception_shift(sites: Sites, _data: Data) -> list[Effect]:
    """With a given number of senders more or fewer packets are delivered."""
    if not offers(sites, "reception_logits"):
        return []
    effects: list[Effect] = []
    for count in range(1, sites["reception_logits"].shape[-1]):

        def tilt(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], count: int = count) -> Any:
            own = _senders(context) == count
            return value + p["log_odds"] * own[..., None] * np.arange(value.shape[-1])

        effects.append(
            Effect(
                "reception_shift",
                {"reception_logits": tilt},
                (normal("log_odds", 1.0),),
                instance=f"{count}_senders",
                physics=f"The odds of each further delivery change when {count} devices send.",
                source="Exponential tilt: P(d) exp(c d).",
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
        return jnp.where((_senders(context) >= 2)[..., None], captured, p)

    return [
        Effect(
            "capture",
            {"reception_logits": _mixed(other, "capture")},
            (half_normal("capture", 1.0),),
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
            (normal("advantage", 1.0),),
            instance=f"device_{device}",
            physics=f"Log-odds that device {device} is delivered rather than another sender.",
            source="Conditional Bernoulli law of the delivered set: Chen and Liu, Statistica Sinica 7 (1997).",
        )
        for device in range(devices)
    ]


def bursty_channel(sites: Sites, _data: Data) -> list[Effect]:
    """The channel has good and bad times: nothing is heard in outages that last, or windows differ."""
    if not offers(sites, "reception_logits"):
        return []

    def silence(value: Any, _: Mapping[str, Any]) -> Any:
        return jnp.broadcast_to(at(0, value.shape[-1]).astype(float), value.shape)

    effects = [
        Effect(
            "bursty_channel",
            {"reception_logits": _at_times(silence, "loss")},
            (half_normal("loss", 0.5), _DURATION),
            physics="Nothing is heard in a share 1 - exp(-loss) of the slots, in outages of about exp(log_duration) slots.",
            source="Channel of Gilbert (1960) and Elliott (1963), " + _FILTER,
            requires=("sending", "deliveries", "log_reception"),
        )
    ]
    effects.append(
        Effect(
            "bursty_channel",
            {
                "reception_logits": lambda value, p, _: (
                    value + p["scale"] * p[FIELD] * np.arange(value.shape[-1])
                )
            },
            (half_normal("scale", 1.0),),
            instance="each_window",
            kind="variance",
            physics="The channel differs at random between windows.",
            source="P(d) exp(s z d), z standard normal per window.",
            field_shape=lambda value, _: (value.shape[0], 1, 1),
        )
    )
    return effects


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
            law = (more * jnp.maximum(1.0 - share, 0.0) + _next(more * share))[_senders(context)]
            return jnp.where(_with(context, device), law, jax.nn.softmax(value))

        anywhere, activity = device is None, half_normal("activity", 0.5)
        law = "P_s becomes P_{s+1}; one of its d deliveries is the stranger's with probability d / (s + 1)"
        effects.append(
            Effect(
                "interferer",
                {"reception_logits": (_at_times if anywhere else _mixed)(other, "activity")},
                (activity, _DURATION) if anywhere else (activity,),
                instance=None if anywhere else f"device_{device}",
                physics="In a share 1 - exp(-activity) of the slots"
                + (
                    ", in bouts of about exp(log_duration) slots,"
                    if anywhere
                    else f" in which device {device} sends"
                )
                + " one sender more takes part.",
                source=f"{law}; the bouts are a {_FILTER}" if anywhere else f"{law}.",
                requires=("sending", "log_reception", "deliveries"),
            )
        )
    return effects


def ack_loss(sites: Sites, _data: Data) -> list[Effect]:
    """Deliveries of a device are not acknowledged."""

    def other(value: Any, context: Mapping[str, Any], device: int) -> Any:
        p, senders = jax.nn.softmax(value), jnp.maximum(_senders(context), 1)
        share = np.arange(p.shape[-1]) / senders[..., None]
        law = p * jnp.maximum(1.0 - share, 0.0) + _next(p * share)
        return jnp.where(_with(context, device), law, p)

    return _unheard(
        sites,
        "ack_loss",
        "loss",
        other,
        physics="A delivery of device {device} goes unacknowledged with probability 1 - exp(-loss).",
        source="Thinning of the deliveries; exact for one delivery per slot.",
    )


def duty_cycle(sites: Sites, _data: Data) -> list[Effect]:
    """A device's radio sleeps in part of the slots in which it is to send."""

    def other(value: Any, context: Mapping[str, Any], device: int) -> Any:
        law = jnp.exp(context["log_reception"])[jnp.maximum(_senders(context) - 1, 0)]
        return jnp.where(_with(context, device), law, jax.nn.softmax(value))

    return _unheard(
        sites,
        "duty_cycle",
        "sleep",
        other,
        physics="Device {device} does not transmit in a share 1 - exp(-sleep) of the slots in which it is to.",
        source="P_s becomes P_{s-1}, and none of the deliveries is the device's.",
    )


def _unheard(
    sites: Sites,
    family: str,
    parameter: str,
    other: Unheard,
    *,
    physics: str,
    source: str,
) -> list[Effect]:
    """A part of what a device sends is not heard: another law of deliveries in that part, and fewer are its own.

    Args:
        sites: what the model offers.
        family: of the effects, one per device.
        parameter: its share of slots is 1 - exp(-parameter).
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
                "reception_logits": _mixed(lambda value, context: other(value, context, device), parameter),
                "device_advantage": lambda value, p, context: (
                    value + _set_back(p[parameter], context, device, other)[..., None] * at(device, devices)
                ),
            },
            (half_normal(parameter, 0.5),),
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
    senders, delivered = _senders(context), jnp.asarray(context["deliveries"])
    logits = jnp.asarray(context["log_reception"])[senders]
    law, elsewhere = (
        jnp.take_along_axis(p, delivered[..., None], axis=-1)[..., 0]
        for p in (jax.nn.softmax(logits), other(logits, context, device))
    )
    own = 1.0 / (1.0 + jnp.expm1(amount) * elsewhere / jnp.maximum(law, _LEAST))
    is_open = (delivered > 0) & (delivered < senders) & _with(context, device)[..., 0]
    senders, delivered = jnp.where(is_open, senders, 2), jnp.where(is_open, delivered, 1)
    return jnp.where(is_open, jnp.log(own * (senders - delivered) / (senders - own * delivered)), 0.0)


def _mixed(other: Other, parameter: str) -> Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Any]:
    def rewrite(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return mix(value, other(value, context), p[parameter])

    return rewrite


def _at_times(other: Other, parameter: str) -> Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Any]:
    """Another law in bad times, which come and go as a Markov chain of two states does."""

    def rewrite(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        law, delivered = other(value, context), jnp.asarray(context["deliveries"])[..., None]
        good, bad = (jnp.take_along_axis(q, delivered, axis=-1)[..., 0] for q in (jax.nn.softmax(value), law))
        odds = jnp.minimum(bad / jnp.maximum(good, _LEAST), _SURE)
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


def _senders(context: Mapping[str, Any]) -> Array:
    """How many devices send, (episode, slot)."""
    return jnp.sum(jnp.asarray(context["sending"]), axis=-1)


def _with(context: Mapping[str, Any], device: int | None) -> Array:
    """Whether the device sends, (episode, slot, 1); whether any does without one."""
    sending = jnp.asarray(context["sending"], bool)
    return (jnp.any(sending, axis=-1) if device is None else sending[..., device])[..., None]


def _next(mass: Float[Array, "*batch delivery_count"]) -> Float[Array, "*batch delivery_count"]:
    """Mass moved to one delivery fewer; that of none is gone."""
    return jnp.concatenate([mass[..., 1:], jnp.zeros_like(mass[..., :1])], axis=-1)


FAMILIES: Final[dict[str, Family]] = {
    "reception_shift": reception_shift,
    "capture": capture,
    "near_far": near_far,
    "bursty_channel": bursty_channel,
    "interferer": interferer,
    "ack_loss": ack_loss,
    "duty_cycle": duty_cycle,
}
