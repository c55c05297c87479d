"""Radio front ends: what transmitter and receiver do to every path alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from dtprob.effects.common import (
    COMPLEX,
    Band,
    Data,
    Family,
    Sites,
    band,
    complex_of,
    each_antenna,
    half_normal,
    has_phase,
    is_coherent,
    legendre,
    n_antenna,
    n_snapshot,
    normal,
    offers,
    on_axis,
    phasor,
)
from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.effects.meaning import CHANNEL_AXES

_RIPPLES: Final = np.arange(1.5, 16.25, 0.5)
"""Cycles of a ripple over the band: an echo between two of them loses a fifth of its power at most."""


def timing_offset(sites: Sites, data: Data) -> list[Effect]:
    """A baseband delay common to all links, or an independent one in every packet."""
    measured = band(data)
    if measured is None or not has_phase(sites):
        return []
    spread, effects = 0.5 / measured.width, []

    def delay(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value * phasor(-2 * jnp.pi * context["subcarrier_frequency"] * p["delay"])

    def jitter(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value * phasor(-2 * jnp.pi * context["subcarrier_frequency"] * (p["scale"] * p[FIELD]))

    if offers(sites, "frequency_response"):
        effects.append(
            Effect(
                "timing_offset",
                {"frequency_response": delay},
                (normal("delay", spread, "s"),),
                physics="The receiver's time origin is late by a common delay; the carrier's phase stays.",
                source="h(f_k) exp(-j 2 pi f_k d).",
                requires=("subcarrier_frequency",),
            )
        )
    count = n_snapshot(sites)
    effects.append(
        Effect(
            "timing_offset",
            {"noiseless_channel": jitter},
            (half_normal("scale", spread / 2, "s"),),
            instance="each_packet",
            kind="variance",
            physics="The receiver's time origin is random, independent between links and snapshots.",
            source="h(f_k) exp(-j 2 pi f_k d), d ~ N(0, scale^2).",
            requires=("subcarrier_frequency",),
            field_shape=lambda value, _: (value.shape[0], max(value.shape[1], count), 1, 1, 1),
        )
    )
    return effects


def carrier_phase(sites: Sites, data: Data) -> list[Effect]:
    """A constant phase between the two oscillators."""
    if not is_coherent(sites, data) or not offers(sites, "frequency_response"):
        return []
    return [
        Effect(
            "carrier_phase",
            {"frequency_response": lambda value, p, _: value * phasor(p["phase"])},
            (normal("phase", 1.0, "rad"),),
            physics="All measurements are turned by one phase.",
            source="h exp(j phi).",
        )
    ]


def frequency_response(sites: Sites, data: Data) -> list[Effect]:
    """Filters and cables weigh the subcarriers: smoothly for all, or differently at one receiving antenna."""
    measured = band(data)
    if measured is None or measured.size < 4 or not has_phase(sites):
        return []
    effects = []
    if offers(sites, "frequency_response"):
        effects.append(
            Effect(
                "frequency_response",
                {"frequency_response": lambda value, p, context: value * _smooth(measured, p, context)},
                _smooth_sizes(),
                physics="Smooth response of the whole chain, its mean gain and its delay included.",
                source="exp(sum_n a_n P_n(x) + j sum_m b_m P_m(x)), Legendre, n = 0..4, m = 1..4.",
                requires=("subcarrier_frequency",),
            )
        )
    for index, name in each_antenna(n_antenna(sites, "rx"), "rx"):

        def weigh(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], index: int = index) -> Any:
            own = on_axis(jnp.arange(value.shape[2]) == index, "rx_antenna", CHANNEL_AXES)
            return jnp.where(own, value * _smooth(measured, p, context), value)

        effects.append(
            Effect(
                "frequency_response",
                {"noiseless_channel": weigh},
                _smooth_sizes(),
                instance=name,
                physics=f"Smooth response of the chain of receiving antenna {index} alone.",
                source="As for the whole chain.",
                requires=("subcarrier_frequency",),
            )
        )
    return effects


def _smooth_sizes() -> tuple[Parameter, Parameter]:
    """Coefficients of Legendre polynomials, labelled by their degree."""
    gains, phases = (tuple(map(str, range(first, 5))) for first in (0, 1))
    return normal("log_gain", 0.1, "Np", 5, gains), normal("phase", 0.1, "rad", 4, phases)


def _smooth(
    measured: Band, p: Mapping[str, Any], context: Mapping[str, Any]
) -> Complex[Array, " subcarrier"]:
    x = measured.position(context["subcarrier_frequency"])
    gain = legendre(x, range(5)) @ p["log_gain"]
    return jnp.exp(gain) * phasor(legendre(x, range(1, 5)) @ p["phase"])


def frequency_ripple(sites: Sites, data: Data) -> list[Effect]:
    """An echo inside the chain, as between two ends of a mismatched cable."""
    measured = band(data)
    if measured is None or not has_phase(sites) or not offers(sites, "frequency_response"):
        return []
    effects = []
    for cycles in _RIPPLES.tolist():
        if measured.size <= 2 * cycles:
            continue

        def echo(value: Any, p: Mapping[str, Any], context: Mapping[str, Any], cycles: float = cycles) -> Any:
            turn = jnp.pi * cycles * measured.position(context["subcarrier_frequency"])
            return value * (1.0 + complex_of(p["echo"]) * phasor(-turn))

        effects.append(
            Effect(
                "frequency_ripple",
                {"frequency_response": echo},
                (normal("echo", 0.05, "1", 2, COMPLEX),),
                instance=f"{cycles:g}_cycles",
                physics=f"An echo {cycles / measured.width:.3g} s late, {cycles:g} cycles over the band.",
                source="1 + g exp(-j 2 pi f_k m / B), g complex (real, imaginary).",
                requires=("subcarrier_frequency",),
            )
        )
    return effects


def iq_imbalance(sites: Sites, data: Data) -> list[Effect]:
    """The two branches of the receiver's mixer differ, so each subcarrier gets an image of its mirror one."""
    measured = band(data)
    if measured is None or not has_phase(sites) or not _has_mirror(data):
        return []
    effects = []
    for index, name in [(None, None), *each_antenna(n_antenna(sites, "rx"), "rx")]:
        effects.append(
            _mixing(
                name,
                _both_branches,
                "Gain and phase mismatch of the receiver's branches; subcarrier k gets the conjugate"
                " of -k. Holds for pilots that are real and equal on mirror subcarriers, as in sounding.",
                "y = mu x + nu x*: Tarighat et al., IEEE Trans. Signal Process. 53 (2005).",
                index,
            )
        )
    effects.append(
        _mixing(
            "one_branch",
            _one_branch,
            "Gain and phase of one branch of the receiver's mixer, beside the other, by which levels and phases"
            " count: all that is received turns and grows a little, too.",
            "mu = (1 + g exp(-j phi)) / 2, nu = (1 - g exp(j phi)) / 2: Valkama et al., IEEE Trans. Signal"
            " Process. 49 (2001).",
        )
    )
    return effects


