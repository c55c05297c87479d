"""The files of a case: `case.toml`, the measured channels, and the paths that the twin traced."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Complex

from dtprob.data.kinds import ChannelData
from dtprob.data.write import write
from dtprob.files import write_text
from dtprob.physical.channel import Sounding
from dtprob.physical.study import case_end
from dtprob.physical.world import World
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.storage import save


def write_case(
    folder: Path,
    paths: PathSet,
    nominal: World,
    sounding: Sounding,
    channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
    *,
    noise_power: float,
    model: str,
    phase: str = "coherent",
    used: Sequence[str] = (),
    excluded: Sequence[str] = (),
    seed: int = 0,
) -> None:
    """Write a case that `dtprob diagnose` takes.

    Args:
        folder: made where it is missing.
        paths: what the twin traced.
        nominal: the world as the twin has it: positions, arrays and carrier.
        sounding: subcarriers and snapshots.
        channel: the measurement; written in single precision.
        noise_power: as recorded.
        model: the twin's model.
        phase: what the phases of the data mean.
        used: families of effects that the case offers; all when empty.
        excluded: families of effects that the case leaves out.
        seed: of the diagnosis.
    """
    save(paths, folder / "paths.nc")
    data = ChannelData(
        channel=channel.astype(np.complex64),
        subcarrier_frequency=sounding.subcarrier_frequency,
        rx_position=nominal.rx_position,
        tx_position=nominal.tx_position,
        snapshot_time=sounding.snapshot_time,
        rx_array=nominal.rx_array,
        tx_array=nominal.tx_array,
        noise_power=np.asarray(noise_power),
    )
    write(folder / "channels.npz", data)
    end = case_end(excluded, seed, list(used) or "all")
    write_text(folder / "case.toml", _toml(nominal, model, phase) + end)


def _toml(nominal: World, model: str, phase: str) -> str:
    return f"""[model]
name = "{model}"

[data]
file = "channels.npz"
phase = "{phase}"

[scene]
file = "paths.nc"
frequency = {nominal.frequency!r}
max_depth = {nominal.max_depth}
merge_shapes = false

"""
