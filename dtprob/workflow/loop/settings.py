"""The CASE of a running twin: which model, which physical twin, and how the loop goes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

from dtprob.case import EffectsSection, ModelSection, SeedSection
from dtprob.effects import summaries
from dtprob.effects.network import FAMILIES
from dtprob.errors import InputError, unknown_name
from dtprob.models.multi_access import Clusters, Kernel
from dtprob.sections import Options, parse_sections, read_document

MODEL: Final = "multi_access"
OPTIONS: Final = ("clusters", "capacity", "traffic", "concentration")
_PLAIN: Final[Mapping[str, tuple[str, tuple[type, ...]]]] = {
    "capacity": ("a whole number", (int,)),
    "traffic": ("text", (str,)),
    "concentration": ("a number", (int, float)),
}
"""What an option is in words, and its types."""


@final
@dataclass(frozen=True, kw_only=True)
class PhysicalSection:
    """[physical]: what the twin is of; an environment or a log.

    Attributes:
        environment: "multi_access", or a function "package.module:function" of the user's own that makes a PettingZoo
            `ParallelEnv`; its devices see packets that wait, last arrival, last acknowledgement, in this order.
        log: a network's log, whose rows come one after the other, whatever policy is handed over.
        options: of the function, or of the log's reader.
        replay: whether the environment does the same again after `reset` with the same seed; a resumed loop plays
            the logged actions again then, and goes on exactly there, else it starts an episode.
    """

    environment: str | None = None
    log: Path | None = None
    options: Options = field(default_factory=dict)
    replay: bool = True


@final
@dataclass(frozen=True, kw_only=True)
class LoopSection:
    """[loop]: how the loop goes.

    Attributes:
        slots: of the physical twin, in all.
        collect: slots of each collection.
        training: virtual slots on which each policy is trained.
        caution: of the control, see `dtprob.control.COMA`; the plain mean over what is not known by default.
        window: slots that the monitor judges together.
        run_length: mean number of windows to a false alarm while the learned network holds.
        diagnose: slots after a change that a diagnosis needs; 0 for none.
        relearn: whether an alarm has consequences; false for a twin that is learned once.
    """

    slots: int = 4000
    collect: int = 40
    training: int = 120_000
    caution: float | None = None
    window: int = 10
    run_length: int = 1000
    diagnose: int = 200
    relearn: bool = True

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        for name in ("slots", "collect", "training", "window", "run_length"):
            if getattr(self, name) < 1:
                raise InputError(f"[loop] {name}", "1 or more", str(getattr(self, name)), "Correct the value")
        if self.window > self.slots:
            expected = f"at most the {self.slots} slots of the run"
            raise InputError("[loop] window", expected, str(self.window), "The monitor would never judge")


@final
@dataclass(frozen=True, kw_only=True)
class TwinCase:
    """A checked CASE of a running twin.

    Attributes:
        path: the TOML file.
        model, physical, loop, effects, seed: its sections.
    """

    path: Path
    model: ModelSection
    physical: PhysicalSection
    loop: LoopSection = field(default_factory=LoopSection)
    effects: EffectsSection = field(default_factory=EffectsSection)
    seed: SeedSection = field(default_factory=SeedSection)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that this case reads, besides the user's own modules."""
        log = self.physical.log
        return (self.path,) if log is None else (self.path, self.path.parent / log)

    @property
    def user_code(self) -> tuple[str, ...]:
        """The user's own functions that this case runs."""
        name = self.physical.environment
        return (name,) if name is not None and ":" in name else ()

    @property
    def kernel(self) -> Kernel:
        """The network's transition."""
        clusters = tuple(tuple(cluster) for cluster in self.model.options["clusters"])
        return Kernel(Clusters(clusters), int(self.model.options.get("capacity", 1)))

    @property
    def memory(self) -> bool:
        """Whether arrivals depend on the last ones."""
        return self.model.options.get("traffic", "memoryless") == "markov"

    @property
    def concentration(self) -> float:
        """Of the Dirichlet priors."""
        return float(self.model.options.get("concentration", 0.5))


_SECTIONS: Final[Mapping[str, type]] = {
    "model": ModelSection,
    "physical": PhysicalSection,
    "loop": LoopSection,
    "effects": EffectsSection,
    "seed": SeedSection,
}


def load_twin_case(path: Path) -> TwinCase:
    """Read and check the CASE file of a running twin.

    Args:
        path: a TOML file.

    Raises:
        InputError: no such file, not TOML, an unknown section or key, a missing one, or a value that cannot be.
    """
    sections = parse_sections(read_document(path), path, _SECTIONS)
    for name, key in (("model", "name"), ("physical", "environment")):
        if name not in sections:
            raise InputError(path.name, f"a section [{name}]", "none", f"Add [{name}] with at least '{key}'")
    case = TwinCase(path=path.absolute(), **sections)
    _check_model(case)
    _check_effects(case)
    physical = case.physical
    if (physical.environment is None) == (physical.log is None):
        got = "neither" if physical.log is None else "both"
        raise InputError(f"{path.name} [physical]", "an environment or a log", got, "Name one of the two")
    return case


def _check_model(case: TwinCase) -> None:
    where = f"{case.path.name} [model]"
    if case.model.name != MODEL:
        remedy = "Fit and diagnose other models with `dtprob fit` and `dtprob diagnose`"
        raise InputError(f"{where} name", f"'{MODEL}', which can be controlled", case.model.name, remedy)
    options: Mapping[str, Any] = case.model.options
    for name in options:
        if name not in OPTIONS:
            raise InputError(f"{where} options", f"keys among {', '.join(OPTIONS)}", name, "Correct the key")
    if "clusters" not in options:
        raise InputError(f"{where} options", "a key 'clusters'", "none", "Add clusters = [[0, 1], ...]")
    for name, (expected, kinds) in _PLAIN.items():
        if name in options and type(options[name]) not in kinds:
            raise InputError(f"{where} options {name}", expected, repr(options[name]), "Correct the value")
    if options.get("traffic", "memoryless") not in {"memoryless", "markov"}:
        got = str(options["traffic"])
        raise InputError(f"{where} options traffic", "memoryless or markov", got, "Correct the value")
    try:
        kernel, concentration = case.kernel, case.concentration
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} options", "values of the right type", str(error), "Correct them") from None
    if kernel.capacity < 1 or not 0 < concentration < float("inf"):
        got = f"capacity {kernel.capacity}, concentration {concentration}"
        raise InputError(
            f"{where} options", "a capacity from 1, a concentration above 0", got, "Correct them"
        )


def _check_effects(case: TwinCase) -> None:
    """Refuse what a diagnosis would refuse only after an alarm, when another case cannot go on with the slots."""
    where, chosen = f"{case.path.name} [effects]", case.effects
    use = chosen.use if isinstance(chosen.use, tuple) else () if chosen.use == "all" else (chosen.use,)
    for key, names, valid in (("use", use, FAMILIES), ("exclude", chosen.exclude, summaries())):
        for name in names:
            if name.partition("[")[0] not in valid:
                raise unknown_name(f"{where} {key}", name, valid, "effect family")
    if chosen.known:
        got = ", ".join(chosen.known)
        raise InputError(
            f"{where} known", "nothing, since a running twin has no effects", got, "Leave it out"
        )
