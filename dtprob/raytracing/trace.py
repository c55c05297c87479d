"""Trace the paths of many links through a scene, once, into a `PathSet`."""

import os
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from scipy.constants import speed_of_light

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.assemble import SAME, Antenna, Flat, assemble
from dtprob.raytracing.candidates import in_groups
from dtprob.raytracing.carrier import carrier_of, set_frequency
from dtprob.raytracing.inside import enclosing_objects
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.sionna import sionna_rt
from dtprob.raytracing.solve import Settings, Traced, describe_objects, solve

_ROUNDING: Final = 2.0**-24
"""Largest relative error of a coordinate in the solver, whose meshes and rays are of single precision."""
_HOPELESS: Final = 1e-3
"""Coordinates of both ends that are rounded by more than this, in m, lose most reflections and double others."""


def load_scene(
    file: str | os.PathLike[str],
    frequency: float,
    *,
    merge_shapes: bool = True,
) -> Any:
    """Load a scene and fix its materials at a carrier.

    The materials take their values at this frequency and keep them, whatever is edited later;
    `dtprob.raytracing.carrier.set_frequency` takes them to another.

    Args:
        file: name of a scene that sionna-rt ships, or path of a Mitsuba XML file.
        frequency: carrier in Hz.
        merge_shapes: whether objects of one material become one, which is faster; False keeps them apart.

    Returns:
        a ``sionna.rt.Scene``.

    Raises:
        InputError: there is no such scene, the file is no scene, a material is not known at this frequency,
            or no LLVM library works.
    """
    rt = sionna_rt()
    path = _scene_file(file, _shipped(rt.scene))
    try:
        scene = rt.load_scene(str(path), merge_shapes=merge_shapes)
    except (ValueError, TypeError, RuntimeError, SyntaxError) as error:
        got = f"an error of the loader: {error}"
        raise InputError(f"scene {path}", "a Mitsuba XML scene", got, "Correct the file") from error
    return set_frequency(scene, frequency)


def _scene_file(file: str | os.PathLike[str], shipped: dict[str, Path]) -> Path:
    name = os.fspath(file)
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.suffix.lower() != ".xml":
        raise unknown_name("scene", name, shipped, "scene")
    if not path.is_file():
        raise InputError(
            f"scene {name}", "an XML file", "no such file", "Correct the path, or name a shipped scene"
        )
    return path


def _shipped(module: ModuleType) -> dict[str, Path]:
    """Names and files of the scenes that sionna-rt ships."""
    named = {name: value for name, value in vars(module).items() if isinstance(value, str)}
    return {name: Path(value) for name, value in named.items() if value.endswith(f"{name}.xml")}


