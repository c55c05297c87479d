"""Things that stand elsewhere than the twin believes: antennas, objects, the whole map."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from dtprob.effects import unfolding
from dtprob.effects.common import (
    DIRECTIONS,
    Data,
    Family,
    Sites,
    along,
    axis_labels,
    half_normal,
    normal,
    observable_basis,
    of_model,
    offers,
    touched_objects,
)
from dtprob.effects.effect import FIELD, Effect, Rewrite
from dtprob.raytracing.paths import SPECULAR, PathSet

_IMAGE: Final = "Image method: the unfolded path is straight, so L' = |L k + s|."
_SIZE: Final = 0.1
"""Prior standard deviation of a displacement in m."""
_SAME_PLACE: Final = 1e-3
"""Positions closer than this, in m, are one place."""
_TURN: Final = 0.01
"""Prior standard deviation of an object's rotation in rad."""


def receiver_displacement(sites: Sites, data: Data) -> list[Effect]:
    """Receivers stand elsewhere: all shifted alike, each by a random vector, or those of one place."""
    if not _movable(sites, data):
        return []
    common = Effect(
        "receiver_displacement",
        unfolding.rewrites(sites, lambda paths, p: unfolding.of_receiver(paths, p["displacement"])),
        (normal("displacement", _SIZE, "m", 3, DIRECTIONS),),
        physics="All receivers stand a common vector away from their recorded positions.",
        source=_IMAGE,
        requires=("paths",),
    )
    each = _jitter("receiver_displacement", sites, "receiver", unfolding.of_receiver)
    return [common, each, *_one_place("receiver", sites, data, unfolding.of_receiver)]


def transmitter_displacement(sites: Sites, data: Data) -> list[Effect]:
    """Transmitters stand elsewhere: all shifted alike, each by a random vector, or those of one place."""
    if not _movable(sites, data):
        return []
    common = Effect(
        "transmitter_displacement",
        unfolding.rewrites(sites, lambda paths, p: unfolding.of_transmitter(paths, p["displacement"])),
        (normal("displacement", _SIZE, "m", 3, DIRECTIONS),),
        physics="All transmitters stand a common vector away from their recorded positions.",
        source=_IMAGE,
        requires=("paths",),
    )
    if len(np.unique(np.asarray(data["paths"].tx_position), axis=0)) == 1:
        return [common]
    each = _jitter("transmitter_displacement", sites, "transmitter", unfolding.of_transmitter)
    return [common, each, *_one_place("transmitter", sites, data, unfolding.of_transmitter)]


def object_displacement(sites: Sites, data: Data) -> list[Effect]:
    """An object is shifted; only the directions that its reflections can see are parameters."""
    if not _movable(sites, data):
        return []
    effects = []
    for index, name in touched_objects(data):
        basis = observable_basis(_normals(data["paths"], index))
        if not len(basis):
            continue

        def shift(paths: PathSet, p: Mapping[str, Any], index: int = index, basis: Any = basis) -> Any:
            return unfolding.of_object(paths, index, p["displacement"] @ jnp.asarray(basis))

        effects.append(
            Effect(
                "object_displacement",
                unfolding.rewrites(sites, shift),
                (normal("displacement", _SIZE, "m", len(basis), axis_labels(basis)),),
                instance=name,
                physics=f"{name} stands away from its place in the scene, along {along(basis)}.",
                source=_IMAGE,
                requires=("paths",),
            )
        )
    return effects


def object_rotation(sites: Sites, data: Data) -> list[Effect]:
    """An object is turned about its centre, to first order in the angle."""
    if not _movable(sites, data):
        return []
    effects = []
    for index, name in touched_objects(data):
        centre, levers = _levers(data["paths"], index)
        basis = observable_basis(levers)
        if not len(basis) or np.abs(levers).max() < 1e-2:
            continue

        def shift(
            paths: PathSet, p: Mapping[str, Any], index: int = index, basis: Any = basis, centre: Any = centre
        ) -> Any:
            turn = p["rotation"] @ jnp.asarray(basis)
            arm = jnp.asarray(paths.vertex) - jnp.asarray(centre)
            return unfolding.of_object(paths, index, jnp.cross(jnp.broadcast_to(turn, arm.shape), arm))

        effects.append(
            Effect(
                "object_rotation",
                unfolding.rewrites(sites, shift),
                (normal("rotation", _TURN, "rad", len(basis), axis_labels(basis)),),
                instance=name,
                physics=f"{name} is turned about its centre, around {along(basis)}.",
                source="d = omega x (v - c) at each point of reflection; " + _IMAGE,
                requires=("paths",),
            )
        )
    return effects


