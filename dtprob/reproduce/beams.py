"""Paths from a base station to many street positions of a scene: the truth of studies of beam alignment."""

from typing import Any, Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from dtprob.errors import InputError
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.trace import load_scene, trace

HEIGHT: Final = 1.5
"""Of the users above the ground, m."""

PATHS: Final = 8
"""Paths kept per position, the strongest ones."""

_BATCH: Final = 6000
_ABOVE: Final = 500.0


class Site(NamedTuple):
    """A base station in a scene.

    Attributes:
        scene: name of a scene that sionna-rt ships, or a Mitsuba XML file.
        frequency: carrier, Hz.
        position: of the array, m; its rows lie along y, its columns along z. Users' antennas lie along x.
        spacing: of the grid of positions, m.
        max_depth: most reflections on a path.
        samples: rays shot.
    """

    scene: str = "etoile"
    frequency: float = 28e9
    position: tuple[float, float, float] = (20.0, 20.0, 30.0)
    spacing: float = 2.0
    max_depth: int = 2
    samples: int = 50_000


class BeamPaths(NamedTuple):
    """Paths from a base station to positions, the strongest first, padded by paths of gain 0.

    Attributes:
        position: horizontal, m.
        gain: passband gain with the phase of the delay, 1.
        horizontal: direction cosine of departure along the rows of the array, sin(theta) sin(phi).
        vertical: along its columns, cos(theta).
        arrival: of arrival, along the user's line of antennas.
    """

    position: Float[np.ndarray, "position 2"]
    gain: Complex[np.ndarray, "position path"]
    horizontal: Float[np.ndarray, "position path"]
    vertical: Float[np.ndarray, "position path"]
    arrival: Float[np.ndarray, "position path"]


def trace_positions(site: Site, count: int) -> BeamPaths:
    """The paths to the positions that are nearest the base station among those that a path reaches.

    The positions form a square grid and stand in the open: looked at from above, the ground is there.

    Args:
        site: where the base station is.
        count: number of positions.

    Raises:
        InputError: the scene has fewer such positions, or no ray tracer can run here.
    """
    scene = load_scene(site.scene, site.frequency)
    grid = _open_grid(scene, site)
    found: list[BeamPaths] = []
    reached = 0
    for start in range(0, len(grid), _BATCH):
        batch = _trace(scene, site, grid[start : start + _BATCH])
        found.append(batch)
        reached += len(batch.position)
        if reached >= count:
            return BeamPaths(*(np.concatenate(parts)[:count] for parts in zip(*found, strict=True)))
    remedy = "Ask for fewer, or set a finer grid"
    raise InputError("positions of the scene", f"{count} that a path reaches", str(reached), remedy)


def _open_grid(scene: Any, site: Site) -> Float[np.ndarray, "position 2"]:
    """The grid's positions with nothing but ground below the sky, the nearest first."""
    import mitsuba as mi  # noqa: PLC0415

    box = scene.mi_scene.bbox()
    axes = [np.arange(box.min[i] + site.spacing, box.max[i], site.spacing) for i in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.linalg.norm(grid - np.array(site.position[:2]), axis=1), kind="stable")]
    ray = mi.Ray3f(mi.Point3f(*grid.T, _ABOVE), mi.Vector3f(0, 0, -1))
    hit = scene.mi_scene.ray_intersect(ray)
    floor = float(box.min[2])
    return grid[np.asarray(hit.is_valid()) & (np.asarray(hit.p.z) < floor + HEIGHT / 2)]


def _trace(scene: Any, site: Site, grid: Float[np.ndarray, "position 2"]) -> BeamPaths:
    rx = np.column_stack([grid, np.full(len(grid), scene.mi_scene.bbox().min[2] + HEIGHT)])
    tx = np.tile(site.position, (len(grid), 1))
    paths = trace(scene, tx, rx, max_depth=site.max_depth, samples=site.samples, allow_empty=True)
    return _strongest(paths.take(np.asarray(paths.mask).any(axis=1)))


def _strongest(paths: PathSet) -> BeamPaths:
    gain = np.asarray(path_gain(paths, paths.permittivity, paths.conductivity) * paths.carrier_phasor)
    departure, arrival = (
        np.asarray(jnp.where(paths.mask[..., None], direction, 0.0))
        for direction in (paths.departure, -paths.arrival)
    )
    order = np.argsort(-np.abs(gain), axis=1, kind="stable")[:, :PATHS]
    short = ((0, 0), (0, PATHS - order.shape[1]))

    def taken(values: np.ndarray) -> np.ndarray:
        return np.pad(np.take_along_axis(values, order, axis=1), short)

    position = np.asarray(paths.rx_position)[:, :2]
    cosines = taken(departure[..., 1]), taken(departure[..., 2]), taken(arrival[..., 0])
    return BeamPaths(position, taken(gain), *cosines)
