"""Traffic that is not as the twin learned it: devices that fall silent, load, bursts, coupling, drift."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpyro.distributions as dist

from dtprob.effects.common import Data, Family, Sites, half_normal, normal, offers, told
from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.effects.network.laws import (
    ClustersLike,
    clusters_of,
    from_then_on,
    joined,
    last_arrival,
    last_delivery,
    mixed_at,
    of_device,
    progress,
    repeated,
    same_arrival,
    thinned,
)

_WINDOWS: Final = 8
"""Windows from which on it can be told when in a log a device falls silent."""
_ONSETS: Final = 32
"""Times in a log at which a device is looked at whether it falls silent."""
_MOST_ONSETS: Final = 32
"""Devices up to which that is done; in larger networks a device is looked at over the whole log."""
_MOST_PAIRS: Final = 120
"""Pairs of devices in which coupling is looked for; larger networks have none offered."""


def device_disconnected(sites: Sites, data: Data) -> list[Effect]:
    """A device generates fewer packets, or none, from some time on, and the others go on as before."""
    clusters = _clusters(sites, data)
    if clusters is None:
        return []
    lasts = sites["arrival_logits"].shape[0] >= _WINDOWS
    tried = (
        tuple(np.linspace(0.0, 1.0, _ONSETS, endpoint=False).tolist())
        if clusters.devices <= _MOST_ONSETS
        else ()
    )
    since = Parameter("onset", dist.Normal(0.0, 0.5), is_place=True, tried=tried)
    onset = (told(since, "part of the log before that", "percent"),) if lasts else ()
    effects: list[Effect] = []
    for device in range(clusters.devices):

        def thin(value: Any, p: Mapping[str, Any], _: Mapping[str, Any], device: int = device) -> Any:
            loss = p["loss"]
            if lasts:
                loss = from_then_on(loss, value.shape[0], p["onset"])[:, None, None, None]
            return mixed_at(value, clusters, device, thinned, loss)

        effects.append(
            Effect(
                "device_disconnected",
                {"arrival_logits": thin},
                (told(half_normal("loss", 3.0), "packets that are missing", "share"), *onset),
                instance=f"device_{device}",
                physics=f"Each packet of device {device} is not generated with probability 1 - exp(-loss)"
                + (", after a share `onset` of the log." if lasts else "."),
                source="Thinning of the joint arrivals: P(a) of outcomes with the device moves to those without.",
                requires=("clusters",),
            )
        )
    return effects


def arrival_rate_shift(sites: Sites, data: Data) -> list[Effect]:
    """A device generates more packets, or all devices generate them at another rate."""
    clusters = _clusters(sites, data)
    if clusters is None:
        return []
    total = _count(clusters)
    effects = [
        Effect(
            "arrival_rate_shift",
            {"arrival_logits": lambda value, p, _: value + p["log_odds"] * total},
            (told(normal("log_odds", 1.0), "factor of the odds of a packet", "factor"),),
            physics="The odds of an arrival at all devices change by a factor.",
            source="Exponential tilt of the joint arrivals: P(a) exp(c n(a)).",
            requires=("clusters",),
        )
    ]
    for device in range(clusters.devices):

        def add(value: Any, p: Mapping[str, Any], _: Mapping[str, Any], device: int = device) -> Any:
            return mixed_at(value, clusters, device, joined, p["extra"])

        effects.append(
            Effect(
                "arrival_rate_shift",
                {"arrival_logits": add},
                (told(half_normal("extra", 1.0), "empty slots that get a packet", "share"),),
                instance=f"device_{device}",
                physics=f"Device {device} generates a packet with probability 1 - exp(-extra) where it would have none; "
                "fewer packets are `device_disconnected`.",
                source="Superposition: P(a) of outcomes without the device moves to those with it.",
                requires=("clusters",),
            )
        )
    return effects


def bursty_traffic(sites: Sites, data: Data) -> list[Effect]:
    """Arrivals come in bursts: more likely after an arrival, or in some windows than in others."""
    clusters = _clusters(sites, data)
    if clusters is None:
        return []
    effects: list[Effect] = []
    for device in range(clusters.devices):

        def follow(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], device: int = device) -> Any:
            last = last_arrival(context, clusters, device)[..., None]
            return mixed_at(value, clusters, device, lambda v, bit: repeated(v, bit, last), p["persistence"])

        effects.append(
            Effect(
                "bursty_traffic",
                {"arrival_logits": follow},
                (told(half_normal("persistence", 1.0), "slots that repeat the last one", "share"),),
                instance=f"device_{device}",
                physics=f"Device {device} repeats its last slot with probability 1 - exp(-persistence); its load stays.",
                source="Discrete autoregression of order one (Jacobs and Lewis, J. R. Stat. Soc. B 40 (1978) 94).",
                requires=("clusters", "previous"),
            )
        )
    total = _count(clusters)
    effects.append(
        Effect(
            "bursty_traffic",
            {"arrival_logits": lambda value, p, _: value + p["scale"] * p[FIELD] * total},
            (told(half_normal("scale", 1.0), "spread of the log-odds of packets between windows"),),
            instance="each_window",
            kind="variance",
            physics="The load differs at random between windows.",
            source="P(a) exp(s z n(a)), z standard normal per window: over-dispersed counts.",
            requires=("clusters",),
            field_shape=lambda value, _: (value.shape[0], 1, 1, 1),
        )
    )
    return effects


def closed_loop_traffic(sites: Sites, data: Data) -> list[Effect]:
    """A device's source waits for an acknowledgement: packets come more often, or less, after a delivery."""
    clusters = _clusters(sites, data)
    if clusters is None:
        return []
    effects: list[Effect] = []
    for device in range(clusters.devices):

        def answer(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], device: int = device) -> Any:
            delivered = last_delivery(context, clusters, device)
            return of_device(value, clusters, device, p["log_odds"] * delivered[..., None])

        effects.append(
            Effect(
                "closed_loop_traffic",
                {"arrival_logits": answer},
                (told(normal("log_odds", 1.0), "factor of the odds of a packet after a delivery", "factor"),),
                instance=f"device_{device}",
                physics=f"The odds of a packet of device {device} change in the slot after one of its own was delivered.",
                source="Closed-loop sources: Schroeder, Wierman and Harchol-Balter, NSDI (2006).",
                requires=("clusters", "acknowledged"),
            )
        )
    return effects


