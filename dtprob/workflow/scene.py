"""The paths of a case's links: from a file, from an earlier run, or traced."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.case import Case, SceneSection
from dtprob.data import ChannelData, PowerData
from dtprob.data.location import located
from dtprob.data.tones import check_tones
from dtprob.edition import edition
from dtprob.effects.mistaken import place_name
from dtprob.effects.solver import DEPTH, REFRACTION
from dtprob.errors import InputError
from dtprob.raytracing import storage
from dtprob.raytracing.beyond import strongest, with_beyond
from dtprob.raytracing.carrier import check_carrier
from dtprob.raytracing.paths import PathSet
from dtprob.workflow.plausible import doubts, mirrored, strayed

_WALL_THICKNESS = 0.12
_APART = 1e-2
"""Ends closer than this, in m, cannot be traced."""
_MOST_BEYOND = 64
"""Paths of another trace that are kept for each link where the case does not say."""
_MOST_ELSEWHERE = 8
"""The same from another transmitter's place."""
_OF_A_TRACE = (
    *(
        "max_depth",
        "refraction",
        "diffraction",
        "diffuse_reflection",
        "tx_pattern",
        "rx_pattern",
        "polarization",
    ),
    *("ceiling_height", "wall_material", "wall_thickness", "samples"),
)
"""Settings that only tracing takes."""


def reached[Links: ChannelData | PowerData](
    case: Case, data: Links, cache: Path | None, say: Callable[[str], None]
) -> tuple[Links, PathSet]:
    """The data and their path set, without the links that no path reaches where the case asks for that.

    Args:
        case: the CASE, with its scene.
        data: what was measured.
        cache: a folder in which traced paths are kept.
        say: receives one line before tracing, and one that names links left out.

    Raises:
        InputError: see `paths_of`; or a link that no path reaches, unless the case asks to skip it.
    """
    paths = paths_of(case, data, cache, say)
    for doubt in (*doubts(data, paths.frequency), *mirrored(data, paths)):
        say(f"note: {doubt}")
    found = np.asarray(paths.mask).any(axis=1)
    if found.all():
        return data, paths
    missed = ", ".join(map(str, np.flatnonzero(~found)[:20])) + (", ..." if np.sum(~found) > 20 else "")
    if case.scene is None or not case.scene.skip_unreached or not found.any():
        remedy = "Correct their positions, raise max_depth, or set skip_unreached = true to leave them out"
        raise InputError(
            f"{case.path.name} [scene]", "a path or more for each link", f"none for links {missed}", remedy
        )
    say(f"leaving out links that no path reaches: {missed}")
    return data.take(np.flatnonzero(found)), paths.take(found)


def paths_of(
    case: Case, data: ChannelData | PowerData, cache: Path | None, say: Callable[[str], None]
) -> PathSet:
    """The path set of the data's links: read, taken from the cache, or traced.

    Args:
        case: the CASE, with its scene.
        data: the positions of the links.
        cache: a folder in which traced paths are kept.
        say: receives one line before tracing, or where the paths are those of an earlier run.

    Raises:
        InputError: no scene, a scene or path set that cannot be used, or a path set of other positions.
    """
    scene = None if case.scene is None else _found(case.scene)
    if scene is None:
        remedy = "Add [scene] with file and frequency"
        raise InputError(case.path.name, f"a section [scene] for {case.model.name}", "none", remedy)
    if scene.file.lower().endswith(".nc"):
        _check_needs_no_trace(scene, case)
        paths = _same_links(storage.load(scene.file), _placed(scene, data), case)
        _check_traced(scene, paths, case, say)
        if isinstance(data, ChannelData):
            check_tones(data.subcarrier_frequency, paths.frequency)
        return paths
    if scene.frequency is not None:
        check_carrier(f"{case.path.name} [scene] frequency", scene.frequency)
        if isinstance(data, ChannelData):
            check_tones(data.subcarrier_frequency, scene.frequency)
    kept = None if cache is None else cache / f"paths-{_scene_hash(scene, data)}.nc"
    if kept is not None and kept.is_file():
        say(f"taking the paths that were traced before, {kept.name}")
        return storage.load(kept)
    say(f"tracing {len(data.rx_position)} links through {Path(scene.file).name}")
    paths = _trace(scene, _placed(scene, data), say)
    if kept is not None:
        storage.save(paths, kept)
    return paths


