"""Which objects of a scene enclose a point."""

from typing import Any

import numpy as np
from jaxtyping import Float


def enclosing_objects(scene: Any, point: Float[np.ndarray, "3"]) -> list[str]:
    """Names of the objects whose closed surfaces have a point inside.

    Args:
        scene: a ``sionna.rt.Scene``.
        point: in m.
    """
    return [
        name
        for name, item in scene.objects.items()
        if abs(winding_number(_corners(item.mi_mesh), np.asarray(point, np.float64))) > 0.5
    ]


def winding_number(corners: Float[np.ndarray, "face 3 3"], point: Float[np.ndarray, "3"]) -> float:
    """How often a triangle mesh goes round a point: 0 outside of a closed surface, 1 or -1 inside.

    Source: solid angle of a triangle, A. Van Oosterom and J. Strackee, The Solid Angle of a Plane Triangle (1983).

    Args:
        corners: of each triangle, in m.
        point: in m.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=1)
    rest = la * lb * lc + np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
    return float(np.sum(np.arctan2(volume, rest)) / (2 * np.pi))


def _corners(mesh: Any) -> Float[np.ndarray, "face 3 3"]:
    vertices = np.asarray(mesh.vertex_positions_buffer()).reshape(-1, 3).astype(np.float64)
    return vertices[np.asarray(mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)]
