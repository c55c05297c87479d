"""What the true effects of withheld cases mean in the terms of the twins, for those who score answers.

The truth is made by other physics, with sizes of its own; only here are the two languages brought together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

_MOVED: Final = ("path_gain", "path_delay", "departure", "arrival")
_RESPONSES: Final = ("rx_response", "tx_response")
_MATERIALS: Final = ("permittivity", "conductivity")

SITES: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "channel": {
        **dict.fromkeys(
            ("receiver_displacement", "transmitter_displacement", "object_displacement", "object_rotation"),
            _MOVED,
        ),
        "material_mismatch": _MATERIALS,
        "thickness_mismatch": ("thickness",),
        "dispersive_walls": (*_MATERIALS, "path_gain", "path_response", "frequency_response"),
        "antenna_orientation": ("path_gain", *_RESPONSES),
        **dict.fromkeys(
            ("element_spacing", "array_calibration", "mutual_coupling", "beam_squint"),
            _RESPONSES,
        ),
        "near_field": (*_RESPONSES, "noiseless_channel"),
        **dict.fromkeys(
            (
                "polarization_mismatch",
                "missing_path",
                "blockage",
                "shadowing",
                "atmospheric_attenuation",
                "antenna_pattern",
                "gain_offset",
            ),
            ("path_gain",),
        ),
        **dict.fromkeys(
            ("phase_error", "doppler", "carrier_frequency_offset", "phase_noise", "carrier_phase_drift"),
            ("path_phase",),
        ),
        "pedestrian": ("path_gain", "noiseless_channel"),
        **dict.fromkeys(
            (
                "extra_path",
                "diffuse_scattering",
                "cable_delay",
                "sampling_clock_offset",
                "iq_imbalance",
                "amplifier_nonlinearity",
                "crosstalk",
                "gain_drift",
            ),
            ("noiseless_channel",),
        ),
        **dict.fromkeys(("timing_offset", "frequency_response"), ("frequency_response", "noiseless_channel")),
        **dict.fromkeys(("carrier_phase", "frequency_ripple"), ("frequency_response",)),
        **dict.fromkeys(
            ("quantization", "interference", "colored_noise", "correlated_noise", "noise_imbalance"),
            ("noise_power", "channel"),
        ),
        "heavy_tailed_noise": ("channel", "noise_power"),
    },
    "network": {
        **dict.fromkeys(
            (
                "device_disconnected",
                "arrival_rate_shift",
                "bursty_traffic",
                "cross_cluster_traffic",
                "periodic_traffic",
            ),
            ("arrival_logits",),
        ),
        "drift": ("arrival_logits", "reception_logits"),
        **dict.fromkeys(
            ("reception_shift", "capture", "interferer", "bursty_channel", "pair_interference"),
            ("reception_logits",),
        ),
        "near_far": ("device_advantage",),
        **dict.fromkeys(("ack_loss", "duty_cycle"), ("device_advantage", "reception_logits")),
    },
    "labels": {
        **dict.fromkeys(
            ("regional_bias", "scale_bias", "stale_map", "swapped_segments", "periodic_bias"),
            ("predicted_label",),
        ),
        "saturation": ("predicted_label", "y"),
        "label_noise": ("label_deviation", "spread of y"),
        "autocorrelated_errors": ("predicted_label", "y"),
    },
    "custom": {
        **dict.fromkeys(
            ("wall", "gain_drift", "second_slope", "sector", "ground_ripple", "handover", "periodic_gain"),
            ("expected_power",),
        ),
        **dict.fromkeys(("base_station_moved", "swapped_streets"), ("distance", "expected_power")),
        **dict.fromkeys(("noise_with_distance", "gusts"), ("deviation", "power")),
        "speed_change": ("memory",),
        "rising_noise": ("noise",),
        "deeper_fading": ("fading",),
        "bursts": ("expected_power", "noise"),
        "own_level": ("expected_power", "fading"),
    },
}
"""For each track and family of what is wrong, the twin's sites at which it shows.

`spread of y` is what is observed at y where the report finds its spread, not its place, to be wrong."""

type Sizes = Callable[[float], tuple[float, ...]]


def _either(size: float) -> tuple[float, ...]:
    return size, -size


def _as_is(size: float) -> tuple[float, ...]:
    return (size,)


PARAMETERS: Final[Mapping[str, Mapping[str, Sizes]]] = {
    "channel": {
        "timing_offset": _as_is,
        "carrier_frequency_offset": _as_is,
        "carrier_phase": _as_is,
        "gain_offset": lambda decibels: (decibels * np.log(10) / 20,),
    },
    "network": {
        **dict.fromkeys(
            ("arrival_rate_shift", "cross_cluster_traffic"), lambda share: (-float(np.log1p(-share)),)
        )
    },
    "labels": {"scale_bias": lambda slope: (float(np.log1p(slope)), float(np.log1p(-slope)))},
    "custom": {"handover": _either},
}
"""Families whose size means the same in truth and library: the values that the library's first parameter can then have.

A sign that the key does not tell may be either. Families whose shape is another in truth, as zones with soft edges are,
have no size to compare: what the library's parameter should be is then not what the key holds.
"""

INSTANCES_UNTOLD: Final[Mapping[str, frozenset[str]]] = {
    "channel": frozenset({"antenna_pattern", "blockage", "extra_path", "frequency_ripple", "interference"}),
}
"""Families of which the key tells no instance, while the library has nothing else: the family is what counts."""
