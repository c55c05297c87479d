"""Path sets of Remcom Wireless InSite: the text file `<project>.paths.t<tx>_<point>.r<rx>.p2m`.

Lines that begin with # are comments. Then the number of receivers; for each receiver a line with its number and how many
paths it has and, where there are any, a line that sums them up; for each path

    number, interactions, power (dBm), phase (deg), delay (s), arrival theta and phi, departure theta and phi (deg)
    Tx-R-D-Rx                        what happens: R reflection, D diffraction, DS scattering, T, F and X transmission
    x y z                            of the transmitter, of each interaction, of the receiver, one line each, m

Directions follow from the points. Receivers without a path have no position in the file, and are left out.
Source: the layout as public readers of the format describe it (DeepMIMO's converter among them).
"""

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError
from dtprob.raytracing.imported import ImportedPaths, path_set
from dtprob.raytracing.paths import PathSet

_INTERACTIONS: Final = frozenset({"R", "D", "DS", "T", "F", "X"})


class _Path(NamedTuple):
    power_dbm: float
    phase_deg: float
    delay: float
    points: Float[np.ndarray, "point 3"]


def read_p2m(file: str | os.PathLike[str], frequency: float, transmit_power_dbm: float = 0.0) -> PathSet:
    """Read the paths between one transmitter and a set of receivers.

    Args:
        file: the .paths. file.
        frequency: carrier in Hz, which the file does not hold.
        transmit_power_dbm: with which the file was made; gains are relative to it.

    Raises:
        InputError: no such file, a line that is not as described above, or no path in it.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(str(path), "a .paths.*.p2m file", "no such file", "Check the name and the folder")
    lines = _Lines(path)
    links = [found for found in _receivers(lines) if found]
    if not links:
        raise InputError(path.name, "a receiver with a path", "none", "Export receivers that are reached")
    most = max(map(len, links))
    mask = np.arange(most) < np.array([[len(link)] for link in links])
    imported = ImportedPaths(
        coefficient=np.zeros(mask.shape, complex),
        delay=np.zeros(mask.shape),
        departure=np.zeros((*mask.shape, 3)),
        arrival=np.zeros((*mask.shape, 3)),
        mask=mask,
        rx_position=np.stack([link[0].points[-1] for link in links]),
        tx_position=np.stack([link[0].points[0] for link in links]),
    )
    for row, link in enumerate(links):
        for column, one in enumerate(link):
            steps = np.diff(one.points, axis=0)
            amplitude = 10 ** ((one.power_dbm - transmit_power_dbm) / 20)
            imported.coefficient[row, column] = amplitude * np.exp(1j * np.deg2rad(one.phase_deg))
            imported.delay[row, column] = one.delay
            imported.departure[row, column] = steps[0] / np.linalg.norm(steps[0])
            imported.arrival[row, column] = steps[-1] / np.linalg.norm(steps[-1])
    return path_set(imported, frequency, (("solver", "Wireless InSite"), ("file", path.name)))


class _Lines:
    """The lines of a file without comments, with their numbers for what goes wrong."""

    def __init__(self, path: Path) -> None:
        self._name, self._number = path.name, 0
        self._rest: Iterator[tuple[int, str]] = iter(
            (number, text)
            for number, text in enumerate(_text(path).splitlines(), 1)
            if text.strip() and not text.lstrip().startswith("#")
        )

    def words(self, count: int | None, what: str) -> list[str]:
        """The next line's words, so many of them."""
        self._number, text = next(self._rest, (self._number + 1, ""))
        found = text.split()
        if not found or (count is not None and len(found) != count):
            raise self.wrong(what, text.strip() or "the end of the file")
        return found

    def numbers(self, count: int, what: str) -> list[float]:
        """The next line's numbers, so many of them."""
        found = self.words(count, what)
        try:
            return [float(word) for word in found]
        except ValueError:
            raise self.wrong(what, " ".join(found)) from None

    def counts(self, count: int, what: str) -> list[int]:
        """The next line's whole numbers from 0 on, so many of them."""
        found = self.words(count, what)
        if not all(word.isdecimal() for word in found):
            raise self.wrong(what, " ".join(found))
        return [int(word) for word in found]

    def wrong(self, expected: str, got: str) -> InputError:
        """What to raise for the latest line."""
        return InputError(f"{self._name} line {self._number}", expected, f"'{got}'", "Export the file again")


def _text(path: Path) -> str:
    """The text of a file, whose comments may be of any encoding."""
    return path.read_text(encoding="utf-8-sig", errors="replace")


def _receivers(lines: _Lines) -> Iterator[list[_Path]]:
    (count,) = lines.counts(1, "the number of receivers")
    for _ in range(count):
        _, paths = lines.counts(2, "a receiver and its number of paths")
        if paths:
            lines.words(None, "a summary of the paths")
        yield [_read_path(lines) for _ in range(paths)]


def _read_path(lines: _Lines) -> _Path:
    values = lines.numbers(9, "the nine numbers of a path")
    if not np.all(np.isfinite(values)):
        raise lines.wrong("nine finite numbers of a path", " ".join(map(str, values)))
    (chain,) = lines.words(1, "a chain of interactions from Tx to Rx")
    steps = chain.split("-")
    expected = f"a chain of {int(values[1])} interactions from Tx to Rx"
    if steps[0] != "Tx" or steps[-1] != "Rx" or not _INTERACTIONS.issuperset(steps[1:-1]):
        raise lines.wrong(expected, chain)
    if len(steps) - 2 != int(values[1]):
        raise lines.wrong(expected, chain)
    points = [lines.numbers(3, "the coordinates of a point") for _ in steps]
    if any(one == next_ for one, next_ in pairwise(points)):
        raise lines.wrong("points that differ from one to the next", " ".join(map(str, points[-1])))
    return _Path(values[2], values[3], values[4], np.asarray(points))
