"""From a world to its rays: Sionna RT finds paths and fields, geometry is redone in double precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from dtprob.errors import InputError, unknown_name
from dtprob.physical.rays import Rays, reflections
from dtprob.physical.world import Material, World, rotation
from dtprob.raytracing.candidates import CandidateCount, in_groups, large_table
from dtprob.raytracing.sionna_patch import repaired_sionna
from dtprob.raytracing.trace import load_scene

SEED: Final = 1
"""Of the solver's rays; path sets of rich scenes may depend on it."""

MAX_PATHS: Final = 1_000_000
"""Room for the solver's candidate paths per call."""

SAME: Final = 1e-4
"""Two paths on the same objects whose unfolded ends lie closer than this, in m, are one."""


class _Shape(NamedTuple):
    """One object's mesh in double precision."""

    name: str
    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]


class _Found(NamedTuple):
    """What the solver found, padded to the largest number of paths of a link."""

    gain: Complex[np.ndarray, "link path"]
    mask: Bool[np.ndarray, "link path"]
    objects: Int[np.ndarray, "link path depth"]
    primitives: Int[np.ndarray, "link path depth"]
    steps: Bool[np.ndarray, "link path depth"]


def trace(world: World) -> Rays:
    """The rays of a world: line of sight and specular reflections.

    Paths and their polarized gains come from Sionna RT (with its complex square root repaired); lengths,
    directions and mirrors are recomputed in double precision from the meshes.

    Warns where the solver dropped candidates of a link.

    Raises:
        InputError: the scene, an object or a material does not exist, or no ray tracer can run here.
    """
    scene, shapes = _build(world)
    found = _links(scene, world)
    mask, steps = found.mask, found.steps
    mirror, shift, meets = _isometries(shapes, steps, found.objects, found.primitives)
    unfolded = np.einsum("lpij,lj->lpi", mirror, world.rx_position) + shift - world.tx_position[:, None]
    names = tuple(sorted(shape.name for shape in shapes.values()))
    mask = _single(mask, unfolded, meets)
    rays = Rays(np.where(mask, found.gain, 0)[:, None], unfolded[:, None], mirror, mask, meets, names)
    return _ordered(rays, steps.sum(axis=-1))


def scene_materials(world: World) -> dict[str, Material]:
    """The materials in use in a world, by class, with the values they have there."""
    scene, _ = _build(world)
    return {
        name: _read_material(material)
        for name, material in sorted(scene.radio_materials.items())
        if material.is_used
    }


def object_classes(world: World) -> dict[str, str]:
    """For every object of a world, the class of its material."""
    scene, _ = _build(world)
    return {name: scene.objects[name].radio_material.name for name in sorted(scene.objects)}


def _read_material(material: Any) -> Material:
    values = (material.relative_permittivity, material.conductivity, material.thickness)
    return Material(*(float(np.asarray(value).reshape(-1)[0]) for value in values))


def _build(world: World) -> tuple[Any, dict[int, _Shape]]:
    """The Sionna scene of a world, and its meshes in double precision by object number."""
    scene = load_scene(world.scene, world.frequency, merge_shapes=False)
    _require(world, scene)
    _edit(world, scene)
    _paint(world, scene)
    shapes = {int(one.object_id): _shape(name, one, world) for name, one in scene.objects.items()}
    _place(world, scene)
    return scene, shapes


def _require(world: World, scene: Any) -> None:
    named = {*world.moved, *world.turned, *world.removed, *world.object_materials} - set(world.parts)
    for name in sorted(named - set(scene.objects)):
        raise unknown_name("object of the world", name, scene.objects, "object")
    for name in sorted(set(world.materials) - set(scene.radio_materials)):
        raise unknown_name("material of the world", name, scene.radio_materials, "material")


def _edit(world: World, scene: Any) -> None:
    """Take objects out and put parts in."""
    import mitsuba as mi  # noqa: PLC0415
    from sionna import rt  # noqa: PLC0415

    parts = []
    for name, part in sorted(world.parts.items()):
        if not Path(part.mesh).is_file():
            raise InputError(
                f"part {name!r} of the world", "a PLY file", part.mesh, "Name a mesh that exists"
            )
        parts.append(
            rt.SceneObject(fname=part.mesh, name=name, radio_material=_material(f"of {name}", part.material))
        )
    if parts or world.removed:
        scene.edit(add=parts, remove=list(world.removed))
    for name, part in sorted(world.parts.items()):
        one = scene.objects[name]
        one.scaling = part.scaling
        one.position = mi.Point3f(*part.position)


