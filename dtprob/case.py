"""A CASE: the TOML file that says which model, data, effects and engine belong together."""

import os
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, Literal, NewType, cast, get_type_hints

from dtprob.errors import InputError, unknown_name

type Phase = Literal["coherent", "per_packet", "none"]
type Options = Mapping[str, Any]
type Words = Mapping[str, tuple[str, ...]]
"""For each column its words in the order of their numbers, from 0."""
Share = NewType("Share", float)

PHASES: tuple[Phase, ...] = ("coherent", "per_packet", "none")

LARGEST: Final = 2**63 - 1
"""Largest whole number that counts and seeds may be."""


@dataclass(frozen=True, kw_only=True)
class ModelSection:
    """[model]: the generative model.

    Attributes:
        name: a model of dtprob, or "package.module:function" of the user's own.
        options: settings of the model, by the names of its arguments.
    """

    name: str
    options: Options = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class DataSection:
    """[data]: what was measured.

    Attributes:
        file: the data file.
        reference: earlier data from which the twin was learned; its posterior is the prior of a diagnosis.
        designs: measurements that could be made, as data of the same kind; where causes cannot be told apart, a diagnosis
            ranks them. What is observed in them is not looked at.
        phase: what the phases of the data mean; "coherent" unless said.
        cluster: the column or axis whose values belong together; the model's own unless said.
        words: for columns of words in a table for a model of the user's own, the words in the order of their numbers.
        options: settings of the reader, for data that have some.
    """

    file: Path
    reference: Path | None = None
    designs: Path | None = None
    phase: Phase | None = None
    cluster: str | None = None
    words: Words = field(default_factory=dict)
    options: Options = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class SceneSection:
    """[scene]: the geometry of ray-traced models.

    Attributes:
        file: a scene that sionna-rt ships, the path of a Mitsuba XML file, of a path set (.nc), or of a floor
            plan (.json, also "data set/floorplan.json" of a measured set).
        frequency: carrier, Hz; a path set knows its own.
        max_depth: most interactions on a path.
        refraction, diffraction, diffuse_reflection: what the twin traces besides specular reflection; the last two
            are refused, since dtprob cannot trace them yet.
        tx_pattern, rx_pattern, polarization: of the antenna elements, as sionna-rt names them.
        merge_shapes: whether objects of one material become one; false keeps every object apart.
        skip_unreached: leave out links that no path reaches, instead of refusing the case.
        device_height: m, added to the height of both ends of each link.
        ceiling_height: m, of the rooms of a floor plan.
        wall_material, wall_thickness: of the walls of a floor plan; thickness in m.
        samples: rays shot from each end; fewer are faster and miss small or far surfaces.
        strongest: at most so many paths of each link are kept; None keeps all.
        check_depth: most interactions of a second trace, whose additional paths only the effect depth_cut_off uses.
        check_refraction: the same of a trace through walls, for refraction_off.
        check_transmitters: the same of traces from each other transmitter's place, for swapped_transmitters.
    """

    file: str
    frequency: float | None = None
    max_depth: int = 3
    refraction: bool = False
    diffraction: bool = False
    diffuse_reflection: bool = False
    tx_pattern: str = "iso"
    rx_pattern: str = "iso"
    polarization: str = "V"
    merge_shapes: bool = True
    skip_unreached: bool = False
    device_height: float | None = None
    ceiling_height: float | None = None
    wall_material: str = "brick"
    wall_thickness: float | None = None
    samples: int = 1_000_000
    strongest: int | None = None
    check_depth: int | None = None
    check_refraction: bool = False
    check_transmitters: bool = False


@dataclass(frozen=True, kw_only=True)
class EffectsSection:
    """[effects]: the candidate causes.

    Attributes:
        use: "all", names, or "package.module:effects" of the user's own.
        exclude: names of families or instances that are left out of these.
        known: names of effects that the twin has beyond doubt, such as those that an earlier diagnosis found: they are
            fitted with the model's other unknowns, and are no candidates.
    """

    use: str | tuple[str, ...] = "all"
    exclude: tuple[str, ...] = ()
    known: tuple[str, ...] = ()

    @property
    def listed(self) -> tuple[str, ...]:
        """What `use` names; nothing where it is "all"."""
        names = (self.use,) if isinstance(self.use, str) else self.use
        return () if self.use == "all" else names


