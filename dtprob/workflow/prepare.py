"""From a CASE file to everything a fit or a diagnosis needs: model, data, effects, engine, key."""

import dataclasses
import hashlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.case import Case, EngineSection
from dtprob.data import ChannelData, Data, PowerData, Table, read, read_table
from dtprob.data.location import located
from dtprob.effects import Effect
from dtprob.errors import InputError, unknown_name
from dtprob.files import sha256
from dtprob.inference.engine import AbstractEngine
from dtprob.inference.fit import ENGINES
from dtprob.models.arguments import Model, taking
from dtprob.usercode import load_object, source_files
from dtprob.workflow.candidates import Say, candidates, check_families, extended
from dtprob.workflow.columns import check_columns
from dtprob.workflow.models import MODELS, NAMES
from dtprob.workflow.scene import reached, scene_files
from dtprob.workflow.words import check_words, coded


@dataclass(frozen=True)
class Prepared:
    """A case ready to run.

    Attributes:
        case: where it comes from.
        model: the generative model, extended by the effects that the case says are known.
        data: its arguments by name.
        reference: the arguments that the twin was learned from, if the case names them.
        designs: arguments for measurements that could be made, by name.
        effects: the candidate effects that the model and the data allow.
        engine: the inference engine.
        key: the typed JAX key of the case's seed.
        cluster: the axis or column whose values belong together; None for the model's own.
        data_sha256: hash of the data file.
        made_of_sha256: hash of the user's own code and of the scene's files.
    """

    case: Case
    model: Model
    data: Mapping[str, Any]
    reference: Mapping[str, Any] | None
    designs: Mapping[str, Mapping[str, Any]]
    effects: tuple[Effect, ...]
    engine: AbstractEngine
    key: jax.Array
    cluster: str | None
    data_sha256: str
    made_of_sha256: str

    @property
    def provenance(self) -> dict[str, Any]:
        """What identifies the run besides the versions of packages."""
        case = self.case
        return {
            "seed": case.seed.value,
            "engine": case.engine.name,
            "model": case.model.name,
            "data_sha256": self.data_sha256,
        }


def prepare(
    case: Case,
    *,
    need: Literal["fit", "diagnosis"],
    allow_code: bool = True,
    cache: Path | None = None,
    say: Say = lambda _: None,
) -> Prepared:
    """Read the data, load or trace the scene, and bind model, effects and engine.

    Args:
        case: a checked CASE.
        need: a fit needs neither effects nor reference data.
        allow_code: whether functions of the user's own may run.
        cache: a folder in which traced paths are kept for the next run.
        say: receives one line for each step that takes time.

    Raises:
        InputError: whatever in the case or its files is not as it must be.
    """
    if case.user_code and not allow_code:
        expected = "a model and effects of dtprob, since --no-code is given"
        remedy = "Leave --no-code out if you trust this code"
        raise InputError(f"{case.path.name}", expected, f"the code {', '.join(case.user_code)}", remedy)
    check_families(case)
    case = dataclasses.replace(case, data=dataclasses.replace(case.data, file=located(case.data.file)))
    engine = make_engine(case.engine, f"{case.path.name} [engine]")
    model = _model(case)
    other = MODELS[case.model.name].diagnosed_by if case.model.name in MODELS else None
    if need == "diagnosis" and other is not None:
        expected = f"a model of the data to diagnose, such as {other}"
        remedy = f'Set name = "{other}", which asks where the predictor errs'
        raise InputError(f"{case.path.name} [model] name", expected, case.model.name, remedy)
    if case.scene is not None and "paths" not in inspect.signature(model).parameters:
        expected, remedy = (
            "a model that takes paths, such as ray_traced_channel",
            "Leave [scene] out, or choose such a model",
        )
        raise InputError(f"{case.path.name} [scene]", expected, case.model.name, remedy)
    say(f"reading {case.data.file.name}")
    arguments = _arguments(case, model, case.data.file, cache, say)
    model = taking(model, arguments, case.data.cluster)
    reference, designs, effects = None, {}, ()
    if need == "diagnosis":
        if case.data.reference is not None:
            say(f"reading {case.data.reference.name}")
            reference = _arguments(case, model, case.data.reference, cache, say)
        if case.data.designs is not None:
            say(f"reading {case.data.designs.name}")
            found = _arguments(case, model, case.data.designs, cache, say, observed=False)
            designs = {case.data.designs.stem: found}
        effects = candidates(case, model, arguments, say)
    model = extended(case, model, arguments)
    key, digest = jax.random.key(case.seed.value), sha256(case.data.file)
    cluster = case.data.cluster
    sources = [
        *source_files(case.user_code, case.folder),
        *([] if case.scene is None else scene_files(case.scene)),
    ]
    made_of = hashlib.sha256("".join(map(sha256, sources)).encode()).hexdigest()
    return Prepared(
        case, model, arguments, reference, designs, effects, engine, key, cluster, digest, made_of
    )


def make_engine(section: EngineSection, where: str) -> AbstractEngine:
    """The engine of a CASE, with its settings.

    Args:
        section: name and settings.
        where: what to call them in an error.

    Raises:
        InputError: an unknown engine or setting, or a setting of the wrong type.
    """
    if section.name not in ENGINES:
        raise unknown_name(f"{where} name", section.name, ENGINES, "engine")
    kind: Any = ENGINES[section.name]
    settings = {field.name: field.default for field in dataclasses.fields(kind) if field.init}
    for name, value in section.options.items():
        if name not in settings:
            raise unknown_name(f"{where} options", name, settings, "setting")
        default = settings[name]
        is_plain = isinstance(default, bool | int | float | str)
        if is_plain and not (type(value) is type(default) or (type(default) is float and type(value) is int)):
            expected = f"a value like {default!r}"
            raise InputError(f"{where} options {name}", expected, repr(value), "Correct the value")
    return kind(**section.options)


