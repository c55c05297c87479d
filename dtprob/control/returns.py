"""What actions were worth: returns that mix lengths, and COMA's counterfactual advantage."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def lambda_returns(
    reward: Float[Array, " slot"],
    value: Float[Array, " slot"],
    ends: Bool[Array, " slot"],
    discount: float,
    mix: float,
) -> Float[Array, " slot"]:
    """TD(lambda) returns, G_t = r_t + discount ((1 - mix) v_{t+1} + mix G_{t+1}).

    Where an episode was cut, and at the last slot, what follows is not known: G_t = v_t there, which only
    serves the slots before it.

    Args:
        reward: of each slot.
        value: v_t, of the state and action of each slot, or of the state.
        ends: whether the episode was cut after the slot.
        discount: of the next slot.
        mix: lambda.
    """
    ends = ends.at[-1].set(True)

    def one(
        after: tuple[Array, Array], slot: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], Array]:
        reward, value, ends = slot
        following = (1 - mix) * after[0] + mix * after[1]
        now = jnp.where(ends, value, reward + discount * following)
        return (value, now), now

    start = (value[-1], value[-1])
    return jax.lax.scan(one, start, (reward, value, ends), reverse=True)[1]


def device_returns(
    reward: Float[Array, "slot environment"],
    value: Float[Array, "slot environment device"],
    truncated: Bool[Array, "slot environment"],
    discount: float,
    mix: float,
) -> tuple[Float[Array, "slot environment device"], Bool[Array, "slot environment"]]:
    """`lambda_returns` of every device in every environment, and where they are more than a guess."""
    by_device = jax.vmap(lambda_returns, (None, 1, None, None, None), 1)
    every = jax.vmap(by_device, (1, 1, 1, None, None), 1)
    return every(reward, value, truncated, discount, mix), ~truncated.at[-1].set(True)


def taken(value: Float[Array, "*batch choice"], action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The value of the action taken."""
    return jnp.where(action > 0, value[..., 1], value[..., 0])


def counterfactual_advantage(
    value: Float[Array, "*batch choice"], logit: Float[Array, "*batch"], action: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """How much better a device's action was than what its policy does on average, others' actions kept.

    Args:
        value: of silence and of sending, given the others' actions.
        logit: the policy's log-odds of sending.
        action: that was taken.
    """
    chance = jax.nn.sigmoid(logit)
    average = (1 - chance) * value[..., 0] + chance * value[..., 1]
    return taken(value, action) - average


def normalised(
    advantage: Float[Array, "slot environment device"], counts: Bool[Array, "slot environment"]
) -> Float[Array, "slot environment device"]:
    """Advantages to mean 0 and standard deviation 1 over the slots that count; those of guessed slots are 0.

    Args:
        advantage: of every device.
        counts: where it is more than a guess, as `device_returns` says.
    """
    known = jnp.broadcast_to(counts[..., None], advantage.shape)
    size = jnp.maximum(jnp.sum(known), 1)
    offset = jnp.where(known, advantage - jnp.sum(advantage, where=known) / size, 0.0)
    return offset / (jnp.sqrt(jnp.sum(offset**2) / size) + 1e-6)
