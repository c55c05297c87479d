"""Counterfactual multi-agent policy gradients (Foerster et al. 2018) for access to a shared channel."""

from dataclasses import dataclass
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.control.critic import CentralCritic
from dtprob.control.policy import Memory, choice_entropy, log_chance, unroll_each
from dtprob.control.returns import counterfactual_advantage, device_returns, taken
from dtprob.control.rollout import Trajectory
from dtprob.errors import InputError


class Kept(NamedTuple):
    """What COMA keeps: the critic, its slow copy, the optimisers, the number of updates."""

    critic: CentralCritic
    target: CentralCritic
    actor_state: Any
    critic_state: Any
    updates: Int[Array, ""]


@final
@dataclass(frozen=True)
class COMA:
    """Settings of the learner.

    Attributes:
        actor_rate, critic_rate: of Adam; both fall to a tenth over the training.
        discount: of the next slot.
        mix: lambda of the returns.
        refresh: updates after which the target critic is copied.
        critic_steps: of the critic for one of the actor.
        entropy: weight of the entropy at the start; it falls to zero over two thirds of the training.
        scale: reward that counts as one.
        frame: slots of the frame whose phase the critic sees.
        capacity: packets that a buffer holds.
        caution: how much more the environments count that paid less between two updates, per unit of reward and slot;
            0 is the plain mean. What is maximised is the entropic risk over draws and luck together; a point estimate
            has one draw, and only luck to be cautious about.
    """

    actor_rate: float = 5e-3
    critic_rate: float = 5e-3
    discount: float = 0.95
    mix: float = 0.8
    refresh: int = 5
    critic_steps: int = 2
    entropy: float = 0.05
    scale: float = 100.0
    frame: int = 4
    capacity: int = 1
    caution: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a caution that weighs nothing.

        Raises:
            InputError: one that is no number, infinite or below 0.
        """
        if not 0 <= self.caution < float("inf"):
            raise InputError(
                "caution", "a finite number, 0 or more", f"{self.caution:g}", "Correct the value"
            )

    def start(self, key: PRNGKeyArray, policy: Any) -> Kept:
        """See `Learner`."""
        critic = CentralCritic(key, policy.initial().shape[0], self.frame, self.capacity)
        actor_state, critic_state = (
            self._optimiser().init(eqx.filter(module, eqx.is_array)) for module in (policy, critic)
        )
        return Kept(critic, critic, actor_state, critic_state, jnp.zeros((), jnp.int32))

    def update(
        self, policy: Any, kept: Kept, memory: Memory, trajectory: Trajectory, progress: Float[Array, ""]
    ) -> tuple[Any, Kept, dict[str, Float[Array, ""]]]:
        """See `Learner`."""
        fall = 1 - 0.9 * progress
        returns, counts = self.returns(kept.target, trajectory)
        critic, critic_state = kept.critic, kept.critic_state
        weight = counts * self.weight(trajectory)
        error = jnp.zeros(())
        for _ in range(self.critic_steps):
            error, slope = eqx.filter_value_and_grad(critic_loss)(critic, trajectory, returns, weight)
            critic, critic_state = self._apply(critic, slope, critic_state, self.critic_rate * fall)
        advantage = self.advantage(critic, trajectory)
        entropy = self.entropy * jnp.maximum(0.0, 1 - 1.5 * progress)
        slope = eqx.filter_grad(actor_loss)(
            policy, memory, trajectory, advantage, weight=weight, entropy=entropy
        )
        policy, actor_state = self._apply(policy, slope, kept.actor_state, self.actor_rate * fall)
        updates = kept.updates + 1
        fresh = updates % self.refresh == 0
        target = jax.tree.map(
            lambda new, old: jnp.where(fresh, new, old) if eqx.is_array(new) else new, critic, kept.target
        )
        kept = Kept(critic, target, actor_state, critic_state, updates)
        return policy, kept, {"critic_error": error, "advantage": jnp.std(advantage)}

    def returns(
        self, target: CentralCritic, trajectory: Trajectory
    ) -> tuple[Float[Array, "slot environment device"], Bool[Array, "slot environment"]]:
        """TD(lambda) returns of the actions taken, by device's critic, and where they are more than a guess."""
        value = taken(values(target, trajectory), trajectory.action)
        reward = trajectory.reward / self.scale
        return device_returns(reward, value, trajectory.truncated, self.discount, self.mix)

    def weight(self, trajectory: Trajectory) -> Float[Array, " environment"]:
        """How much each environment counts, 1 on average: exp(-caution reward), tilted to what pays least."""
        pay = jnp.mean(trajectory.reward, axis=0) / self.scale
        return jax.nn.softmax(-self.caution * pay) * len(pay)

    def advantage(
        self, critic: CentralCritic, trajectory: Trajectory
    ) -> Float[Array, "slot environment device"]:
        """Counterfactual advantages, in units of their root mean square."""
        advantage = counterfactual_advantage(values(critic, trajectory), trajectory.logit, trajectory.action)
        return advantage / (jnp.sqrt(jnp.mean(advantage**2)) + 1e-6)

    def _optimiser(self) -> optax.GradientTransformation:
        return optax.flatten(optax.chain(optax.clip(1.0), optax.scale_by_adam()))

    def _apply(self, module: Any, slope: Any, state: Any, rate: Float[Array, ""]) -> tuple[Any, Any]:
        change, state = self._optimiser().update(slope, state)
        return eqx.apply_updates(module, jax.tree.map(lambda x: -rate * x, change)), state


def values(critic: CentralCritic, trajectory: Trajectory) -> Float[Array, "slot environment device choice"]:
    """The critic's values of both actions of every device, others' actions kept."""
    return jax.vmap(jax.vmap(critic))(trajectory.observation, trajectory.action)


def critic_loss(
    critic: CentralCritic,
    trajectory: Trajectory,
    returns: Float[Array, "slot environment device"],
    weight: Float[Array, "slot environment"],
) -> Float[Array, ""]:
    """Mean square difference from the returns, weighted."""
    error = taken(values(critic, trajectory), trajectory.action) - returns
    return jnp.mean(error**2 * weight[..., None])


def actor_loss(
    policy: Any,
    memory: Memory,
    trajectory: Trajectory,
    advantage: Float[Array, "slot environment device"],
    *,
    weight: Float[Array, "slot environment"],
    entropy: Float[Array, ""],
) -> Float[Array, ""]:
    """Minus the weighted log-probability of the actions taken, and minus the entropy; an empty buffer has no say."""
    logit = unroll_each(policy, memory, trajectory.observation, trajectory.start)
    matters = (trajectory.observation.buffer > 0) * weight[..., None]
    gain = log_chance(logit, trajectory.action) * advantage
    return -jnp.mean(matters * (gain + entropy * choice_entropy(logit)))