def _paint(world: World, scene: Any) -> None:
    for name, material in sorted(world.materials.items()):
        _assign(scene.radio_materials[name], material)
    for name, material in sorted(world.object_materials.items()):
        one = scene.objects.get(name)
        if one is None:  # it was taken out
            continue
        thickness = _read_material(one.radio_material).thickness
        full = Material(material.permittivity, material.conductivity, material.thickness or thickness)
        one.radio_material = _material(f"of {name}", full)


def _assign(target: Any, material: Material) -> None:
    """Set values as opaque variables, so that other values do not compile the kernels again."""
    import drjit as dr  # noqa: PLC0415
    import mitsuba as mi  # noqa: PLC0415

    target.relative_permittivity = dr.opaque(mi.Float, material.permittivity)
    target.conductivity = dr.opaque(mi.Float, material.conductivity)
    if material.thickness is not None:
        target.thickness = dr.opaque(mi.Float, material.thickness)


def _material(name: str, material: Material) -> Any:
    from sionna import rt  # noqa: PLC0415

    made = rt.RadioMaterial(name=name)
    _assign(made, material)
    return made


def _shape(name: str, one: Any, world: World) -> _Shape:
    """The mesh of an object as it stands in the world; the file's single precision is taken as exact."""
    import mitsuba as mi  # noqa: PLC0415

    buffers = mi.traverse(one.mi_mesh)
    vertices = np.array(buffers["vertex_positions"], np.float64).reshape(-1, 3)
    faces = np.array(buffers["faces"], np.int64).reshape(-1, 3)
    if name in world.turned:
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        vertices = (vertices - centre) @ rotation((world.turned[name], 0.0, 0.0)).T + centre
    return _Shape(name, vertices + np.asarray(world.moved.get(name, (0.0, 0.0, 0.0))), faces)


def _place(world: World, scene: Any) -> None:
    import mitsuba as mi  # noqa: PLC0415

    for name, one in sorted(scene.objects.items()):
        if name in world.turned:
            one.orientation = mi.Point3f(float(world.turned[name]), 0.0, 0.0)
        if name in world.moved:
            one.position = one.position + mi.Point3f(*map(float, world.moved[name]))


def _links(scene: Any, world: World) -> _Found:
    """The paths of all links, those of one transmitter after the other."""
    sources, which = np.unique(world.tx_position, axis=0, return_inverse=True)
    groups = list(
        in_groups(
            lambda number, some: _solve(scene, world, sources[number], world.rx_position[some]),
            [np.flatnonzero(which.reshape(-1) == number) for number in range(len(sources))],
            depth=world.max_depth,
            samples=world.rays,
            max_paths=MAX_PATHS,
        )
    )
    paths = max(found.mask.shape[1] for _, found in groups)
    depth = max(found.steps.shape[2] for _, found in groups)
    order = np.argsort(np.concatenate([links for links, _ in groups]))

    def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
        size = (paths, depth)
        wide = [
            np.pad(
                part,
                [(0, 0), *((0, wanted - had) for wanted, had in zip(size, part.shape[1:], strict=False))],
            )
            for part in parts
        ]
        return np.concatenate(wide)[order]

    return _Found(*(joined(parts) for parts in zip(*(found for _, found in groups), strict=True)))


def _solve(
    scene: Any, world: World, source: Float[np.ndarray, "3"], targets: Float[np.ndarray, "link 3"]
) -> tuple[_Found, int]:
    """Paths from a transmitter to some receivers, and how many candidates the solver had for them."""
    from sionna import rt  # noqa: PLC0415

    places, which = np.unique(targets, axis=0, return_inverse=True)
    _stand(scene, world, source, places)
    solver = rt.PathSolver(deterministic=True)
    count = CandidateCount(solver)
    with repaired_sionna(), large_table():
        paths = solver(
            scene,
            max_depth=world.max_depth,
            max_num_paths_per_src=MAX_PATHS,
            samples_per_src=world.rays,
            refraction=False,
            seed=SEED,
        )
        real, imaginary = (np.asarray(part, np.float64) for part in paths.a)
    pick = which.reshape(-1)
    mask = np.asarray(paths.valid, bool)[pick, 0]
    objects, primitives, kinds = (
        np.moveaxis(np.asarray(part, np.int64)[:, pick, 0], 0, -1)
        for part in (paths.objects, paths.primitives, paths.interactions)
    )
    gain = (real + 1j * imaginary)[pick, 0, 0, 0]
    return _Found(gain, mask, objects, primitives, (kinds != 0) & mask[..., None]), count.found


