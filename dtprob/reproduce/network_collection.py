"""How fast data teach the reception of the network: collected at random, or by a policy trained to learn.

The policy is trained by COMA on networks drawn from the prior, with the information of each slot about all tables as
reward; it is a frame policy of 8 slots. It is judged on the real network, and beside what one hand could do that directs
all devices and knows the network.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob import control
from dtprob.control import Budget, TablePolicy
from dtprob.models.multi_access import Clusters, priors
from dtprob.physical.multi_access import Network
from dtprob.reproduce.collection_bound import least_errors
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.network_study import NETWORK, TWIN, collect, counts, law, record
from dtprob.reproduce.progress import Progress

RUNS: Final = 400
SLOTS: Final = 40
CONCENTRATION: Final = 0.5
"""Of the prior. With that of control, 0.01, a row counts as known after a single outcome."""
TARGETS: Final = (0.4, 0.3, 0.25, 0.2)
BOUND: Final = 20
"""Slots up to which the best central collector is computed."""
FRAME: Final = 8
BUDGET: Final = Budget(400_000, 40, SLOTS)


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(key, runs, progress, BUDGET)


def figure(key: PRNGKeyArray, runs: int, progress: Progress, budget: Budget) -> Figure:
    """The figure for a given training of the policy that collects."""
    random_key, train_key, play_key = jax.random.split(key, 3)

    def trained() -> dict[str, np.ndarray]:
        return {"table": collector(train_key, budget)}

    table = progress.part(f"policy that collects, {budget.slots} virtual slots", trained)["table"]
    curves = {
        "random": errors(collect(random_key, SLOTS + 1, runs)),
        "optimised": errors(directed(play_key, table, runs)),
    }
    slots = np.arange(1, SLOTS + 1)
    best = least_errors(NETWORK, CONCENTRATION, BOUND)[1:]
    series = (
        *(_mean(name, slots, value) for name, value in curves.items()),
        Series("best_central", slots[:BOUND].astype(float), best, best, best),
    )
    axes = Quantity("slots of data"), Quantity("error of the reception table")
    panel = Panel("posterior mean against the truth", *axes, series)
    return Figure(
        "collection", "collecting data that teach", (panel,), runs, (_MEASURE, *_steps(curves, best))
    )


_MEASURE: Final = "error: total variation of the posterior mean from the truth, mean over 1 to 4 senders"


def collector(key: PRNGKeyArray, budget: Budget) -> Float[np.ndarray, "phase device buffer arrival ack"]:
    """The table of a policy that is trained to learn as much as it can in an episode."""
    prior = priors(Clusters(NETWORK.clusters), CONCENTRATION)
    nothing = {name: np.zeros_like(table) for name, table in prior.items()}
    policy, _ = control.collector(
        key,
        TWIN,
        law(nothing, CONCENTRATION),
        clusters=NETWORK.clusters,
        slots=SLOTS,
        frame=FRAME,
        budget=budget,
    )
    return np.asarray(policy.probability)


def directed(
    key: PRNGKeyArray, table: Float[np.ndarray, "phase device buffer arrival ack"], runs: int
) -> dict[str, Float[np.ndarray, "run slot ..."]]:
    """The counts of each slot of episodes that a policy plays on the real network."""
    policy = TablePolicy(jnp.asarray(table))
    played = jax.jit(jax.vmap(lambda k: record(k, policy, SLOTS + 1)))(jax.random.split(key, runs))
    return counts(jax.tree.map(lambda leaf: np.asarray(leaf)[:, :, 0], played))


def errors(
    seen: Mapping[str, Float[np.ndarray, "run slot ..."]], network: Network = NETWORK
) -> Float[np.ndarray, "run slot"]:
    """Error of the reception table's posterior mean after each slot."""
    prior = priors(Clusters(network.clusters), CONCENTRATION)["log_reception"]
    posterior = prior + seen["log_reception"].cumsum(axis=1)
    mean = posterior / posterior.sum(axis=-1, keepdims=True)
    distance = 0.5 * np.abs(mean - network.reception).sum(axis=-1)
    return distance[..., 1:].mean(axis=-1)


def _mean(name: str, slots: Sequence[int] | np.ndarray, values: Float[np.ndarray, "run slot"]) -> Series:
    mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(len(values))
    return Series(name, np.asarray(slots, float), mean, mean - 1.96 * error, mean + 1.96 * error)


def _steps(
    curves: Mapping[str, Float[np.ndarray, "run slot"]], best: Float[np.ndarray, " slot"]
) -> tuple[str, ...]:
    """Slots until the mean error is no larger than each target."""
    means = {**{name: value.mean(axis=0) for name, value in curves.items()}, "best": best}

    def until(name: str, target: float) -> str:
        below = np.flatnonzero(means[name] <= target)
        return str(below[0] + 1) if len(below) else f"more than {len(means[name])}"

    return tuple(
        f"error {target}: {until('optimised', target)} slots, at random {until('random', target)}, "
        f"the best central collector that knows the network {until('best', target)}"
        for target in TARGETS
    )
