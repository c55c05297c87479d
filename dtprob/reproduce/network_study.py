"""The reference network for figures: data collected at random, the twin's posteriors, training, exact judgement."""

from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.special import expit

from dtprob.control import (
    COMA,
    Budget,
    Environment,
    FramePolicy,
    TablePolicy,
    draw_pool,
    train,
)
from dtprob.control.kernel import Kernel
from dtprob.control.rollout import Trajectory, begin, play
from dtprob.inference import PointMass, Sampler
from dtprob.inference.exact import DirichletTables
from dtprob.models.multi_access import Clusters, kernel, priors, window_counts
from dtprob.physical.multi_access import Averages, Chain, Network, PhysicalKernel, average

type Method = Literal["bayesian", "map", "maximum_likelihood"]
type Counts = Mapping[str, Float[np.ndarray, "..."]]

NETWORK: Final = Network.reference()
TWIN: Final = kernel(NETWORK.clusters, NETWORK.capacity)
CONCENTRATION: Final[Mapping[Method, float]] = {"bayesian": 0.01, "map": 1.01, "maximum_likelihood": 1.0}
HORIZON: Final = 2000
REDRAW: Final = 200
DRAWS: Final = 256
"""Of the posterior, for the environments to choose from."""


def collect(key: PRNGKeyArray, slots: int, runs: int) -> dict[str, Float[np.ndarray, "run slot ..."]]:
    """What random access tells about the network: the counts of each slot, in episodes from empty buffers.

    In each slot all devices send with the same chance, drawn uniformly from (0, 1).

    Args:
        key: typed JAX key.
        slots: of an episode.
        runs: episodes, each a data set.
    """
    first, second = jax.random.split(key)
    chance = jax.random.uniform(first, (runs, slots))

    def one(key: PRNGKeyArray, chance: Float[jax.Array, " slot"]) -> Trajectory:
        table = jnp.broadcast_to(chance[:, None, None, None, None], (slots, NETWORK.devices, 2, 2, 2))
        return record(key, TablePolicy(table), slots)

    played = jax.jit(jax.vmap(one))(jax.random.split(second, runs), chance)
    return counts(jax.tree.map(lambda leaf: np.asarray(leaf)[:, :, 0], played))


def record(key: PRNGKeyArray, policy: TablePolicy, slots: int) -> Trajectory:
    """An episode of the real network from empty buffers; leaves (slot, 1, ...)."""
    pool = jax.tree.map(lambda table: jnp.asarray(table, float)[None], NETWORK.parameters)
    environment = Environment(PhysicalKernel.of(NETWORK), pool, slots + 1)
    first, second = jax.random.split(key)
    return play(second, environment, policy, begin(first, environment, policy, 1), slots)[1]


def counts(played: Trajectory) -> dict[str, Float[np.ndarray, "run slot ..."]]:
    """How often each slot saw each entry of the tables.

    Args:
        played: leaves (run, slot, ...), each run from empty buffers. The arrivals of a slot are those that the next
            one observes, so that the last slot is not counted.
    """
    seen = played.observation
    runs, slots = seen.slot.shape[0], seen.slot.shape[1] - 1
    known = Clusters(NETWORK.clusters)
    sending = (played.action * seen.buffer > 0)[:, :-1]
    arrivals = seen.arrival @ known.weight.T
    columns = {
        "sending": sending,
        "previous": arrivals[:, :-1],
        "arrivals": arrivals[:, 1:],
        "deliveries": played.slot.delivered.sum(-1)[:, :-1],
    }
    flat = {name: value.reshape(runs * slots, 1, *value.shape[2:]) for name, value in columns.items()}
    every = window_counts({"clusters": known, "valid": np.ones((runs * slots, 1), bool), **flat})
    return {name: value.reshape(runs, slots, *value.shape[1:]) for name, value in every.items()}


def law(seen: Counts, concentration: float) -> DirichletTables:
    """The exact posterior of the tables after some counts."""
    return DirichletTables(priors(Clusters(NETWORK.clusters), concentration)).updated(seen)


def learned(method: Method, seen: Counts) -> Sampler:
    """The twin of a method after some counts: the posterior, or its point.

    The mode of a Dirichlet with concentration a is (n + a - 1) / sum; maximum likelihood gives relative counts,
    and equal chances where nothing was counted.
    """
    posterior = law(seen, CONCENTRATION[method])
    if method == "bayesian":
        return posterior
    tables = {name: mode(table) for name, table in posterior.concentration.items()}
    with np.errstate(divide="ignore"):
        return PointMass({name: np.log(table) for name, table in tables.items()})


def mode(concentration: Float[np.ndarray, "*row outcome"]) -> Float[np.ndarray, "*row outcome"]:
    """The mode of Dirichlet rows with concentrations of 1 or more; 0 where an outcome cannot happen."""
    possible = concentration > 0
    excess = np.where(possible, concentration - 1, 0.0)
    total = excess.sum(axis=-1, keepdims=True)
    equal = possible / possible.sum(axis=-1, keepdims=True)
    return np.where(total > 0, excess / np.where(total > 0, total, 1.0), equal)


class Campaign(NamedTuple):
    """How policies are trained.

    Attributes:
        learner: that trains them.
        budget: virtual slots of each training.
        kernel: the transition that is trained on.
        starts: random rules from which the best local rule is sought.
    """

    learner: COMA = COMA()
    budget: Budget = Budget(slots=120_000)
    kernel: Kernel = TWIN
    starts: int = 4

    def policies(
        self, key: PRNGKeyArray, samplers: Sequence[Sampler]
    ) -> Float[np.ndarray, "run phase device buffer arrival ack"]:
        """The table of the frame policy that is trained on each sampler's draws.

        Args:
            key: typed JAX key; run by run the same for all methods.
            samplers: a twin per run.
        """
        keys = jax.random.split(key, len(samplers))
        pools = [draw_pool(k, s, DRAWS) for k, s in zip(keys, samplers, strict=True)]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pools)
        return expit(np.asarray(_train(keys, stacked, self), float))


@eqx.filter_jit
def _train(
    keys: PRNGKeyArray, pools: dict[str, jax.Array], campaign: Campaign
) -> Float[jax.Array, "run phase device buffer arrival ack"]:
    """Log-odds of sending; as chances they would round to 0 and 1 in single precision."""

    def one(key: PRNGKeyArray, pool: dict[str, jax.Array]) -> jax.Array:
        first, second = jax.random.split(key)
        environment = Environment(campaign.kernel, pool, HORIZON, REDRAW)
        start = FramePolicy(first, NETWORK.devices)
        trained = train(second, campaign.learner, start, environment, campaign.budget)
        return jnp.moveaxis(trained.policy.table(), -1, 0)

    return jax.vmap(one)(keys, pools)


def judge(chain: Chain, tables: Float[np.ndarray, "run phase device buffer arrival ack"]) -> list[Averages]:
    """Exact long-run averages of policies on the real network."""
    return [average(chain, table) for table in tables]