def _found(scene: SceneSection) -> SceneSection:
    """The scene with its file looked for among the measured data sets too."""
    file = Path(scene.file)
    folder = file.parent if file.exists() else located(file.parent)
    return dataclasses.replace(scene, file=str(folder / file.name)) if _is_plan(scene) else scene


def _is_plan(scene: SceneSection) -> bool:
    return scene.file.lower().endswith(".json")


def _placed[Links: ChannelData | PowerData](scene: SceneSection, data: Links) -> Links:
    """The data with the height that the case gives to both ends added to their positions."""
    if scene.device_height is None:
        return data
    up = np.array([0.0, 0.0, scene.device_height])
    return dataclasses.replace(data, rx_position=data.rx_position + up, tx_position=data.tx_position + up)


def _load(scene: SceneSection, frequency: float) -> Any:
    """The scene for the ray tracer, from its file or from a floor plan."""
    if not _is_plan(scene):
        from dtprob.raytracing.trace import load_scene  # noqa: PLC0415  (needs the ray tracer)

        return load_scene(scene.file, frequency, merge_shapes=scene.merge_shapes)
    from dtprob.raytracing.floorplan import Surface, floorplan_scene, read_floorplan  # noqa: PLC0415

    if scene.ceiling_height is None:
        remedy = "Add ceiling_height = ..., in m"
        raise InputError("[scene] of a floor plan", "a key 'ceiling_height'", "none", remedy)
    plan = read_floorplan(scene.file)
    wall = Surface(scene.wall_material, scene.wall_thickness or _WALL_THICKNESS)
    return floorplan_scene(plan.walls, scene.ceiling_height, frequency, wall=wall, furniture=plan.furniture)


def _check_needs_no_trace(scene: SceneSection, case: Case) -> None:
    asked = [
        n for n in ("strongest", "check_depth", "check_refraction", "check_transmitters") if getattr(scene, n)
    ]
    if asked:
        where = f"{case.path.name} [scene] {asked[0]}"
        raise InputError(where, "a scene to trace", Path(scene.file).name, "Name the scene, or leave it out")


def _check_traced(scene: SceneSection, paths: PathSet, case: Case, say: Callable[[str], None]) -> None:
    """Refuse another carrier than that of a path set, and say which settings of a trace it does without."""
    if scene.frequency is not None and not np.isclose(scene.frequency, paths.frequency, rtol=1e-6):
        expected, remedy = (
            f"{paths.frequency:g} Hz, the carrier of {Path(scene.file).name}",
            "Correct it, or leave it out",
        )
        raise InputError(f"{case.path.name} [scene] frequency", expected, f"{scene.frequency:g}", remedy)
    fields = dataclasses.fields(scene)
    given = [f.name for f in fields if f.name in _OF_A_TRACE and getattr(scene, f.name) != f.default]
    if given:
        say(f"note: {Path(scene.file).name} was traced before: [scene] {', '.join(given)} changes nothing")


def _trace(scene: SceneSection, data: ChannelData | PowerData, say: Callable[[str], None]) -> PathSet:
    """The twin's paths, and apart from them those of the traces that the case wants for a check."""
    traced = _Traced(scene, _load(scene, float(scene.frequency or 0.0)), data)
    for doubt in strayed(data, traced.scene):
        say(f"note: {doubt}")
    paths = traced.paths(scene.max_depth, refraction=scene.refraction)
    fuller: dict[str, PathSet] = {}
    if scene.check_depth is not None:
        fuller[DEPTH] = traced.paths(scene.check_depth, refraction=scene.refraction)
    if scene.check_refraction and not scene.refraction:
        fuller[REFRACTION] = traced.paths(scene.max_depth, refraction=True)
    if scene.check_transmitters:
        for number, place in enumerate(np.unique(data.tx_position, axis=0)):
            elsewhere = traced.paths(scene.max_depth, refraction=scene.refraction, source=place)
            fuller[place_name(number)] = elsewhere
    known = paths
    paths = paths if scene.strongest is None else strongest(paths, scene.strongest)
    for name, other in fuller.items():
        most = (
            _MOST_BEYOND if name in {DEPTH, REFRACTION} else _MOST_ELSEWHERE,
            scene.strongest or _MOST_BEYOND,
        )
        paths = with_beyond(paths, name, other, min(most), known=known)
    return paths


