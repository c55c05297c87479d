"""What a learner is, and the one loop that trains with any: a compiled scan over vectorised rollouts."""

from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.control.environment import Environment
from dtprob.control.policy import Memory, Policy, TablePolicy
from dtprob.control.rollout import Play, Trajectory, begin, play
from dtprob.errors import InputError
from dtprob.twin.rollout import check_size
from dtprob.xla import warn_of_miscompilation


class Learner(Protocol):
    """Improves a policy by what it did; hashable, its settings are static."""

    def start(self, key: PRNGKeyArray, policy: Any) -> Any:
        """What the learner keeps: critics and the state of optimisers."""
        ...

    def update(
        self, policy: Any, kept: Any, memory: Memory, trajectory: Trajectory, progress: Float[Array, ""]
    ) -> tuple[Any, Any, dict[str, Float[Array, ""]]]:
        """One improvement.

        Args:
            policy: that acted.
            kept: by the learner.
            memory: of the policy in each environment before the trajectory.
            trajectory: leaves (slot, environment, ...).
            progress: of the training, from 0 to 1.

        Returns:
            The policy, what the learner keeps, and numbers to watch.
        """
        ...


class Budget(NamedTuple):
    """How much is played.

    Attributes:
        slots: in all, over all environments.
        environments: that are played side by side.
        length: slots between two updates, 2 or more: what follows the last one is a guess.
    """

    slots: int = 120_000
    environments: int = 32
    length: int = 20

    @property
    def updates(self) -> int:
        """Number of updates."""
        return max(1, self.slots // (self.environments * self.length))


class Trained(NamedTuple):
    """A trained policy, and by update the reward per slot and the learner's numbers."""

    policy: Any
    reward: Float[Array, " update"]
    watched: dict[str, Float[Array, " update"]]


def train(
    key: PRNGKeyArray,
    learner: Learner,
    policy: Policy,
    environment: Environment,
    budget: Budget,
) -> Trained:
    """Train a policy; pure, so that members of an ensemble train side by side under `jax.vmap`.

    Args:
        key: typed JAX key.
        learner: that improves it.
        policy: to start from.
        environment: the twin, or the truth; each episode takes parameters from its pool, or more often.
        budget: how much is played.

    Raises:
        InputError: a budget without an environment, or with too few slots between two updates to learn from; a table, or a
            policy of other devices, or one or a learner of smaller buffers; or a training that ends with what is no number
            (who compiles this calls `check_trained`).
    """
    warn_of_miscompilation()
    for name, value, least in (("environments", budget.environments, 1), ("length", budget.length, 2)):
        if value < least:
            raise InputError(f"budget: {name}", f"{least} or more", str(value), "Give a larger number")
    check_size(environment.kernel, learner)
    if isinstance(policy, TablePolicy):
        remedy = "Start from a FramePolicy, whose table dtprob.control.tabulate gives"
        raise InputError("policy to train", "one with free parameters", "a table of chances", remedy)
    first, second, third = jax.random.split(key, 3)
    kept = learner.start(first, policy)
    now = begin(second, environment, policy, budget.environments)
    arrays, fixed = eqx.partition((policy, kept), eqx.is_array)

    def one(carry: tuple[Any, Play], step: tuple[PRNGKeyArray, Array]) -> tuple[Any, Any]:
        arrays, now = carry
        policy, kept = eqx.combine(arrays, fixed)
        memory = now.memory
        now, trajectory = play(step[0], environment, policy, now, budget.length)
        policy, kept, watched = learner.update(policy, kept, memory, trajectory, step[1])
        arrays = eqx.filter((policy, kept), eqx.is_array)
        return (arrays, now), (jnp.mean(trajectory.reward), watched)

    progress = jnp.arange(budget.updates) / budget.updates
    steps = jax.random.split(third, budget.updates), progress
    (arrays, _), (reward, watched) = jax.lax.scan(one, (arrays, now), steps)
    trained = Trained(eqx.combine(arrays, fixed)[0], reward, watched)
    check_trained(trained)
    return trained


def check_trained(trained: Trained) -> None:
    """Refuse a policy whose parameters are no numbers; what is traced has none yet and is let through.

    Raises:
        InputError: such a policy.
    """
    leaves = [x for x in jax.tree.leaves(trained.policy) if eqx.is_inexact_array(x)]
    if any(not isinstance(x, Tracer) and not bool(jnp.all(jnp.isfinite(x))) for x in leaves):
        remedy = "Train at a lower rate, or with rewards that are numbers"
        raise InputError("training", "a policy of finite parameters", "NaN or infinity", remedy)
