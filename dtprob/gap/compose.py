"""Turn the evidence of a diagnosis into its result: plain words, numbers of report.json, arrays of gap.nc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import jax
import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.diagnosis import Cause, Diagnosis, meant
from dtprob.gap.evidence import Evidence
from dtprob.gap.fitting.at_end import shared_draws
from dtprob.gap.how_far.terms import in_user_terms
from dtprob.gap.keys import key_for
from dtprob.gap.located import along, unlisted, where
from dtprob.gap.maps import maps
from dtprob.gap.settings import Settings
from dtprob.gap.vocabulary import Verdict
from dtprob.gap.where.closed_share import closed_shares
from dtprob.gap.where.coordinates import CoordinateFinding
from dtprob.gap.where.site_finding import SiteFinding
from dtprob.gap.which.screen import Screening
from dtprob.gap.which.trials import credit
from dtprob.inference.engine import AbstractEngine

_DRAWS = 200
_MOST = 0.5
"""Share of the gap from which causes close most of it."""
_MOST_ALIKE = 300
"""Candidates up to which a report tells how much each looks like each."""


def compose(
    evidence: Evidence,
    causes: tuple[Cause, ...],
    verdict: Verdict,
    *,
    settings: Settings,
    engine: AbstractEngine,
    key: jax.Array,
) -> Diagnosis:
    """The diagnosis with all sections of the report."""
    first = evidence.steps[0].view.screening
    told_along = along(evidence)
    tolerated = verdict == "NO_GAP" and evidence.steps[0].view.alarmed(settings)
    sections: dict[str, Any] = {
        "tried": _tried(evidence),
        "where": where(evidence, told_along),
        "gap": {**_gap(evidence), "tolerated": tolerated},
        "unlisted": {**unlisted(evidence.after, settings.level / 2), "called_for": list(evidence.asked_for)},
        "remainder": _remainder(evidence),
        "detectable": [
            {
                "effect": name,
                "size": one.size,
                "parameter": one.parameter.name,
                "unit": one.parameter.unit,
                **meant(one.parameter.meaning),
            }
            for name, one in zip(first.names, first.detectable, strict=True)
            if one is not None
        ],
        "screening": _screening(evidence),
        "fit": _fit(evidence, key_for(key, "fit")),
        "provenance": {
            "engine": engine.name,
            "seed": _seed(key),
            "model": evidence.problem.declaration.name,
            **_alike(first),
        },
    }
    arrays = maps(evidence, closed_shares(told_along))
    return Diagnosis(
        verdict, summary(verdict, causes, evidence, tolerated=tolerated), causes, sections, arrays
    )


def summary(
    verdict: Verdict, causes: tuple[Cause, ...], evidence: Evidence, *, tolerated: bool = False
) -> str:
    """The verdict in one sentence.

    Args:
        verdict: of the diagnosis.
        causes: that it names.
        evidence: that it has.
        tolerated: whether there is a gap that only the user's tolerance calls none.
    """
    best = causes[0] if causes else None
    name = " and ".join(best.effects) if best else ""
    closed_part = ""
    if best is not None and best.closed_fraction is not None:
        c, verb = best.closed_fraction, "close" if len(best.effects) > 1 else "closes"
        closed_part = (
            f", which {verb} {100 * c.mean:.0f}% of the gap ({100 * c.low:.0f} to {100 * c.high:.0f}%)"
        )
    match verdict:
        case "NO_GAP":
            seen = "A gap was found, but predictions err by no more than the tolerance that was set."
            return seen if tolerated else "No gap was found between the twin and the data."
        case "LISTED":
            return f"The gap comes from {name}{closed_part}."
        case "LISTED_WITH_REMAINDER":
            much = "Part" if best and best.closed_fraction and best.closed_fraction.mean < _MOST else "Most"
            return f"{much} of the gap comes from {name}{closed_part}; {_rest(evidence)} left."
        case "UNLISTED":
            sites = [s for s in evidence.after.sites[:2] if s.p_value <= 0.01]
            at = _most_at(sites[0], evidence.before.coordinates) if sites else ""
            tail = f" It shows at {', '.join(map(_place, sites))}{at}." if sites else ""
            verb = "imitate" if best is not None and len(best.effects) > 1 else "imitates"
            part = (
                f" {name} {verb} part of it." if best is not None and best.closed_fraction is not None else ""
            )
            why = (
                ", and none of the known effects explains it"
                if evidence.problem.effects
                else "; no effects were given that could explain it"
            )
            return f"There is a gap{why}.{tail}{part}"
        case _:
            if best is None:
                return "There are signs of a gap, but the data cannot tell which effect causes it."
            return _undecided(best.alias_class)


def _rest(evidence: Evidence) -> str:
    """What an answer leaves: the sites' remainder, or what was not looked for any more."""
    if not evidence.asked_for:
        return "something that no known effect explains is"
    count = len(evidence.accepted)
    looked = "only one effect was" if count == 1 else f"only {count} effects were"
    return f"{looked} looked for, and {' and '.join(evidence.asked_for)} may explain some of what is"