@dataclass(frozen=True, kw_only=True)
class DiagnosisSection:
    """[diagnosis]: the effort of a diagnosis; less of it is faster and misses more.

    Attributes:
        candidates: how many effects are refitted in full at each step.
        polished: how many fits are freed from local optima of the unknown parameters at each step, beside
            fitted effects at most one; 0 for none.
        max_effects: the largest set of effects that is looked for.
        relevance: share of the gap that causes have to close to be named where something is left. Less of it suits
            data whose twin is known to lack more than is on the list.
        tolerance_db: residual error that does not matter, in dB below the signal; of powers, their rms error in dB, and of
            other readings, such as levels in dBm, that in their own unit.
    """

    candidates: int = 8
    polished: int = 3
    max_effects: int = 3
    relevance: Share = Share(0.75)
    tolerance_db: float | None = None


@dataclass(frozen=True, kw_only=True)
class EngineSection:
    """[engine]: the inference engine.

    Attributes:
        name: its name.
        options: its settings.
    """

    name: str = "laplace"
    options: Options = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class SeedSection:
    """[seed]: where randomness starts.

    Attributes:
        value: a whole number from 0 to `LARGEST`.
    """

    value: int = 0


@dataclass(frozen=True, kw_only=True)
class Case:
    """A checked CASE; every path in it is complete.

    Attributes:
        path: the TOML file.
        model, data, scene, effects, diagnosis, engine, seed: its sections; scene is None where there is none.
    """

    path: Path
    model: ModelSection
    data: DataSection
    scene: SceneSection | None = None
    effects: EffectsSection = field(default_factory=EffectsSection)
    diagnosis: DiagnosisSection = field(default_factory=DiagnosisSection)
    engine: EngineSection = field(default_factory=EngineSection)
    seed: SeedSection = field(default_factory=SeedSection)

    @property
    def folder(self) -> Path:
        """Where the TOML file lies, and the user's own modules beside it."""
        return self.path.parent

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that this case reads, besides the user's own modules."""
        scene = () if self.scene is None else (Path(self.scene.file),)
        data = self.data
        return tuple(file for file in (self.path, data.file, data.reference, data.designs, *scene) if file)

    @property
    def user_code(self) -> tuple[str, ...]:
        """The user's own functions that this case runs, as "module:name"."""
        return tuple(name for name in (self.model.name, *self.effects.listed) if ":" in name)


_SECTIONS: dict[str, type] = {
    "model": ModelSection,
    "data": DataSection,
    "scene": SceneSection,
    "effects": EffectsSection,
    "diagnosis": DiagnosisSection,
    "engine": EngineSection,
    "seed": SeedSection,
}


def load_case(path: str | os.PathLike[str]) -> Case:
    """Read and check a CASE file.

    Args:
        path: a TOML file.

    Raises:
        InputError: no such file, not TOML, an unknown section or key (the nearest valid one is named), a
            missing key, a value of the wrong type or out of range.
    """
    path = Path(path)
    return parse_case(read_document(path), path)


def check_seed(seed: int) -> int:
    """A seed that is given instead of the one of a CASE; raises InputError where it cannot be one."""
    if not _is_whole(seed):
        raise InputError("--seed", "a whole number from 0", str(seed), "Give another seed")
    return seed


def read_document(path: Path) -> dict[str, Any]:
    """The sections of a TOML file.

    Raises:
        InputError: no such file, a folder, one that may not be read, or not TOML.
    """
    try:
        if path.is_dir():
            inside = sorted(path.glob("*.toml")) or [path / "case.toml"]
            raise InputError(str(path), "a CASE file (TOML)", "a folder", f"Name the file: {inside[0]}")
        if not path.is_file():
            raise InputError(str(path), "a CASE file (TOML)", "no such file", "Check the name and the folder")
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        is_toml = path.suffix.lower() == ".toml"
        got = f"another encoding (byte {error.start})" if is_toml else "no text"
        remedy = "Save it as UTF-8" if is_toml else "Name the TOML file, not the data"
        raise InputError(str(path), "a CASE file (TOML), in UTF-8", got, remedy) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), "a TOML file", str(error), "Correct the file there") from None
    except OSError as error:
        got = error.strerror or str(error)
        raise InputError(str(path), "a CASE file (TOML)", got, "Check the name and the permissions") from None


def parse_case(document: Mapping[str, Any], path: Path) -> Case:
    """Check the content of a CASE file.

    Args:
        document: the sections as TOML gives them.
        path: where it came from; paths inside are relative to its folder.

    Raises:
        InputError: as ``load_case``.
    """
    sections = parse_sections(document, path, _SECTIONS)
    for name, key in (("model", "name"), ("data", "file")):
        if name not in sections:
            raise InputError(path.name, f"a section [{name}]", "none", f"Add [{name}] with at least '{key}'")
    return _resolved(Case(path=path.absolute(), **sections))


