"""The image method in double precision: exact vertices, directions and lengths of specular paths."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.raytracing.paths import DIFFRACTION, DIFFUSE, NONE, SPECULAR


class Geometry(NamedTuple):
    """Where paths run.

    Attributes:
        vertex: points of interaction in m; the receiver where there is none.
        length: unfolded length in m.
        departure: unit vector of travel leaving the transmitter.
        arrival: unit vector of travel at the receiver.
    """

    vertex: Float[np.ndarray, "path depth 3"]
    length: Float[np.ndarray, " path"]
    departure: Float[np.ndarray, "path 3"]
    arrival: Float[np.ndarray, "path 3"]

    def chosen(self, order: Int[np.ndarray, " chosen"]) -> "Geometry":
        """Some of the paths, in this order."""
        return Geometry(self.vertex[order], self.length[order], self.departure[order], self.arrival[order])


def unfold(
    tx: Float[np.ndarray, "path 3"],
    rx: Float[np.ndarray, "path 3"],
    interaction: Int[np.ndarray, "path depth"],
    normal: Float[np.ndarray, "path depth 3"],
    vertex: Float[np.ndarray, "path depth 3"],
) -> Geometry:
    """Recompute paths from the planes they meet.

    A specular reflection mirrors the transmitter in its plane, a refraction leaves the ray straight (thin
    slabs); the path is then the straight line from the last image to the receiver, cut by the planes from
    the last to the first. Paths with a diffuse reflection or a diffraction keep the vertices given.

    Args:
        tx: transmitter of each path, m.
        rx: receiver of each path, m.
        interaction: codes of `PathSet.interaction`.
        normal: unit normals of the planes.
        vertex: a point of each plane (the vertex found by the ray tracer), m.
    """
    tx, rx, normal, vertex = (np.asarray(a, np.float64) for a in (tx, rx, normal, vertex))
    images = _images(tx, interaction, normal, vertex)
    exact = _vertices(rx, images, interaction, normal, vertex)
    free = np.any((interaction == DIFFUSE) | (interaction == DIFFRACTION), axis=1)
    points = np.where(free[:, None, None], _fill(vertex, interaction, rx), exact)
    steps = np.diff(np.concatenate([tx[:, None], points, rx[:, None]], axis=1), axis=1)
    lengths = np.linalg.norm(steps, axis=-1)
    length = np.where(free, lengths.sum(axis=1), np.linalg.norm(rx - images[-1], axis=1))
    last = np.count_nonzero(interaction != NONE, axis=1)
    arrival = np.take_along_axis(steps, last[:, None, None], axis=1)[:, 0]
    return Geometry(points, length, _unit(steps[:, 0]), _unit(arrival))


def _unit(vector: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _images(
    tx: Float[np.ndarray, "path 3"],
    interaction: Int[np.ndarray, "path depth"],
    normal: Float[np.ndarray, "path depth 3"],
    point: Float[np.ndarray, "path depth 3"],
) -> list[Float[np.ndarray, "path 3"]]:
    """The transmitter and its image after each step."""
    images = [tx]
    for step in range(interaction.shape[1]):
        n, source = normal[:, step], images[-1]
        height = np.sum((source - point[:, step]) * n, axis=-1, keepdims=True)
        mirrored = source - 2 * height * n
        images.append(np.where((interaction[:, step] == SPECULAR)[:, None], mirrored, source))
    return images


def _vertices(
    rx: Float[np.ndarray, "path 3"],
    images: list[Float[np.ndarray, "path 3"]],
    interaction: Int[np.ndarray, "path depth"],
    normal: Float[np.ndarray, "path depth 3"],
    point: Float[np.ndarray, "path depth 3"],
) -> Float[np.ndarray, "path depth 3"]:
    """Cut the straight line from each image by its plane, from the receiver backwards."""
    target, found = rx, np.empty_like(point)
    for step in reversed(range(interaction.shape[1])):
        n = normal[:, step]
        direction = images[step + 1] - target
        slope = np.sum(direction * n, axis=-1)
        height = np.sum((point[:, step] - target) * n, axis=-1)
        fraction = height / np.where(slope == 0, 1.0, slope)
        cut = target + fraction[:, None] * direction
        target = np.where((interaction[:, step] != NONE)[:, None], cut, target)
        found[:, step] = target
    return found


def _fill(
    vertex: Float[np.ndarray, "path depth 3"],
    interaction: Int[np.ndarray, "path depth"],
    rx: Float[np.ndarray, "path 3"],
) -> Float[np.ndarray, "path depth 3"]:
    """The vertices given, and the receiver where there is no interaction."""
    return np.where((interaction != NONE)[..., None], vertex, rx[:, None])
