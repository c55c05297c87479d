"""Control of the multi-access network by twins learned from T slots: throughput and overflow against T.

Data sets are nested: the first T slots of an episode of random access. Policies are frame policies, trained by COMA on
draws of the twin in single precision, and judged exactly on the real network, so that no test noise is left. The
cautious ones are trained on the entropic risk over the draws in the place of their mean.
"""

import dataclasses
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
SLOTS: Final = (0, 2, 5, 10, 20)
PAIRS: Final = ((0, 1), (2, 3))
CAUTION: Final = 6.0
"""Of the cautious lines; chosen from 2, 6 and 20 on ten of the data sets at T = 10."""
LINES: Final[Mapping[str, tuple[Method, float]]] = {
    "bayesian": ("bayesian", 0.0),
    "map": ("map", 0.0),
    "maximum_likelihood": ("maximum_likelihood", 0.0),
    "bayesian_cautious": ("bayesian", CAUTION),
    "map_cautious": ("map", CAUTION),
}
"""The twin that each line trains on, and the learner's caution."""
ALOHA: Final = 0.54
"""The chance of sending at which symmetric random access delivers most."""
_BATCH: Final = 10


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    with jax.enable_x64(False):  # a third of the time; what is judged is exact all the same
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

    def fitted(line: str, count: int, start: int) -> np.ndarray:
        method, caution = LINES[line]
        chosen = range(start, min(start + _BATCH, runs))
        until = [{n: v[r, count - 1] * (count > 0) for n, v in seen.items()} for r in chosen]
        learner = dataclasses.replace(campaign.learner, caution=caution)
        own = jax.random.fold_in(fit_key, start)
        return campaign._replace(learner=learner).policies(own, [learned(method, each) for each in until])

    def results_of(line: str, count: int) -> np.ndarray:
        """Metrics of one line at one size of the data, a batch of data sets after the other."""
        batches = [
            part(f"{line}, T = {count}, data sets from {i}", lambda i=i: fitted(line, count, i))["metric"]
            for i in range(0, runs, _BATCH)
        ]
        return np.concatenate(batches)

    results = {line: np.stack([results_of(line, count) for count in slots], 1) for line in LINES}
    truth = [PointMass(NETWORK.parameters)] * min(runs, _BATCH)
    oracle = part("oracle", lambda: campaign.policies(true_key, truth))
    history = progress.part(
        f"policies that remember, {campaign.budget.slots} virtual slots",
        lambda: {"throughput": remembering(true_key, campaign)},
    )
    best = progress.part(
        f"local rules, {campaign.budget.slots} virtual slots",
        lambda: local_rules(true_key, oracle["table"][:3], campaign.starts),
    )["throughput"]
    lines = {"oracle": oracle["metric"], "tdma": _fixed("tdma"), "aloha": _fixed("aloha")}
    panels = tuple(
        Panel(name, Quantity("slots of data"), Quantity(name, unit), _curves(slots, results, lines, index))
        for index, (name, unit) in enumerate(_METRICS)
    )
    pairs = (("bayesian", "map"), ("bayesian_cautious", "map"), ("bayesian_cautious", "map_cautious"))
    notes = (
        *_facts(oracle["metric"], history["throughput"], best),
        *(note for ours, theirs in pairs for note in _gains(slots, results, ours, theirs)),
    )
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
    """Throughput of policies that remember their history, trained on the truth in double precision; 64 x 2000 slots."""
    budget = campaign.budget._replace(slots=2 * campaign.budget.slots)

    @eqx.filter_jit
    def one(key: PRNGKeyArray, environment: Environment) -> jax.Array:
        first, second, third = jax.random.split(key, 3)
        start = HistoryPolicy(first, NETWORK.devices)
        trained = train(second, campaign.learner, start, environment, budget)
        return jnp.mean(evaluate(third, environment, trained.policy, HORIZON, 64).throughput)

    with jax.enable_x64(True):
        pool = draw_pool(key, PointMass(NETWORK.parameters), 1)
        environment = Environment(TWIN, pool, HORIZON, REDRAW)
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
    slots: Sequence[int], results: Mapping[str, Float[np.ndarray, "run size metric"]], ours: str, theirs: str
) -> tuple[str, ...]:
    first, second = (results[name][:, :, 0].mean(axis=0) for name in (ours, theirs))
    return tuple(
        f"T = {count}: throughput {mine:.4f} ({ours}), {other:.4f} ({theirs}), ratio {mine / max(other, 1e-9):.4g}"
        for count, mine, other in zip(slots, first, second, strict=True)
    )
