"""What summary.json says of a posterior: each parameter's centre and spread, and how far to trust them."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dtprob.inference import Posterior, summary
from dtprob.raytracing.paths import PathSet
from dtprob.workflow.identified import Learnt

LARGEST = 1000
"""Sites with more entries than this are only named: their draws are in posterior.nc."""
ENOUGH_DRAWS = 400.0
LARGEST_R_HAT = 1.01
APART_R_HAT = 1.1
"""Chains that disagree by more than this have no common posterior to hold against a prior."""
LARGEST_PARETO_K = 0.7
FEWEST_AGREEING = 2
"""A mode that fewer starts than this found, of several, may be one of many."""


def summarise(posterior: Posterior, known: Mapping[str, Learnt] | None = None) -> dict[str, Any]:
    """The content of summary.json.

    Args:
        posterior: from any engine.
        known: for latent sites, what `dtprob.workflow.identified.learnt` finds of their entries; the contraction is
            then told with each, and warnings name those of which the data say nothing and those whose prior they
            contradict.

    Returns:
        plain numbers and text: `parameters` (for each entry of each latent site the columns of
        `dtprob.inference.summary`, intervals of 90%), `not_summarised` (sites with too many entries),
        `warnings` (sentences; empty when all is well), `chains`, `draws`, `diverging`, `provenance`. What
        does not exist, such as the r-hat of a single chain, is left out.
    """
    small = summarised(posterior)
    table = summary(posterior, small).to_dict("index") if small else {}
    told = known or {}
    contractions = _by_label({name: one.contraction for name, one in told.items()})
    rows = {
        str(label): _present(row | ({"contraction": contractions[label]} if label in contractions else {}))
        for label, row in table.items()
    }
    diverging = int(np.sum(posterior.sample_stats.get("diverging", 0)))
    return {
        "parameters": rows,
        "not_summarised": [name for name in posterior.latent if name not in small],
        "warnings": [*_warnings(rows, diverging, posterior), *_of_priors(rows, told)],
        "chains": posterior.chains,
        "draws": posterior.draws_per_chain,
        "diverging": diverging,
        "provenance": json.loads(json.dumps(posterior.provenance, sort_keys=True)),
    }


def summarised(posterior: Posterior) -> list[str]:
    """The latent sites with few enough entries to tell of each."""
    sizes = {name: int(np.prod(posterior.draws[name].shape[2:])) for name in posterior.latent}
    return [name for name, size in sizes.items() if size <= LARGEST]


def entry_names(data: Mapping[str, Any]) -> dict[str, list[str]]:
    """What the entries of materials and objects in a posterior are called, in their order; empty without a scene.

    Args:
        data: the model's arguments.
    """
    paths = data.get("paths")
    if not isinstance(paths, PathSet):
        return {}
    own = {"per_object": paths.object_names, "shared": ("all objects",), "known": ()}
    materials = own.get(data.get("materials", "per_material"), paths.material_names)
    return {"material": list(materials), "object": list(paths.object_names)}


def _by_label(columns: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Numbers of the entries of sites by the labels of the rows."""
    return {
        f"{name}[{','.join(map(str, index))}]" if index else name: float(values[index])
        for name, values in columns.items()
        for index in np.ndindex(values.shape)
    }


def _present(row: dict[Any, Any]) -> dict[str, Any]:
    return {
        str(name): value
        for name, value in row.items()
        if isinstance(value, str) or math.isfinite(float(value))
    }


def _warnings(rows: dict[str, dict[str, Any]], diverging: int, posterior: Posterior) -> Iterable[str]:
    if diverging:
        total = posterior.chains * posterior.draws_per_chain
        yield f"{diverging} of {total} draws diverged: raise the target acceptance, or reparametrise."
    mixed = [name for name, row in rows.items() if row.get("rhat", 1.0) > LARGEST_R_HAT]
    if mixed:
        yield f"The chains disagree on {_some(mixed)} (r-hat above {LARGEST_R_HAT}): run longer."
    few = [name for name, row in rows.items() if row.get("ess", math.inf) < ENOUGH_DRAWS]
    if few and posterior.chains > 1:
        yield f"Fewer than {ENOUGH_DRAWS:.0f} effective draws of {_some(few)}: run longer."
    if not np.all(posterior.extra.get("converged", True)):
        yield "The search or the fit of the engine did not converge: give it more steps, or more starts."
    if np.any(posterior.extra.get("noise_unknown", False)):
        yield "The ensemble added noise to data whose noise is unknown, which comes out too large: confirm with nuts."
    yield from _of_mode(posterior)
    if infinite := [name for name, row in rows.items() if "mean" not in row]:
        yield f"Some draws of {_some(infinite)} are not finite, so that it has no mean: confirm with nuts."
    if float(np.max(posterior.extra.get("pareto_k", 0.0))) > LARGEST_PARETO_K:
        yield f"The approximation is poor (Pareto k above {LARGEST_PARETO_K}): confirm with nuts."


def _of_mode(posterior: Posterior) -> Iterable[str]:
    """What an engine that goes to a mode says of it itself."""
    replaced = int(np.max(posterior.extra.get("replaced", 0)))
    if replaced:
        where = f"{replaced} direction{'s' if replaced > 1 else ''} from the mode"
        yield f"The density does not fall off in {where}, so that draws are not to be trusted there: confirm with nuts."
    share = float(np.min(posterior.extra.get("agreeing", 1.0)))
    starts = posterior.provenance.get("settings", {}).get("starts", 1)
    if share < 1 and round(share * starts) < FEWEST_AGREEING:
        yield f"No two of the {starts} starts ended at the same mode: there may be a better one, give more starts."


def _of_priors(rows: dict[str, dict[str, Any]], known: Mapping[str, Learnt]) -> Iterable[str]:
    """What the data do to priors, of entries on which the chains agree."""
    total = sum(one.width.size for one in known.values())
    idle = _by_label({name: one.is_idle for name, one in known.items()})
    against = _by_label({name: one.contradicts(total) for name, one in known.items()})
    agreed = [name for name, row in rows.items() if row.get("rhat", 1.0) <= APART_R_HAT]
    if unknown := [name for name in agreed if idle.get(name)]:
        yield f"The data say nothing of {_some(unknown)} (not identified): the posterior is the prior."
    if denied := [name for name in agreed if against.get(name)]:
        yield (
            f"The data contradict the prior of {_some(denied)}, which ends far from it or far wider: "
            "the model may lack something, run dtprob diagnose."
        )


def _some(labels: list[str]) -> str:
    return ", ".join(labels[:5]) + (f" and {len(labels) - 5} more" if len(labels) > 5 else "")