def _model(case: Case) -> Model:
    name = case.model.name
    where = f"{case.path.name} [model] name"
    if ":" not in name:
        if name not in MODELS:
            raise unknown_name(where, name, MODELS, "model")
        return MODELS[name].load()
    found = load_object(name, case.folder)
    if not callable(found):
        raise InputError(where, "a function", type(found).__name__, "Name a NumPyro model")
    return found


def _arguments(
    case: Case, model: Model, file: Path, cache: Path | None, say: Say, *, observed: bool = True
) -> dict[str, Any]:
    """The model's arguments from one data file, the scene and the options; of designs nothing has been observed."""
    takes = inspect.signature(model).parameters
    needs_paths = "paths" in takes
    if case.model.name in MODELS:
        data = _expected(read(file, case.data.options), MODELS[case.model.name].data, file, case)
    elif needs_paths:
        data = _expected(read(file, case.data.options), ChannelData, file, case)
    else:
        data = read_table(file, case.data.options)
    if observed:  # designs may lack the columns that are
        named = data.arrays() if isinstance(data, Table) else ()
        check_words(f"{case.path.name} [data.words]", case.data.words, named)
    paths = None
    if needs_paths and isinstance(data, ChannelData | PowerData):
        data, paths = reached(case, data, cache, say)
    arrange = MODELS[case.model.name].arranger() if case.model.name in MODELS else None
    columns = data.arrays() if arrange is None else _arranged(case, arrange, data)
    if isinstance(data, Table):
        columns = coded(file, columns, case.data.words, takes)
    arguments = {name: _as_jax(array) for name, array in columns.items() if name in takes}
    if case.data.cluster is not None and case.data.cluster in columns:
        arguments[case.data.cluster] = columns[case.data.cluster]
    if paths is not None:
        arguments["paths"] = paths
    arguments |= _phase(case, data, takes="phase" in takes)
    if case.model.name in MODELS:
        arguments |= {name: jnp.asarray(v) for name, v in MODELS[case.model.name].derive(arguments).items()}
        arguments |= MODELS[case.model.name].reduced({**columns, **arguments})
    own = [] if arrange is None else list(inspect.signature(arrange).parameters)[1:]
    arguments |= _options(case, takes, arguments, own)
    if observed and case.model.name not in MODELS:
        check_columns(file, taking(model, arguments, case.data.cluster), arguments, columns)
    return arguments


def _phase(case: Case, data: Data, *, takes: bool) -> dict[str, Any]:
    """The argument that says what phases mean, if the case says it and the model takes it."""
    phase = case.data.phase
    if phase is None:
        return {}
    if takes:
        return {"phase": phase}
    if phase != ("none" if isinstance(data, PowerData) else "coherent"):
        expected = f"coherent phases, which {case.model.name} assumes"
        remedy = "Choose a model that takes a phase, such as ray_traced_channel"
        if isinstance(data, PowerData):
            expected, remedy = "none, since powers have no phase", 'Set phase = "none"'
        raise InputError(f"{case.path.name} [data] phase", expected, phase, remedy)
    return {}


def _arranged(case: Case, arrange: Callable[..., dict[str, Any]], data: Data) -> dict[str, Any]:
    """The arguments that are made from the data and some of the options."""
    parameters = list(inspect.signature(arrange).parameters.values())[1:]
    given = {p.name: _frozen(case.model.options[p.name]) for p in parameters if p.name in case.model.options}
    missing = [p.name for p in parameters if p.default is p.empty and p.name not in given]
    if missing:
        where = f"{case.path.name} [model.options]"
        raise InputError(where, f"a key '{missing[0]}'", "none", f"Add {missing[0]} = ...")
    try:
        return arrange(data, **given)
    except (TypeError, ValueError) as error:
        where = f"{case.path.name} [model.options]"
        raise InputError(where, "values of the right type", str(error), "Correct the options") from None


def _expected(data: Data, kind: type, file: Path, case: Case) -> Data:
    if isinstance(data, kind):
        return data
    names = ", ".join(list(data.arrays())[:6])
    got = f"{type(data).__name__} ({names})"
    hint = f", under the names {NAMES[kind]}" if isinstance(data, Table) else ""
    remedy = f"Give {case.model.name} its kind of data{hint}"
    raise InputError(file.name, kind.__name__, got, remedy)


def _as_jax(array: Any) -> Any:
    is_number = isinstance(array, np.ndarray) and array.dtype.kind != "U"
    return jnp.asarray(array) if is_number else array


def _options(
    case: Case, takes: Mapping[str, inspect.Parameter], taken: Iterable[str], own: Iterable[str]
) -> dict[str, Any]:
    """The model's options; those in ``own`` have been used to arrange the data."""
    where, own = f"{case.path.name} [model.options]", set(own)
    free = [name for name in takes if name not in set(taken)]
    for name in case.model.options:
        if name not in free and name not in own:
            raise unknown_name(where, name, {*free, *own}, "option")
    return {name: _frozen(value) for name, value in case.model.options.items() if name not in own}


def _frozen(value: Any) -> Any:
    """Lists as tuples, so that settings can be compared and hashed."""
    return tuple(_frozen(entry) for entry in value) if isinstance(value, list) else value