def _undecided(sets: Sequence[Sequence[str]]) -> str:
    """What the explanations have in common, if anything, and what cannot be told apart."""
    if len(sets) == 1:
        return f"There are signs of {' and '.join(sets[0])}, but held-out data do not confirm that it closes a gap."
    common = [name for name in sets[0] if all(name in names for names in sets)]
    rests = [" and ".join(name for name in names if name not in common) for names in sets]
    if not common:
        return f"There is a gap, but the data cannot tell {' or '.join(rests)} apart."
    sure, choice = " and ".join(common), " or ".join(rest for rest in rests if rest)
    if "" in rests:
        return f"The gap comes from {sure}, perhaps together with {choice}: the data cannot tell."
    return f"The gap comes from {sure} together with {choice}, and the data cannot tell which."


def _most_at(first: SiteFinding, blocks: Sequence[CoordinateFinding]) -> str:
    """Where most of it is, in the words of the first site, or the block of the data that stands out most."""
    if first.place is not None:
        return f"; most of it at {first.place}"
    worst = max(blocks, key=lambda block: block.excess, default=None)
    if first.whereabouts is not None or worst is None:
        return ""
    ends = f"{worst.low}" if worst.low == worst.high else f"{worst.low} to {worst.high}"
    return f", and in the data most at {worst.axis} {ends}"


def _place(found: SiteFinding) -> str:
    """A site, or a moment of an observation, as text, and where there."""
    what, _, whither = (found.moment or "").partition(" ")
    site = f"the {what} of {found.site} {whither}".rstrip() if what else found.site
    return f"{site} ({found.whereabouts})" if found.whereabouts else site


def _tried(evidence: Evidence) -> list[dict[str, Any]]:
    """The named set and others that were fitted in full, the likeliest first; nothing where none was named."""
    fits = {n: one for n, one in evidence.tried.items() if np.isfinite(one.fitted.log_evidence)}
    worth = {names: credit(evidence.problem, one.fitted, evidence.base) for names, one in fits.items()}
    return [
        {
            "effects": list(names),
            "gain_nats": fits[names].fitted.log_evidence - evidence.base.log_evidence,
            "behind_nats": worth[evidence.accepted] - worth[names],
        }
        for names in sorted(fits, key=lambda names: (names != evidence.accepted, -worth[names]))
    ]


def _gap(evidence: Evidence) -> dict[str, Any]:
    n = evidence.problem.observed.count
    best = evidence.floor.best
    before = (best - float(evidence.held_before.log_likelihood.sum())) / n
    after = (best - float(evidence.held_after.log_likelihood.sum())) / n if evidence.accepted else None
    held_after = evidence.held_after if evidence.accepted else None
    terms = in_user_terms(evidence.problem, evidence.held_before, held_after)
    return {
        "unit": "nats per observation",
        "before": before,
        "after": after,
        "floor": [0.0, max((best - evidence.floor.low) / n, 0.0)],
        "in_user_terms": {name: list(pair) for name, pair in terms.items()},
        "own": sorted(block.name for block in evidence.problem.blocks_of(None) if block.local),
    }


def _remainder(evidence: Evidence) -> dict[str, Any] | None:
    """How far a model of what is left, at its site, carries on held-out clusters."""
    found = evidence.remainder
    if found is None:
        return None
    gain = float((found.held.log_likelihood - evidence.held_after.log_likelihood).sum())
    return {
        "terms": [asdict(term) for term in found.terms],
        "closed_fraction": asdict(found.closed),
        "gain_nats": gain,
        "before": asdict(found.before),
        "after": asdict(found.after),
    }


