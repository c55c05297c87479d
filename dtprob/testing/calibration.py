"""Simulation-based calibration: are posteriors of data from the prior right on average?

The rank of the true value among independent posterior draws is uniform if, and for all practical purposes
only if, the engine draws from the posterior. Source: Talts, Betancourt, Simpson, Vehtari and Gelman,
Validating Bayesian inference algorithms with simulation-based calibration (2018).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Float, Int, PRNGKeyArray
from scipy import stats

from dtprob.inference.engine import AbstractEngine, RunOptions
from dtprob.models.declaration import Model, trace_model

DRAWS = 19
"""Draws that a true value is ranked among: its rank has 20 values, and the middle 18 are the 90% interval."""
_NULL = 20_000
_LEAN = RunOptions(pointwise=False, deterministics=False)


class Case(NamedTuple):
    """A model to calibrate on: its data but for the observed ones."""

    model: Model
    data: Mapping[str, Any]


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


def simulated_ranks(
    engine: AbstractEngine, case: Case, key: PRNGKeyArray, runs: int
) -> dict[str, Int[np.ndarray, " run"]]:
    """Rank of the true value among thinned posterior draws, for each entry of each latent site.

    Args:
        engine: gives a multiple of 19 draws, by chain and draw in an order that thinning can use.
        case: the model; values are drawn from its prior, data from these.
        key: typed JAX key.
        runs: how many data sets.
    """
    found: dict[str, list[int]] = {}
    for number in range(runs):
        truth_key, fit_key, turn_key = jax.random.split(jax.random.fold_in(key, number), 3)
        trace = trace_model(case.model, case.data, truth_key)
        drawn = {n: m for n, m in trace.items() if m["type"] == "sample"}
        data = {**case.data, **{n: np.asarray(m["value"]) for n, m in drawn.items() if n == "y"}}
        posterior = engine(fit_key, case.model, data, options=_LEAN)
        turn = float(jax.random.uniform(turn_key, maxval=2 * np.pi))
        for name in posterior.latent:
            values, truth = posterior.flat(name), np.asarray(drawn[name]["value"])
            values = values[:: len(values) // DRAWS][:DRAWS].reshape(DRAWS, -1)
            measure = _turned(turn) if name in posterior.circular else np.asarray
            below = np.sum(measure(values) < measure(truth.reshape(-1)), axis=0)
            for entry, rank in enumerate(below):
                found.setdefault(f"{name}[{entry}]" if truth.ndim else name, []).append(int(rank))
    return {name: np.asarray(ranks) for name, ranks in found.items()}


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
    counts = np.random.default_rng(0).multinomial(runs, np.full(bins, 1 / bins), _NULL)
    null = _unevenness(counts)
    here = _unevenness(np.bincount(ranks, minlength=bins))
    return Verdict(
        p_value=(1 + int(np.sum(null >= here))) / (1 + _NULL),
        coverage=inside / runs,
        coverage_p_value=float(stats.binomtest(inside, runs, (bins - 2) / bins).pvalue),
        mean=float(np.mean(ranks) / DRAWS),
    )


def _unevenness(counts: Int[np.ndarray, "*study bin"]) -> Float[np.ndarray, " *study"]:
    """Cramer and von Mises's distance of the counts from even ones: neighbouring bins count together."""
    share = np.cumsum(counts, axis=-1) / np.sum(counts, axis=-1, keepdims=True)
    return np.mean((share - np.arange(1, counts.shape[-1] + 1) / counts.shape[-1]) ** 2, axis=-1)


def _normal(x: Any, y: Any = None) -> None:
    level = numpyro.sample("level", dist.Normal(1.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(level + slope * x, 1.0), obs=y)


def _circular(x: Any, y: Any = None) -> None:
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    angle = numpyro.sample("angle", dist.VonMises(np.pi, 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(scale * jnp.cos(angle - x), 0.7), obs=y)


def _hierarchical(x: Any, y: Any = None) -> None:
    centre = numpyro.sample("centre", dist.Normal(0.0, 1.0))
    spread = numpyro.sample("spread", dist.LogNormal(-0.5, 0.5))
    with numpyro.plate("group", len(x)):
        level = numpyro.sample("level", dist.Normal(centre, spread))
        numpyro.sample("y", dist.Normal(level, x), obs=y)


CASES: Mapping[str, Case] = {
    "normal": Case(_normal, {"x": np.linspace(-1, 2, 6)}),
    "circular": Case(_circular, {"x": np.linspace(-1, 2, 6)}),
    "hierarchical": Case(_hierarchical, {"x": np.linspace(0.3, 1.2, 5)}),
}
"""Small models: a linear regression, a phase with an amplitude, groups around a common centre."""
