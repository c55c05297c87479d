"""What rows tell: their counts, the law of the tables after them, and the evidence that the network is another."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy import special

from dtprob.data import NetworkLog
from dtprob.inference.exact import DirichletTables
from dtprob.models.dirichlet import log_marginal
from dtprob.models.multi_access import priors, records, window_counts
from dtprob.models.multi_access.records import WINDOW
from dtprob.twin import statistics
from dtprob.workflow.loop.physical import Rows
from dtprob.workflow.loop.settings import TwinCase
from dtprob.workflow.loop.state import State, Tables

ARRIVAL: Final = "log_arrival"
RECEPTION: Final = "log_reception"
_LIKELY: Final = 0.05
"""A factor is forgotten whose probability to have changed is at least this."""
_DRAWS: Final = 400
_LONGEST: Final = 128
"""Windows that a change may have lasted before it is noticed."""


def log_of(rows: Rows, first: int = 0, last: int | None = None) -> NetworkLog:
    """Some of the rows as a checked log.

    Raises:
        InputError: rows that cannot be.
    """
    return NetworkLog(**{name: column[first:last] for name, column in rows.items()})


def row_counts(
    case: TwinCase, rows: Rows, first: int = 0, last: int | None = None
) -> dict[str, Float[np.ndarray, "row ..."]]:
    """How often each of some rows saw each entry of the tables; once, that is.

    Raises:
        InputError: rows that cannot be.
    """
    counts = window_counts(_recorded(case, rows, first, last, 1), memory=case.memory)
    return {name: each[min(first, 1) :] for name, each in counts.items()}


def known(case: TwinCase, state: State, last: int | None = None) -> DirichletTables:
    """The law of the tables after the rows that count, up to one."""
    law = DirichletTables(state.prior)
    if state.since >= (state.slots if last is None else last):
        return law
    counts = window_counts(_recorded(case, state.rows, state.since, last, WINDOW), memory=case.memory)
    return law.updated({name: each.sum(axis=0) for name, each in counts.items()})


def _recorded(case: TwinCase, rows: Rows, first: int, last: int | None, window: int) -> dict[str, Any]:
    """The model's arguments from some rows, with one more before them that tells what arrived last, but does not count."""
    kernel = case.kernel
    log = log_of(rows, max(first - 1, 0), last)
    arguments = records(log, clusters=kernel.clusters.members, capacity=kernel.capacity, window=window)
    arguments["valid"][0, 0] = first == 0
    return arguments