class _Traced(NamedTuple):
    """A loaded scene and the links to trace through it."""

    section: SceneSection
    scene: Any
    data: ChannelData | PowerData

    def paths(
        self, max_depth: int, *, refraction: bool, source: Float[np.ndarray, "3"] | None = None
    ) -> PathSet:
        """The paths of all links, from their own transmitters or from one place; none where the receiver stands there."""
        from dtprob.raytracing.trace import trace  # noqa: PLC0415  (needs the ray tracer)

        section, data = self.section, self.data
        there = np.zeros(len(data.rx_position), bool)
        sources = data.tx_position
        if source is not None:
            there = np.linalg.norm(data.rx_position - source, axis=1) < _APART
            sources = np.where(there[:, None], data.tx_position, source)
        paths = trace(
            self.scene,
            sources,
            data.rx_position,
            max_depth=max_depth,
            refraction=refraction,
            diffraction=section.diffraction,
            diffuse_reflection=section.diffuse_reflection,
            tx_pattern=section.tx_pattern,
            rx_pattern=section.rx_pattern,
            polarization=section.polarization,
            samples=section.samples,
            frequency=float(section.frequency or 0.0),
            allow_empty=True,
        )
        return eqx.tree_at(lambda p: p.mask, paths, paths.mask & ~jnp.asarray(there)[:, None])


def _scene_hash(scene: SceneSection, data: ChannelData | PowerData) -> str:
    """What a traced path set depends on, the state of dtprob's own code too, in 16 characters."""
    digest = hashlib.sha256(json.dumps([edition(), dataclasses.asdict(scene)], sort_keys=True).encode())
    for file in scene_files(scene):
        digest.update(file.read_bytes())
    for positions in (data.tx_position, data.rx_position):
        digest.update(positions.tobytes())
    return digest.hexdigest()[:16]


def scene_files(scene: SceneSection) -> list[Path]:
    """The files that a scene is made of: its own, and what a Mitsuba XML names or includes; none of a shipped one."""
    file = Path(scene.file)
    if not file.is_file():
        return []
    found, left = {file}, [file]
    while left:
        named = {path for name in _named(left.pop()) if (path := file.parent / name).is_file()}
        left += named - found
        found |= named
    return [file, *sorted(found - {file})]


def _named(file: Path) -> set[str]:
    """The files that a Mitsuba XML names: meshes, pictures and XMLs that it includes; of others nothing."""
    if file.suffix.lower() != ".xml":
        return set()
    try:
        elements = list(ET.parse(file).iter())  # noqa: S314  (no entity of another file is read)
    except (ET.ParseError, ValueError):
        return set()  # the ray tracer says what is wrong
    values = [e.get("value") for e in elements if e.get("name") == "filename"]
    return {name for name in (*values, *(e.get("filename") for e in elements)) if name}


def _same_links(paths: PathSet, data: ChannelData | PowerData, case: Case) -> PathSet:
    for name in ("rx_position", "tx_position"):
        traced, measured = np.asarray(getattr(paths, name)), getattr(data, name)
        if traced.shape != measured.shape or not np.allclose(traced, measured, rtol=0.0, atol=1e-3):
            where = f"{case.path.name} [scene] file: {name}"
            expected = f"the {len(measured)} positions of the data, to 1 mm"
            got = f"{len(traced)} positions"
            if traced.shape == measured.shape:
                apart = np.linalg.norm(traced - measured, axis=1)
                got += f", that of link {np.argmax(apart)} {apart.max():.3g} m away"
            raise InputError(where, expected, got, "Trace the scene again for these data, link by link")
    return paths
