"""At which places effects are looked for: those that they name, or quantiles of priors where the usual ones tell nothing.

An effect of one size that names no places is scored where its places usually are. If nothing that is observed shows it
there, as the compression of signals that are all weaker than a receiver's usual knee, that says nothing of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.fitting.plausible import scales, sizes
from dtprob.gap.model.problem import Problem

_LEAST: Final = 1.0
"""Information at the largest plausible size below which data tell nothing: it is not a standard deviation."""
_FAR: Final = 2.5
"""Standard deviations of a normal prior, or quantiles as rare, out to which places are tried."""
_ALONG: Final = 21
"""Quantiles of one place that are tried."""
_TOGETHER: Final = 512
"""Combinations of quantiles that are tried, about."""
_MOST: Final = 4
"""Places of one effect that are looked for together."""
_DRAWS: Final = 4001

type Values = tuple[np.ndarray, ...]
"""Values of each parameter of an effect that are tried, one alone where it stays as it is."""


def may_be_anywhere(effect: Effect) -> bool:
    """Whether an effect is looked for at several places, in any case or where nothing shows it at the usual one."""
    return effect.is_looked_for or bool(_free(effect))


def offered(
    problem: Problem, effects: Sequence[Effect], values: Mapping[str, jax.Array], drawn: Replicates
) -> dict[str, Values]:
    """What is tried of each effect that is looked for, by name.

    Once an effect has been found at a place that it does not name, it is looked for beside other effects, too.

    Args:
        problem: the model and candidates on their data.
        effects: some of the candidates.
        values: of the sites at the fit.
        drawn: site gradients of the data and of replicates there.
    """
    found = {e.name: tuple(np.array(p.tried or (p.null,)) for p in e.parameters) for e in effects}
    fixed = [e for e in effects if not e.is_looked_for]
    tangents = problem.programs.site_tangents(values, ()) if any(map(_free, fixed)) else {}
    for effect in fixed:
        free, usual = {p.name for p in _free(effect)}, problem.programs.declared(effect.name)
        has_moved = any(p.null != q.null for p, q in zip(effect.parameters, usual.parameters, strict=True))
        if free and (has_moved or _information(effect, tangents[effect.name], drawn) < _LEAST):
            count = min(int(_TOGETHER ** (1 / len(free))), _ALONG)
            found[effect.name] = tuple(
                _quantiles(p, count) if p.name in free else np.array([p.null]) for p in usual.parameters
            )
        else:
            del found[effect.name]
    return found


def _free(effect: Effect) -> list[Parameter]:
    """The places of a mean effect of one size that names none of them, if all that it rewrites are computed values."""
    if effect.kind != "mean" or effect.is_looked_for or effect.distributions or len(sizes(effect)) != 1:
        return []
    single = [p for p in effect.parameters if p.is_place and not p.shape]
    return single if len(single) <= _MOST else []


def _information(effect: Effect, tangents: Mapping[str, jax.Array], drawn: Replicates) -> float:
    """Variance of the score of its largest plausible size at the usual places in the replicates."""
    (size,) = sizes(effect)
    score = np.zeros(drawn.at_sites)
    for site, gradient in drawn.gradients.items():
        if site in tangents:
            moved = np.broadcast_to(np.asarray(tangents[site])[..., size], gradient.shape[1:]).reshape(-1)
            score += np.real(np.asarray(gradient[1:]).reshape(len(score), -1) @ moved)
    return float(np.mean(score**2) * scales(effect)[size] ** 2)


def _quantiles(parameter: Parameter, count: int) -> Float[np.ndarray, " value"]:
    """Quantiles of the prior of a place, as of so many equally spaced values of a normal one."""
    chances = stats.norm.cdf(np.linspace(-_FAR, _FAR, count))
    try:
        found = np.asarray(parameter.prior.icdf(chances))
    except (NotImplementedError, ImportError):
        found = np.quantile(np.asarray(parameter.prior.sample(jax.random.key(0), (_DRAWS,))), chances)
    return np.unique(found)
