"""Plain scores: how far each candidate's slope is from zero, as if the nuisances had not been fitted to the same data."""

from __future__ import annotations

import numpy as np
from scipy import stats

from dtprob.gap.fitting.plausible import is_one_sided, sizes
from dtprob.gap.tails import log_gamma_tail
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.look import Look, chance

_NOTHING = 1e-9


def unadjusted(seen: Look) -> Claim:
    """Rank by the p-value of Rao's score test with the information of the effect alone, and name the first.

    A random field, which has no such test, is judged by its energy. The alarm is the smallest p-value.

    Args:
        seen: the base fit.
    """
    columns = [_log_p(seen, k) for k in range(len(seen.scores.effects))]
    own = np.stack(columns, axis=1) if columns else np.zeros((len(seen.u), 0))
    log_p = np.concatenate([own, seen.field_log_p], axis=1)
    ranking = tuple(seen.names[i] for i in np.argsort(log_p[0], kind="stable"))
    return Claim(chance(-log_p.min(axis=1)), ranking[:1], ranking)


def _log_p(seen: Look, k: int) -> np.ndarray:
    """Log p-value (1 + replicate,) of one effect."""
    group = seen.scores.groups[k]
    values, vectors = np.linalg.eigh(seen.unadjusted[np.ix_(group, group)])
    keep = values > _NOTHING * max(float(values.max(initial=0.0)), 1e-300)
    if not keep.any():
        return np.zeros(len(seen.u))
    t = seen.u[:, group] @ vectors[:, keep] / np.sqrt(values[keep])
    effect = seen.scores.effects[k]
    if is_one_sided(effect):
        return stats.norm.logsf(t[:, 0] * np.sign(vectors[sizes(effect)[0], keep][0]))
    return log_gamma_tail(0.5 * (t**2).sum(axis=1), keep.sum() / 2)
