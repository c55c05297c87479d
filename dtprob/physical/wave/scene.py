"""What stands in a plane: rectangles of dielectric or metal, and their averages over the cells of a grid."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dtprob.errors import InputError


class Medium(NamedTuple):
    """What fills a region.

    Attributes:
        permittivity: relative, at least 1.
        conductivity: S/m; infinite for a perfect conductor.
    """

    permittivity: float
    conductivity: float

    @property
    def is_metal(self) -> bool:
        """Whether it conducts perfectly."""
        return math.isinf(self.conductivity)


AIR: Final = Medium(1.0, 0.0)
METAL: Final = Medium(1.0, math.inf)
CONCRETE: Final = Medium(5.31, 0.0326 * 6**0.8095)
"""Concrete at 6 GHz. Source: Recommendation ITU-R P.2040-1 (2015), table 3; later editions have other values."""


@dataclass(frozen=True)
class Rectangle:
    """A region with sides along the axes.

    Attributes:
        lower: smallest x and y, m; -inf reaches through the edge of the scene.
        upper: largest x and y, m; likewise inf.
        medium: what fills it.
    """

    lower: tuple[float, float]
    upper: tuple[float, float]
    medium: Medium

    def __post_init__(self) -> None:
        _require_extent("rectangle", self.lower, self.upper)
        if not (1 <= self.medium.permittivity < math.inf and self.medium.conductivity >= 0):
            raise InputError(
                "medium of a rectangle",
                "a finite relative permittivity from 1 and a conductivity in S/m from 0",
                f"{self.medium.permittivity:g} and {self.medium.conductivity:g}",
                "Correct them, or name METAL",
            )


@dataclass(frozen=True)
class Scene2D:
    """A part of the plane, open on every side: what reaches its edges goes on for ever.

    Attributes:
        lower: smallest x and y of interest, m.
        upper: largest x and y.
        rectangles: what stands there; where they overlap the later one counts. The rest is air.
    """

    lower: tuple[float, float]
    upper: tuple[float, float]
    rectangles: tuple[Rectangle, ...] = ()

    def __post_init__(self) -> None:
        _require_extent("scene", self.lower, self.upper)
        if not np.all(np.isfinite([*self.lower, *self.upper])):
            raise InputError("scene", "finite corners", f"{self.lower}, {self.upper}", "Bound the scene")

    def medium_at(self, point: tuple[float, float]) -> Medium:
        """What fills a point, edges included."""
        inside = [
            each.medium
            for each in self.rectangles
            if all(a <= p <= b for a, p, b in zip(each.lower, point, each.upper, strict=True))
        ]
        return inside[-1] if inside else AIR


class Acting(NamedTuple):
    """A medium as the time steps on a grid need it (`dtprob.physical.wave.grid.acting`).

    Attributes:
        permittivity: relative.
        conductivity: S/m.
        permeability: relative.
    """

    permittivity: float
    conductivity: float
    permeability: float


class Raster(NamedTuple):
    """The media of a scene on a grid, each the mean over the cell around its place.

    Attributes:
        permittivity: relative, at nodes.
        conductivity: S/m, at nodes.
        permeability_x: relative, half way between nodes along y.
        permeability_y: half way between nodes along x.
        metal: nodes inside a perfect conductor or on its surface.
    """

    permittivity: Float[np.ndarray, "nx ny"]
    conductivity: Float[np.ndarray, "nx ny"]
    permeability_x: Float[np.ndarray, "nx ny-1"]
    permeability_y: Float[np.ndarray, "nx-1 ny"]
    metal: Bool[np.ndarray, "nx ny"]


def rasterise(
    scene: Scene2D,
    x: Float[np.ndarray, " nx"],
    y: Float[np.ndarray, " ny"],
    act: Callable[[Medium], Acting],
) -> Raster:
    """Average the media over square cells; exact, also where several meet in a cell.

    The mean is the arithmetic one: the electric field is along z, so it lies in every surface.

    Args:
        scene: what stands where.
        x: of the nodes, m, equally spaced.
        y: likewise.
        act: how a medium that is no metal acts on the grid.
    """
    spacing = x[1] - x[0]
    edges = [_edges(scene, axis, nodes, spacing) for axis, nodes in enumerate((x, y))]
    middles = [(each[1:] + each[:-1]) / 2 for each in edges]
    media = [[scene.medium_at((u, v)) for v in middles[1]] for u in middles[0]]
    acting = {each: act(AIR if each.is_metal else each) for row in media for each in row}
    tiles = np.array([[acting[each] for each in row] for row in media])
    at_nodes = [_shares(nodes, each, spacing) for nodes, each in zip((x, y), edges, strict=True)]
    between = [_shares(n[:-1] + spacing / 2, each, spacing) for n, each in zip((x, y), edges, strict=True)]
    return Raster(
        at_nodes[0] @ tiles[..., 0] @ at_nodes[1].T,
        at_nodes[0] @ tiles[..., 1] @ at_nodes[1].T,
        at_nodes[0] @ tiles[..., 2] @ between[1].T,
        between[0] @ tiles[..., 2] @ at_nodes[1].T,
        _metal(scene, x, y, 1e-6 * spacing),
    )


def _metal(
    scene: Scene2D, x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], margin: float
) -> Bool[np.ndarray, "nx ny"]:
    """Nodes in a conductor; a later rectangle of another medium takes out what is strictly inside it.

    Raises:
        InputError: a conductor in the middle of the grid holds no node.
    """
    metal = np.zeros((len(x), len(y)), bool)
    for each in scene.rectangles:
        grow = margin if each.medium.is_metal else -margin
        inside = [
            (nodes >= low - grow) & (nodes <= high + grow)
            for nodes, low, high in zip((x, y), each.lower, each.upper, strict=True)
        ]
        if each.medium.is_metal:
            _require_nodes(each, (x, y), inside)
        metal[np.ix_(*inside)] = each.medium.is_metal
    return metal


def _require_nodes(
    plate: Rectangle,
    axes: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]],
    inside: list[Bool[np.ndarray, " n"]],
) -> None:
    """Refuse a plate that lies between the lines of nodes, where it would vanish."""
    reached = all(
        low < nodes[-1] and high > nodes[0]
        for nodes, low, high in zip(axes, plate.lower, plate.upper, strict=True)
    )
    if reached and not all(each.any() for each in inside):
        expected = "a node of the grid on each axis"
        remedy = "Make it thicker than the spacing, or the spacing finer"
        raise InputError("metal rectangle", expected, f"none in {plate.lower} to {plate.upper}", remedy)


def _edges(
    scene: Scene2D, axis: int, nodes: Float[np.ndarray, " n"], spacing: float
) -> Float[np.ndarray, " edge"]:
    """Where the medium may change along an axis, with the ends of the grid."""
    ends = nodes[0] - spacing / 2, nodes[-1] + spacing / 2
    inner = [bound[axis] for each in scene.rectangles for bound in (each.lower, each.upper)]
    return np.unique(np.clip([*ends, *inner], *ends))


def _shares(
    nodes: Float[np.ndarray, " n"], edges: Float[np.ndarray, " edge"], spacing: float
) -> Float[np.ndarray, "n tile"]:
    """Part of each node's cell that lies in each tile."""
    low = np.maximum(edges[None, :-1], nodes[:, None] - spacing / 2)
    high = np.minimum(edges[None, 1:], nodes[:, None] + spacing / 2)
    return np.maximum(high - low, 0.0) / spacing


def _require_extent(what: str, lower: tuple[float, float], upper: tuple[float, float]) -> None:
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        got = f"{lower} and {upper}"
        raise InputError(what, "a lower corner below and left of the upper one", got, "Correct the corners")
