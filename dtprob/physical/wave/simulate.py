"""From a scene to the channel between two points of it."""

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import epsilon_0, mu_0

from dtprob.errors import InputError
from dtprob.physical.wave.fdtd import Factors, Patches, State, advance, factors, patches, rest
from dtprob.physical.wave.grid import Grid, acting, grid_frequency, make_grid, source_gain
from dtprob.physical.wave.scene import AIR, Scene2D, rasterise
from dtprob.physical.world import SPEED_OF_LIGHT

CELLS: Final = 30.0
"""Cells per wavelength in air at the middle frequency."""
_CHUNK: Final = 500
_TAIL: Final = 0.05
_LATE: Final = 1.2
"""When the pulse is highest, in periods of the middle frequency."""


class Response(NamedTuple):
    """What probes saw.

    Attributes:
        frequency: Hz.
        field: E_z over that of the source alone at 1 m, seen from far away: a ray of length L in m adds
            its reflection coefficients times exp(-j k L) / sqrt(L). m^(-1/2).
        misaligned: largest distance of a surface from the nodes, in cells.
        tail: largest field at a probe in the last twentieth of the time over its largest of all times, of the probe
            where that is most, 1 if it saw nothing; what was cut off is about as large.
        record: the field over time at each probe, V/m, one sample per `step`, where it was asked for.
        step: time step, s.
    """

    frequency: Float[np.ndarray, " frequency"]
    field: Complex[np.ndarray, "probe frequency"]
    misaligned: float
    tail: float
    record: Float[np.ndarray, "probe step"] | None
    step: float

    @property
    def channel(self) -> Complex[np.ndarray, "probe frequency"]:
        """The field times lambda / (4 pi), lambda of the middle frequency.

        It is the channel between isotropic antennas, but for a ray's spreading, which is that of a cylinder:
        1 / sqrt(L) in place of 1 / L.
        """
        return SPEED_OF_LIGHT / (4 * np.pi * np.mean(self.frequency)) * self.field


class Cost(NamedTuple):
    """What a simulation takes.

    Attributes:
        nodes: of the grid.
        steps: in time.
        bytes: of the field, of the factors of a step and of what a step needs for a while.
    """

    nodes: int
    steps: int
    bytes: int


def cost(
    scene: Scene2D, frequency: Float[np.ndarray, " frequency"], *, duration: float, cells: float = CELLS
) -> Cost:
    """What `simulate` with these arguments takes."""
    grid = _grid(scene, frequency, cells)
    nodes = grid.shape[0] * grid.shape[1]
    return Cost(nodes, _steps(grid, duration), 4 * (3 + 4 + 3) * nodes)


