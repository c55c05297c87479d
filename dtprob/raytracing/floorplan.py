"""A scene from a floor plan: walls and furniture drawn in two dimensions, extruded to a height.

Every wall is one flat surface on its centre line; its thickness is that of the slab it stands for.
"""

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.carrier import set_frequency, unknown_materials
from dtprob.raytracing.sionna import sionna_rt

_GAP: Final = 1e-3
"""Height in m at which furniture starts, so that it shares no plane with the floor."""


@dataclass(frozen=True)
class Surface:
    """What a wall, a floor or a piece of furniture is made of.

    Attributes:
        material: name in Recommendation ITU-R P.2040, as sionna-rt spells it ("concrete", "wood", "metal").
        thickness: of the slab, m.
        name: of the material in the scene; surfaces of one name share their parameters. Made from material
            and thickness when empty.
    """

    material: str
    thickness: float
    name: str = ""

    @property
    def label(self) -> str:
        """Name of the material in the scene."""
        return self.name or f"{self.material}_{1000 * self.thickness:g}mm"


@dataclass(frozen=True)
class Furniture:
    """A closed body with vertical sides.

    Attributes:
        kind: what it is; the object is called kind_0, kind_1, ...
        polygon: outline seen from above, convex, m.
        height: m.
        surface: of its panels.
    """

    kind: str
    polygon: Float[np.ndarray, "corner 2"]
    height: float = 2.0
    surface: Surface = Surface("wood", 0.02)


class Floorplan(NamedTuple):
    """What a floor plan file holds."""

    walls: Float[np.ndarray, "wall 4"]
    furniture: tuple[Furniture, ...]


class _Body(NamedTuple):
    """A named mesh with what it is made of."""

    name: str
    surface: Surface
    vertex: Float[np.ndarray, "vertex 3"]
    face: Int[np.ndarray, "face 3"]