def scene_scale(sites: Sites, data: Data) -> list[Effect]:
    """The map is too large or too small by a common factor."""
    if not _movable(sites, data):
        return []
    table: dict[str, Rewrite] = {
        "path_delay": lambda value, p, _: value * (1.0 + p["scale"]),
        "path_gain": lambda value, p, _: value / (1.0 + p["scale"]),
    }
    return [
        Effect(
            "scene_scale",
            of_model(sites, table),
            (normal("scale", 1e-3),),
            physics="All lengths of the scene, antennas' places included, are off by one factor.",
            source="tau' = tau (1 + s), free-space loss 1 / L.",
        )
    ]


def _movable(sites: Sites, data: Data) -> bool:
    return offers(sites, "path_delay") and data.get("paths") is not None


def _jitter(family: str, sites: Sites, end: str, shift: Any) -> Effect:
    """Independent random displacements of one end of every link."""

    def shift_each(paths: PathSet, p: Mapping[str, Any]) -> Any:
        return shift(paths, p["scale"] * p[FIELD])

    return Effect(
        family,
        unfolding.rewrites(sites, shift_each),
        (half_normal("scale", _SIZE / 2, "m"),),
        instance="each_link",
        kind="variance",
        physics=f"The {end} of every link stands a random vector away from its recorded position.",
        source=_IMAGE,
        requires=("paths",),
        field_shape=lambda value, _: (value.shape[0], 1, 3),
    )


def _one_place(end: str, sites: Sites, data: Data, shift: Any) -> list[Effect]:
    """The device at one place stands elsewhere, for places that several links share; none where all links share one."""
    attribute = {"receiver": "rx_position", "transmitter": "tx_position"}[end]
    places, count = np.unique(np.asarray(getattr(data["paths"], attribute)), axis=0, return_counts=True)
    if len(places) == 1:
        return []

    def shift_some(paths: PathSet, p: Mapping[str, Any], place: Any) -> Any:
        apart = jnp.max(jnp.abs(getattr(paths, attribute) - jnp.asarray(place)), axis=-1)
        return shift(paths, jnp.where(apart < _SAME_PLACE, 1.0, 0.0)[:, None, None] * p["displacement"])

    return [
        Effect(
            f"{end}_displacement",
            unfolding.rewrites(sites, partial(shift_some, place=place)),
            (normal("displacement", _SIZE, "m", 3, DIRECTIONS),),
            instance=f"{end}_{number}",
            physics=f"The {end} recorded at ({' '.join(f'{x:.1f}' for x in place)}) m stands a vector away from there.",
            source=_IMAGE,
            requires=("paths",),
        )
        for number, place in enumerate(places)
        if count[number] > 1
    ]


def _normals(paths: PathSet, index: int) -> np.ndarray:
    """Normals of an object's specular reflections, (n, 3)."""
    return np.asarray(paths.normal)[_reflections(paths, index)]


def _levers(paths: PathSet, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre c of an object and the levers (v - c) x n of a turn, (n, 3), for each of its points of reflection v.

    The centre is that of its points of reflection where the path set does not say how far the object reaches.
    """
    chosen = _reflections(paths, index)
    points = np.asarray(paths.vertex)[chosen]
    if paths.object_center is not None:
        centre = np.asarray(paths.object_center)[index]
    else:
        centre = points.mean(axis=0) if len(points) else np.zeros(3)
    return centre, np.cross(points - centre, np.asarray(paths.normal)[chosen]).reshape(-1, 3)


def _reflections(paths: PathSet, index: int) -> np.ndarray:
    at_object = (np.asarray(paths.interaction) == SPECULAR) & (np.asarray(paths.object) == index)
    return at_object & np.asarray(paths.mask)[..., None]


FAMILIES: Final[dict[str, Family]] = {
    "receiver_displacement": receiver_displacement,
    "transmitter_displacement": transmitter_displacement,
    "object_displacement": object_displacement,
    "object_rotation": object_rotation,
    "scene_scale": scene_scale,
}
