"""What a policy is foreseen to deliver, on how much of it nobody has seen, and whether the network delivers less."""

from typing import Any, Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.control import Stateless, TablePolicy
from dtprob.inference.exact import DirichletTables
from dtprob.models.multi_access import Kernel, priors
from dtprob.models.multi_access.transition import State as NetworkState
from dtprob.twin.predict import Prediction, predict
from dtprob.twin.rollout import Metric, Steps, throughput
from dtprob.workflow.loop.knowledge import ARRIVAL, RECEPTION, known
from dtprob.workflow.loop.physical import Chances
from dtprob.workflow.loop.settings import TwinCase
from dtprob.workflow.loop.state import State

HORIZON: Final = 200
"""Slots over which the throughput is foreseen, and that are judged together."""
FEW: Final = 5
"""A row of a table that was seen less often is seldom seen: the prior has a say in what it does."""
RATE: Final = 0.05
"""Probability that a policy is said to deliver less than foreseen though the network is of the learned law."""
_DRAWS, _EPISODES = 800, 2


def foresee(key: jax.Array, case: TwinCase, state: State, policy: Chances) -> Prediction:
    """Packets per slot of a policy's episodes of `HORIZON` slots, under what is known.

    Args:
        key: typed JAX key.
        case: the settings.
        state: with the rows that are known.
        policy: the chances of sending.
    """
    return _foreseen(key, case.kernel, known(case, state), policy, throughput)


def seldom_seen(key: jax.Array, case: TwinCase, state: State, policy: Chances) -> float:
    """Share of the slots of the episodes that `foresee` foresees that take a row seen fewer than `FEW` times.

    Args:
        key: as for `foresee`.
        case: the settings.
        state: with the rows that are known.
        policy: the chances of sending.
    """
    law = known(case, state)
    return _foreseen(key, _noting(case, law), law, policy, _seldom).mean


def _foreseen(
    key: jax.Array, kernel: Steps, law: DirichletTables, policy: Chances, metric: Metric
) -> Prediction:
    return predict(
        key,
        kernel,
        law,
        policy=Stateless(TablePolicy(jnp.asarray(policy, jnp.result_type(float)))),
        metric=metric,
        horizon=HORIZON,
        draws=_DRAWS,
        episodes=_EPISODES,
    )


def shortfall(state: State) -> dict[str, Any] | None:
    """The first stretch of `HORIZON` slots since the policy was handed over that delivered less than was foreseen.

    The k-th stretch is judged at the level RATE 6 / (pi k)^2, so that all together are wrong with probability RATE at most,
    however they depend on one another, as long as each is like an episode that was foreseen.

    Args:
        state: with the throughputs that were foreseen, and the rows since.

    Returns:
        What the history says of it; None where nothing falls short.
    """
    delivered = state.rows["ack"][state.handed :].sum(axis=1)
    count = len(delivered) // HORIZON
    for number, value in enumerate(delivered[: count * HORIZON].reshape(count, HORIZON).mean(axis=1)):
        chance = (1 + np.sum(state.foreseen <= value)) / (1 + len(state.foreseen))
        if chance <= RATE * 6 / (np.pi * (number + 1)) ** 2:
            first = state.handed + number * HORIZON
            return {
                "why": f"delivers less than foreseen: {value:.3f} packets per slot from slot {first} to {first + HORIZON}",
                "shortfall": {"slots": [first, first + HORIZON], "chance": round(float(chance), 4)},
            }
    return None


@final
class _Noting(eqx.Module):
    """A network that notes which of its slots take rows seldom seen.

    Attributes:
        kernel: the network.
        arrival, reception: which rows of the tables are seldom seen.
    """

    kernel: Kernel
    arrival: Bool[Array, "cluster previous"]
    reception: Bool[Array, " sender_count"]

    @property
    def devices(self) -> int:
        """Number of devices."""
        return self.kernel.devices

    @property
    def capacity(self) -> int:
        """Packets that a buffer holds."""
        return self.kernel.capacity

    def initial(self) -> NetworkState:
        """See `Kernel`."""
        return self.kernel.initial()

    def step(
        self, key: PRNGKeyArray, parameters: Any, state: NetworkState, action: Int[Array, " device"]
    ) -> tuple[NetworkState, Bool[Array, ""]]:
        """The state after the slot, see `Kernel`, and whether it took a row that was seldom seen."""
        after, _ = self.kernel.step(key, parameters, state, action)
        senders = jnp.sum((action > 0) & (state.buffer > 0))
        previous = self.kernel.clusters.encode(state.arrival) % self.arrival.shape[1]
        seldom = jnp.any(self.arrival[jnp.arange(len(self.arrival)), previous]) | self.reception[senders]
        return after, seldom


def _noting(case: TwinCase, law: DirichletTables) -> _Noting:
    """The network with its rows that were seldom seen; those with one outcome are known."""
    fresh = priors(case.kernel.clusters, case.concentration, memory=case.memory)
    seldom = {
        name: (law.concentration[name].sum(axis=-1) - each.sum(axis=-1) < FEW)
        & (np.sum(each > 0, axis=-1) > 1)
        for name, each in fresh.items()
    }
    return _Noting(case.kernel, jnp.asarray(seldom[ARRIVAL]), jnp.asarray(seldom[RECEPTION]))


def _seldom(slots: Bool[Array, " slot"]) -> Float[Array, ""]:
    """Share of the slots that take a row seldom seen."""
    return jnp.mean(slots, dtype=float)
