"""One example report for each verdict, as a diagnosis would write it, with the maps that go with it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dtprob.report import render

PROVENANCE = {
    "dtprob": "0.1.0",
    "seed": 0,
    "engine": "laplace",
    "model": "phase_error_channel",
    "candidates": 255,
    "versions": {"jax": "0.12.0", "numpyro": "0.22.0"},
    "data_sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
}
FAMILIES = (
    ("object_displacement[building_{}]", "path_delay", "m", 0.04),
    ("material_mismatch[building_{}]", "path_gain", "1", 0.2),
    ("array_calibration[antenna_{}]", "rx_response", "rad", 0.03),
    ("timing_offset", "path_delay", "s", 2.5e-10),
    ("carrier_phase_drift", "path_phase", "rad", 0.02),
    ("iq_imbalance", "noiseless_channel", "1", 0.01),
    ("carrier_frequency_offset", "path_phase", "Hz", 12.0),
    ("receiver_displacement", "path_phase", "m", 0.006),
    ("antenna_orientation", "rx_response", "rad", 0.05),
    ("amplifier_nonlinearity", "noiseless_channel", "1", 0.013),
    ("frequency_response", "frequency_response", "1", 0.02),
    ("diffuse_scattering", "noiseless_channel", "1", 0.08),
    ("interference", "noise_power", "1", 0.11),
    ("gain_offset", "path_gain", "dB", 0.3),
    ("colored_noise", "noise_power", "1", 0.2),
    ("doppler", "path_phase", "Hz", 3.0),
)


def _instances() -> list[tuple[str, str, str, float]]:
    return [
        (name.format(index), site, unit, size * (1 + 0.2 * index))
        for name, site, unit, size in FAMILIES
        for index in (range(8) if "{}" in name else range(1))
    ]


def _screening(strong: dict[str, float]) -> list[dict[str, Any]]:
    noise = np.random.default_rng(3).normal(size=len(_instances()))
    rows: list[dict[str, Any]] = []
    for (name, site, _, _), small in zip(_instances(), noise, strict=True):
        z = round(strong.get(name, float(small)), 2)
        p = float(np.clip(np.exp(-0.717 * abs(z) - 0.416 * z * z), 1e-300, 1.0))
        kind = "variance" if name in {"diffuse_scattering", "interference"} else "mean"
        row = {"effect": name, "sites": [site], "z": z, "p_value": p, "adjusted_p_value": min(1.0, 40 * p)}
        rows.append({**row, "absorbed_by": None, "kind": kind})
    rows[-3] |= {"z": None, "p_value": None, "adjusted_p_value": None, "absorbed_by": "material_gain"}
    return rows


def _base() -> dict[str, Any]:
    return {
        "causes": [],
        "where": {"sites": [], "coordinates": []},
        "gap": {
            "unit": "nats per observation",
            "before": 1.23,
            "after": None,
            "floor": [0.02, 0.08],
            "in_user_terms": {"channel_nmse_db": [-3.1, None]},
        },
        "unlisted": {"p_value": 0.4, "sites": []},
        "next_measurement": None,
        "detectable": [{"effect": name, "size": size, "unit": unit} for name, _, unit, size in _instances()],
        "screening": _screening({}),
        "fit": {
            "nuisances": [
                {
                    "name": "material_permittivity[concrete]",
                    "mean": 5.31,
                    "low": 5.02,
                    "high": 5.66,
                    "contraction": 0.93,
                },
                {
                    "name": "material_permittivity[glass]",
                    "mean": 6.4,
                    "low": 4.1,
                    "high": 9.0,
                    "contraction": 0.02,
                },
                {
                    "name": "phase_error_std",
                    "mean": 0.21,
                    "low": 0.19,
                    "high": 0.23,
                    "unit": "rad",
                    "contraction": 0.99,
                },
                {
                    "name": "noise_power",
                    "mean": 2.1e-12,
                    "low": 2.05e-12,
                    "high": 2.16e-12,
                    "unit": "W",
                    "contraction": 0.999,
                },
            ],
            "converged": True,
            "n_clusters": 1000,
            "n_observations": 256000,
            "warnings": [],
        },
        "provenance": PROVENANCE,
    }


def _interval(mean: float, low: float, high: float, **more: Any) -> dict[str, Any]:
    return {"mean": mean, "low": low, "high": high, **more}


def no_gap() -> dict[str, Any]:
    """The twin is right."""
    report = _base()
    report |= {"verdict": "NO_GAP"}
    report["gap"] |= {"before": 0.051, "in_user_terms": {"channel_nmse_db": [-19.2, None]}}
    return report


def listed() -> dict[str, Any]:
    """One effect of the library, found."""
    report = _base()
    report |= {
        "verdict": "LISTED",
        "causes": [
            {
                "effects": ["timing_offset"],
                "alias_class": [["timing_offset"]],
                "probability": 0.97,
                "size": {"delay_s": _interval(1.02e-9, 9.1e-10, 1.13e-9)},
                "closed_fraction": _interval(0.93, 0.88, 0.97),
                "physics": "The receiver's clock starts late, so every path arrives later by the same time.",
                "strata": {"estimate": [0.99e-9, 1.08e-9, 0.97e-9, 1.03e-9]},
                "plausible": True,
            },
            {
                "effects": ["object_displacement[building_2]"],
                "alias_class": [["object_displacement[building_2]"]],
                "probability": 0.02,
                "size": {
                    "offset.x": _interval(0.31, 0.18, 0.44, unit="m"),
                    "offset.y": _interval(-0.02, -0.09, 0.05, unit="m"),
                },
                "closed_fraction": _interval(0.41, 0.3, 0.5),
            },
        ],
        "where": {
            "sites": [
                {"site": "path_delay", "p_value": 1e-9, "share": 0.8, "family": "additive, common"},
                {"site": "path_phase", "p_value": 0.004, "share": 0.12},
            ],
            "coordinates": [
                {"axes": {"subcarrier": [40, 63]}, "p_value": 1e-6, "share": 0.4},
                {"axes": {"rx_antenna": [0, 1]}, "p_value": 0.003, "share": 0.15},
            ],
        },
        "next_measurement": None,
        "screening": _screening(
            {"timing_offset": 14.2, "object_displacement[building_2]": 8.3, "frequency_response": 5.1}
        ),
    }
    report["gap"] |= {"after": 0.10, "in_user_terms": {"channel_nmse_db": [-3.1, -17.8]}}
    return report


def listed_with_remainder() -> dict[str, Any]:
    """Two effects at once, a third that the library lacks, and an implausible size."""
    report = listed()
    cause = report["causes"][0]
    cause |= {
        "effects": ["timing_offset", "iq_imbalance"],
        "alias_class": [["timing_offset", "iq_imbalance"], ["carrier_phase_drift", "iq_imbalance"]],
        "size": {
            "timing_offset.delay": _interval(1.02e-9, 9.1e-10, 1.13e-9, unit="s"),
            "iq_imbalance.gain": _interval(0.08, 0.06, 0.1, unit="1"),
            "iq_imbalance.phase": _interval(0.11, 0.09, 0.13, unit="rad"),
        },
        "closed_fraction": _interval(0.64, 0.55, 0.72),
        "plausible": False,
    }
    cause.pop("strata")
    report |= {
        "verdict": "LISTED_WITH_REMAINDER",
        "unlisted": {
            "p_value": 2e-7,
            "sites": ["rx_response"],
            "located": [{"site": "rx_response", "p_value": 2e-7, "share": None, "family": "relative, link"}],
        },
    }
    report["gap"] |= {"after": 0.47, "in_user_terms": {"channel_nmse_db": [-3.1, -8.4]}}
    report["fit"] |= {
        "converged": False,
        "warnings": ["The gradient at the best point is 3.2, not below 0.001."],
    }
    return report


def unlisted() -> dict[str, Any]:
    """Something that the library does not know."""
    report = _base()
    report |= {
        "verdict": "UNLISTED",
        "where": {
            "sites": [{"site": "arrival", "p_value": 3e-12, "share": 0.71}],
            "coordinates": [{"axes": {"rx_antenna": [3, 5]}, "p_value": 1e-8, "share": 0.55}],
        },
        "unlisted": {"p_value": 3e-12, "sites": ["arrival"]},
        "screening": _screening({"antenna_orientation": 5.5, "array_calibration[antenna_3]": 4.4}),
    }
    return report


def undetermined() -> dict[str, Any]:
    """A log of a network: two explanations that no data of this kind can separate."""
    report = _base()
    report |= {
        "verdict": "UNDETERMINED",
        "causes": [
            {
                "effects": ["device_disconnected[3]"],
                "alias_class": [["device_disconnected[3]"], ["arrival_rate_shift[3]"]],
                "probability": 0.49,
                "size": {"share": _interval(0.93, 0.7, 1.0, unit="1")},
                "closed_fraction": _interval(0.88, 0.7, 0.99),
                "physics": "The device has left the network and neither transmits nor acknowledges.",
            },
            {
                "effects": ["arrival_rate_shift[3]"],
                "alias_class": [["device_disconnected[3]"], ["arrival_rate_shift[3]"]],
                "probability": 0.46,
                "size": {"log_rate": _interval(-2.9, -4.4, -1.6, unit="1")},
                "closed_fraction": _interval(0.87, 0.69, 0.98),
                "physics": "Packets arrive more or less often than when the twin was learned.",
            },
            {
                "effects": ["near_far[3]"],
                "alias_class": [["near_far[3]"]],
                "probability": 0.04,
                "size": {"logit": _interval(-1.2, -2.0, -0.3, unit="1")},
                "closed_fraction": _interval(0.35, 0.02, 0.6),
            },
        ],
        "where": {
            "sites": [{"site": "arrival_logit", "p_value": 2e-4, "share": 0.66}],
            "coordinates": [{"axes": {"device": [3, 3]}, "p_value": 1e-4, "share": 0.9}],
        },
        "next_measurement": {
            "description": "Let device 3 transmit in 40 slots in which its buffer is known to be full.",
            "slots": 40,
            "probability_of_a_decision": 0.93,
            "splits": ["device_disconnected[3]", "arrival_rate_shift[3]"],
        },
        "detectable": [],
    }
    report["gap"] = {
        "unit": "nats per slot",
        "before": 0.82,
        "after": 0.31,
        "floor": [0.2, 0.28],
        "in_user_terms": {"throughput_error": [0.14, 0.02]},
    }
    report["screening"] = [
        {
            "effect": f"{name}[{k}]",
            "sites": [site],
            "z": z,
            "p_value": p,
            "adjusted_p_value": min(1, 12 * p),
            "kind": "mean",
        }
        for name, site, z, p, k in (
            ("device_disconnected", "arrival_logit", 5.2, 2e-7, 3),
            ("arrival_rate_shift", "arrival_logit", -5.1, 3e-7, 3),
            ("near_far", "reception_logit", -2.2, 0.028, 3),
            ("near_far", "reception_logit", 0.4, 0.69, 1),
        )
    ]
    report.pop("fit")
    return report


EXAMPLES: dict[str, Callable[[], dict[str, Any]]] = {
    "NO_GAP": no_gap,
    "LISTED": listed,
    "LISTED_WITH_REMAINDER": listed_with_remainder,
    "UNLISTED": unlisted,
    "UNDETERMINED": undetermined,
}


def gap_tree(*, after: bool = True, strength: float = 1.0) -> xr.DataTree:
    """Maps over antennas and subcarriers, and 150 links along a street of which the far end fits worse.

    With strength 0 only noise is left.
    """
    random = np.random.default_rng(5)
    antenna = np.array([9.1 * strength, 6.2 * strength, 0.4, -0.8, 1.3, 0.2, -0.4, 0.9])
    frequency = np.linspace(-50e6, 50e6, 64)
    rising = 0.4 * random.normal(size=64) + 4.0 * strength * (np.abs(frequency) / 50e6) ** 2
    where = xr.Dataset(
        {
            "gap_rx_antenna": ("rx_antenna", antenna),
            "gap_subcarrier": ("subcarrier", rising, {"long_name": "excess"}),
        }
    ).assign_coords(subcarrier=("subcarrier", frequency, {"units": "Hz"}), rx_antenna=np.arange(8))
    x, y = random.uniform(0, 110, 150), random.choice([-6.0, 6.0], 150) + random.normal(size=150)
    position = np.stack([x, y + 0.2 * x, np.full(150, 1.5)], axis=1)
    before = np.maximum(0.02 * strength * x + random.normal(size=150) * 0.25, -0.1)
    links = xr.Dataset(
        {
            "before": ("link", before),
            "rx_position": (("link", "xyz"), position),
            "tx_position": (("link", "xyz"), np.tile([[-4.0, 4.0, 10.0]], (150, 1))),
        }
    )
    if after:
        where["gap_after_rx_antenna"] = ("rx_antenna", random.normal(size=8))
        where["gap_after_subcarrier"] = ("subcarrier", random.normal(size=64))
        links["after"] = ("link", 0.12 * before + 0.05 * random.normal(size=150))
    return xr.DataTree.from_dict({"/where": where, "/links": links, "/screening": xr.Dataset()})


@pytest.fixture(scope="session", params=sorted(EXAMPLES))
def verdict(request: pytest.FixtureRequest) -> str:
    """Each verdict in turn."""
    return request.param


@pytest.fixture
def report(verdict: str) -> dict[str, Any]:
    """The example report of the verdict."""
    return EXAMPLES[verdict]()


@pytest.fixture(scope="session")
def page(verdict: str) -> str:
    """The page of the verdict's example, with maps."""
    return render(EXAMPLES[verdict](), gap_tree(), title="Street canyon")


@pytest.fixture
def examples() -> dict[str, Callable[[], dict[str, Any]]]:
    """A maker of each example report, by verdict."""
    return EXAMPLES


@pytest.fixture
def gap() -> xr.DataTree:
    """Maps and links, before and after."""
    return gap_tree()
