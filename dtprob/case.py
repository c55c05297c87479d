"""A CASE: the TOML file that says which model, data, effects and engine belong together."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from dtprob.errors import InputError
from dtprob.sections import Options, Phase, Share, Words, parse_sections, read_document

_RELEVANT: Final = Share(0.75)


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
    relevance: Share = _RELEVANT
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
        value: a whole number from 0 to 2^63 - 1.
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