def trace(
    scene: Any,
    tx_position: Float[np.ndarray, "link 3"],
    rx_position: Float[np.ndarray, "link 3"],
    *,
    max_depth: int = 3,
    refraction: bool = False,
    diffraction: bool = False,
    diffuse_reflection: bool = False,
    tx_pattern: str = "iso",
    rx_pattern: str = "iso",
    polarization: str | float = "V",
    rx_polarization: str | float | None = None,
    tx_orientation: Float[np.ndarray, "*link 3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    rx_orientation: Float[np.ndarray, "*link 3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    samples: int = 1_000_000,
    seed: int = 1,
    max_paths: int = 1_000_000,
    frequency: float | None = None,
    allow_empty: bool = False,
) -> PathSet:
    """Find the paths of each link and recompute their geometry in double precision.

    Antennas have one element; arrays enter later, through `field.steering`. Only the pairs asked for are
    traced, and which paths are found does not depend on antennas. Warns where the solver dropped candidates of a link,
    and where ends are so far from the origin (a kilometre or two) that it rounds them too much.

    Args:
        scene: from `load_scene` or `floorplan_scene`; left as it was.
        tx_position: of each link, m.
        rx_position: of each link, m.
        max_depth: most interactions on a path.
        refraction: whether rays pass through walls; which paths are found then depends on the materials.
        diffraction: must be False: not traced yet.
        diffuse_reflection: must be False: not traced yet.
        tx_pattern: iso, dipole, hw_dipole or tr38901.
        rx_pattern: likewise.
        polarization: of both elements: V, H, or a slant angle in rad.
        rx_polarization: of the receiving element, when it differs.
        tx_orientation: rotations about z, y and x, rad, one or one per link.
        rx_orientation: likewise.
        samples: rays shot from each source; more of them find small or far surfaces.
        seed: of the solver; the same seed finds the same paths.
        max_paths: room for candidates per call of the solver; links are traced in smaller groups if need be.
        frequency: carrier in Hz; that of the scene, known in single precision only, when None.
        allow_empty: whether a link may have no path.

    Raises:
        InputError: a link without a path, an end inside a wall, wrong positions, an unknown pattern, an unsupported
            interaction, a scene without objects, one whose carrier was changed after its materials were fixed, or one
            17 km from the origin.
    """
    tx, rx = _positions("tx_position", tx_position), _positions("rx_position", rx_position)
    _check_request(tx, rx, max_depth, samples, diffraction=diffraction, diffuse_reflection=diffuse_reflection)
    carrier = _carrier(scene, frequency)
    _check_near(tx, rx, speed_of_light / carrier)
    settings = Settings(max_depth, refraction, samples, seed, max_paths)
    sending = Antenna(tx_pattern, polarization, tx_orientation).checked(len(tx))
    other = polarization if rx_polarization is None else rx_polarization
    receiving = Antenna(rx_pattern, other, rx_orientation).checked(len(tx))
    objects = describe_objects(scene)
    flat = _trace_links(scene, tx, rx, settings)
    if not allow_empty:
        _check_found(scene, flat, tx, rx)
    return assemble(
        flat, objects, tx=tx, rx=rx, antennas=(sending, receiving), frequency=carrier, settings=settings
    )


def _trace_links(
    scene: Any,
    tx: Float[np.ndarray, "link 3"],
    rx: Float[np.ndarray, "link 3"],
    settings: Settings,
) -> Flat:
    """Trace from the side with fewer distinct places, and turn the paths round if that is the receivers."""
    turned = len(np.unique(rx, axis=0)) < len(np.unique(tx, axis=0))
    source, target = (rx, tx) if turned else (tx, rx)
    places, links = _groups(source)
    found = list(
        in_groups(
            lambda number, some: solve(scene, places[number], target[some], settings),
            links,
            depth=settings.max_depth,
            samples=settings.samples,
            max_paths=settings.max_paths,
        )
    )
    flat = _join(found, settings.max_depth)
    return flat.turned() if turned else flat


def _groups(
    source: Float[np.ndarray, "link 3"],
) -> tuple[Float[np.ndarray, "place 3"], list[Int[np.ndarray, " group"]]]:
    """Each distinct source, and its links."""
    places, which = np.unique(source, axis=0, return_inverse=True)
    return places, [np.flatnonzero(which.reshape(-1) == number) for number in range(len(places))]


def _join(found: list[tuple[Int[np.ndarray, " group"], Traced]], max_depth: int) -> Flat:
    depth = max(max_depth, 1)

    def padded(value: np.ndarray) -> np.ndarray:
        missing = depth - value.shape[1]
        return np.pad(value, [(0, 0), (0, missing), *[(0, 0)] * (value.ndim - 2)])

    return Flat(
        np.concatenate([links[traced.target] for links, traced in found]),
        np.concatenate([padded(traced.interaction) for _, traced in found]),
        np.concatenate([padded(traced.object) for _, traced in found]),
        np.concatenate([padded(traced.primitive) for _, traced in found]),
        np.concatenate([padded(traced.vertex) for _, traced in found]),
    )


def _positions(name: str, value: Float[np.ndarray, "link 3"]) -> Float[np.ndarray, "link 3"]:
    array = np.asarray(value, np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not np.all(np.isfinite(array)):
        raise InputError(
            name, "finite coordinates in m, shape (link, 3)", f"shape {array.shape}", "Give x, y and z"
        )
    return array


def _check_near(tx: Float[np.ndarray, "link 3"], rx: Float[np.ndarray, "link 3"], wavelength: float) -> None:
    """Refuse links far from the origin at both ends; warn of ends whose rounding doubles paths or turns phases."""
    size = np.max(np.abs([tx, rx]), axis=2)
    if np.any(np.min(size, axis=0) * _ROUNDING > _HOPELESS):
        got = f"{size.max() / 1e3:.3g} km"
        remedy = "Move the scene and the ends of its links to the origin"
        expected = f"ends within {_HOPELESS / _ROUNDING / 1e3:.2g} km of the scene's origin"
        raise InputError("positions of the links", expected, got, remedy)
    rounded = float(size.max()) * _ROUNDING
    if rounded > min(SAME, wavelength / 100):
        place = f"{size.max() / 1e3:.3g} km from the origin"
        text = f"the solver rounds places {place} to {1e3 * rounded:.2g} mm, so that paths may be lost or doubled"
        warnings.warn(f"{text}; move the scene to the origin.", RuntimeWarning, stacklevel=3)


def _carrier(scene: Any, frequency: float | None) -> float:
    held = carrier_of(scene)
    if frequency is not None and abs(frequency - held) > 1e-6 * held:
        raise InputError(
            "frequency", f"that of the scene, {held:.6g} Hz", f"{frequency:.6g} Hz", "Load the scene at it"
        )
    return held if frequency is None else float(frequency)


def _check_request(
    tx: Float[np.ndarray, "link 3"],
    rx: Float[np.ndarray, "link 3"],
    max_depth: int,
    samples: int,
    *,
    diffraction: bool,
    diffuse_reflection: bool,
) -> None:
    if len(tx) != len(rx) or not len(tx):
        raise InputError(
            "links", "a tx_position and a rx_position each", f"{len(tx)} and {len(rx)}", "Pair them up"
        )
    if np.any(np.linalg.norm(tx - rx, axis=1) < 1e-2):
        same = np.flatnonzero(np.linalg.norm(tx - rx, axis=1) < 1e-2).tolist()
        raise InputError(
            "links", "ends at least 1 cm apart", f"links {same} with both ends at one place", "Move one end"
        )
    for name, value in (("max_depth", max_depth), ("samples", samples)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
            raise InputError(name, "a whole number", repr(value), "Give it without a point")
    if max_depth < 0 or samples < 1:
        got = f"max_depth {max_depth}, samples {samples}"
        raise InputError("trace", "max_depth of 0 or more and samples of 1 or more", got, "Correct them")
    asked = [
        name for name, on in (("diffraction", diffraction), ("diffuse_reflection", diffuse_reflection)) if on
    ]
    if asked:
        expected = "line of sight, specular reflection and refraction"
        remedy = f"Set {' and '.join(asked)} to false; what it adds can enter the model as a discrepancy"
        raise InputError("interactions to trace", expected, " and ".join(asked), remedy)


def _check_found(
    scene: Any, flat: Flat, tx: Float[np.ndarray, "link 3"], rx: Float[np.ndarray, "link 3"]
) -> None:
    empty = sorted(set(range(len(tx))) - set(flat.link.tolist()))
    if not empty:
        return
    for name, place in (("rx_position", rx[empty[0]]), ("tx_position", tx[empty[0]])):
        around = enclosing_objects(scene, place)
        if around:
            got = f"{np.round(place, 3).tolist()} inside '{around[0]}'"
            raise InputError(
                f"{name} of link {empty[0]}", "a place in the open", got, "Move it out of the wall"
            )
    shown = ", ".join(map(str, empty[:20])) + (", ..." if len(empty) > 20 else "")
    remedy = "Check their positions, raise max_depth or samples, or allow links without a path"
    raise InputError("paths of the links", "a path or more for each link", f"none for links {shown}", remedy)
