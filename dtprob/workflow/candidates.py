"""The effects of a CASE: those to choose among, and those that are known."""

from collections.abc import Callable, Mapping
from typing import Any

from dtprob.case import Case
from dtprob.effects import Effect, catalogue, summaries, with_effects
from dtprob.effects.common import Sites
from dtprob.effects.library import FAMILIES, family_of, instances
from dtprob.errors import InputError, unknown_name
from dtprob.models.arguments import Model
from dtprob.models.declaration import declare
from dtprob.usercode import load_object

type Say = Callable[[str], None]


def check_families(case: Case) -> None:
    """Refuse effects whose family the library does not have.

    Args:
        case: a checked CASE.

    Raises:
        InputError: there is one.
    """
    for name in case.effects.listed:
        if not _is_code(name):
            family_of(name, f"{case.path.name} [effects] use")


def candidates(case: Case, model: Model, arguments: Mapping[str, Any], say: Say) -> tuple[Effect, ...]:
    """The effects to choose among; of a list of families those that neither model nor data allow are left out.

    Args:
        case: a checked CASE.
        model: the one that it names.
        arguments: the model's, by name.
        say: receives a note of what is left out.

    Raises:
        InputError: a name is unknown, nothing of what is named is allowed, or code of the user's own gives no effects.
    """
    sites = declare(model, arguments, cluster=_axis(case, arguments)).sites
    everything = case.effects.use == "all"
    offered = catalogue(sites, arguments, "all" if everything else _chosen(case, sites, arguments, say))
    left_out = case.effects.exclude
    known = {*summaries(), *(n for effect in offered for n in (effect.name, effect.family))}
    for name in left_out:
        if name not in known:
            raise unknown_name(f"{case.path.name} [effects] exclude", name, known, "effect")
    left_out = {*left_out, *case.effects.known}
    return tuple(effect for effect in offered if not {effect.family, effect.name} & left_out)


def extended(case: Case, model: Model, arguments: Mapping[str, Any]) -> Model:
    """The model with the effects that are known, their parameters among its unknowns.

    Args:
        case: a checked CASE.
        model: the one that it names.
        arguments: the model's, by name.

    Raises:
        InputError: what is to be known is no single effect with parameters and a place of its own.
    """
    if not case.effects.known:
        return model
    where = f"{case.path.name} [effects] known"
    sites = declare(model, arguments, cluster=_axis(case, arguments)).sites
    named = {e.name: e for code in case.effects.listed if _is_code(code) for e in _own_effects(code, case)}
    added: list[Effect] = []
    for name in case.effects.known:
        offered = {e.name: e for e in catalogue(sites, arguments, [named.get(name, name)])}
        if name not in offered:
            remedy = "Name one of the instances"
            raise InputError(where, f"one effect ({', '.join(list(offered)[:8])})", repr(name), remedy)
        if offered[name].kind == "variance":
            expected = "effects with parameters of their own"
            raise InputError(where, expected, f"the random field {name}", "Leave it among the candidates")
        if offered[name].is_looked_for:
            expected = "effects at a place of their own"
            raise InputError(
                where, expected, f"{name}, which may be anywhere", "Leave it among the candidates"
            )
        added.append(offered[name])
    return with_effects(model, added)


def _is_code(name: str) -> bool:
    """Whether an entry of `use` is code of the user's own, `module:attribute`."""
    return ":" in name


def _chosen(case: Case, sites: Sites, arguments: Mapping[str, Any], say: Say) -> list[str | Effect]:
    """What a list of candidates names, without the families that are not allowed, unless there is nothing else."""
    chosen: list[str | Effect] = []
    idle: list[str | Effect] = []
    for name in case.effects.listed:
        if _is_code(name):
            chosen += _own_effects(name, case)
        elif name in FAMILIES:
            found = instances(name, sites, arguments)
            chosen += found
            idle += [] if found else [name]
        else:
            chosen.append(name)
    if idle and chosen:
        say(f"note: left out, since neither model nor data allow them: {', '.join(map(str, idle))}")
    return chosen or idle


def _axis(case: Case, arguments: Mapping[str, Any]) -> str | None:
    """The cluster when it is an axis of the model, not a column of the data."""
    return None if case.data.cluster in arguments else case.data.cluster


def _own_effects(name: str, case: Case) -> list[Effect]:
    found = load_object(name, case.folder)
    entries = [found] if isinstance(found, Effect) else found
    if not isinstance(entries, list | tuple) or not all(isinstance(entry, Effect) for entry in entries):
        where = f"{case.path.name} [effects] use"
        raise InputError(where, "an Effect or a list of them", type(found).__name__, f"Correct {name}")
    return list(entries)