def parse_sections(document: Mapping[str, Any], path: Path, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Check the sections of a TOML file.

    Args:
        document: the sections as TOML gives them.
        path: where it came from.
        kinds: for each section that can be, the dataclass that it is to become.

    Raises:
        InputError: an unknown section or key, a missing key, or a value of the wrong type or out of range.
    """
    sections: dict[str, Any] = {}
    for name, content in document.items():
        if name not in kinds:
            raise unknown_name(path.name, name, kinds, "section")
        if not isinstance(content, Mapping):
            raise InputError(
                f"{path.name} {name}", f"a section [{name}]", _shown(content), "Write it as a section"
            )
        sections[name] = _section(cast("Mapping[str, Any]", content), kinds[name], f"{path.name} [{name}]")
    return sections


def _section(content: Mapping[Any, Any], kind: type, where: str) -> Any:
    hints = get_type_hints(kind)
    for key in content:
        if key not in hints:
            error = unknown_name(where, key, hints, "key")
            if "options" in hints:
                hint = f"Settings stand under {where.rsplit(maxsplit=1)[-1][:-1]}.options]"
                remedy = f"{error.remedy} {hint}" if error.remedy.endswith("?") else hint
                error = InputError(error.what, error.expected, error.got, remedy)
            raise error
    for entry in fields(kind):
        if entry.name not in content and entry.default is entry.default_factory is MISSING:
            raise InputError(where, f"a key '{entry.name}'", "none", f"Add {entry.name} = ...")
    return kind(**{key: _value(content[key], hints[key], f"{where} {key}") for key in content})


def _value(value: Any, hint: Any, where: str) -> Any:
    expected, accepts = _KINDS[hint]
    if not accepts(value):
        raise InputError(where, expected, _shown(value), "Correct the value")
    return _CONVERT.get(hint, lambda kept: kept)(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_names(value: Any) -> bool:
    return _is_text(value) or (isinstance(value, list) and all(map(_is_text, cast("list[Any]", value))))


def _are_lists(value: Mapping[str, Any]) -> bool:
    return all(isinstance(listed, list) and _is_names(listed) for listed in value.values())


_KINDS: dict[Any, tuple[str, Any]] = {
    str: ("text", _is_text),
    str | None: ("text", _is_text),
    Path: ("the name of a file", _is_text),
    Path | None: ("the name of a file", _is_text),
    int: ("a whole number from 0", _is_whole),
    int | None: ("a whole number from 1", lambda value: _is_whole(value) and value > 0),
    float | None: ("a positive number", lambda value: _is_number(value) and 0 < value < float("inf")),
    Share: ("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1),
    bool: ("true or false", lambda value: isinstance(value, bool)),
    str | tuple[str, ...]: ("'all', a list of names, or 'module:name'", _is_names),
    tuple[str, ...]: ("a list of names", lambda value: isinstance(value, list) and _is_names(value)),
    Options: ("a table of settings", lambda value: isinstance(value, Mapping)),
    Words: ("a table of lists of words", lambda value: isinstance(value, Mapping) and _are_lists(value)),
    Phase | None: (f"one of {', '.join(PHASES)}", lambda value: value in PHASES),
}
"""For each type of a field: what it is in words, and the test for it."""

_CONVERT: dict[Any, Any] = {
    Path: Path,
    Path | None: Path,
    float | None: float,
    str | tuple[str, ...]: lambda value: value if isinstance(value, str) else tuple(value),
    tuple[str, ...]: tuple,
    Options: dict,
    Words: lambda value: {name: tuple(listed) for name, listed in value.items()},
}


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _resolved(case: Case) -> Case:
    """The case with its paths made complete."""
    reference, designs = (path and case.folder / path for path in (case.data.reference, case.data.designs))
    data = replace(case.data, file=case.folder / case.data.file, reference=reference, designs=designs)
    scene = case.scene
    if scene is not None:
        is_path = Path(scene.file).suffix.lower() in {".xml", ".nc", ".json"}
        scene = replace(scene, file=str(case.folder / scene.file) if is_path else scene.file)
        if scene.frequency is None and Path(scene.file).suffix.lower() != ".nc":
            where = f"{case.path.name} [scene]"
            raise InputError(where, "a key 'frequency'", "none", "Add frequency = ..., the carrier in Hz")
    return replace(case, data=data, scene=scene)
