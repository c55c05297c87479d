"""How large a gap is in the user's own terms: errors of predictions of clusters that the fit has not seen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dtprob.errors import InputError
from dtprob.gap.how_far.closed import HeldOut
from dtprob.gap.model.misses import Miss
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


def check_tolerance(problem: Problem, missed: Mapping[str, Miss], tolerance: float | None) -> None:
    """Refuse a tolerance where predictions have no one error that it could be compared with.

    Raises:
        InputError: what is observed are classes, or several quantities of different units.
    """
    if tolerance is None or _whole_error(problem, missed) is not None:
        return
    raise InputError(
        "tolerance_db",
        "complex channels, powers, or readings of one kind that have a mean",
        ", ".join(f"{name} ({family})" for name, family in problem.families.items()),
        "Leave the tolerance out",
    )


def is_within(problem: Problem, held: HeldOut, tolerance: float) -> bool:
    """Whether predictions of clusters left out err by no more than a tolerance.

    Args:
        problem: the model on its data.
        held: held-out results.
        tolerance: of complex channels in dB below the signal; of all else the root mean square error, of powers in dB, of
            readings in their own unit.
    """
    error = _whole_error(problem, held.misses)
    if error is None:
        return False
    return error <= (-abs(tolerance) if _complex_sites(problem) else abs(tolerance))


def _whole_error(problem: Problem, missed: Mapping[str, Miss]) -> float | None:
    """The error that a tolerance is compared with; None where there is none, or none over all that is observed."""
    relative = [missed[name] for name in _complex_sites(problem) if name in missed]
    if relative:
        return _decibels(sum(m.error.sum() for m in relative), sum(m.signal.sum() for m in relative))
    seen = [missed[name] for name in problem.declaration.observed if name in missed]
    if not seen or (len(seen) > 1 and not problem.has_powers):
        return None
    count = sum(miss.count.sum() for miss in seen)
    return float(np.sqrt(sum(miss.error.sum() for miss in seen) / max(count, 1.0)))


def _complex_sites(problem: Problem) -> list[str]:
    return [name for name, site in problem.declaration.observed.items() if site.is_complex]
