"""What importance weights tell of a stand-in for a posterior.

Source: Vehtari, Simpson, Gelman, Yao and Gabry, Pareto smoothed importance sampling (2024).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

_FEWEST: Final = 25
"""Draws that a tail can be told from."""
_SAME: Final = 1e-6
"""Nats between log weights that are told from rounding."""


def weight_facts(log_weight: Float[np.ndarray, " draw"]) -> dict[str, Any]:
    """What importance weights tell of a guide: the tail index of Pareto's, and the log evidence.

    Args:
        log_weight: log posterior, not normalised, less log density of the guide, at draws of the guide.
    """
    evidence = float(logsumexp(log_weight) - np.log(log_weight.size))
    return {"pareto_k": tail_index(log_weight), "log_evidence": evidence}


def tail_index(log_weight: Float[np.ndarray, " draw"]) -> float:
    """The index k of the largest weights' Pareto tail; above .7 the draws do not stand for the posterior.

    Minus infinity for equal weights, NaN of too few draws, infinity where too few of them are possible at all.

    Args:
        log_weight: as of `weight_facts`; minus infinity for a draw that the posterior does not allow.
    """
    from arviz_stats.base import array_stats  # noqa: PLC0415  (takes a second)

    possible = log_weight[np.isfinite(log_weight)]
    if log_weight.size < _FEWEST:
        return np.nan
    if possible.size < _FEWEST:
        return np.inf
    if np.ptp(possible) < _SAME:
        return -np.inf
    # It takes minus the log weights, as of a likelihood that is left out.
    _, index = array_stats.psislw(-possible)
    return float(index)
