"""What likelihoods of windows say about a change: statistics, thresholds whose false alarms are bounded, detectors.

Source of the disagreement statistic: Ruah, Simeone and Al-Hashimi, arXiv 2212.01351, here with likelihoods in log space;
of thresholds: conformal prediction (Vovk et al.); of the sequential detector: Shin, Ramdas and Rinaldo, E-detectors,
New England Journal of Statistics in Data Science (2023).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy import special

from dtprob.errors import InputError


def disagreement(likelihood: Float[np.ndarray, "draw window"]) -> Float[np.ndarray, " window"]:
    """Standard deviation of the log likelihood over draws, nats; large where the ensemble disagrees.

    It has no bound where a draw says that the window cannot be.
    """
    can_be = np.all(likelihood > -np.inf, axis=0)
    return np.where(can_be, np.std(np.where(can_be, likelihood, 0.0), axis=0), np.inf)


def log_predictive(likelihood: Float[np.ndarray, "draw window"]) -> Float[np.ndarray, " window"]:
    """Log of the mean likelihood over draws; of a point estimate, its log likelihood."""
    return special.logsumexp(likelihood, axis=0) - np.log(len(likelihood))


def surprise(likelihood: Float[np.ndarray, "draw window"]) -> Float[np.ndarray, " window"]:
    """Minus `log_predictive`, nats; with one draw the frequentist's statistic."""
    return -log_predictive(likelihood)


def log_evidence(
    changed: Float[np.ndarray, "draw window"], normal: Float[np.ndarray, "draw window"]
) -> Float[np.ndarray, " window"]:
    """Log Bayes factor for a change: each window under new parameters against the learned ones.

    Its exponential is an e-value: its mean is at most 1 while windows come from the learned model.

    Args:
        changed: likelihoods under draws of what a change may bring, such as the prior.
        normal: likelihoods under draws of the posterior. A window that cannot be under any of them is a change for sure.
    """
    learned = log_predictive(normal)
    can_be = learned > -np.inf
    return np.where(can_be, log_predictive(changed) - np.where(can_be, learned, 0.0), np.inf)


def threshold(normal: Float[np.ndarray, " window"], rate: float) -> float:
    """The value that a statistic of a normal window exceeds with probability `rate` or less.

    The bound holds exactly, whatever the statistic, over normal windows that the statistic was not tuned on and that
    are exchangeable with the next one.

    Args:
        normal: the statistic of held-out normal windows.
        rate: probability of a false alarm per window.

    Raises:
        InputError: a rate outside of (0, 1), too few windows for it, one whose statistic is not a number, or so many that
            cannot be that nothing would ever be an alarm.
    """
    check_rate(rate)
    if np.isnan(normal).any():
        got = f"NaN in {int(np.isnan(normal).sum())} of {len(normal)}"
        raise InputError(
            "statistic of normal windows", "a number of each window", got, "Correct what it is told from"
        )
    n = len(normal)
    place = int(np.ceil((n + 1) * (1 - rate) - 1e-9))
    if place > n:
        needed = int(np.ceil(1 / rate)) - 1
        remedy = "Log more normal slots, choose shorter windows, or allow more false alarms"
        raise InputError(f"whole normal windows for a rate of {rate:g}", f"{needed} or more", str(n), remedy)
    found = float(np.sort(normal)[place - 1])
    if np.isposinf(found):
        got = f"{int(np.isposinf(normal).sum())} of {n} that cannot be under any draw"
        remedy = "Learn from windows like these, or leave out those that are not normal"
        raise InputError("normal windows", "windows that can be under what was learned", got, remedy)
    return found


def check_rate(rate: float) -> None:
    """Refuse what is no probability of a false alarm.

    Raises:
        InputError: a rate outside of (0, 1).
    """
    if not 0 < rate < 1:
        raise InputError("rate of false alarms", "a probability between 0 and 1", f"{rate:g}", "Correct it")


def p_value(
    statistic: Float[np.ndarray, " window"], normal: Float[np.ndarray, " calibration"]
) -> Float[np.ndarray, " window"]:
    """Conformal p-value of each window against held-out normal ones."""
    below = np.searchsorted(np.sort(normal), statistic, side="left")
    return (1 + len(normal) - below) / (1 + len(normal))


def detector(evidence: Float[np.ndarray, "... window"], axis: int = -1) -> Float[np.ndarray, "... window"]:
    """Log of the Shiryaev-Roberts detector R_t = (1 + R_{t-1}) e_t, which forgets no possible time of the change.

    An alarm when it first reaches log(n) has a mean time to a false alarm of n windows or more. After a window that
    cannot be without a change it stays infinite.

    Args:
        evidence: log e-value of each window.
        axis: along which windows follow one another.
    """
    steps = np.moveaxis(np.asarray(evidence, float), axis, 0)
    path, last = np.empty_like(steps), np.full(steps.shape[1:], -np.inf)
    for i, step in enumerate(steps):
        last = np.logaddexp(0.0, last) + np.where(np.isposinf(last), np.inf, step)
        path[i] = last
    return np.moveaxis(path, 0, axis)


def mixed(evidence: Mapping[str, Float[np.ndarray, " window"]]) -> Float[np.ndarray, " window"]:
    """One log e-value per window from those of the factors: a change of one factor, any of them alike."""
    stacked = np.stack(list(evidence.values()))
    return special.logsumexp(stacked, axis=0) - np.log(len(stacked))


def blame(evidence: Mapping[str, Float[np.ndarray, " window"]]) -> dict[str, float]:
    """Probability of each factor to be the one that changed, by each one's own detector in the last window."""
    return shares({name: float(detector(each)[-1]) for name, each in evidence.items()})


def shares(evidence: Mapping[str, float]) -> dict[str, float]:
    """Probabilities of alternatives that were alike before, from the log evidence of each.

    Those whose evidence has no bound share all of it; where every one is impossible, none stands out.
    """
    if not evidence:
        return {}
    values = np.array(list(evidence.values()))
    top = values.max()
    weight = special.softmax(values) if np.isfinite(top) else (values == top) / np.sum(values == top)
    return dict(zip(evidence, map(float, weight), strict=True))


def roc(
    statistic: Float[np.ndarray, " window"],
    normal: Float[np.ndarray, " window"],
    changed: Float[np.ndarray, " window"],
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """Probabilities of a false and of a true alarm at every threshold, from none to all.

    Args:
        statistic: of each window, large after a change; ties share a threshold.
        normal: probability of each window without a change; for samples 1 / n for those that are normal, else 0.
        changed: the same after a change.
    """
    values, index = np.unique(statistic, return_inverse=True)
    ends = (np.bincount(index, weights, len(values))[::-1] for weights in (normal, changed))
    false, true = (np.concatenate([[0.0], np.cumsum(mass)]) for mass in ends)
    return false, true


def area(
    statistic: Float[np.ndarray, " window"],
    normal: Float[np.ndarray, " window"],
    changed: Float[np.ndarray, " window"],
) -> float:
    """Area under the curve of `roc`; ties count one half."""
    false, true = roc(statistic, normal, changed)
    return float(np.trapezoid(true, false))