def _stand(
    scene: Any, world: World, source: Float[np.ndarray, "3"], places: Float[np.ndarray, "place 3"]
) -> None:
    """Put one transmitter and some receivers into the scene, in place of those that were there."""
    import mitsuba as mi  # noqa: PLC0415
    from sionna import rt  # noqa: PLC0415

    scene.remove([*scene.transmitters, *scene.receivers])
    for side in ("tx_array", "rx_array"):
        setattr(scene, side, rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V"))
    yaw, pitch, roll = world.rx_turn
    scene.add(rt.Transmitter("tx", mi.Point3f(*source.tolist()), orientation=mi.Point3f(*world.tx_turn)))
    turn = mi.Point3f(yaw, pitch, roll + world.rx_slant)
    for number, point in enumerate(places):
        scene.add(rt.Receiver(f"rx-{number}", mi.Point3f(*point.tolist()), orientation=turn))


def _isometries(
    shapes: Mapping[int, _Shape],
    steps: Bool[np.ndarray, "link path depth"],
    objects: Int[np.ndarray, "link path depth"],
    primitives: Int[np.ndarray, "link path depth"],
) -> tuple[
    Float[np.ndarray, "link path 3 3"], Float[np.ndarray, "link path 3"], Bool[np.ndarray, "link path object"]
]:
    """Mirror, shift and objects met, per path."""
    points, normals = np.zeros((*steps.shape, 3)), np.zeros((*steps.shape, 3))
    meets = np.zeros((*steps.shape[:2], len(shapes)), bool)
    for column, (number, shape) in enumerate(sorted(shapes.items(), key=lambda item: item[1].name)):
        here = steps & (objects == number)
        corner, edge, other = np.moveaxis(shape.vertices[shape.faces[primitives[here]]], 1, 0)
        normal = np.cross(edge - corner, other - corner)
        points[here] = corner
        normals[here] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        meets[..., column] = here.any(axis=-1)
    depth = steps.shape[2]
    flat = (points.reshape(-1, depth, 3), normals.reshape(-1, depth, 3), steps.reshape(-1, depth))
    mirror, shift = reflections(*flat)
    return mirror.reshape(*steps.shape[:2], 3, 3), shift.reshape(*steps.shape[:2], 3), meets


def _single(
    mask: Bool[np.ndarray, "link path"],
    unfolded: Float[np.ndarray, "link path 3"],
    meets: Bool[np.ndarray, "link path object"],
) -> Bool[np.ndarray, "link path"]:
    """The mask without paths that are there twice.

    The solver tells mirrors apart by a rounded plane: the triangles of one wall, once it has moved, may round
    differently, and every reflection on it is then found as often as it has triangles.
    """
    apart = np.linalg.norm(unfolded[:, :, None] - unfolded[:, None], axis=-1)
    same = (apart < SAME) & np.all(meets[:, :, None] == meets[:, None], axis=-1) & mask[:, None]
    return mask & ~np.any(np.tril(same, -1), axis=-1)


def _ordered(rays: Rays, bounces: Int[np.ndarray, "link path"]) -> Rays:
    """Paths by number of reflections, then by length; padding last, and no more of it than needed."""
    order = np.lexsort((rays.length[:, 0], bounces, ~rays.mask), axis=-1)
    order = order[:, : max(1, int(rays.mask.sum(axis=1).max(initial=0)))]
    rows = np.arange(len(order))[:, None]
    return Rays(
        rays.gain[:, 0][rows, order][:, None],
        rays.unfolded[:, 0][rows, order][:, None],
        rays.mirror[rows, order],
        rays.mask[rows, order],
        rays.meets[rows, order],
        rays.objects,
    )
