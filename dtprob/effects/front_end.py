"""Radio front ends: what transmitter and receiver do to every path alike."""

from __future__ import annotations

from collections.abc import Mapping
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
    chains = [(None, None), *each_antenna(n_antenna(sites, "rx"), "rx")]
    effects = []
    for index, name in chains:

        def image(
            value: Any, p: Mapping[str, Any], context: Mapping[str, Any], index: int | None = index
        ) -> Any:
            mirror, exists = _mirror(context["subcarrier_frequency"])
            own = jnp.ones(value.shape[2]) if index is None else jnp.arange(value.shape[2]) == index
            own = on_axis(jnp.asarray(own, float), "rx_antenna", CHANNEL_AXES)
            half, amplitude = p["phase"] / 2, p["amplitude"]
            direct = jnp.cos(half) + 1j * amplitude * jnp.sin(half) - 1.0
            crossed = amplitude * jnp.cos(half) - 1j * jnp.sin(half)
            reflected = jnp.where(exists, jnp.conj(value[..., mirror]), 0.0)
            return value + own * (direct * value + crossed * reflected)

        effects.append(
            Effect(
                "iq_imbalance",
                {"noiseless_channel": image},
                (normal("amplitude", 0.05), normal("phase", 0.05, "rad")),
                instance=name,
                physics="Gain and phase mismatch of the receiver's branches; subcarrier k gets the conjugate"
                " of -k. Holds for pilots that are real and equal on mirror subcarriers, as in sounding.",
                source="y = mu x + nu x*: Tarighat et al., IEEE Trans. Signal Process. 53 (2005).",
                requires=("subcarrier_frequency",),
            )
        )
    return effects


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