def factors(counts: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Tables, or their counts, by factor: the arrivals of each cluster apart, and the reception."""
    arrival = np.moveaxis(counts[ARRIVAL], -3, 0)
    return {f"arrivals[{i}]": each for i, each in enumerate(arrival)} | {"reception": counts[RECEPTION]}


class Watched(NamedTuple):
    """What the monitor says.

    Attributes:
        detector: log of the Shiryaev-Roberts detector after each window.
        alarm: the window in which it called; None while it did not.
        changed: the row from which on the network is most likely another.
        blame: probability of each factor to be the one that changed.
    """

    detector: Float[np.ndarray, " window"]
    alarm: int | None
    changed: int
    blame: dict[str, float]


def watch(case: TwinCase, state: State) -> Watched:
    """Judge the windows that are watched, by the exact evidence of new tables against those learned from all rows before.

    A Shiryaev-Roberts detector with one new law for all windows since each possible time of a change: what they have in
    common counts, so that a small change that lasts is found too. Of windows that were judged before, `state.detector`
    tells.
    """
    width = case.loop.window
    count = (state.slots - state.watched) // width
    judged = len(state.detector)
    path = state.detector
    if count > judged:
        mixed = statistics.mixed(_evidence(case, state, judged, count))
        path = np.concatenate([path, np.asarray(special.logsumexp(mixed, axis=1))])
    crossed = np.flatnonzero(path >= np.log(case.loop.run_length))
    alarm = int(crossed[0]) if crossed.size else None
    last = count - 1 if alarm is None else alarm
    final = {name: each[0] for name, each in _evidence(case, state, last, last + 1).items()}
    changed = state.watched + width * (last - int(np.argmax(statistics.mixed(final))))
    blame = statistics.shares(
        {name: float(np.asarray(special.logsumexp(each))) for name, each in final.items()}
    )
    return Watched(path, alarm, changed, blame)


def _evidence(
    case: TwinCase, state: State, begin: int, end: int
) -> dict[str, Float[np.ndarray, "window lag"]]:
    """`evidence_since` of each factor in some of the windows that are watched."""
    width, oldest = case.loop.window, max(0, begin + 1 - _LONGEST)
    first, last = (state.watched + number * width for number in (oldest, end))
    learned = factors(known(case, state, first).concentration)
    fresh = factors(priors(case.kernel.clusters, case.concentration, memory=case.memory))
    found: dict[str, Float[np.ndarray, "window lag"]] = {}
    for name, rows in factors(row_counts(case, state.rows, first, last)).items():
        windows = rows.reshape(end - oldest, width, *rows.shape[1:]).sum(axis=1)
        found[name] = evidence_since(fresh[name], learned[name], windows)[begin - oldest :]
    return found


def evidence_since(
    fresh: Float[np.ndarray, "*row outcome"],
    learned: Float[np.ndarray, "*row outcome"],
    windows: Float[np.ndarray, "window *row outcome"],
) -> Float[np.ndarray, "window lag"]:
    """Log Bayes factors of a new law against the known one for all of a window and the `lag` windows before it.

    What is known then is what was learned and all windows before these, so that what comes after a change is compared with
    ever more of what came before. While all come from one network of the learned law, the exponential's mean is 1.

    Args:
        fresh: concentrations of the tables that a change brings.
        learned: those of the tables before the first window.
        windows: how often each outcome happened.
    """
    total = np.concatenate([np.zeros_like(windows[:1]), np.cumsum(windows, axis=0)])
    known_law = log_marginal(learned, total).reshape(len(total), -1).sum(axis=1)
    found = np.full((len(windows), min(_LONGEST, len(windows))), -np.inf)
    for end in range(1, len(total)):
        starts = np.arange(end)[::-1][:_LONGEST]
        new_law = log_marginal(fresh, total[end] - total[starts]).reshape(len(starts), -1).sum(axis=1)
        found[end - 1, : len(starts)] = new_law - (known_law[end] - known_law[starts])
    return found


def forget(case: TwinCase, state: State, blame: Mapping[str, float]) -> tuple[Tables, tuple[str, ...]]:
    """What is still known after a change: the tables of the factors that changed begin anew."""
    before = known(case, state, state.changed).concentration
    fresh = priors(case.kernel.clusters, case.concentration, memory=case.memory)
    gone = tuple(name for name, probability in blame.items() if probability >= _LIKELY)
    again = [f"arrivals[{i}]" in gone for i in range(len(fresh[ARRIVAL]))]
    arrival = np.where(np.array(again)[:, None, None], fresh[ARRIVAL], before[ARRIVAL])
    reception = fresh[RECEPTION] if "reception" in gone else before[RECEPTION]
    return {ARRIVAL: arrival, RECEPTION: reception}, gone


def summary(law: DirichletTables, key: jax.Array) -> dict[str, Any]:
    """Means and 90% intervals of the probabilities, by factor and row; rows with one outcome are left out."""
    drawn = factors({name: np.exp(value) for name, value in law.sample(key, _DRAWS).items()})
    means = factors(law.concentration)
    told: dict[str, Any] = {}
    for name, draws in drawn.items():
        for row in range(draws.shape[-2]):
            weight = means[name][row]
            if np.sum(weight > 0) > 1:
                low, high = np.quantile(draws[:, row], [0.05, 0.95], axis=0)
                mean = weight / weight.sum()
                columns = {"mean": mean, "low": low, "high": high}
                told[f"{name} row {row}"] = {n: np.round(c, 4).tolist() for n, c in columns.items()}
    return told
