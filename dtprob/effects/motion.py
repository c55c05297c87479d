"""What changes from snapshot to snapshot: movement, oscillators, clocks, gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects import unfolding
from dtprob.effects.common import (
    Clock,
    Data,
    Family,
    Sites,
    along,
    axis_labels,
    band,
    clock,
    half_normal,
    has_phase,
    is_coherent,
    links_and_paths,
    n_snapshot,
    normal,
    observable_basis,
    offers,
    phasor,
    touched_objects,
)
from dtprob.effects.effect import FIELD, Effect
from dtprob.raytracing.paths import SPECULAR, PathSet

_SPEED: Final = 1.0
"""Prior standard deviation of a speed in m/s, before it is cut to what snapshots can tell."""


def doppler(sites: Sites, data: Data) -> list[Effect]:
    """Receiver, transmitter or an object moves while snapshots are taken."""
    time, paths = clock(data), data.get("paths")
    if time is None or paths is None or not has_phase(sites) or not offers(sites, "path_phase"):
        return []
    every = np.eye(3)
    effects = [
        _doppler(
            None, "The receivers move", basis=every, time=time, paths=paths, shift=unfolding.of_receiver
        ),
        _doppler(
            "transmitter",
            "The transmitters move",
            basis=every,
            time=time,
            paths=paths,
            shift=unfolding.of_transmitter,
        ),
    ]
    for index, name in touched_objects(data):
        at_object = (np.asarray(paths.interaction) == SPECULAR) & (np.asarray(paths.object) == index)
        basis = observable_basis(np.asarray(paths.normal)[at_object & np.asarray(paths.mask)[..., None]])
        if len(basis):

            def shift(paths: PathSet, velocity: Any, index: int = index) -> Any:
                return unfolding.of_object(paths, index, velocity)

            text = f"{name} moves along {along(basis)}"
            effects.append(_doppler(name, text, basis=basis, time=time, paths=paths, shift=shift))
    return effects


def _doppler(
    instance: str | None,
    text: str,
    *,
    basis: np.ndarray,
    time: Clock,
    paths: PathSet,
    shift: Callable[[PathSet, Any], Float[Array, "link path 3"]],
) -> Effect:
    """A speed adds L'(t) = L + t dL/dt to every path, dL/dt = k . s(velocity); delays and angles stay."""

    def turn(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths = context["paths"]
        rate = jnp.sum(paths.arrival * shift(paths, p["velocity"] @ jnp.asarray(basis)), -1)
        rate = jnp.where(paths.mask, rate, 0.0)
        elapsed = time.elapsed(context["snapshot_time"])
        return value - (2 * jnp.pi / paths.wavelength) * rate[:, None, :] * elapsed[None, :, None]

    return Effect(
        "doppler",
        {"path_phase": turn},
        (
            normal(
                "velocity",
                min(_SPEED, 0.5 * paths.wavelength / time.step),
                "m/s",
                len(basis),
                axis_labels(basis),
            ),
        ),
        instance=instance,
        physics=f"{text} with a constant velocity during the snapshots.",
        source="phase = -2 pi / lambda (dL/dt) t; the prior ends where a snapshot step turns half a cycle.",
        requires=("paths", "snapshot_time"),
    )


def carrier_frequency_offset(sites: Sites, data: Data) -> list[Effect]:
    """The oscillators of the two ends differ in frequency."""
    time = clock(data)
    if time is None or not is_coherent(sites, data) or not offers(sites, "path_phase"):
        return []

    def turn(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + (2 * jnp.pi * p["frequency"] * time.elapsed(context["snapshot_time"]))[None, :, None]

    return [
        Effect(
            "carrier_frequency_offset",
            {"path_phase": turn},
            (normal("frequency", min(100.0, 0.5 / time.step), "Hz"),),
            physics="The rest of the frequency difference turns all paths alike, from snapshot to snapshot.",
            source="h(t) = h exp(j 2 pi df t); the prior ends where a snapshot step turns half a cycle.",
            requires=("snapshot_time",),
        )
    ]


def carrier_phase_drift(sites: Sites, data: Data) -> list[Effect]:
    """The common phase wanders from snapshot to snapshot, as a free-running oscillator does."""
    time = clock(data)
    if time is None or not is_coherent(sites, data) or not offers(sites, "path_phase"):
        return []

    def wander(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        steps = jnp.diff(context["snapshot_time"], prepend=context["snapshot_time"][:1])
        walk = jnp.cumsum(jnp.sqrt(jnp.abs(steps))[None, :, None] * p[FIELD], axis=1)
        return value + p["scale"] * walk

    return [
        Effect(
            "carrier_phase_drift",
            {"path_phase": wander},
            (half_normal("scale", 1.0 / np.sqrt(time.span), "rad/s^0.5"),),
            kind="variance",
            physics="Phase common to all paths that does a random walk over the snapshots of a link.",
            source="Free-running oscillator: Demir et al., IEEE Trans. Circuits Syst. I 47 (2000).",
            requires=("snapshot_time",),
            field_shape=lambda value, context: (
                links_and_paths(value, context)[0],
                np.shape(context["snapshot_time"])[0],
                1,
            ),
        )
    ]


def phase_noise(sites: Sites, data: Data) -> list[Effect]:
    """An independent common phase in every snapshot of every link."""
    if not is_coherent(sites, data) or not offers(sites, "path_phase"):
        return []
    count = n_snapshot(sites)
    return [
        Effect(
            "phase_noise",
            {"path_phase": lambda value, p, _: value + p["scale"] * p[FIELD]},
            (half_normal("scale", 0.3, "rad"),),
            kind="variance",
            physics="Phase common to all paths, independent between snapshots and links.",
            source="Common phase error of OFDM: Petrovic et al., IEEE Trans. Commun. 55 (2007).",
            field_shape=lambda value, context: (links_and_paths(value, context)[0], count, 1),
        )
    ]


def sampling_clock_offset(sites: Sites, data: Data) -> list[Effect]:
    """The sampling clocks of the two ends differ, so the timing drifts from snapshot to snapshot."""
    time, measured = clock(data), band(data)
    if time is None or measured is None or not has_phase(sites):
        return []

    def drift(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        delay = p["offset"] * time.elapsed(context["snapshot_time"])
        turn = delay[:, None] * jnp.asarray(context["subcarrier_frequency"])
        return value * phasor(-2 * jnp.pi * turn)[None, :, None, None, :]

    return [
        Effect(
            "sampling_clock_offset",
            {"noiseless_channel": drift},
            (normal("offset", min(2e-5, 0.5 / (measured.width * time.span))),),
            physics="The baseband delay of all paths grows in proportion to time.",
            source="h(f_k, t) = h exp(-j 2 pi f_k e t), e the relative clock error.",
            requires=("snapshot_time", "subcarrier_frequency"),
        )
    ]


def gain_drift(sites: Sites, data: Data) -> list[Effect]:
    """The gain of the chain drifts with time, as with temperature."""
    time = clock(data)
    if time is None or not has_phase(sites):
        return []

    def drift(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        elapsed = time.elapsed(context["snapshot_time"]) / time.span
        return value * jnp.exp(p["log_gain"] * elapsed)[None, :, None, None, None]

    return [
        Effect(
            "gain_drift",
            {"noiseless_channel": drift},
            (normal("log_gain", 0.2, "Np"),),
            physics="Log amplitude that grows linearly from the first to the last snapshot, by this much.",
            source="h(t) = h exp(g t / T).",
            requires=("snapshot_time",),
        )
    ]


FAMILIES: Final[dict[str, Family]] = {
    "doppler": doppler,
    "carrier_frequency_offset": carrier_frequency_offset,
    "carrier_phase_drift": carrier_phase_drift,
    "phase_noise": phase_noise,
    "sampling_clock_offset": sampling_clock_offset,
    "gain_drift": gain_drift,
}
