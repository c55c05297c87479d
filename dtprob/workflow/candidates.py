"""The effects of a CASE: those to choose among, and those that are known."""

from collections.abc import Callable, Mapping
from typing import Any

from dtprob.case import Case
from dtprob.effects import Effect, catalogue, summaries, with_effects
from dtprob.effects.library import FAMILIES, instances
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
    use = case.effects.use
    for name in () if use == "all" else (use,) if isinstance(use, str) else use:
        if ":" not in name and name.partition("[")[0] not in FAMILIES:
            raise unknown_name(f"{case.path.name} [effects] use", name, FAMILIES, "effect family")


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
    use = case.effects.use
    chosen: list[str | Effect] = []
    for name in (use,) if isinstance(use, str) else use:
        chosen += _own_effects(name, case) if ":" in name else [name]
    families = [name for name in chosen if isinstance(name, str) and name in FAMILIES]
    idle = [name for name in families if not instances(name, sites, arguments)]
    if 0 < len(idle) < len(chosen):
        say(f"note: left out, since neither model nor data allow them: {', '.join(idle)}")
        chosen = [entry for entry in chosen if not isinstance(entry, str) or entry not in idle]
    offered = catalogue(sites, arguments, use="all" if use == "all" else chosen)
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
    use = case.effects.use
    own = [e for n in ((use,) if isinstance(use, str) else use) if ":" in n for e in _own_effects(n, case)]
    named = {effect.name: effect for effect in own if isinstance(effect, Effect)}
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


def _axis(case: Case, arguments: Mapping[str, Any]) -> str | None:
    """The cluster when it is an axis of the model, not a column of the data."""
    return None if case.data.cluster in arguments else case.data.cluster


def _own_effects(name: str, case: Case) -> list[str | Effect]:
    found = load_object(name, case.folder)
    entries = [found] if isinstance(found, Effect) else found
    if not isinstance(entries, list | tuple) or not all(isinstance(entry, Effect) for entry in entries):
        where = f"{case.path.name} [effects] use"
        raise InputError(where, "an Effect or a list of them", type(found).__name__, f"Correct {name}")
    return list(entries)
