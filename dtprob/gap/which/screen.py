"""Which effect: nuisance-adjusted scores of all candidates at once, with a bootstrapped family-wise threshold.

Source: Neyman's C(alpha) score, u = sum_i (s_i - B r_i) with variance J = I_ee - B I_te (Bera & Yoon 1993); variance
effects by the second-order score of a random field (one-sided); significance by the parametric bootstrap of the smallest
p-value over all candidates (Westfall & Young's min-p).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy import stats

from dtprob.effects.effect import Effect
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.bootstrap import Replicates, more
from dtprob.gap.fitting.plausible import is_one_sided, places, scales, sizes
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.tails import any_of, deviation, effective_tests
from dtprob.gap.vocabulary import UNSEEN
from dtprob.gap.which.detectable import Detectable, detectable
from dtprob.gap.which.directions import surroundings, tangents
from dtprob.gap.which.fields import tests_of_fields
from dtprob.gap.which.places import Placed
from dtprob.gap.which.scores import NOTHING, Scores, mean_scores, mean_tests

_ABSORBED = 0.98
_SEEN = 25.0
_SHOWN = 10.0
"""Nats of an effect that the data show, however much of it nuisances could take up."""
_FAR = 4.0
"""Standard deviations of its prior from which on a size is one that the prior all but excludes."""
_SURE = 1e-6
"""Family-wise p-value of a random field at which a gap is sure, however skew its energy is."""


@dataclass(frozen=True)
class Screening:
    """Scores of all candidates at one fit.

    Attributes:
        names: the candidates.
        z: signed scores for one size, otherwise the normal quantile of the chi-square p-value.
        p_value: of each candidate alone.
        adjusted: family-wise p-value over all candidates.
        log_bayes_factor: of adding the candidate, from (u, J) and its prior.
        step: one-step estimate of each mean effect's parameters, flat.
        absorbed_by: the nuisance that hides the candidate, if one does.
        opposite: whether the data surely ask for a size on the side that the prior of the candidate's only one excludes.
        beyond: what the data alone ask for over what the prior of the candidate's only size calls usual, to first order
            where they surely ask for it and it is far; None elsewhere.
        detectable: from which size on each would be noticed nine times in ten; None of random fields.
        correlation: of the candidates' scores after adjustment; aliases are near +-1.
        locates: whether a candidate says how the expected observations move, not only how they spread.
        scores: of the mean effects among them.
    """

    names: tuple[str, ...]
    z: np.ndarray
    p_value: np.ndarray
    adjusted: np.ndarray
    log_bayes_factor: np.ndarray
    step: dict[str, np.ndarray]
    absorbed_by: tuple[str | None, ...]
    opposite: tuple[bool, ...]
    beyond: tuple[float | None, ...]
    detectable: tuple[Detectable | None, ...]
    correlation: np.ndarray
    locates: tuple[bool, ...]
    scores: Scores

    def promise_of(self, name: str) -> float:
        """Nats that a candidate promises to gain, to first order and less what its prior costs."""
        return float(self.log_bayes_factor[self.names.index(name)])

    def shows_gap(self, settings: Settings) -> bool:
        """Whether the scores show a gap at their half of the level."""
        return float(self.adjusted.min(initial=1.0)) <= settings.level / 2

    def pays_for(self, name: str, most: float, settings: Settings) -> bool:
        """Whether a candidate's score shows a gap at its half of the level, or another's that tells of no more nats."""
        shown = self.adjusted <= settings.level / 2
        return bool((shown & ((np.array(self.names) == name) | (self.z**2 / 2 <= most))).any())


def screen(
    problem: Problem,
    fitted: fitting.Fit,
    projection: Projection,
    drawn: Replicates,
    settings: Settings,
    *,
    placed: Mapping[str, Placed] = MappingProxyType({}),
) -> Screening:
    """Score every candidate that the fit does not already contain.

    Args:
        problem: the model and candidates on their data.
        fitted: the fit.
        projection: of rows there.
        drawn: the data and replicates there.
        settings: the level that is to be noticed.
        placed: how the places of effects that may act anywhere were found, by name.
    """
    candidates = [e for e in problem.effects if e.name not in fitted.effects]
    means = [e for e in candidates if e.kind == "mean"]
    fields = [e for e in candidates if e.kind == "variance"]
    around = surroundings(problem, fitted.x)
    told = mean_scores(
        problem,
        projection,
        drawn,
        tangents(around, means, problem.programs, projection.centre),
    )
    scores = replace(told, price=np.array([placed[e.name].price if e.name in placed else 0.0 for e in means]))
    tested = tests_of_fields(problem, around, fields, drawn, placed)
    (mean_p, mean_z), null_p = mean_tests(scores, scores.u[None]), mean_tests(scores, scores.u_null)[0]
    for k, found in ((k, placed[e.name]) for k, e in enumerate(means) if e.name in placed):
        mean_p[0, k], null_p[:, k] = found.p_value, 1.0
        one_sided = is_one_sided(means[k])
        z = deviation(found.p_value, one_sided=one_sided)
        mean_z[0, k] = z if one_sided else np.copysign(z, mean_z[0, k])
    replicate_p = _smallest(
        null_p.min(axis=1, initial=1.0), *(found.replicate_p for found in placed.values())
    )
    together = _smallest(replicate_p, tested.replicates.min(axis=1)) if fields else replicate_p
    tests = effective_tests(together)
    times = drawn.most(settings.site_times)
    if times > 1 and _is_open(tested.smallest, mean_p, tests, settings):
        tested = tests_of_fields(problem, around, fields, more(drawn, times), placed)
        of_means = effective_tests(replicate_p) if means else 0.0
        tests = of_means + effective_tests(tested.replicates.min(axis=1))
    smallest = np.concatenate([mean_p[0], tested.smallest])
    names = [e.name for e in (*means, *fields)]
    order = np.array([names.index(c.name) for c in candidates], int)
    above, below = (any_of(p, tests) for p in (mean_p[0], stats.norm.cdf(mean_z[0])))
    opposite, beyond = _excluded(scores, above, below, placed, settings)
    reach = np.sqrt(np.einsum("cmg,cmg->g", projection.columns, projection.columns))
    log_bf = np.concatenate([scores.log_bayes_factor, tested.log_bayes_factor])
    return Screening(
        names=tuple(c.name for c in candidates),
        z=np.concatenate([mean_z[0], tested.z])[order],
        p_value=np.concatenate([mean_p[0], tested.p_value])[order],
        adjusted=any_of(smallest, tests)[order],
        log_bayes_factor=log_bf[order],
        step={e.name: scores.step(k) for k, e in enumerate(means)},
        absorbed_by=tuple(_absorbed(problem, fitted, scores, reach, c) for c in candidates),
        opposite=tuple(c.name in opposite for c in candidates),
        beyond=tuple(beyond.get(c.name) for c in candidates),
        detectable=tuple(_detectable(scores, c, placed.get(c.name), settings) for c in candidates),
        correlation=_correlation(candidates, scores),
        locates=tuple(c.name in scores.locating for c in candidates),
        scores=scores,
    )


def _smallest(replicate_p: np.ndarray, *others: np.ndarray) -> np.ndarray:
    """Smallest p-value in each of the replicates that all have, which are the first of the same data sets."""
    for other in others:
        replicate_p = np.minimum(replicate_p[: len(other)], other[: len(replicate_p)])
    return replicate_p


def _excluded(
    scores: Scores, above: np.ndarray, below: np.ndarray, placed: Mapping[str, Placed], settings: Settings
) -> tuple[set[str], dict[str, float]]:
    """Effects of one size that data ask for on the side that its prior excludes, and how far out others are, if far.

    Args:
        scores: of the mean effects.
        above: family-wise p-values of the sizes that the priors allow.
        below: the same of those on the other side.
        placed: effects whose place was looked for, of which nothing is said.
        settings: the level.
    """
    alone = [(k, e) for k, e in enumerate(scores.effects) if len(sizes(e)) == 1 and e.name not in placed]
    level = settings.level / 2
    opposite = {e.name for k, e in alone if is_one_sided(e) and below[k] <= level}
    asked = {e.name: scores.asked(k) for k, e in alone if above[k] <= level}
    return opposite, {name: size for name, size in asked.items() if size > _FAR}


def _is_open(fields: np.ndarray, means: np.ndarray, tests: float, settings: Settings) -> bool:
    """Whether fields alone show a gap, by p-values so large that a hundred replicates do not tell how rare they are."""
    least = fields.min(initial=1.0)
    is_open = _SURE < float(any_of(least, tests)) <= settings.level / 2
    return is_open and bool(least < means.min(initial=1.0))


def _absorbed(
    problem: Problem, fitted: fitting.Fit, scores: Scores, reach: np.ndarray, effect: Effect
) -> str | None:
    """The nuisance that explains nearly all of an effect's own information; `reach`: how far each moves predictions."""
    if effect.kind != "mean":
        return None
    k = [e.name for e in scores.effects].index(effect.name)
    group = scores.groups[k]
    if scores.total[group].max(initial=0.0) == 0.0:
        return UNSEEN
    own = np.diag(scores.part(k))
    left = own / np.maximum(scores.total[group], 1e-300)
    if left.max() > 1 - _ABSORBED or (own * scales(scores.effects[k]) ** 2).max() > _SEEN:
        return None
    if scores.log_bayes_factor[k] > _SHOWN:
        return None
    blocks = [b for b in activate(problem, fitted.effects).blocks if not b.local]
    owners = np.concatenate([[i] * b.size for i, b in enumerate(blocks)]) if blocks else np.zeros(0, int)
    if not len(owners):
        return "the clusters' own parameters"
    share = np.abs(scores.coefficients[:, group]) @ scales(effect) * reach
    return blocks[int(owners[int(np.argmax(share))])].name


