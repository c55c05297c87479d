"""Receivers and estimators that do more than filter: compression, leakage, smoothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from dtprob.effects.common import (
    COMPLEX,
    Data,
    Family,
    Sites,
    band,
    complex_of,
    half_normal,
    has_phase,
    normal,
    on_axis,
    phasor,
    reference_power,
    square,
)
from dtprob.effects.effect import Effect, Parameter
from dtprob.effects.meaning import CHANNEL_AXES

_SALEH: Final = (
    "A. Saleh, IEEE Trans. Commun. 29 (1981); to first order the cubic term of a memoryless polynomial."
)
_KNEE: Final = 0.4
"""Of the log of the power's exponent: tubes compress from afar (1), transistors near saturation (2 and more)."""
_FAINT: Final = 1e-12
"""Power, in units of the mean, below which no entry is taken: its logarithm has a derivative."""


def amplifier_nonlinearity(sites: Sites, data: Data) -> list[Effect]:
    """A memoryless amplifier compresses strong signals and turns their phase."""
    power = reference_power(data)
    if power is None or not has_phase(sites):
        return []

    def compress(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        level = jnp.maximum(square(value) / power, _FAINT)
        return value / (1.0 + p["compression"] * level ** jnp.exp(p["log_knee"]))

    def compress_all(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        level = jnp.mean(square(value), axis=-1, keepdims=True) / power
        return value / (1.0 + p["compression"] * level)

    def turn(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        level = square(value) / power
        return value * phasor(p["phase"] * level / (1.0 + level))

    compression = half_normal("compression", 0.1)
    knee = Parameter("log_knee", dist.Normal(0.0, _KNEE), is_place=True)
    effects = [
        Effect(
            "amplifier_nonlinearity",
            {"noiseless_channel": compress},
            (compression, knee),
            physics="Gain falls with the power of the entry: one tone at a time, the sharper the larger the knee."
            " Unit: the mean power.",
            source="h / (1 + c (|h|^2 / P)^k): for k = 1 " + _SALEH,
        ),
        Effect(
            "amplifier_nonlinearity",
            {"noiseless_channel": turn},
            (normal("phase", 0.3, "rad"),),
            instance="phase",
            physics="Phase turns with the power of the entry; size is the turn far above the mean power.",
            source="h exp(j a x / (1 + x)), x = |h|^2 / P: " + _SALEH,
        ),
    ]
    if band(data) is not None:
        wideband = Effect(
            "amplifier_nonlinearity",
            {"noiseless_channel": compress_all},
            (compression,),
            instance="wideband",
            physics="Gain falls with the power over the whole band: all subcarriers at a time.",
            source="h / (1 + c mean_k |h|^2 / P): " + _SALEH,
        )
        effects.append(wideband)
    return effects


def crosstalk(sites: Sites, data: Data) -> list[Effect]:
    """A constant leaks inside the instrument, on all subcarriers or on the one at the carrier."""
    power, measured = reference_power(data), band(data)
    if power is None or not has_phase(sites):
        return []
    level = np.sqrt(power)
    effects = [
        Effect(
            "crosstalk",
            {"noiseless_channel": lambda value, p, _: value + level * complex_of(p["leak"])},
            (normal("leak", 0.1, "1", 2, COMPLEX),),
            physics="The same complex number is added to every entry; unit: the rms channel.",
            source="h + g sqrt(P), g complex (real, imaginary).",
        )
    ]
    if measured is None:
        return effects
    frequency = np.asarray(data["subcarrier_frequency"], dtype=float)
    if np.abs(frequency).min() > 0.25 * measured.width / (measured.size - 1):
        return effects

    def offset(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        distance = jnp.abs(jnp.asarray(context["subcarrier_frequency"]))
        centre = on_axis(distance == jnp.min(distance), "subcarrier", CHANNEL_AXES)
        return value + jnp.where(centre, level * complex_of(p["leak"]), 0.0)

    centre = Effect(
        "crosstalk",
        {"noiseless_channel": offset},
        (normal("leak", 0.3, "1", 2, COMPLEX),),
        instance="carrier",
        physics="Leaking local oscillator: a complex number is added to the subcarrier at the carrier.",
        source="h_0 + g sqrt(P), g complex (real, imaginary).",
        requires=("subcarrier_frequency",),
    )
    return [*effects, centre]


def estimator_smoothing(sites: Sites, data: Data) -> list[Effect]:
    """The channel estimate was smoothed or interpolated over subcarriers."""
    measured = band(data)
    if measured is None or measured.size < 3 or not has_phase(sites):
        return []

    def smooth(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        padded = jnp.concatenate([value[..., :1], value, value[..., -1:]], axis=-1)
        return value + p["weight"] * (padded[..., 2:] - 2 * value + padded[..., :-2])

    return [
        Effect(
            "estimator_smoothing",
            {"noiseless_channel": smooth},
            (normal("weight", 0.1),),
            physics="Every estimate is mixed with those of its neighbours in frequency.",
            source="h_k + w (h_{k-1} - 2 h_k + h_{k+1}).",
        )
    ]


FAMILIES: Final[dict[str, Family]] = {
    "amplifier_nonlinearity": amplifier_nonlinearity,
    "crosstalk": crosstalk,
    "estimator_smoothing": estimator_smoothing,
}