def simulate(
    scene: Scene2D,
    source: tuple[float, float],
    probes: Float[np.ndarray, "probe 2"],
    frequency: Float[np.ndarray, " frequency"],
    *,
    duration: float,
    cells: float = CELLS,
    keep_record: bool = False,
    report: Callable[[int, int], None] | None = None,
) -> Response:
    """Send a pulse from a line source along z and transform what arrives at the probes.

    The grid's dispersion is taken out: each frequency is evaluated where the grid's waves have its wavelength,
    the source's strength on the grid is known in closed form, and media are such that waves in them and
    reflections come out right. A surface does best on nodes, whole cells from the scene's lower corner: concrete
    then reflects right to 0.5% at 30 cells and 1% at 20. Between nodes it is 4% and 9% in the worst case, and metal
    ends at its last node. `Response.misaligned` tells.

    Args:
        scene: what stands there.
        source: x and y, m; in air.
        probes: x and y of each, m; anywhere in the scene, not in metal.
        frequency: Hz, from half to one and a half times their mean.
        duration: s; until the last echo that matters has passed, and what is cut off shows in `tail`.
        cells: per wavelength in air at the mean frequency.
        keep_record: keep the field over time.
        report: called with the steps done and their number.

    Raises:
        InputError: the source or a probe outside the scene, in metal or, the source, in another medium than air;
            probes of another shape; fewer than ten cells per wavelength or than 2 pi in a medium; frequencies too far
            apart; a duration that is too short for the pulse to reach the farthest probe.
    """
    frequency = np.asarray(frequency, np.float64)
    probes = np.asarray(probes, np.float64)
    if probes.ndim != 2 or probes.shape[1] != 2:
        raise InputError("probes", "shape (probe, 2), in m", f"shape {probes.shape}", "Give x and y of each")
    _check(scene, source, probes, frequency, cells)
    _check_duration(duration, frequency, np.linalg.norm(probes - np.asarray(source), axis=1).max(initial=0.0))
    grid = _grid(scene, frequency, cells)
    middle = float(np.mean(frequency))
    steps = _steps(grid, duration)
    current = ricker((np.arange(steps) + 0.5) * grid.step - _LATE / middle, middle)
    raster = rasterise(scene, grid.x, grid.y, partial(acting, grid, middle))
    media = factors(grid, raster, middle)
    places = patches(grid, np.asarray([source])), patches(grid, probes)
    seen = _Seen(len(probes), grid, frequency, steps, keep_record=keep_record)
    state = rest(grid)
    drive = -current * np.sqrt(mu_0 / epsilon_0) / grid.spacing
    for start in range(0, steps, _CHUNK):
        state, series = _chunk(state, media, places, drive[start : start + _CHUNK])
        seen.add(series, start)
        if report is not None:
            report(min(start + _CHUNK, steps), steps)
    record = np.concatenate(seen.kept).T if keep_record else None
    spectrum = seen.field / _reference(grid, frequency, current)
    return Response(frequency, spectrum, _misaligned(scene, grid), seen.tail(), record, grid.step)


def ricker(time: Float[np.ndarray, " step"], frequency: float) -> Float[np.ndarray, " step"]:
    """The Ricker pulse, strongest at a frequency, highest at time 0."""
    square = (np.pi * frequency * time) ** 2
    return (1 - 2 * square) * np.exp(-square)


class _Seen:
    """The running Fourier transform of what the probes see, in double precision."""

    def __init__(
        self,
        probes: int,
        grid: Grid,
        frequency: Float[np.ndarray, " frequency"],
        steps: int,
        *,
        keep_record: bool,
    ) -> None:
        self.field = np.zeros((probes, len(frequency)), complex)
        self.kept: list[np.ndarray] = []
        self._grid, self._keep = grid, keep_record
        self._turns = -2j * np.pi * grid_frequency(grid, frequency) * grid.step
        self._last = int(steps * (1 - _TAIL))
        self._most, self._late = np.zeros(probes), np.zeros(probes)

    def add(self, series: Float[np.ndarray, "step probe"], start: int) -> None:
        """Take in the field after some steps, the first of number `start`."""
        instants = start + 1 + np.arange(len(series))
        self.field += series.T.astype(np.float64) @ np.exp(instants[:, None] * self._turns)
        size = np.abs(series)
        self._most = np.maximum(self._most, size.max(axis=0))
        self._late = np.maximum(self._late, size[max(self._last - start, 0) :].max(axis=0, initial=0.0))
        if self._keep:
            self.kept.append(series)

    def tail(self) -> float:
        """See `Response.tail`."""
        heard = self._most > 0
        return float(np.where(heard, self._late / np.where(heard, self._most, 1.0), 1.0).max(initial=0.0))


def _chunk(
    state: State, media: Factors, places: tuple[Patches, Patches], drive: Float[np.ndarray, " step"]
) -> tuple[State, Float[np.ndarray, "step probe"]]:
    """A chunk of steps; the last one is filled up, so that all have one shape."""
    full = np.zeros(_CHUNK, np.float32)
    full[: len(drive)] = drive
    state, series = advance(state, media, *places, jnp.asarray(full))
    return state, np.asarray(series)[: len(drive)]


