"""Simulation-based calibration: are posteriors of data from the prior right on average?

The rank of the true value among independent posterior draws is uniform if, and for all practical purposes
only if, the engine draws from the posterior. Source: Talts, Betancourt, Simpson, Vehtari and Gelman,
Validating Bayesian inference algorithms with simulation-based calibration (2018).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy import stats

from dtprob.inference.engine import LATENTS_ONLY, AbstractEngine
from dtprob.models.arguments import Model
from dtprob.models.execution import trace_model

DRAWS = 19
"""Draws that a true value is ranked among: its rank has 20 values, and the middle 18 are the 90% interval."""
ENTRIES = 6
"""Entries of a site that are ranked, at most: evenly spaced ones."""
_NULL = 20_000


class Simulated(NamedTuple):
    """A data set.

    Attributes:
        data: the model's arguments.
        truth: for each latent site the value behind them.
    """

    data: Mapping[str, Any]
    truth: Mapping[str, np.ndarray]


class Case(NamedTuple):
    """A model to calibrate on.

    Attributes:
        model: the model.
        simulate: from a key, a data set of the shapes of every other one.
    """

    model: Model
    simulate: Callable[[PRNGKeyArray], Simulated]


class Verdict(NamedTuple):
    """What ranks tell.

    Attributes:
        p_value: probability of ranks as uneven as these if the engine were exact.
        coverage: share of 90% intervals that hold the true value.
        coverage_p_value: probability of a share as far from 90%, exact.
        mean: mean rank over the highest one; below a half where draws are too high.
    """

    p_value: float
    coverage: float
    coverage_p_value: float
    mean: float


def from_prior(model: Model, data: Mapping[str, Any]) -> Case:
    """The case in which values are drawn from the prior, and data from these.

    Args:
        model: whose observed sites have the names of its arguments.
        data: its arguments but for the observed ones.
    """
    arguments = set(inspect.signature(model).parameters) - set(data)

    @jax.jit
    def draw(key: PRNGKeyArray) -> tuple[dict[str, Any], dict[str, Any]]:
        trace = trace_model(model, data, key)
        values = {n: m["value"] for n, m in trace.items() if m["type"] == "sample"}
        observed = {name: values.pop(name) for name in arguments & set(values)}
        return observed, values

    def simulate(key: PRNGKeyArray) -> Simulated:
        observed, values = jax.tree.map(np.asarray, draw(key))
        return Simulated({**data, **observed}, values)

    return Case(model, simulate)


def simulated_ranks(
    engine: AbstractEngine, case: Case, key: PRNGKeyArray, runs: Iterable[int]
) -> dict[str, Int[np.ndarray, " run"]]:
    """Rank of the true value among thinned posterior draws, for some entries of each latent site.

    Args:
        engine: gives a multiple of 19 draws, by chain and draw in an order that thinning can use.
        case: the model, and where its data come from.
        key: typed JAX key.
        runs: numbers of the data sets; each has data and draws of its own, whichever others there are.
    """
    found: dict[str, list[int]] = {}
    for number in runs:
        truth_key, fit_key, turn_key = jax.random.split(jax.random.fold_in(key, number), 3)
        data, truth = case.simulate(truth_key)
        posterior = engine(fit_key, case.model, data, options=LATENTS_ONLY)
        turn = float(jax.random.uniform(turn_key, maxval=2 * np.pi))
        for name in posterior.latent:
            measure = _turned(turn) if name in posterior.circular else np.asarray
            for label, rank in _ranks(name, posterior.flat(name), np.asarray(truth[name]), measure):
                found.setdefault(label, []).append(rank)
    return {name: np.asarray(ranks) for name, ranks in found.items()}


def _ranks(
    name: str, draws: np.ndarray, truth: np.ndarray, measure: Callable[[np.ndarray], np.ndarray]
) -> Iterator[tuple[str, int]]:
    """By label, the rank of each chosen entry; those that the model leaves no choice of have none."""
    thin = draws[:: len(draws) // DRAWS][:DRAWS].reshape(DRAWS, -1)
    flat = truth.reshape(-1)
    free = np.flatnonzero(np.any(thin != flat, axis=0))
    for entry in free[np.unique(np.linspace(0, len(free) - 1, ENTRIES).astype(int))] if len(free) else free:
        below = np.sum(measure(thin[:, entry]) < measure(flat[entry]))
        yield f"{name}[{entry}]" if truth.ndim else name, int(below)


def _turned(direction: float) -> Callable[[np.ndarray], np.ndarray]:
    """Angles as they lie behind a direction, so that they have an order."""
    return lambda angle: np.mod(angle - direction, 2 * np.pi)


def judge(ranks: Int[np.ndarray, " run"]) -> Verdict:
    """How far ranks are from uniform.

    Args:
        ranks: between 0 and 19.
    """
    runs, bins = len(ranks), DRAWS + 1
    inside = int(np.sum((ranks > 0) & (ranks < DRAWS)))
    null = _even(runs)
    here = _unevenness(np.bincount(ranks, minlength=bins))
    return Verdict(
        p_value=(1 + int(np.sum(null >= here))) / (1 + _NULL),
        coverage=inside / runs,
        coverage_p_value=float(stats.binomtest(inside, runs, (bins - 2) / bins).pvalue),
        mean=float(np.mean(ranks) / DRAWS),
    )


@functools.cache
def _even(runs: int) -> Float[np.ndarray, " study"]:
    """Unevenness of as many ranks that are even, drawn many times."""
    bins = DRAWS + 1
    return _unevenness(np.random.default_rng(0).multinomial(runs, np.full(bins, 1 / bins), _NULL))


def _unevenness(counts: Int[np.ndarray, "*study bin"]) -> Float[np.ndarray, " *study"]:
    """Cramer and von Mises's distance of the counts from even ones: neighbouring bins count together."""
    share = np.cumsum(counts, axis=-1) / np.sum(counts, axis=-1, keepdims=True)
    return np.mean((share - np.arange(1, counts.shape[-1] + 1) / counts.shape[-1]) ** 2, axis=-1)
