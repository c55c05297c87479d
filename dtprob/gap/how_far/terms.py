"""How large a gap is in the user's own terms: errors of predictions of clusters that the fit has not seen."""

from __future__ import annotations

import numpy as np

from dtprob.gap.how_far.closed import HeldOut
from dtprob.gap.model.problem import Problem


def in_user_terms(
    problem: Problem, before: HeldOut, after: HeldOut | None
) -> dict[str, tuple[float, float | None]]:
    """Errors before and after the causes are added, by what they are called.

    Of complex sites the normalised mean square in dB (`channel_nmse_db`), of log-normal ones the root mean square in dB
    (`power_rmse_db`), of others that have a mean the root mean square in the unit of the data (`label_rmse`); of measures
    that the model declares the root mean square over clusters.
    """
    terms = {}
    for name in before.misses:
        first = _error(problem, before, name)
        second = None if after is None else _error(problem, after, name)
        terms[_called(problem, name)] = (first, second)
    return terms


def _called(problem: Problem, name: str) -> str:
    if name not in problem.declaration.observed:
        return name
    if problem.declaration.sites[name].is_complex:
        return f"{name}_nmse_db"
    return f"{name}_rmse" + ("_db" if problem.families[name] == "LogNormal" else "")


def _error(problem: Problem, held: HeldOut, name: str) -> float:
    miss = held.misses[name]
    site = problem.declaration.observed.get(name)
    if site is not None and site.is_complex:
        return _decibels(miss.error.sum(), miss.signal.sum())
    return float(np.sqrt(miss.error.sum() / max(miss.count.sum(), 1.0)))


def _decibels(error: float, signal: float) -> float:
    return float(10 * np.log10(max(float(error) / max(float(signal), 1e-300), 1e-300)))


def error_db(problem: Problem, held: HeldOut) -> float | None:
    """One error in dB over all sites: normalised mean square, of powers root mean square; None where there is neither."""
    seen = [held.misses[name] for name in held.misses if name in problem.declaration.observed]
    with_signal = [miss for miss in seen if np.sum(miss.signal) > 0]
    error = sum(float(np.sum(miss.error)) for miss in with_signal)
    signal = sum(float(np.sum(miss.signal)) for miss in with_signal)
    if signal <= 0:
        return None
    return float(np.sqrt(error / signal)) if problem.has_powers else _decibels(error, signal)