def _reference(
    grid: Grid, frequency: Float[np.ndarray, " frequency"], current: Float[np.ndarray, " step"]
) -> Complex[np.ndarray, " frequency"]:
    """Sum over time steps of E_z at 1 m from the source in free space, as seen from far away.

    E_z = -(w mu0 I / 4) H0^(2)(k r) with H0^(2)(x) ~ sqrt(2 / (pi x)) exp(-j (x - pi / 4)); on the grid w is
    2 sin(w dt / 2) / dt and the field is larger by `source_gain`.
    """
    turns = 2 * np.pi * grid_frequency(grid, frequency) * grid.step
    spectrum = np.exp(-1j * turns[:, None] * (np.arange(len(current)) + 0.5)) @ current
    rate = 2 * np.sin(turns / 2) / grid.step
    wavenumber = 2 * np.pi * frequency / SPEED_OF_LIGHT
    far = np.sqrt(2 / (np.pi * wavenumber)) * np.exp(1j * np.pi / 4)
    return -rate * mu_0 * spectrum / 4 * source_gain(grid, frequency) * far


def _grid(scene: Scene2D, frequency: Float[np.ndarray, " frequency"], cells: float) -> Grid:
    return make_grid(scene, SPEED_OF_LIGHT / float(np.mean(frequency)) / cells)


def _steps(grid: Grid, duration: float) -> int:
    return int(np.ceil(duration / grid.step))


def _misaligned(scene: Scene2D, grid: Grid) -> float:
    """See `Response.misaligned`."""
    sides = np.array([side for each in scene.rectangles for side in (each.lower, each.upper)]).reshape(-1, 2)
    cells = (sides - scene.lower) / grid.spacing
    cells = cells[np.isfinite(cells)]
    return float(np.abs(cells - np.round(cells)).max(initial=0.0))


def _check(
    scene: Scene2D,
    source: tuple[float, float],
    probes: Float[np.ndarray, "probe 2"],
    frequency: Float[np.ndarray, " frequency"],
    cells: float,
) -> None:
    if frequency.ndim != 1 or not len(frequency) or np.ptp(frequency) > np.mean(frequency):
        got = np.array2string(frequency, threshold=6)
        raise InputError("frequency", "frequencies around one carrier, in Hz", got, "Simulate bands apart")
    densest = max((each.medium.permittivity for each in scene.rectangles), default=1.0)
    fewest = max(10.0, 2 * np.pi * np.sqrt(densest))
    if cells < fewest:
        remedy = "Use 30, or more where a medium is dense"
        raise InputError("cells per wavelength", f"at least {fewest:.3g}", f"{cells:g}", remedy)
    _check_place("source", scene, source, in_air=True)
    for number, place in enumerate(probes):
        _check_place(f"probe {number}", scene, (float(place[0]), float(place[1])), in_air=False)


def _check_place(name: str, scene: Scene2D, place: tuple[float, float], *, in_air: bool) -> None:
    inside = all(a <= p <= b for a, p, b in zip(scene.lower, place, scene.upper, strict=True))
    found = scene.medium_at(place)
    if not inside or found.is_metal or (in_air and found != AIR):
        expected = f"a place inside the scene and {'in air' if in_air else 'outside metal'}"
        raise InputError(name, expected, f"({place[0]:g}, {place[1]:g})", "Move it")


def _check_duration(duration: float, frequency: Float[np.ndarray, " frequency"], farthest: float) -> None:
    least = 2 * _LATE / float(np.mean(frequency)) + farthest / SPEED_OF_LIGHT
    if not duration >= least:
        expected = f"at least the {least:.3g} s in which the pulse has passed the farthest probe"
        remedy = "Add the delay of the last echo that matters to that of the pulse"
        raise InputError("duration", expected, f"{duration:g}", remedy)
