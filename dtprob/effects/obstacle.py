"""A wall that the scene lacks, wherever it may stand: upright screens on a grid over the floor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.common import Data, Family, Sites, half_normal, has_phase, normal, offers, phasor
from dtprob.effects.effect import Effect
from dtprob.raytracing.paths import NONE, PathSet

_CELLS: Final = 6
"""Cells along the longer side of the floor that is tried."""
_EAST, _NORTH = np.eye(2)


def missing_object(sites: Sites, data: Data) -> list[Effect]:
    """A wall that the scene lacks stands in the way, on one of the edges of a grid over the floor."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not offers(sites, "path_gain"):
        return []
    own = (half_normal("loss", 0.7, "Np"), *((normal("phase", 1.0, "rad"),) if has_phase(sites) else ()))
    mask = np.asarray(paths.mask)
    seen: set[bytes] = set()
    effects = []
    for start, stop in _screens(paths):
        crossed = np.asarray(_crossings(paths, start, stop))[mask]
        if not crossed.any() or crossed.all() or crossed.tobytes() in seen:
            continue
        seen.add(crossed.tobytes())
        effects.append(
            Effect(
                "missing_object",
                {"path_gain": _through(start, stop)},
                own,
                instance=_name(start, stop),
                physics=f"A wall from {_text(start)} to {_text(stop)}, floor to ceiling, weakens and turns each path"
                " that crosses it; what it reflects is neglected.",
                source="a exp(n (-l + j phi)), n crossings; ITU-R P.2040.",
                requires=("paths",),
            )
        )
    return effects


def _through(start: np.ndarray, stop: np.ndarray) -> Any:
    def weaken(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        count = _crossings(context["paths"], start, stop)
        lost = value * jnp.exp(-p["loss"] * count)
        return lost * phasor(p["phase"] * count) if "phase" in p else lost

    return weaken


def _screens(paths: PathSet) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ends, (x, y) in m, of the edges of square cells between all ends and points of interaction."""
    points = np.concatenate([np.asarray(paths.tx_position), np.asarray(paths.rx_position), _met(paths)])[
        :, :2
    ]
    low, high = points.min(axis=0), points.max(axis=0)
    side = float(np.max(high - low)) / _CELLS
    if side <= 0:
        return []
    many_x, many_y = (max(int(np.ceil(extent / side - 1e-9)), 1) for extent in high - low)
    corner = (low + high - side * np.array([many_x, many_y])) / 2
    screens = []
    for i, j in product(range(many_x + 1), range(many_y + 1)):
        here = corner + side * np.array([i, j])
        if i < many_x:
            screens.append((here, here + side * _EAST))
        if j < many_y:
            screens.append((here, here + side * _NORTH))
    return screens


def _met(paths: PathSet) -> np.ndarray:
    """Points of interaction of existing paths, (n, 3)."""
    exists = (np.asarray(paths.interaction) != NONE) & np.asarray(paths.mask)[..., None]
    return np.asarray(paths.vertex)[exists]


@jax.jit
def _crossings(paths: PathSet, start: np.ndarray, stop: np.ndarray) -> jax.Array:
    """How often each path crosses the upright screen over a line on the floor, (link, path); 0 where its way is untold."""
    happens = (paths.interaction != NONE)[..., None]
    ends = jnp.broadcast_to(paths.rx_position[:, None, None], paths.vertex.shape)
    first = jnp.broadcast_to(paths.tx_position[:, None, None], ends[:, :, :1].shape)
    corners = jnp.concatenate([first, jnp.where(happens, paths.vertex, ends), ends[:, :, :1]], axis=2)[
        ..., :2
    ]
    before, after = corners[:, :, :-1], corners[:, :, 1:]
    line = jnp.asarray(stop - start)

    def side_of_line(point: jax.Array) -> jax.Array:
        return line[0] * (point[..., 1] - start[1]) - line[1] * (point[..., 0] - start[0])

    def side_of_leg(point: np.ndarray) -> jax.Array:
        leg, reach = after - before, jnp.asarray(point) - before
        return leg[..., 0] * reach[..., 1] - leg[..., 1] * reach[..., 0]

    meets = (side_of_line(before) * side_of_line(after) < 0) & (side_of_leg(start) * side_of_leg(stop) < 0)
    return jnp.sum(meets, axis=-1) * (jnp.asarray(paths.mask) & ~paths.is_untold)


def _name(start: np.ndarray, stop: np.ndarray) -> str:
    """The ends in m, with as many digits as tell this screen from the next one."""
    digits = max(1, math.ceil(-math.log10(float(np.abs(stop - start).max()) / 4)))
    ends = [f"{round(float(v), digits) + 0.0:g}" for v in (*start, *stop)]
    return f"{ends[0]}_{ends[1]}_to_{ends[2]}_{ends[3]}"


def _text(point: np.ndarray) -> str:
    return "(" + " ".join(f"{x:.1f}" for x in point) + ") m"


FAMILIES: Final[dict[str, Family]] = {"missing_object": missing_object}