def read_floorplan(file: str | os.PathLike[str]) -> Floorplan:
    """Read a floor plan in JSON.

    The file holds ``walls_xyxy``, a list of [x1, y1, x2, y2] in m, and may hold ``furniture``, a list of
    {"kind": name, "polygon_m": [[x, y], ...]}.

    Args:
        file: its name.

    Raises:
        InputError: there is no such file, or it holds something else.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(f"floor plan {path}", "a JSON file", "no such file", "Correct the path")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        walls = np.asarray(content["walls_xyxy"], np.float64)
        pieces = [
            (str(one["kind"]), np.asarray(one["polygon_m"], np.float64))
            for one in content.get("furniture", [])
        ]
    except (ValueError, KeyError, TypeError) as error:
        expected = "walls_xyxy [[x1, y1, x2, y2], ...] and furniture [{kind, polygon_m}, ...]"
        raise InputError(
            f"floor plan {path}", expected, f"{type(error).__name__} {error}", "Correct it"
        ) from error
    return Floorplan(walls, tuple(Furniture(kind, polygon) for kind, polygon in pieces))


def floorplan_scene(
    walls: Float[np.ndarray, "wall 4"],
    height: float,
    frequency: float,
    *,
    wall: Surface | Sequence[Surface] = Surface("concrete", 0.1),
    floor: Surface | None = Surface("concrete", 0.2),
    ceiling: Surface | None = Surface("concrete", 0.2),
    furniture: Sequence[Furniture] = (),
) -> Any:
    """Build a scene in memory; its objects are wall_0, wall_1, ..., floor, ceiling, and kind_0, ... .

    Args:
        walls: ends [x1, y1, x2, y2] of each wall's centre line, m.
        height: of the rooms, m.
        frequency: carrier in Hz.
        wall: what the walls are made of, all of them or one by one.
        floor: at height 0 under all walls; None for none.
        ceiling: at `height`; None for none.
        furniture: standing on the floor.

    Returns:
        a ``sionna.rt.Scene`` for `dtprob.raytracing.trace.trace`.

    Raises:
        InputError: a wall without length, an outline that is not convex, a material that does not exist or
            is not known at the carrier, or sizes that are not positive.
    """
    segments = _check_walls(walls, height)
    surfaces = [wall] * len(segments) if isinstance(wall, Surface) else list(wall)
    if len(surfaces) != len(segments):
        raise InputError(
            "wall", f"one surface or {len(segments)} of them", str(len(surfaces)), "Give one per wall"
        )
    bodies = [
        _wall(i, ends, height, made) for i, (ends, made) in enumerate(zip(segments, surfaces, strict=True))
    ]
    low, high = segments.reshape(-1, 2).min(axis=0), segments.reshape(-1, 2).max(axis=0)
    slabs = (("floor", floor, 0.0), ("ceiling", ceiling, height))
    bodies += [_slab(name, made, low, high, level) for name, made, level in slabs if made is not None]
    seen: Counter[str] = Counter()
    for piece in furniture:
        bodies.append(_prism(f"{piece.kind}_{seen[piece.kind]}", piece, height))
        seen[piece.kind] += 1
    return _build(bodies, frequency)


def _check_walls(walls: Float[np.ndarray, "wall 4"], height: float) -> Float[np.ndarray, "wall 4"]:
    segments = np.asarray(walls, np.float64)
    if segments.ndim != 2 or segments.shape[1] != 4 or not len(segments) or not np.all(np.isfinite(segments)):
        got = f"shape {segments.shape}"
        raise InputError(
            "walls", "finite [x1, y1, x2, y2] in m, shape (wall, 4)", got, "Give the ends of each wall"
        )
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    if np.any(length < 1e-3):
        got = f"walls {np.flatnonzero(length < 1e-3).tolist()} without length"
        raise InputError("walls", "walls longer than 1 mm", got, "Remove them")
    if not height > 0:
        raise InputError("height", "a positive height in m", repr(height), "Give the height of the rooms")
    return segments


def _wall(number: int, ends: Float[np.ndarray, "4"], height: float, surface: Surface) -> _Body:
    outline = ends.reshape(2, 2)
    vertex = np.concatenate([np.c_[outline, [0.0, 0.0]], np.c_[outline[::-1], [height, height]]])
    return _Body(f"wall_{number}", surface, vertex, np.array([[0, 1, 2], [0, 2, 3]]))


def _slab(
    name: str, surface: Surface, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], level: float
) -> _Body:
    (x1, y1), (x2, y2) = low, high
    vertex = np.array([[x1, y1, level], [x2, y1, level], [x2, y2, level], [x1, y2, level]])
    return _Body(name, surface, vertex, np.array([[0, 1, 2], [0, 2, 3]]))


def _prism(name: str, piece: Furniture, height: float) -> _Body:
    """Sides and top of a piece of furniture; a top under the ceiling is kept apart from it."""
    corners = np.asarray(piece.polygon, np.float64)
    if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or not _is_convex(corners):
        expected = "a convex outline of 3 corners or more, shape (corner, 2)"
        raise InputError(f"outline of {name}", expected, f"{corners.tolist()}", "Split it into convex parts")
    if not piece.height > _GAP:
        raise InputError(f"height of {name}", "a positive height in m", repr(piece.height), "Correct it")
    n, top = len(corners), min(piece.height, height - _GAP)
    vertex = np.concatenate([np.c_[corners, np.full(n, _GAP)], np.c_[corners, np.full(n, top)]])
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.c_[i, j, j + n], np.c_[i, j + n, i + n]])
    lid = np.c_[np.full(n - 2, n), np.arange(n + 1, 2 * n - 1), np.arange(n + 2, 2 * n)]
    return _Body(name, piece.surface, vertex, np.concatenate([sides, lid]))


def _is_convex(corners: Float[np.ndarray, "corner 2"]) -> bool:
    edges = np.roll(corners, -1, axis=0) - corners
    after = np.roll(edges, -1, axis=0)
    turn = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    angle = np.arctan2(turn, np.sum(edges * after, axis=1)).sum()
    return bool((np.all(turn >= 0) or np.all(turn <= 0)) and np.isclose(abs(angle), 2 * np.pi))


def _build(bodies: Sequence[_Body], frequency: float) -> Any:
    rt = sionna_rt()
    materials = _materials(bodies)
    scene = set_frequency(rt.load_scene(), frequency)
    parts = [
        rt.SceneObject(_mesh(one), name=one.name, radio_material=materials[one.surface.label])
        for one in bodies
    ]
    try:
        scene.add(parts)
    except ValueError as error:
        raise unknown_materials(frequency, error) from error
    return set_frequency(scene, frequency)


def _materials(bodies: Sequence[_Body]) -> dict[str, Any]:
    """One radio material per name."""
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES  # noqa: PLC0415
    from sionna.rt.radio_materials.itu_material import ITURadioMaterial  # noqa: PLC0415

    made: dict[str, Surface] = {}
    for body in bodies:
        surface = body.surface
        if surface.material not in ITU_MATERIALS_PROPERTIES:
            raise unknown_name(
                f"material of {body.name}", surface.material, ITU_MATERIALS_PROPERTIES, "material"
            )
        if not surface.thickness > 0:
            got = repr(surface.thickness)
            raise InputError(f"thickness of {body.name}", "a positive thickness in m", got, "Correct it")
        if made.setdefault(surface.label, surface) != surface:
            expected = f"'{surface.label}' to be one material"
            raise InputError(
                "materials", expected, f"{made[surface.label]} and {surface}", "Give them other names"
            )
    return {
        label: ITURadioMaterial(label, itu_type=one.material, thickness=one.thickness)
        for label, one in made.items()
    }


def _mesh(body: _Body) -> Any:
    import mitsuba as mi  # noqa: PLC0415

    properties = mi.Properties()
    properties["face_normals"] = True
    mesh = mi.Mesh(body.name, len(body.vertex), len(body.face), props=properties)
    fields = mi.traverse(mesh)
    fields["vertex_positions"] = body.vertex.astype(np.float32).ravel()
    fields["faces"] = body.face.astype(np.uint32).ravel()
    fields.update()
    return mesh
