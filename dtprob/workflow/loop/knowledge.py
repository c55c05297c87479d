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


def row_counts(case: TwinCase, rows: Rows) -> dict[str, Float[np.ndarray, "row ..."]]:
    """How often each row saw each entry of the tables; once, that is.

    Raises:
        InputError: rows that cannot be.
    """
    kernel = case.kernel
    arguments = records(log_of(rows), clusters=kernel.clusters.members, capacity=kernel.capacity, window=1)
    return window_counts(arguments, memory=case.memory)


def known(case: TwinCase, state: State, last: int | None = None) -> DirichletTables:
    """The law of the tables after the rows that count, up to one."""
    law = DirichletTables(state.prior)
    if state.since >= (state.slots if last is None else last):
        return law
    counts = row_counts(case, state.rows)
    return law.updated({name: each[state.since : last].sum(axis=0) for name, each in counts.items()})


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
    """Judge the windows since the policy was handed over, by the exact evidence of new tables against those learned.

    A Shiryaev-Roberts detector with one new law for all windows since each possible time of a change: what they have in
    common counts, so that a small change that lasts is found too.
    """
    width = case.loop.window
    count = (state.slots - state.handed) // width
    every = factors(row_counts(case, state.rows))
    learned = factors(known(case, state, state.handed).concentration)
    fresh = factors(priors(case.kernel.clusters, case.concentration, memory=case.memory))
    evidence: dict[str, Float[np.ndarray, "window lag"]] = {}
    for name, rows in every.items():
        own = rows[state.handed : state.handed + count * width]
        windows = own.reshape(count, width, *own.shape[1:]).sum(axis=1)
        evidence[name] = evidence_since(fresh[name], learned[name], windows)
    mixed = statistics.mixed(evidence)
    path = np.asarray(special.logsumexp(mixed, axis=1))
    crossed = np.flatnonzero(path >= np.log(case.loop.run_length))
    alarm = int(crossed[0]) if crossed.size else None
    last = count - 1 if alarm is None else alarm
    changed = state.handed + width * (last - int(np.argmax(mixed[last])))
    blame = statistics.shares({n: float(np.asarray(special.logsumexp(e[last]))) for n, e in evidence.items()})
    return Watched(path, alarm, changed, blame)


def evidence_since(
    fresh: Float[np.ndarray, "*row outcome"],
    learned: Float[np.ndarray, "*row outcome"],
    windows: Float[np.ndarray, "window *row outcome"],
) -> Float[np.ndarray, "window lag"]:
    """Log Bayes factors of a new law against the learned one for all of a window and the `lag` windows before it."""
    total = np.concatenate([np.zeros_like(windows[:1]), np.cumsum(windows, axis=0)])
    found = np.full((len(windows), min(_LONGEST, len(windows))), -np.inf)
    for end in range(len(windows)):
        counts = total[end + 1] - total[max(0, end + 1 - _LONGEST) : end + 1][::-1]
        gain = log_marginal(fresh, counts) - log_marginal(learned, counts)
        found[end, : len(counts)] = gain.reshape(len(counts), -1).sum(axis=1)
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
