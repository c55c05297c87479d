"""What if: the average effect of another policy or another network, and what a logged episode would have been.

The first is an intervention: both arms run anew, with the same luck, under each draw of the parameters. The second is
about one episode that happened: its luck is drawn given its log (abduction), and the episode runs again with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.posterior import Sampler
from dtprob.models.multi_access.abduction import Transition, abduct
from dtprob.models.multi_access.transition import SITES, Kernel, State
from dtprob.twin.predict import Prediction, check_counts, check_tables
from dtprob.twin.rollout import Metric, Parameters, Policy, Steps, check_policy, draw_pool, rollout


def unchanged(parameters: Parameters) -> Parameters:
    """The learned network."""
    return parameters


class Arm(NamedTuple):
    """What an intervention sets.

    Attributes:
        policy: what the devices do.
        change: the network that is set in the place of the learned one, from its parameters; none by default.
        kernel: the transition that is set; the learned network's by default.
    """

    policy: Policy
    change: Callable[[Parameters], Parameters] = unchanged
    kernel: Steps | None = None


@final
@dataclass(frozen=True)
class Effect:
    """The difference that an intervention makes.

    Attributes:
        differences: of the metric, alternative less baseline, in episodes of the same luck, (draw, episode).
    """

    differences: Float[np.ndarray, "draw episode"]

    @property
    def average(self) -> float:
        """The average treatment effect."""
        return float(self.differences.mean())

    def interval(self, level: float = 0.9) -> tuple[float, float]:
        """Credible limits of the average treatment effect, over draws of the parameters.

        They are freed of the noise of few episodes, as those of an expected metric are.
        """
        return Prediction(self.differences).expected_interval(level)


def average_effect(
    key: PRNGKeyArray,
    kernel: Steps,
    sampler: Sampler,
    *,
    baseline: Arm,
    alternative: Arm,
    metric: Metric,
    horizon: int,
    draws: int = 200,
    episodes: int = 20,
    sites: tuple[str, ...] = SITES,
) -> Effect:
    """The average effect of an intervention on model or policy.

    Args:
        key: typed JAX key.
        kernel: the network.
        sampler: of its parameters.
        baseline: what is compared with.
        alternative: what is set instead.
        metric: from slots to a number.
        horizon: slots of an episode.
        draws: of the parameters.
        episodes: under each draw; both arms have the same luck.
        sites: the parameters that the kernel takes.

    Raises:
        InputError: counts below 1, fewer than 2 episodes, a policy or tables of another network, or a sampler that lacks a
            site.
    """
    check_counts({"horizon": (horizon, 1), "draws": (draws, 1), "episodes": (episodes, 2)})
    for arm in (baseline, alternative):
        check_policy(arm.kernel or kernel, arm.policy)
    parameters = draw_pool(jax.random.fold_in(key, 0), sampler, draws, sites)
    check_tables(kernel, parameters)
    for arm in (baseline, alternative):
        check_tables(arm.kernel or kernel, _changed(arm.change, parameters))
    keys = jax.random.split(jax.random.fold_in(key, 1), (draws, episodes))

    arms = (baseline, alternative)
    return Effect(np.asarray(_differences(keys, parameters, kernel, arms, metric, horizon=horizon), float))


def _changed(change: Callable[[Parameters], Parameters], parameters: Parameters) -> Parameters:
    """Shapes of the changed tables, each (draw, ...)."""
    return jax.eval_shape(jax.vmap(change), parameters)


@eqx.filter_jit
def _differences(
    keys: PRNGKeyArray,
    parameters: Parameters,
    kernel: Steps,
    arms: tuple[Arm, Arm],
    metric: Metric,
    *,
    horizon: int,
) -> Float[Array, "draw episode"]:
    """Metric of the second arm less that of the first."""

    def one(key: PRNGKeyArray, chosen: Parameters) -> Float[Array, ""]:
        before, after = (
            metric(rollout(key, arm.kernel or kernel, arm.change(chosen), arm.policy, horizon))
            for arm in arms
        )
        return after - before

    return jax.vmap(jax.vmap(one, in_axes=(0, None)))(keys, parameters)


class LogLike(Protocol):
    """An episode of a network's log."""

    @property
    def buffer(self) -> Int[np.ndarray, "slot device"]: ...  # noqa: D102

    @property
    def action(self) -> Int[np.ndarray, "slot device"]: ...  # noqa: D102

    @property
    def ack(self) -> Int[np.ndarray, "slot device"]: ...  # noqa: D102

    @property
    def arrival(self) -> Int[np.ndarray, "slot device"]: ...  # noqa: D102


