"""Control of the multi-access network by twins learned from T slots: throughput and overflow against T.

Data sets are nested: the first T slots of an episode of random access. Policies are frame policies, trained by COMA on
draws of the twin and judged exactly on the real network, so that no test noise is left.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob.control import Environment, HistoryPolicy, draw_pool, evaluate, train
from dtprob.inference import PointMass
from dtprob.physical.multi_access import (
    Averages,
    aloha,
    average,
    chain,
    improve,
    optimum,
    tdma,
)
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.network_study import (
    HORIZON,
    METHODS,
    NETWORK,
    REDRAW,
    TWIN,
    Campaign,
    Method,
    collect,
    judge,
    learned,
)
from dtprob.reproduce.progress import Progress

RUNS: Final = 50
SLOTS: Final = (0, 2, 4, 6, 8, 10, 15, 20)
PAIRS: Final = ((0, 1), (2, 3))
ALOHA: Final = 0.54
"""The chance of sending at which symmetric random access delivers most."""
_BATCH: Final = 10


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(key, runs, progress, SLOTS, Campaign())


def figure(
    key: PRNGKeyArray, runs: int, progress: Progress, slots: Sequence[int], campaign: Campaign
) -> Figure:
    """The figure for given sizes of the data and a given training."""
    data_key, fit_key, true_key = jax.random.split(key, 3)
    seen = {name: value.cumsum(axis=1) for name, value in collect(data_key, max(slots) + 1, runs).items()}
    exact = chain(NETWORK)

    def part(name: str, tables: Callable[[], np.ndarray]) -> dict[str, np.ndarray]:
        """Throughput and overflow of trained policies, and their tables."""

        def compute() -> dict[str, np.ndarray]:
            made = tables()
            found = judge(exact, made)
            return {"metric": np.array([each[:2] for each in found]), "table": made}

        return progress.part(f"{name}, {campaign.budget.slots} virtual slots", compute)

    def fitted(method: Method, count: int) -> np.ndarray:
        until = [{n: v[r, count - 1] * (count > 0) for n, v in seen.items()} for r in range(runs)]
        samplers = [learned(method, counts) for counts in until]
        keys = jax.random.split(fit_key, -(-runs // _BATCH))
        return np.concatenate(
            [campaign.policies(k, samplers[i * _BATCH : (i + 1) * _BATCH]) for i, k in enumerate(keys)]
        )

    parts = {
        (method, count): part(f"{method}, T = {count}", lambda m=method, c=count: fitted(m, c))["metric"]
        for count in slots
        for method in METHODS
    }
    results = {method: np.stack([parts[method, count] for count in slots], 1) for method in METHODS}
    truth = [PointMass(NETWORK.parameters)] * min(runs, _BATCH)
    oracle = part("oracle", lambda: campaign.policies(true_key, truth))
    history = progress.part(
        f"policies that remember, {campaign.budget.slots} virtual slots",
        lambda: {"throughput": remembering(true_key, campaign)},
    )
    best = progress.part(
        f"local rules, {campaign.budget.slots} virtual slots",
        lambda: local_rules(true_key, oracle["table"], campaign.starts),
    )["throughput"]
    lines = {"oracle": oracle["metric"], "tdma": _fixed("tdma"), "aloha": _fixed("aloha")}
    panels = tuple(
        Panel(name, Quantity("slots of data"), Quantity(name, unit), _curves(slots, results, lines, index))
        for index, (name, unit) in enumerate(_METRICS)
    )
    notes = (*_facts(oracle["metric"], history["throughput"], best), *_gains(slots, results))
    return Figure("fig2", "control of a multi-access network by its twin", panels, runs, notes)


_METRICS: Final = (("throughput", "packets/slot"), ("overflow", "packets/device/slot"))


def _fixed(name: str) -> Float[np.ndarray, "1 metric"]:
    rule = tdma(NETWORK, PAIRS) if name == "tdma" else aloha(NETWORK, ALOHA)
    return np.array([average(chain(NETWORK), rule)[:2]])


def _curves(
    slots: Sequence[int],
    results: Mapping[str, Float[np.ndarray, "run size metric"]],
    lines: dict[str, Float[np.ndarray, "run metric"]],
    index: int,
) -> tuple[Series, ...]:
    """Mean and 1.96 standard errors over data sets; level lines for what needs no data."""
    level = {name: np.repeat(value[:, None], len(slots), axis=1) for name, value in lines.items()}
    every = {**results, **level}
    return tuple(_mean(name, slots, value[:, :, index]) for name, value in every.items())


def _mean(name: str, slots: Sequence[int], values: Float[np.ndarray, "run size"]) -> Series:
    mean = values.mean(axis=0)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.zeros_like(mean)
    return Series(name, np.asarray(slots, float), mean, mean - 1.96 * error, mean + 1.96 * error)


def remembering(key: PRNGKeyArray, campaign: Campaign, runs: int = 3) -> Float[np.ndarray, " run"]:
    """Throughput of policies that remember their history, trained on the truth; simulated, 64 x 2000 slots."""
    pool = draw_pool(key, PointMass(NETWORK.parameters), 1)
    environment = Environment(TWIN, pool, HORIZON, REDRAW)
    budget = campaign.budget._replace(slots=2 * campaign.budget.slots)

    @eqx.filter_jit
    def one(key: PRNGKeyArray, environment: Environment) -> jax.Array:
        first, second, third = jax.random.split(key, 3)
        start = HistoryPolicy(first, NETWORK.devices)
        trained = train(second, campaign.learner, start, environment, budget)
        return jnp.mean(evaluate(third, environment, trained.policy, HORIZON, 64).throughput)

    return np.array([float(one(k, environment)) for k in jax.random.split(key, runs)])


def local_rules(
    key: PRNGKeyArray, trained: Float[np.ndarray, "run phase device buffer arrival ack"], starts: int
) -> dict[str, np.ndarray]:
    """Throughput of rules that no single decision improves, from trained and random ones and from time slots."""
    exact = chain(NETWORK)
    shape = (4, NETWORK.devices, NETWORK.capacity + 1, 2, 2)
    drawn = [np.asarray(jax.random.uniform(k, shape), float) for k in jax.random.split(key, starts)]
    first = np.tile(tdma(NETWORK, PAIRS), (2, 1, 1, 1, 1))
    found = [improve(exact, rule).averages.throughput for rule in (first, *trained, *drawn)]
    return {"throughput": np.array(found)}


def _facts(
    oracle: Float[np.ndarray, "run metric"],
    history: Float[np.ndarray, " run"],
    best: Float[np.ndarray, " start"],
) -> tuple[str, ...]:
    most: Averages = optimum(chain(NETWORK, remembers_ack=False)).averages
    top, mean = max(best.max(), oracle[:, 0].max()), oracle[:, 0].mean()
    return (
        "mean and 1.96 standard errors over data sets; policies are judged by exact long-run averages",
        f"best central control: {most.throughput:.4f}",
        f"best local rule: {top:.4f}, ascent by single decisions from {len(best)} starts, trained tables among them",
        f"oracle: mean {mean:.4f} over {len(oracle)} trainings, {mean / top:.3f} of the best local rule",
        f"policies that remember, trained on the truth: {', '.join(f'{value:.4f}' for value in history)}",
    )


def _gains(
    slots: Sequence[int], results: Mapping[str, Float[np.ndarray, "run size metric"]]
) -> tuple[str, ...]:
    ours = results["bayesian"][:, :, 0].mean(axis=0)
    theirs = results["map"][:, :, 0].mean(axis=0)
    return tuple(
        f"T = {count}: Bayesian throughput {mine:.4f}, MAP {other:.4f}, ratio {mine / other:.3f}"
        for count, mine, other in zip(slots, ours, theirs, strict=True)
    )
