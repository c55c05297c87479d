"""The traced positions as a small file that comes with dtprob, and the command that traces them anew.

    python -m dtprob.reproduce.beams_file FILE

The file holds amplitudes to 0.01 dB, phases to a 256th of a turn, direction cosines to 3e-5; only paths
within 40 dB of a position's strongest. The studies see the paths as they come from the file.
"""

import sys
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from dtprob.files import atomic_write
from dtprob.reproduce.beams import BeamPaths, Site, trace_positions

POSITIONS: Final = 38_038
FILE: Final = Path(__file__).with_name("beam_paths.npz")
"""The positions around `Site()`."""

_DECIBEL: Final = 100
_TURN: Final = 256
_COSINE: Final = 32_767
_WEAK: Final = 40.0
_COSINES: Final = ("horizontal", "vertical", "arrival")


def write_paths(paths: BeamPaths, file: Path) -> None:
    """Keep the paths of some positions in an NPZ file."""
    amplitude = np.abs(paths.gain)
    kept = amplitude > amplitude[:, :1] * 10 ** (-_WEAK / 20)
    gain = paths.gain[kept]
    cosines = {name: getattr(paths, name)[kept] for name in _COSINES}
    arrays = {
        "position": paths.position.astype(np.float32),
        "count": kept.sum(axis=1).astype(np.uint8),
        "attenuation": np.round(-20 * _DECIBEL * np.log10(np.abs(gain))).astype(np.uint16),
        "phase": (np.round(_TURN * np.angle(gain) / (2 * np.pi)) % _TURN).astype(np.uint8),
        **{name: np.round(_COSINE * cosine).astype(np.int16) for name, cosine in cosines.items()},
    }
    with atomic_write(file) as part:
        np.savez_compressed(part, allow_pickle=False, **arrays)


def read_paths(file: Path = FILE) -> BeamPaths:
    """The paths that `write_paths` kept."""
    with np.load(file, allow_pickle=False) as stored:
        count = stored["count"].astype(int)
        there = np.arange(count.max()) < count[:, None]
        amplitude = 10 ** (stored["attenuation"].astype(float) / (-20 * _DECIBEL))
        gain = np.zeros(there.shape, complex)
        gain[there] = amplitude * np.exp(2j * np.pi * stored["phase"] / _TURN)
        cosines = (_filled(there, stored[name] / _COSINE) for name in _COSINES)
        return BeamPaths(stored["position"].astype(float), gain, *cosines)


def _filled(
    there: Bool[np.ndarray, "position path"], values: Float[np.ndarray, " found"]
) -> Float[np.ndarray, "position path"]:
    whole = np.zeros(there.shape)
    whole[there] = values
    return whole


def main() -> None:
    """Trace the positions and keep them."""
    write_paths(trace_positions(Site(), POSITIONS), Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)


if __name__ == "__main__":
    main()
