"""Noise that is not what the twin takes it for: its level, its colour, its origin, its tails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from dtprob.effects.common import (
    SIDES,
    Data,
    Family,
    Sites,
    band,
    clock,
    half_normal,
    has_phase,
    legendre,
    n_antenna,
    normal,
    offers,
    on_axis,
    square,
)
from dtprob.effects.distributions import ComplexStudentT, replace_base
from dtprob.effects.effect import FIELD, Effect, Rewrite
from dtprob.effects.meaning import CHANNEL_AXES

_PARTS: Final = 8
"""Bands, or stretches of time, in which interference is looked for."""


def interference(sites: Sites, data: Data) -> list[Effect]:
    """Another transmitter raises the noise in a part of the band, or during a part of the time."""
    if not _has_noise(sites):
        return []
    measured, time, effects = band(data), clock(data), []
    if measured is not None and measured.size >= _PARTS:
        low = measured.centre - measured.width / 2
        effects += _parts(
            "band", "subcarrier_frequency", "subcarrier", low=low, width=measured.width, unit="Hz"
        )
    if time is not None and np.size(data["snapshot_time"]) >= _PARTS:
        effects += _parts("time", "snapshot_time", "snapshot", low=time.start, width=time.span, unit="s")
    return effects


def _parts(label: str, coordinate: str, axis: str, *, low: float, width: float, unit: str) -> list[Effect]:
    edges = low + width * np.linspace(0.0, 1.0, _PARTS + 1)
    effects = []
    for part in range(_PARTS):
        start, stop = float(edges[part]), float(edges[part + 1])
        effects.append(
            Effect(
                "interference",
                {
                    "noise_power": _raised(
                        coordinate,
                        axis,
                        start if part else -float("inf"),
                        stop if part < _PARTS - 1 else float("inf"),
                    )
                },
                (half_normal("excess", 1.0),),
                instance=f"{label}_{part}",
                physics=f"Interference from {start:.6g} to {stop:.6g} {unit}, as a multiple of the noise.",
                source="N (1 + s) inside the part.",
                requires=(coordinate,),
            )
        )
    return effects


def _raised(coordinate: str, axis: str, start: float, stop: float) -> Rewrite:
    """Raises the noise where start <= coordinate < stop."""

    def raised(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        place = jnp.asarray(context[coordinate])
        inside = (place >= start) & (place < stop)
        return value * (1.0 + p["excess"] * on_axis(inside, axis, CHANNEL_AXES))

    return raised


def colored_noise(sites: Sites, data: Data) -> list[Effect]:
    """The noise power varies smoothly over the band."""
    measured = band(data)
    if measured is None or measured.size < 4 or not _has_noise(sites):
        return []

    def colour(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        x = measured.position(context["subcarrier_frequency"])
        return value * jnp.exp(legendre(x, range(1, 4)) @ p["log_power"])

    return [
        Effect(
            "colored_noise",
            {"noise_power": colour},
            (normal("log_power", 0.3, "1", 3, ("slope", "curvature", "cubic")),),
            physics="Slope, curvature and cubic shape of the log noise power over the band.",
            source="N exp(sum_n c_n P_n(x)), Legendre, n = 1..3.",
            requires=("subcarrier_frequency",),
        )
    ]


def heavy_tailed_noise(sites: Sites, _data: Data) -> list[Effect]:
    """Noise with more large values than a Gaussian has."""
    effects = []
    for name, site in sites.items():
        if site.kind != "observed" or site.distribution != "ComplexNormal":
            continue

        def widen(fn: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            return replace_base(fn, lambda base: ComplexStudentT(base.loc, base.variance, p["tail"]))

        effects.append(
            Effect(
                "heavy_tailed_noise",
                {},
                (half_normal("tail", 0.3),),
                instance=None if not effects else name,
                physics="Complex Student t noise, 2 / tail degrees of freedom: impulses, bursts, outliers.",
                source="Ollila et al., IEEE Trans. Signal Process. 60 (2012).",
                distributions={name: widen},
            )
        )
    return effects


def noise_level(sites: Sites, data: Data) -> list[Effect]:
    """The recorded noise floor is off by a common factor."""
    if not _has_noise(sites) or data.get("noise_power") is None:
        return []
    return [
        Effect(
            "noise_level",
            {"noise_power": lambda value, p, _: value * jnp.exp(p["log_power"])},
            (normal("log_power", 0.5),),
            physics="Common factor of the noise power (noise figure, temperature, wrong record).",
            source="N exp(c).",
        )
    ]


def noise_imbalance(sites: Sites, _data: Data) -> list[Effect]:
    """Receiving chains differ in noise; links do too."""
    if not _has_noise(sites):
        return []
    effects = [
        Effect(
            "noise_imbalance",
            {"noise_power": lambda value, p, _: value * jnp.exp(p["scale"] * p[FIELD])},
            (half_normal("scale", 0.5),),
            instance="each_link",
            kind="variance",
            physics="Log noise power that differs at random between links.",
            source="N exp(s z_link).",
            requires=("noiseless_channel",),
            field_shape=lambda _, context: (context["noiseless_channel"].shape[0], 1, 1, 1, 1),
        )
    ]
    for side in SIDES:
        count = n_antenna(sites, side)
        if count < 2:
            continue
        axis = f"{side}_antenna"

        def weigh(value: Any, p: Mapping[str, Any], _: Mapping[str, Any], axis: str = axis) -> Any:
            return value * jnp.exp(on_axis(p["log_power"], axis, CHANNEL_AXES))

        effects.append(
            Effect(
                "noise_imbalance",
                {"noise_power": weigh},
                (normal("log_power", 0.3, "1", count),),
                instance=side,
                physics=f"Log noise power of the {side} elements against the recorded one.",
                source="N_a exp(c_a).",
            )
        )
    return effects


def quantization(sites: Sites, _data: Data) -> list[Effect]:
    """A converter driven by automatic gain adds noise in proportion to the power of the whole packet."""
    if not _has_noise(sites):
        return []

    def add(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        power = jnp.mean(square(context["noiseless_channel"]), axis=(2, 3, 4), keepdims=True)
        return value + p["ratio"] * power

    return [
        Effect(
            "quantization",
            {"noise_power": add},
            (half_normal("ratio", 3e-3),),
            physics="White noise at a fixed ratio to the mean power of each link's snapshot.",
            source="Additive noise model of a b-bit converter, ratio about 2^(-2b): Widrow et al.,"
            " IEEE Trans. Instrum. Meas. 45 (1996).",
            requires=("noiseless_channel",),
        )
    ]


def error_vector_magnitude(sites: Sites, _data: Data) -> list[Effect]:
    """Every entry has an error in proportion to itself."""
    if not _has_noise(sites):
        return []

    def add(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["ratio"] * square(context["noiseless_channel"])

    return [
        Effect(
            "error_vector_magnitude",
            {"noise_power": add},
            (half_normal("ratio", 3e-3),),
            physics="Multiplicative noise: transmitter distortion, unresolved phase noise, scrambled images.",
            source="N + EVM^2 |h|^2.",
            requires=("noiseless_channel",),
        )
    ]


def _has_noise(sites: Sites) -> bool:
    return has_phase(sites) and offers(sites, "noise_power") and len(sites["noise_power"].shape) == 5


FAMILIES: Final[dict[str, Family]] = {
    "interference": interference,
    "colored_noise": colored_noise,
    "heavy_tailed_noise": heavy_tailed_noise,
    "noise_level": noise_level,
    "noise_imbalance": noise_imbalance,
    "quantization": quantization,
    "error_vector_magnitude": error_vector_magnitude,
}