def _screening(evidence: Evidence) -> list[dict[str, Any]]:
    first, refitted = evidence.steps[0].view.screening, evidence.steps[0].trials.fits
    effects = {e.name: e for e in evidence.problem.effects}
    order = np.argsort(
        first.adjusted + 1e-3 * (1 - np.clip(first.log_bayes_factor / 1e3, 0, 1)), kind="stable"
    )
    return [
        {
            "effect": first.names[i],
            "sites": list(effects[first.names[i]].sites),
            "kind": effects[first.names[i]].kind,
            "z": first.z[i],
            "p_value": first.p_value[i],
            "adjusted_p_value": first.adjusted[i],
            "absorbed_by": None if first.names[i] in refitted else first.absorbed_by[i],
            "opposite": first.opposite[i],
            "beyond": first.beyond[i],
            "spreads": spreads_only(effects[first.names[i]], evidence, locates=first.locates[i]),
        }
        for i in map(int, order)
    ]


def spreads_only(effect: Effect, evidence: Evidence, *, locates: bool) -> bool:
    """Whether an effect moves nothing but how observations spread; a random field does where its sites do."""
    if effect.kind == "mean":
        return not locates
    spreading = {found.site for found in evidence.before.sites if found.spreads}
    return set(effect.sites) <= {*spreading, *evidence.problem.declaration.observed}


def _alike(first: Screening) -> dict[str, Any]:
    """How much candidates look alike, for those who judge what could be told apart: rows below the diagonal."""
    if len(first.names) > _MOST_ALIKE:
        return {}
    rows = [np.round(100 * row[:k]).astype(int).tolist() for k, row in enumerate(first.correlation)]
    return {"alike": {"effects": list(first.names), "percent": rows}}


def _fit(evidence: Evidence, key: jax.Array) -> dict[str, Any]:
    problem, fitted = evidence.problem, evidence.base
    names = {b.name for b in problem.blocks_of(None) if not b.local}
    draws: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for x in shared_draws(problem, fitted, _DRAWS, key):
        for name, value in problem.compiled.sites(x).items():
            if name in names:
                draws[name].append(np.asarray(value).reshape(-1))
    contraction = _contraction(evidence)
    nuisances = []
    for name in (n for n in problem.declaration.latent if n in names):
        values = np.stack(draws[name])
        possible = np.isfinite(values).all(axis=0)  # what cannot happen has log-probability -inf
        for j in np.flatnonzero(possible):
            low, high = np.quantile(values[:, j], [0.05, 0.95])
            label = name if values.shape[1] == 1 else f"{name}[{j}]"
            nuisances.append(
                {
                    "name": label,
                    "mean": values[:, j].mean(),
                    "low": low,
                    "high": high,
                    "contraction": contraction[name][j],
                }
            )
    return {
        "nuisances": nuisances,
        "converged": fitted.converged,
        "n_clusters": problem.n_cluster,
        "n_observations": problem.observed.count,
        "warnings": list(evidence.notes),
    }


def _contraction(evidence: Evidence) -> Mapping[str, np.ndarray]:
    """1 - posterior variance / prior variance of each global nuisance, in unconstrained coordinates."""
    problem, fitted = evidence.problem, evidence.base
    deviation = problem.prior_spread.deviation.copy()
    for names, (_, precision) in problem.known.items():
        deviation[problem.layout.indices(names)] = np.sqrt(np.diag(np.linalg.inv(precision)))
    change = np.zeros(problem.dimension)
    variance = np.diag(fitted.covariance) / np.maximum(deviation[fitted.global_index], 1e-300) ** 2
    change[fitted.global_index] = np.clip(1 - variance, 0.0, 1.0)
    result = {}
    for block in (b for b in problem.blocks_of(None) if not b.local):
        own, size = change[block.index[0]], problem.declaration.sites[block.name].size
        result[block.name] = own if len(own) == size else np.full(size, own.mean())
    return result


def _seed(key: jax.Array) -> int:
    return int(np.asarray(jax.random.key_data(key)).reshape(-1)[-1])