def transitions(episode: LogLike) -> Transition:
    """The slots of one logged episode, each field (slot, device); nothing arrived before the first.

    They are numbered as in the log where it numbers them, else from 0.

    Raises:
        InputError: slots of several episodes, or columns in the place of an episode.
    """
    if isinstance(episode, Mapping):
        raise InputError("episode", "a NetworkLog", "columns by name", "Give NetworkLog(**columns)")
    several = len(np.unique(np.asarray(getattr(episode, "episode", 0))))
    if several > 1:
        raise InputError(
            "episode", "the slots of one", f"those of {several}", "Give one episode after the other"
        )
    arrival, ack = (jnp.asarray(x, jnp.int32) for x in (episode.arrival, episode.ack))
    last_arrival, last_ack = (jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]]) for x in (arrival, ack))
    slot = jnp.asarray(getattr(episode, "slot", np.arange(len(arrival))), jnp.int32)
    state = State(jnp.asarray(episode.buffer, jnp.int32), last_arrival, last_ack, slot)
    return Transition(state, jnp.asarray(episode.action, jnp.int32), ack, arrival)


def what_if(
    key: PRNGKeyArray,
    kernel: Kernel,
    sampler: Sampler,
    episode: LogLike,
    *,
    policy: Policy | None = None,
    change: Callable[[Parameters], Parameters] = unchanged,
    draws: int = 100,
) -> Any:
    """What a logged episode would have been under another policy or in a changed network.

    For each draw of the parameters the luck of every slot is drawn given what happened, and the episode runs again from
    its first state with that luck. With the logged actions in the learned network it is the logged episode, exactly.

    Args:
        key: typed JAX key.
        kernel: the network.
        sampler: of its parameters, best a posterior that knows the episode.
        episode: its log.
        policy: what the devices would have done; the logged actions by default.
        change: the network that would have been, from the learned parameters.
        draws: of parameters and luck.

    Returns:
        The slots, each field (draw, slot, ...).

    Raises:
        InputError: no draws, an episode, policy or tables of another network, columns in the place of an episode, or one
            that could not happen under a draw of the parameters.
    """
    check_counts({"draws": (draws, 1)})
    if policy is not None:
        check_policy(kernel, policy)
    parameters = draw_pool(jax.random.fold_in(key, 0), sampler, draws)
    happened = transitions(episode)
    _check_buffers(kernel, episode)
    check_tables(kernel, parameters)
    check_tables(kernel, _changed(change, parameters))

    keys = jax.random.split(jax.random.fold_in(key, 1), draws)
    slots, could = _replayed(keys, happened, parameters, kernel, policy, change=change)
    if not bool(jnp.all(could)):
        draw, slot = (int(i) for i in np.argwhere(~np.asarray(could))[0])
        remedy = "Learn the parameters from this log too"
        raise InputError("episode", "slots that can happen", f"slot {slot} under draw {draw}", remedy)
    return slots


def _check_buffers(kernel: Kernel, episode: LogLike) -> None:
    """Refuse a log whose buffers are not those that the network would have had."""
    remedy = "Give the network that was logged"
    found = episode.buffer.shape[1]
    if found != kernel.devices:
        raise InputError("episode", f"{kernel.devices} devices, as in the network", str(found), remedy)
    after = np.clip(episode.buffer + episode.arrival - episode.ack, 0, kernel.capacity)
    expected = np.concatenate([np.minimum(episode.buffer[:1], kernel.capacity), after[:-1]])
    if not np.array_equal(expected, episode.buffer):
        slot, device = (int(i) for i in np.argwhere(expected != episode.buffer)[0])
        wanted = f"{expected[slot, device]} packets, as capacity {kernel.capacity} leaves"
        got = f"{episode.buffer[slot, device]} in its slot {slot}"
        raise InputError(f"episode, buffer_{device}", wanted, got, remedy)


@eqx.filter_jit
def _replayed(
    keys: PRNGKeyArray,
    happened: Transition,
    parameters: Parameters,
    kernel: Kernel,
    policy: Policy | None,
    *,
    change: Callable[[Parameters], Parameters],
) -> tuple[Any, Bool[Array, "draw slot"]]:
    """The episode of each draw, and which slots could happen under it."""

    def run(key: PRNGKeyArray, chosen: Parameters) -> tuple[Any, Bool[Array, " slot"]]:
        own = jax.random.split(key, (2, len(happened.action)))
        noise, could = jax.vmap(lambda k, slot: abduct(kernel, k, chosen, slot))(own[0], happened)
        changed = change(chosen)

        def one(state: Any, given: tuple[Any, Array, PRNGKeyArray]) -> tuple[Any, Any]:
            luck, action, act = given
            return kernel.respond(luck, changed, state, action if policy is None else policy(act, state))

        first = jax.tree.map(lambda x: x[0], happened.state)
        return jax.lax.scan(one, first, (noise, happened.action, own[1]))[1], could

    return jax.vmap(run)(keys, parameters)