def cross_cluster_traffic(sites: Sites, data: Data) -> list[Effect]:
    """Arrivals of devices in different clusters depend on one another."""
    clusters = _clusters(sites, data)
    if clusters is None:
        return []
    of, devices = clusters.cluster_of, range(clusters.devices)
    ordered = [(i, j) for i in devices for j in devices if of[i] != of[j]]
    if len(ordered) > _MOST_PAIRS:
        return []
    effects: list[Effect] = []
    for i, j in ordered:
        effects.append(_passed_on(clusters, i, j))
        if of[i] < of[j] and data.get("arrivals") is not None:
            effects.append(_coupled(clusters, i, j))
    return effects


def _passed_on(clusters: ClustersLike, i: int, j: int) -> Effect:
    """A packet that came to device i in the slot before comes to device j, too."""

    def forward(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        last = last_arrival(context, clusters, i)[..., None, None]
        return mixed_at(value, clusters, j, joined, p["passed"] * last)

    return Effect(
        "cross_cluster_traffic",
        {"arrival_logits": forward},
        (told(half_normal("passed", 1.0), "packets that are passed on", "share"),),
        instance=f"{i}_to_{j}",
        physics=f"A packet of device {i} in the slot before is passed on to device {j} with probability 1 - exp(-passed).",
        source="Superposition: P(a) of outcomes without the device moves to those with it.",
        requires=("clusters", "previous"),
    )


def _coupled(clusters: ClustersLike, i: int, j: int) -> Effect:
    """Device i's arrival changes the odds of device j's in the same slot; neither comes first."""

    def couple(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        beside = same_arrival(context, clusters, i) - 0.5
        return of_device(value, clusters, j, p["log_odds"] * beside[..., None])

    return Effect(
        "cross_cluster_traffic",
        {"arrival_logits": couple},
        (
            told(
                normal("log_odds", 1.0), "factor of the odds of a packet beside the other device's", "factor"
            ),
        ),
        instance=f"{i}_with_{j}",
        physics=f"An arrival at device {i} in the same slot changes the odds of one at device {j}.",
        source="Log-linear interaction: P(a_j | the others) tilted by c (a_i[t] - 1/2).",
        requires=("clusters", "arrivals"),
    )


def drift(sites: Sites, data: Data) -> list[Effect]:
    """The load of a device, or how well the channel delivers, changes from the beginning of the log on."""
    clusters = _clusters(sites, data)
    if clusters is None or sites["arrival_logits"].shape[0] < 2:
        return []
    effects: list[Effect] = []
    for device in range(clusters.devices):
        more, fewer = "a packet where it would have none", "no packet where it would have one"
        extra, lost = "empty slots that get a packet at the end", "packets that are missing at the end"
        for change, name, what, meaning in ((joined, "", more, extra), (thinned, "_falling", fewer, lost)):
            text = (
                f"Device {device} generates {what}: with probability 1 - exp(-amount) by the end of the log."
            )
            grow = {"arrival_logits": _growing(clusters, device, change)}
            amount = told(half_normal("amount", 1.0), meaning, "share")
            effects.append(_drift(grow, amount, f"device_{device}{name}", text))
    if offers(sites, "reception_logits"):

        def fade(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            return value + p["log_odds"] * progress(value.shape[0])[..., None] * np.arange(value.shape[2])

        text = "The log-odds of each delivery change linearly, by this over the whole log."
        size = told(normal("log_odds", 1.0), "factor of the odds of each delivery at the end", "factor")
        effects.append(_drift({"reception_logits": fade}, size, "reception", text))
    return effects


def _growing(clusters: ClustersLike, device: int, change: Callable[..., Any]) -> Callable[..., Any]:
    def grow(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        amount = p["amount"] * progress(value.shape[0])[..., None, None]
        return mixed_at(value, clusters, device, change, amount)

    return grow


def _drift(rewrites: Mapping[str, Any], size: Parameter, instance: str, physics: str) -> Effect:
    source = "x from 0 in the first window, where all is as the twin has learned it, to 1 in the last."
    return Effect("drift", rewrites, (size,), instance=instance, physics=physics, source=source)


def _clusters(sites: Sites, data: Data) -> ClustersLike | None:
    return clusters_of(data) if offers(sites, "arrival_logits") else None


def _count(clusters: ClustersLike) -> Any:
    """How many devices have an arrival, (cluster, outcome)."""
    return clusters.arrives.sum(axis=1).astype(float)


FAMILIES: Final[dict[str, Family]] = {
    "device_disconnected": device_disconnected,
    "arrival_rate_shift": arrival_rate_shift,
    "bursty_traffic": bursty_traffic,
    "closed_loop_traffic": closed_loop_traffic,
    "cross_cluster_traffic": cross_cluster_traffic,
    "drift": drift,
}
