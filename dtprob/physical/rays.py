"""Propagation paths as isometries: each unfolds the receiver's surroundings into those of the transmitter.

A chain of mirrors maps a point x near the receiver to R x + t, from where the transmitter sees it along a
straight line. With u the vector from the transmitter to the unfolded receiver, the path has length |u|,
leaves along u / |u| and arrives along R^T u / |u|; moving the receiver by d turns u into u + R d, exactly,
however large d is. Everything that moves is computed that way, with no derivative and no small-angle step. A path
through a point scatterer (`join`) is no chain of mirrors: its R only turns directions, and u + R d is right to first
order in d over the distance to the scatterer.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float

from dtprob.physical.world import SPEED_OF_LIGHT


@dataclass(frozen=True)
class Rays:
    """The paths of every link, padded to a common number.

    Attributes:
        gain: passband gain without the phase of the delay; 0 where there is no path. The snapshot axis has
            length 1 where nothing changes over time.
        unfolded: u in m, from the transmitter to the unfolded receiver; likewise.
        mirror: the orthogonal matrix R.
        mask: which paths exist.
        meets: which objects a path meets, in the order of `objects`.
        objects: names of the scene's objects, sorted.
    """

    gain: Complex[np.ndarray, "link instant path"]
    unfolded: Float[np.ndarray, "link instant path 3"]
    mirror: Float[np.ndarray, "link path 3 3"]
    mask: Bool[np.ndarray, "link path"]
    meets: Bool[np.ndarray, "link path object"]
    objects: tuple[str, ...]

    @property
    def length(self) -> Float[np.ndarray, "link instant path"]:
        """Length of each path, m."""
        return np.linalg.norm(self.unfolded, axis=-1)

    @property
    def delay(self) -> Float[np.ndarray, "link instant path"]:
        """Delay of each path, s."""
        return self.length / SPEED_OF_LIGHT

    @property
    def departure(self) -> Float[np.ndarray, "link path 3"]:
        """Unit vector of travel on leaving the transmitter, in the first snapshot."""
        return self.unfolded[:, 0] / self.length[:, 0, :, None]

    @property
    def arrival(self) -> Float[np.ndarray, "link path 3"]:
        """Unit vector of travel at the receiver, in the first snapshot."""
        return np.einsum("lpji,lpj->lpi", self.mirror, self.departure)

    def meeting(self, name: str) -> Bool[np.ndarray, "link path"]:
        """Which paths meet the object of this name."""
        return self.meets[..., self.objects.index(name)] & self.mask

    def scaled(self, factor: Complex[np.ndarray, "#link #snapshot #path"]) -> Rays:
        """The rays with their gains multiplied."""
        return dataclasses.replace(self, gain=self.gain * factor)

    def shifted(self, displacement: Float[np.ndarray, "#link #snapshot 3"]) -> Rays:
        """The rays after the receivers moved, in m; gains stay, the mirrors are taken as infinite planes.

        Paths of `join` are those of mirrors, which is right while the way is short beside that to the scatterer.
        """
        step = np.einsum(
            "lpij,lsj->lspi", self.mirror, np.broadcast_to(displacement, self._moved_shape(displacement))
        )
        return dataclasses.replace(self, unfolded=self.unfolded + step)

    def _moved_shape(self, displacement: Float[np.ndarray, "#link #snapshot 3"]) -> tuple[int, int, int]:
        return (len(self.mask), displacement.shape[1], 3)


def join(
    rays: Rays,
    gain: Complex[np.ndarray, "link new"],
    via: Float[np.ndarray, "link new 3"],
    tx: Float[np.ndarray, "link 3"],
    rx: Float[np.ndarray, "link 3"],
) -> Rays:
    """The rays with more paths, each through a point scatterer.

    Args:
        rays: paths so far.
        gain: of the new paths.
        via: where the scatterers are, m.
        tx: the transmitters, m.
        rx: the receivers, m.
    """
    out, back = via - tx[:, None], rx[:, None] - via
    length = np.linalg.norm(out, axis=-1) + np.linalg.norm(back, axis=-1)
    away, towards = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (out, back))
    snapshots = rays.unfolded.shape[1]
    unfolded = np.repeat((away * length[..., None])[:, None], snapshots, axis=1)
    new_gain = np.repeat(gain[:, None], rays.gain.shape[1], axis=1)
    here = np.ones(gain.shape, bool)
    return dataclasses.replace(
        rays,
        gain=np.concatenate([rays.gain, new_gain], axis=2),
        unfolded=np.concatenate([rays.unfolded, unfolded], axis=2),
        mirror=np.concatenate([rays.mirror, turning(towards, away)], axis=1),
        mask=np.concatenate([rays.mask, here], axis=1),
        meets=np.concatenate([rays.meets, np.zeros((*gain.shape, len(rays.objects)), bool)], axis=1),
    )


def turning(start: Float[np.ndarray, "*n 3"], end: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The mirror that maps one unit vector to another: the Householder reflection in their difference."""
    difference, middle = start - end, start + end
    along, square = (np.sum(middle * v, axis=-1, keepdims=True) for v in (difference, middle))
    # Unit vectors differ across their middle; rounding of their lengths would tilt the mirror between near ones.
    difference = difference - np.where(square > 1, middle * along / np.maximum(square, 1), 0.0)
    norm = np.sum(difference**2, axis=-1)[..., None, None]
    outer = difference[..., :, None] * difference[..., None, :]
    return np.eye(3) - 2 * np.where(norm > 0, outer / np.where(norm > 0, norm, 1.0), 0.0)


def reflections(
    points: Float[np.ndarray, "path depth 3"],
    normals: Float[np.ndarray, "path depth 3"],
    steps: Bool[np.ndarray, "path depth"],
) -> tuple[Float[np.ndarray, "path 3 3"], Float[np.ndarray, "path 3"]]:
    """The isometry x -> R x + t of a chain of mirrors.

    The mirror that the path meets last acts first.

    Args:
        points: a point of each mirror, m.
        normals: its unit normal.
        steps: which mirrors are there.
    """
    count = len(points)
    turned = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    shift = np.zeros((count, 3))
    for depth in reversed(range(points.shape[1])):
        normal = np.where(steps[:, depth, None], normals[:, depth], 0.0)
        mirror = np.eye(3) - 2 * normal[:, :, None] * normal[:, None, :]
        height = np.sum(points[:, depth] * normal, axis=-1, keepdims=True)
        turned = mirror @ turned
        shift = np.einsum("pij,pj->pi", mirror, shift) + 2 * height * normal
    return turned, shift
