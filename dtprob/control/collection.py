"""Policies that collect: trained on networks that may be, with what a slot tells about them as reward."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from dtprob.control.coma import COMA
from dtprob.control.environment import Environment
from dtprob.control.information import Clusters, Counts, DirichletInformation
from dtprob.control.kernel import Kernel
from dtprob.control.learner import Budget, train
from dtprob.control.policy import FramePolicy, TablePolicy, tabulate
from dtprob.inference.exact import DirichletTables
from dtprob.models.multi_access.transition import SITES
from dtprob.twin.rollout import draw_pool

_DRAWS = 1000


def collector(
    key: PRNGKeyArray,
    kernel: Kernel,
    known: DirichletTables,
    *,
    clusters: Clusters,
    slots: int,
    frame: int = 8,
    budget: Budget,
) -> tuple[TablePolicy, float]:
    """A policy that learns as much as it can in an episode, and how much it expects, nats in the last training slots.

    Args:
        key: typed JAX key.
        kernel: the transition.
        known: the law of its tables, `log_arrival` and `log_reception`, before the episode.
        clusters: the devices of each cluster.
        slots: of the episode.
        frame: of the policy.
        budget: of the training.
    """
    first, second, third = jax.random.split(key, 3)
    counts = Counts(*(jnp.asarray(known.concentration[site], jnp.result_type(float)) for site in SITES))
    reward = DirichletInformation(counts, clusters)
    environment = Environment(kernel, draw_pool(first, known, _DRAWS), slots, reward=reward)
    learner = COMA(scale=1.0, discount=0.98, frame=frame, capacity=kernel.capacity)
    start = FramePolicy(second, kernel.devices, frame, kernel.capacity)
    trained = _train(third, learner, start, environment, budget)
    return tabulate(trained.policy), float(jnp.mean(trained.reward[-max(1, budget.updates // 10) :]))


_train = eqx.filter_jit(train)