def _detectable(
    scores: Scores, effect: Effect, found: Placed | None, settings: Settings
) -> Detectable | None:
    """From which size on a candidate would be noticed, if it moves an expectation or has another size to tell of.

    Of one that may act anywhere at a typical place: at its best one, to which chance has led, that may be another size.
    """
    if effect.kind != "mean":
        return None
    k = [e.name for e in scores.effects].index(effect.name)
    own, total = np.diag(scores.part(k)), scores.total[scores.groups[k]]
    own = np.where(own > NOTHING * total, own, 0.0)
    if found is not None:
        own = np.where(places(effect), own, found.information)
    level = settings.level / (2 * max(len(scores.effects), 1) * float(np.exp(scores.price[k])))
    return detectable(effect, own, scores.root(k).shape[1], level)


def _correlation(candidates: list[Effect], scores: Scores) -> np.ndarray:
    """Correlation of the candidates' scores, of several parameters the largest canonical one; zero without information."""
    result = np.eye(len(candidates))
    roots: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for k, (effect, group) in enumerate(zip(scores.effects, scores.groups, strict=True)):
        root = scores.root(k)
        if root.shape[1]:
            roots[effect.name] = (group, root)
    for a, left in enumerate(candidates):
        for b, right in enumerate(candidates[:a]):
            if left.name in roots and right.name in roots:
                (g, u), (h, v) = roots[left.name], roots[right.name]
                shared = u.T @ scores.information[np.ix_(g, h)] @ v
                single = shared.size == 1
                value = float(shared[0, 0]) if single else float(np.linalg.svd(shared, compute_uv=False)[0])
                result[a, b] = result[b, a] = float(np.clip(value, -1.0, 1.0))
    return result
