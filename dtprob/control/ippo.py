"""Independent proximal policy optimisation (Schulman et al. 2017): a local critic per device, a clipped ratio."""

from dataclasses import dataclass
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dtprob.control.critic import LocalCritic
from dtprob.control.policy import Memory, choice_entropy, log_chance, unroll_each
from dtprob.control.returns import device_returns, normalised
from dtprob.control.rollout import Trajectory


class Kept(NamedTuple):
    """What IPPO keeps: the critic and the optimiser of both."""

    critic: LocalCritic
    state: Any


@final
@dataclass(frozen=True)
class IPPO:
    """Settings of the learner.

    Attributes:
        rate: of Adam; it falls to a tenth over the training.
        discount: of the next slot.
        mix: lambda of the advantages.
        passes: over each trajectory.
        clip: how far the ratio of probabilities counts.
        entropy: weight of the entropy at the start; it falls to zero over two thirds of the training.
        scale: reward that counts as one.
        frame: slots of the frame whose phase the critic sees.
        capacity: packets that a buffer holds.
    """

    rate: float = 5e-3
    discount: float = 0.95
    mix: float = 0.8
    passes: int = 4
    clip: float = 0.2
    entropy: float = 0.02
    scale: float = 100.0
    frame: int = 4
    capacity: int = 1

    def start(self, key: PRNGKeyArray, policy: Any) -> Kept:
        """See `Learner`."""
        critic = LocalCritic(key, policy.initial().shape[0], self.frame, self.capacity)
        return Kept(critic, self._optimiser().init(eqx.filter((policy, critic), eqx.is_array)))

    def update(
        self, policy: Any, kept: Kept, memory: Memory, trajectory: Trajectory, progress: Float[Array, ""]
    ) -> tuple[Any, Kept, dict[str, Float[Array, ""]]]:
        """See `Learner`."""
        value = jax.vmap(jax.vmap(kept.critic))(trajectory.observation)
        reward = trajectory.reward / self.scale
        returns, counts = device_returns(reward, value, trajectory.truncated, self.discount, self.mix)
        advantage = returns - value
        advantage = normalised(advantage, counts)
        entropy = self.entropy * jnp.maximum(0.0, 1 - 1.5 * progress)
        rate = self.rate * (1 - 0.9 * progress)

        def one(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], Array]:
            modules = eqx.combine(carry[0], fixed)
            error, slope = eqx.filter_value_and_grad(self.loss)(
                modules, memory, trajectory, advantage, returns=returns, counts=counts, entropy=entropy
            )
            change, state = self._optimiser().update(slope, carry[1])
            modules = eqx.apply_updates(modules, jax.tree.map(lambda x: -rate * x, change))
            return (eqx.filter(modules, eqx.is_array), state), error

        arrays, fixed = eqx.partition((policy, kept.critic), eqx.is_array)
        (arrays, state), error = jax.lax.scan(one, (arrays, kept.state), None, self.passes)
        policy, critic = eqx.combine(arrays, fixed)
        return policy, Kept(critic, state), {"loss": error[-1]}

    def loss(
        self,
        modules: tuple[Any, LocalCritic],
        memory: Memory,
        trajectory: Trajectory,
        advantage: Float[Array, "slot environment device"],
        *,
        returns: Float[Array, "slot environment device"],
        counts: Bool[Array, "slot environment"],
        entropy: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Clipped objective, error of the critic, entropy; an empty buffer has no say."""
        policy, critic = modules
        logit = unroll_each(policy, memory, trajectory.observation, trajectory.start)
        ratio = jnp.exp(
            log_chance(logit, trajectory.action) - log_chance(trajectory.logit, trajectory.action)
        )
        near = jnp.clip(ratio, 1 - self.clip, 1 + self.clip)
        gain = jnp.minimum(ratio * advantage, near * advantage) + entropy * choice_entropy(logit)
        error = (jax.vmap(jax.vmap(critic))(trajectory.observation) - returns) ** 2
        matters = trajectory.observation.buffer > 0
        return jnp.mean(counts[..., None] * (0.5 * error - matters * gain))

    def _optimiser(self) -> optax.GradientTransformation:
        return optax.flatten(optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam()))
