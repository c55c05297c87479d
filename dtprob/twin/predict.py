"""Foreseeing a metric over a horizon, with what is not known of the network kept apart from its own randomness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.posterior import Sampler
from dtprob.models.multi_access.transition import SITES, Kernel
from dtprob.twin.rollout import Metric, Parameters, Policy, Steps, check_policy, draw_pool, rollout


@final
@dataclass(frozen=True)
class Prediction:
    """A metric foreseen.

    Attributes:
        values: of each episode under each draw of the parameters, (draw, episode).
    """

    values: Float[np.ndarray, "draw episode"]

    @property
    def mean(self) -> float:
        """The expected metric."""
        return float(self.values.mean())

    @property
    def aleatoric(self) -> float:
        """Variance that the network's own randomness causes: the mean over draws of the variance within."""
        return float(self.values.var(axis=1, ddof=1).mean())

    @property
    def epistemic(self) -> float:
        """Variance for want of knowledge: of the draws' expected metrics, freed of the noise of their means.

        About 0 for a point estimate; the sum of both is the metric's variance (law of total variance).
        """
        draws, episodes = self.values.shape
        if draws < 2:
            return 0.0
        return max(float(self.values.mean(axis=1).var(ddof=1)) - self.aleatoric / episodes, 0.0)

    def interval(self, level: float = 0.9) -> tuple[float, float]:
        """Limits between which the metric of one episode lies with probability `level`."""
        tail = (1 - _checked(level)) / 2
        low, high = np.quantile(self.values, [tail, 1 - tail])
        return float(low), float(high)

    def expected_interval(self, level: float = 0.9) -> tuple[float, float]:
        """Limits between which the expected metric lies with probability `level`.

        The draws' means are pulled together by the share of their spread that is noise of few episodes.
        """
        tail = (1 - _checked(level)) / 2
        means = self.values.mean(axis=1)
        spread = means.std(ddof=1) if len(means) > 1 else 0.0
        shrink = np.sqrt(self.epistemic) / spread if spread > 0 else 0.0
        low, high = np.quantile(means.mean() + shrink * (means - means.mean()), [tail, 1 - tail])
        return float(low), float(high)


def predict(
    key: PRNGKeyArray,
    kernel: Steps,
    sampler: Sampler,
    *,
    policy: Policy,
    metric: Metric,
    horizon: int,
    draws: int = 200,
    episodes: int = 20,
    sites: tuple[str, ...] = SITES,
) -> Prediction:
    """Foresee a metric of episodes from the start, under a policy.

    Args:
        key: typed JAX key.
        kernel: the network.
        sampler: of its parameters: a posterior, a point estimate or the truth.
        policy: what the devices do; the same function again is not compiled again.
        metric: from slots to a number, such as `throughput`.
        horizon: slots of an episode.
        draws: of the parameters.
        episodes: under each draw.
        sites: the parameters that the kernel takes.

    Raises:
        InputError: counts below 1, fewer than 2 episodes, a policy or tables of another network, or a sampler that lacks a
            site.
    """
    check_counts({"horizon": (horizon, 1), "draws": (draws, 1), "episodes": (episodes, 2)})
    check_policy(kernel, policy)
    parameters = draw_pool(jax.random.fold_in(key, 0), sampler, draws, sites)
    check_tables(kernel, parameters)
    keys = jax.random.split(jax.random.fold_in(key, 1), (draws, episodes))
    return Prediction(np.asarray(_values(keys, parameters, kernel, policy, metric, horizon=horizon), float))


@eqx.filter_jit
def _values(
    keys: PRNGKeyArray, parameters: Parameters, kernel: Steps, policy: Policy, metric: Metric, *, horizon: int
) -> Float[Array, "draw episode"]:
    """The metric of each episode; compiled once per kernel, policy, metric and shape."""

    def one(key: PRNGKeyArray, chosen: Parameters) -> Float[Array, ""]:
        return metric(rollout(key, kernel, chosen, policy, horizon))

    return jax.vmap(jax.vmap(one, in_axes=(0, None)))(keys, parameters)


def check_tables(kernel: Steps, parameters: Parameters) -> None:
    """Refuse tables of another multi-access network, whose rows would be clamped; of other kernels nothing is known.

    Args:
        kernel: the network.
        parameters: its tables, each (draw, ...).

    Raises:
        InputError: a table of another shape.
    """
    if not isinstance(kernel, Kernel):
        return
    clusters = kernel.clusters
    tables = {
        "log_arrival": [clusters.arrival_allowed(memory=memory).shape for memory in (False, True)],
        "log_reception": [clusters.reception_allowed().shape],
    }
    for name, shapes in tables.items():
        if (found := parameters[name].shape[1:]) not in shapes:
            expected = " or ".join(map(str, shapes))
            remedy = "Take a posterior of the model that the kernel belongs to"
            raise InputError(
                f"draws of {name!r}", f"(draw, ...) with {expected} each", f"{found} each", remedy
            )


def check_counts(counts: Mapping[str, tuple[int, int]]) -> None:
    """Refuse counts that are too small; each with the least that it can be.

    Raises:
        InputError: one below it.
    """
    for name, (value, least) in counts.items():
        if value < least:
            raise InputError(name, f"{least} or more", str(value), f"Give a larger {name}")


def _checked(level: float) -> float:
    if not 0 < level < 1:
        raise InputError("level of an interval", "a probability between 0 and 1", f"{level:g}", "Correct it")
    return level
