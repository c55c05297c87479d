"""Running a network under a policy: what prediction and counterfactuals share."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.posterior import Sampler
from dtprob.models.multi_access.transition import SITES

type Parameters = Mapping[str, Array]
type Policy = Callable[[PRNGKeyArray, Any], Int[Array, " device"]]
"""From a key and the state at the start of a slot to each device's action."""
type Metric = Callable[[Any], Float[Array, ""]]
"""From the slots of an episode, each field (slot, ...), to a number."""


def check_size(whole: Any, part: Any) -> None:
    """Refuse a policy or learner of other devices or smaller buffers than what it is used with: indices would be clamped.

    Args:
        whole: a kernel or a policy.
        part: a policy or a learner; what either does not tell is not compared.

    Raises:
        InputError: the first difference.
    """
    for name, fits, bound in (("devices", operator.eq, ""), ("capacity", operator.ge, " or more")):
        expected, got = getattr(whole, name, None), getattr(part, name, None)
        if expected is not None and got is not None and not fits(got, expected):
            what, wanted = (
                f"{name} of {type(part).__name__}",
                f"{expected}{bound}, as in {type(whole).__name__}",
            )
            raise InputError(what, wanted, str(got), "Make it with as many")


def check_policy(kernel: Steps, policy: Any) -> None:
    """Refuse a policy that takes what devices see in place of a key and the state, or of another network.

    Raises:
        InputError: such a policy.
    """
    if hasattr(policy, "initial"):
        remedy = "Give dtprob.control.Stateless(policy)"
        raise InputError("policy", "a function of a key and the state", type(policy).__name__, remedy)
    check_size(kernel, policy)
    found = jax.eval_shape(policy, jax.random.key(0), kernel.initial())
    if (shape := np.shape(found)) != (kernel.devices,):
        expected = f"an action of each of {kernel.devices} devices"
        raise InputError("policy", expected, f"actions of shape {shape}", "Give one of this network")


class Steps(Protocol):
    """A network's transition in pure JAX."""

    @property
    def devices(self) -> int:
        """Number of devices."""
        ...

    def initial(self) -> Any:
        """The state at the start of an episode."""
        ...

    def step(
        self, key: PRNGKeyArray, parameters: Any, state: Any, action: Int[Array, " device"]
    ) -> tuple[Any, Any]:
        """One slot: the next state, and what happened."""
        ...


def draw_pool(
    key: PRNGKeyArray, sampler: Sampler, n: int, sites: tuple[str, ...] = SITES
) -> dict[str, Float[Array, "draw ..."]]:
    """Parameters of a kernel for episodes to choose from, in the precision in use; whole numbers stay whole.

    Args:
        key: typed JAX key.
        sampler: posterior, point estimate or ground truth.
        n: how many draws.
        sites: the parameters that the kernel takes.

    Raises:
        InputError: the sampler lacks one.
    """
    found = sampler.sample(key, n)
    for site in sites:
        if site not in found:
            remedy = "Take a posterior of the model that the kernel belongs to"
            raise InputError("sampler", f"draws of {site!r}", f"of {', '.join(found)}", remedy)
    return {site: _in_precision(found[site]) for site in sites}


def _in_precision(value: Any) -> Array:
    array = jnp.asarray(value)
    return array.astype(float) if jnp.issubdtype(array.dtype, jnp.floating) else array


def rollout(key: PRNGKeyArray, kernel: Steps, parameters: Parameters, policy: Policy, horizon: int) -> Any:
    """The slots of one episode, each field (slot, ...).

    Args:
        key: typed JAX key.
        kernel: the network.
        parameters: of its transition.
        policy: what the devices do.
        horizon: slots.
    """

    def one(state: Any, key: PRNGKeyArray) -> tuple[Any, Any]:
        act, move = jax.random.split(key)
        return kernel.step(move, parameters, state, policy(act, state))

    return jax.lax.scan(one, kernel.initial(), jax.random.split(key, horizon))[1]


def throughput(slots: Any) -> Float[Array, ""]:
    """Mean number of packets delivered per slot."""
    return jnp.mean(jnp.sum(slots.delivered, axis=-1, dtype=float))


def overflow(slots: Any) -> Float[Array, ""]:
    """Mean number of packets lost to full buffers per device and slot."""
    return jnp.mean(jnp.asarray(slots.overflow, float))


def random_access(devices: int, probability: float | Array) -> Policy:
    """Slotted ALOHA: each device with a packet transmits with this probability.

    Raises:
        InputError: a probability outside of [0, 1].
    """
    if isinstance(probability, int | float) and not 0 <= probability <= 1:
        raise InputError("probability of random access", "from 0 to 1", f"{probability:g}", "Correct it")

    def act(key: PRNGKeyArray, state: Any) -> Int[Array, " device"]:
        chosen = jax.random.bernoulli(key, probability, (devices,))
        return (chosen & (state.buffer > 0)).astype(jnp.int32)

    return act
