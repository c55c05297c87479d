"""The part of tracing that speaks with sionna-rt: scene in, plain NumPy arrays out."""

import hashlib
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import InputError
from dtprob.raytracing.candidates import CandidateCount, large_table
from dtprob.raytracing.sionna_patch import repaired_sionna


@dataclass(frozen=True)
class Settings:
    """What the solver looks for and how hard.

    Attributes:
        max_depth: most interactions on a path.
        refraction: whether rays pass through walls.
        samples: rays shot from each source.
        seed: of the solver's random choices.
        max_paths: room for candidate paths per call.
    """

    max_depth: int
    refraction: bool
    samples: int
    seed: int
    max_paths: int


class Traced(NamedTuple):
    """Paths from one source, as the solver found them; `target` says where each ends."""

    target: Int[np.ndarray, " path"]
    interaction: Int[np.ndarray, "path depth"]
    object: Int[np.ndarray, "path depth"]
    primitive: Int[np.ndarray, "path depth"]
    vertex: Float[np.ndarray, "path depth 3"]


class Objects(NamedTuple):
    """The objects of a scene; `center`: of each bounding box; faces of object i begin in `normal` at `first_face[i]`."""

    names: tuple[str, ...]
    identifier: Int[np.ndarray, " object"]
    material: Int[np.ndarray, " object"]
    material_names: tuple[str, ...]
    permittivity: Float[np.ndarray, " object"]
    conductivity: Float[np.ndarray, " object"]
    thickness: Float[np.ndarray, " object"]
    scattering: Float[np.ndarray, " object"]
    center: Float[np.ndarray, "object 3"]
    first_face: Int[np.ndarray, " object"]
    normal: Float[np.ndarray, "face 3"]
    sha256: str


def describe_objects(scene: Any) -> Objects:
    """Read names, materials and the normals of all faces from a loaded scene.

    Raises:
        InputError: a scene without objects.
    """
    if not scene.objects:
        raise InputError("scene", "an object or more", "none", "Add one, such as the ground")
    digest = hashlib.sha256()
    names, normals, values, used, centres = [], [], [], [], []
    for name, item in scene.objects.items():
        corners = np.asarray(item.mi_mesh.vertex_positions_buffer()).reshape(-1, 3).astype(np.float64)
        faces = np.asarray(item.mi_mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)
        names.append(name)
        normals.append(_face_normals(corners[faces]))
        centres.append((corners.min(axis=0) + corners.max(axis=0)) / 2)
        values.append([_value(item.radio_material, key, default) for key, default in _PROPERTIES])
        used.append(item.radio_material.name)
        for part in (name.encode(), used[-1].encode(), corners.tobytes(), faces.tobytes()):
            digest.update(len(part).to_bytes(8, "little") + part)
    table = np.asarray(values, np.float64)
    digest.update(table.tobytes())
    materials = tuple(sorted(set(used)))
    return Objects(
        tuple(names),
        np.asarray([int(item.object_id) for item in scene.objects.values()], np.int64),
        np.asarray([materials.index(name) for name in used], np.int64),
        materials,
        table[:, 0],
        table[:, 1],
        table[:, 2],
        table[:, 3],
        np.asarray(centres, np.float64),
        np.cumsum([0, *map(len, normals)])[:-1],
        np.concatenate(normals),
        digest.hexdigest(),
    )


_PROPERTIES: Final = (
    ("relative_permittivity", 1.0),
    ("conductivity", 0.0),
    ("thickness", 0.1),
    ("scattering_coefficient", 0.0),
)
"""Properties of a radio material, and what stands for them in one that has none (a perfect absorber)."""


def _value(material: Any, name: str, default: float) -> float:
    return float(np.asarray(getattr(material, name, default)).reshape(-1)[0])


def _face_normals(corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 3"]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(area == 0, 1.0, area)


def solve(
    scene: Any,
    source: Float[np.ndarray, "3"],
    targets: Float[np.ndarray, "target 3"],
    settings: Settings,
) -> tuple[Traced, int]:
    """Find the paths from one source to some targets, in the solver's own order; and say how many candidates it had.

    Antennas are isotropic and doubly polarised here, so that no path is lost to a null of a pattern.
    """
    from sionna import rt  # noqa: PLC0415

    solver = rt.PathSolver(deterministic=True)
    count = CandidateCount(solver)
    with _only_these_devices(scene, source, targets), repaired_sionna(), large_table():
        paths = solver(
            scene,
            max_depth=settings.max_depth,
            samples_per_src=settings.samples,
            max_num_paths_per_src=settings.max_paths,
            refraction=settings.refraction,
            diffuse_reflection=False,
            diffraction=False,
            seed=settings.seed,
        )
        return _flatten(paths), count.found


@contextmanager
def _only_these_devices(
    scene: Any,
    source: Float[np.ndarray, "3"],
    targets: Float[np.ndarray, "target 3"],
) -> Generator[None]:
    """Put these devices in the scene for the time of a trace, and those of its owner back after it."""
    from sionna import rt  # noqa: PLC0415

    kept = [*scene.transmitters.values(), *scene.receivers.values()]
    arrays = {"tx_array": scene.tx_array, "rx_array": scene.rx_array}
    _remove_devices(scene)
    element = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
    scene.tx_array = element
    scene.rx_array = element
    scene.add(rt.Transmitter("dtprob-source", position=source.tolist()))
    for number, target in enumerate(targets):
        scene.add(rt.Receiver(f"dtprob-target-{number}", position=target.tolist()))
    try:
        yield
    finally:
        _remove_devices(scene)
        scene.add(kept)
        for name, array in arrays.items():
            if array is not None:
                setattr(scene, name, array)


def _remove_devices(scene: Any) -> None:
    scene.remove([*scene.transmitters, *scene.receivers])


def _flatten(paths: Any) -> Traced:
    """List the valid paths of all targets one after another."""
    valid = np.asarray(paths.valid)[:, 0]
    target, slot = np.nonzero(valid)
    steps = {
        name: np.asarray(getattr(paths, name))
        for name in ("interactions", "objects", "primitives", "vertices")
    }
    chosen = {name: value[:, target, 0, slot].swapaxes(0, 1) for name, value in steps.items()}
    return Traced(
        target,
        chosen["interactions"].astype(np.int64),
        chosen["objects"].astype(np.int64),
        chosen["primitives"].astype(np.int64),
        chosen["vertices"].astype(np.float64),
    )
