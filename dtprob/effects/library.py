"""The table of all families of effects, and the choice of those that a model and its data allow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

from dtprob.effects import (
    array,
    displacement,
    extra,
    front_end,
    labels,
    loss,
    mistaken,
    motion,
    network,
    noise,
    nonlinearity,
    obstacle,
    orientation,
    solver,
    surface,
    visibility,
)
from dtprob.effects.common import Data, Family, Sites
from dtprob.effects.effect import Effect
from dtprob.errors import InputError, nearest, unknown_name

FAMILIES: Final[dict[str, Family]] = {
    **displacement.FAMILIES,
    **surface.FAMILIES,
    **visibility.FAMILIES,
    **obstacle.FAMILIES,
    **mistaken.FAMILIES,
    **solver.FAMILIES,
    **extra.FAMILIES,
    **loss.FAMILIES,
    **array.FAMILIES,
    **orientation.FAMILIES,
    **front_end.FAMILIES,
    **nonlinearity.FAMILIES,
    **motion.FAMILIES,
    **noise.FAMILIES,
    **network.FAMILIES,
    **labels.FAMILIES,
}
"""For each family's name, the function (sites, data) -> its instances on such a model and data."""


def catalogue(sites: Sites, data: Data, use: str | Iterable[str | Effect] = "all") -> tuple[Effect, ...]:
    """The effects that a model's sites and data allow.

    Args:
        sites: `declare(model, data).sites`.
        data: the model's arguments by name, with concrete arrays.
        use: "all", or names of families ("doppler") or instances ("array_calibration[rx_1]"), or effects of
            the user's own, which are taken as they are.

    Returns:
        The effects in the order of the table, or of `use`; no name twice.

    Raises:
        InputError: a name is unknown, the model or the data do not allow it, an effect of the user's names a
            site that the model lacks, or two effects have one name.
    """
    if use == "all":
        return _unique([effect for family in FAMILIES for effect in instances(family, sites, data)])
    chosen: list[Effect] = []
    for entry in [use] if isinstance(use, str) else use:
        if isinstance(entry, Effect):
            check_sites(entry, sites)
            chosen.append(entry)
        else:
            chosen += _named(entry, sites, data)
    return _unique(chosen)


def check_sites(effect: Effect, sites: Sites) -> None:
    """Look whether an effect finds its sites, values to rewrite and distributions to replace.

    Raises:
        InputError: the model lacks one, or has it as something else.
    """
    remedies = {
        "a site": (
            [site for site in effect.sites if site not in sites],
            "Name it with numpyro.deterministic in the model, or leave the effect out.",
        ),
        "a value that the model draws or computes": (
            [site for site in effect.rewrites if site in sites and sites[site].kind == "observed"],
            "What is observed has a distribution that an effect can replace: `distributions`, not `rewrites`.",
        ),
        "a site that has a distribution": (
            [site for site in effect.distributions if site in sites and sites[site].kind == "deterministic"],
            "What the model computes has a value that an effect can rewrite: `rewrites`, not `distributions`.",
        ),
    }
    for what, (wrong, remedy) in remedies.items():
        if wrong:
            expected = f"{what} among {', '.join(sites)}"
            raise InputError(f"effect {effect.name}", expected, ", ".join(wrong), remedy)


def summaries() -> dict[str, str]:
    """For each family's name, one line that says what it is."""
    return {name: (family.__doc__ or "").strip().splitlines()[0] for name, family in FAMILIES.items()}


def instances(family: str, sites: Sites, data: Data) -> list[Effect]:
    """The instances of a family that find what they need by the time that the model computes their sites.

    Args:
        family: a name of `FAMILIES`.
        sites: `declare(model, data).sites`.
        data: the model's arguments by name, with concrete arrays.
    """
    return [effect for effect in FAMILIES[family](sites, data) if _finds_its_needs(effect, sites, data)]


def _finds_its_needs(effect: Effect, sites: Sites, data: Data) -> bool:
    """What it rewrites itself has to come before its other sites, all else before the last of them."""
    when = {name: place for place, name in enumerate(sites)}
    own = sorted(when[site] for site in effect.sites)
    latest = {need: own[0] if need in effect.sites else own[-1] - 1 for need in effect.requires}
    return all(need in data or when.get(need, len(when)) <= latest[need] for need in effect.requires)


def family_of(name: str, where: str = "effects") -> str:
    """The family of a name of a family or an instance.

    Args:
        name: "doppler" or "array_calibration[rx_1]".
        where: what an error says of the name's place.

    Raises:
        InputError: there is no such family.
    """
    family = name.partition("[")[0]
    if family not in FAMILIES:
        raise unknown_name(where, name, FAMILIES, "effect family")
    return family


def _named(name: str, sites: Sites, data: Data) -> list[Effect]:
    """All instances of a family, or the one instance of that name."""
    family = family_of(name)
    offered = instances(family, sites, data)
    found = offered if name == family else [effect for effect in offered if effect.name == name]
    if found:
        return found
    names = [effect.name for effect in offered]
    close = nearest(name, names)
    raise InputError(
        "effects",
        f"an effect that this model and data allow ({', '.join(names[:8]) or f'no {family}'})",
        repr(name),
        f"Did you mean {close!r}?" if close else "Leave it out, or give the sites and data that it needs.",
    )


def _unique(effects: list[Effect]) -> tuple[Effect, ...]:
    twice = [name for name, count in Counter(effect.name for effect in effects).items() if count > 1]
    if twice:
        raise InputError("effects", "each name once", f"{', '.join(twice)} twice", "Rename one of them.")
    return tuple(effects)
