"""The recorded example: a street measured after the wall of one building had moved, and the twin from before.

`python -m dtprob.physical.demo FOLDER` makes it again, bit by bit the same on the same versions;
this needs the ray tracer. What it makes lies in `dtprob/data/demo`, so that diagnosing it needs neither
Sionna RT nor LLVM.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Final

import numpy as np

from dtprob.files import write_text
from dtprob.physical.bench import varied
from dtprob.physical.campaign import describe, trace_nominal
from dtprob.physical.case_files import write_case
from dtprob.physical.channel import Sounding, mean_power, subcarriers
from dtprob.physical.impairment import measure, simulate, thermal
from dtprob.physical.placement import object_displacement
from dtprob.physical.tracing import scene_materials
from dtprob.physical.world import SPEED_OF_LIGHT, World, planar_array, set_materials

SEED: Final = 20
FREQUENCY: Final = 6e9
BUILDING: Final = "building_6"
MOVED: Final = 0.05
"""How far the building's walls stand nearer to the street than in the scene file, m."""
LINKS: Final = 40
SNR_DB: Final = 20.0

EFFECTS = (
    "object_displacement",
    "material_mismatch",
    "missing_path",
    "antenna_orientation",
    "phase_error",
    "timing_offset",
    "carrier_frequency_offset",
    "iq_imbalance",
    "frequency_response",
    "array_calibration",
    "amplifier_nonlinearity",
    "gain_offset",
    "interference",
    "heavy_tailed_noise",
)
"""Families that the demo offers; all of them would take several times as long."""


def street() -> World:
    """The campaign as the twin has it: a base station above one pavement, 40 places along the street."""
    rng = np.random.default_rng(SEED)
    half = SPEED_OF_LIGHT / FREQUENCY / 2
    x = np.linspace(-14.0, 30.0, LINKS) + rng.uniform(-0.5, 0.5, LINKS)
    rx = np.stack([x, rng.uniform(-5.0, 6.0, LINKS), np.full(LINKS, 1.5)], axis=-1)
    tx = np.tile([-24.0, 3.0, 6.0], (LINKS, 1))
    one, four = planar_array(1, 1, half), planar_array(2, 2, half)
    return World("simple_street_canyon", FREQUENCY, tx, rx, one, four)


def generate(folder: Path) -> None:
    """Write `case.toml`, `channels.npz`, `paths.nc` and, for the curious, `truth.json`."""
    rng = np.random.default_rng(SEED + 1)
    nominal = street()
    paths = trace_nominal(nominal)
    materials = {
        name: varied(material, 0.05 * rng.standard_normal(), 0.2 * rng.standard_normal())
        for name, material in scene_materials(nominal).items()
    }
    sounding = Sounding(subcarriers(16, 100e6), np.array([0.0, 1e-3]))
    world = set_materials(nominal, materials)
    moved = object_displacement(BUILDING, (0.0, 1.0, 0.0))
    clean = simulate(world, sounding, thermal(1.0))
    power = mean_power(clean.mean) / 10 ** (SNR_DB / 10)
    truth = simulate(world, sounding, thermal(power), [(moved, MOVED)])
    channel = measure(rng, truth, sounding)
    recorded = float(power * np.exp(0.05 * rng.standard_normal()))
    write_case(
        folder,
        paths,
        nominal,
        sounding,
        channel,
        noise_power=recorded,
        model="ray_traced_channel",
        used=EFFECTS,
    )
    error = np.sum(np.abs(truth.mean - clean.mean) ** 2) / np.sum(np.abs(truth.mean) ** 2)
    record = {
        "effect": moved.name,
        "displacement": [0.0, MOVED, 0.0],
        "unit": "m",
        "gap_db": float(10 * np.log10(error)),
        "noise_power": float(power),
        "materials": describe(materials),
        "scene": world.scene,
    }
    write_text(folder / "truth.json", json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    generate(Path(sys.argv[1]))