def _mixing(
    instance: str | None,
    shares: Callable[[Array, Array], tuple[Array, Array]],
    physics: str,
    source: str,
    index: int | None = None,
) -> Effect:
    """What a mismatch of the branches does to one receiving antenna, or all; shares tell mu and nu by gain and phase."""

    def mix(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        mirror, exists = _mirror(context["subcarrier_frequency"])
        own = jnp.ones(value.shape[2]) if index is None else jnp.arange(value.shape[2]) == index
        own = on_axis(jnp.asarray(own, float), "rx_antenna", CHANNEL_AXES)
        direct, crossed = shares(p["amplitude"], p["phase"])
        reflected = jnp.where(exists, jnp.conj(value[..., mirror]), 0.0)
        return value + own * ((direct - 1.0) * value + crossed * reflected)

    return Effect(
        "iq_imbalance",
        {"noiseless_channel": mix},
        (normal("amplitude", 0.05), normal("phase", 0.05, "rad")),
        instance=instance,
        physics=physics,
        source=source,
        requires=("subcarrier_frequency",),
    )


def _both_branches(amplitude: Array, phase: Array) -> tuple[Array, Array]:
    """Branches of gains 1 + a and 1 - a, turned by half the phase each against the other."""
    half = phase / 2
    return jnp.cos(half) + 1j * amplitude * jnp.sin(half), amplitude * jnp.cos(half) - 1j * jnp.sin(half)


def _one_branch(amplitude: Array, phase: Array) -> tuple[Array, Array]:
    """One branch as it should be, the other of gain 1 + a and turned by the phase."""
    other = 1.0 + amplitude
    return (1.0 + other * phasor(-phase)) / 2, (1.0 - other * phasor(phase)) / 2


def _mirror(frequency: Float[Array, " n"]) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
    """Index of the subcarrier nearest to -f_k, and whether it lies within a quarter of a subcarrier of it."""
    distance = jnp.abs(frequency[:, None] + frequency[None, :])
    step = (jnp.max(frequency) - jnp.min(frequency)) / (frequency.shape[0] - 1)
    return jnp.argmin(distance, axis=1), jnp.min(distance, axis=1) < 0.25 * step


def _has_mirror(data: Data) -> bool:
    return bool(np.mean(_mirror(jnp.asarray(data["subcarrier_frequency"], float))[1]) > 0.25)


FAMILIES: Final[dict[str, Family]] = {
    "timing_offset": timing_offset,
    "carrier_phase": carrier_phase,
    "frequency_response": frequency_response,
    "frequency_ripple": frequency_ripple,
    "iq_imbalance": iq_imbalance,
}
