"""How often intervals for a metric of the next 200 slots hold it, for twins learned from 10 to 200 slots."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from dtprob.inference import PointMass, Sampler
from dtprob.inference.concentrations import LearnedConcentration
from dtprob.inference.exact import DirichletTables
from dtprob.models.dirichlet import log_shares
from dtprob.models.multi_access import Clusters, kernel, priors
from dtprob.physical.multi_access import Network, PhysicalKernel
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress
from dtprob.twin.predict import Prediction, predict
from dtprob.twin.rollout import Metric, random_access, rollout, throughput

RUNS: Final = 300
"""Twins, each learned from data of its own."""
SLOTS: Final = (10, 20, 50, 200)
HORIZON: Final = 200
LEVEL: Final = 0.9
METRICS: Final = {"throughput": throughput}
_TRUTH: Final = Network.reference()
_CLUSTERS: Final = Clusters(_TRUTH.clusters)
_PRIOR: Final = {"bayesian": 0.01, "bayesian_jeffreys": 0.5}
_NAMES: Final = (*_PRIOR, "bayesian_learned", "map")
_MODE: Final = 1.01
_TWIN: Final = kernel(_TRUTH.clusters)
_POLICY: Final = random_access(_CLUSTERS.devices, 0.4)
_DRAWS, _EPISODES, _AT_ONCE = 60, 2, 40
_SITE: Final = "log_arrival"


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    cells = {
        slots: progress.part(
            f"{runs} twins of {slots} slots",
            lambda slots=slots: _cell(jax.random.fold_in(key, slots), runs, slots),
        )
        for slots in SLOTS
    }
    notes = [
        f"Random access with probability 0.4; horizon {HORIZON} slots; {_DRAWS} draws, {_EPISODES} episodes of each.",
        "bayesian: prior concentration .01; bayesian_jeffreys: .5; bayesian_learned: each table's is learned;",
        "map: the mode under 1.01, its own randomness only.",
    ]
    panels: list[Panel] = []
    for metric in METRICS:
        covered = [_coverage(name, metric, cells) for name in _NAMES]
        notes += [
            f"{metric}, {s.name}: "
            + ", ".join(f"T={t:.0f} {value:.3f}" for t, value in zip(s.x, s.median, strict=True))
            for s in covered
        ]
        x, y = Quantity("training slots", is_log=True), Quantity("coverage of 90% intervals")
        panels.append(Panel(metric, x, y, tuple(covered)))
        widths = [
            Series.of_runs(
                name, SLOTS, np.stack([cells[t][f"{name}.{metric}.width"] for t in SLOTS], axis=-1)
            )
            for name in _NAMES
        ]
        panels.append(Panel(metric, x, Quantity("width of 90% intervals"), tuple(widths)))
    return Figure("prediction", "predictions of the twin", tuple(panels), runs, tuple(notes))


def _coverage(name: str, metric: str, cells: Mapping[int, Mapping[str, np.ndarray]]) -> Series:
    """Share of intervals that hold the value, with two standard errors."""
    inside = np.stack([cells[t][f"{name}.{metric}.inside"] for t in SLOTS], axis=-1)
    share = inside.mean(axis=0)
    error = 2 * np.sqrt(share * (1 - share) / len(inside))
    return Series(name, np.asarray(SLOTS, float), share, share - error, share + error)


def _cell(key: PRNGKeyArray, runs: int, slots: int) -> dict[str, np.ndarray]:
    """Whether each interval holds the value that came, `<method>.<metric>.inside` (run,), and its width."""
    keys = jax.random.split(key, 3)
    truth = {name: jnp.asarray(value) for name, value in _TRUTH.parameters.items()}
    counts = {name: np.asarray(value) for name, value in _collected(keys[0], truth, runs, slots).items()}
    came = _realised(keys[1], truth, runs)
    found: dict[str, list[np.ndarray]] = {}
    for start in range(0, runs, _AT_ONCE):
        own = {name: value[start : start + _AT_ONCE] for name, value in counts.items()}
        for method, sampler in _samplers(own).items():
            for metric, function in METRICS.items():
                foreseen = _foreseen(jax.random.fold_in(keys[2], start), sampler, function, len(own[_SITE]))
                limits = np.array([prediction.interval(LEVEL) for prediction in foreseen])
                value = came[metric][start : start + _AT_ONCE]
                inside = (limits[:, 0] <= value) & (value <= limits[:, 1])
                found.setdefault(f"{method}.{metric}.inside", []).append(inside.astype(float))
                found.setdefault(f"{method}.{metric}.width", []).append(limits[:, 1] - limits[:, 0])
    return {name: np.concatenate(values) for name, values in found.items()}


def _foreseen(key: PRNGKeyArray, sampler: Sampler, metric: Metric, twins: int) -> list[Prediction]:
    """The metric foreseen by each of some twins, which the sampler's draws take in turn."""
    together = predict(
        key,
        _TWIN,
        sampler,
        policy=_POLICY,
        metric=metric,
        horizon=HORIZON,
        draws=_DRAWS * twins,
        episodes=_EPISODES,
    )
    values = together.values.reshape(_DRAWS, twins, _EPISODES)
    return [Prediction(values[:, twin]) for twin in range(twins)]


@final
@dataclass(frozen=True)
class _InTurn:
    """Draws of several twins in turn, from a sampler whose sites have the twins as their first axis."""

    twins: Sampler

    def sample(self, key: PRNGKeyArray, n: int) -> dict[str, np.ndarray]:
        """`n` draws, the same number of each twin."""
        first = self.twins.sample(key, 1)
        count = next(iter(first.values())).shape[1]
        drawn = self.twins.sample(key, n // count)
        return {name: value.reshape(n, *value.shape[2:]) for name, value in drawn.items()}


def _samplers(counts: Mapping[str, np.ndarray]) -> dict[str, Sampler]:
    """The samplers of some twins together."""

    def repeated(a: float) -> dict[str, np.ndarray]:
        return {
            name: np.broadcast_to(value, counts[name].shape) for name, value in priors(_CLUSTERS, a).items()
        }

    found: dict[str, Sampler] = {
        name: _InTurn(DirichletTables(repeated(a)).updated(counts)) for name, a in _PRIOR.items()
    }
    allowed = {name: value > 0 for name, value in repeated(1.0).items()}
    found["bayesian_learned"] = _InTurn(
        LearnedConcentration({name: value > 0 for name, value in priors(_CLUSTERS, 1.0).items()}, counts)
    )
    mode = {name: log_shares(value + _MODE - 1, allowed[name]) for name, value in counts.items()}
    return {**found, "map": _InTurn(PointMass(mode))}


def _collected(key: PRNGKeyArray, truth: Mapping[str, Array], runs: int, slots: int) -> dict[str, Array]:
    """Counts of each run's log under random access, a transmit probability drawn in every slot."""
    system = PhysicalKernel.of(_TRUTH)

    def step(state: Any, key: PRNGKeyArray) -> tuple[Any, tuple[Array, ...]]:
        own = jax.random.split(key, 3)
        chance = jax.random.uniform(own[1])
        action = jax.random.bernoulli(own[0], chance, (system.devices,)).astype(jnp.int32)
        after, slot = system.step(own[2], truth, state, action)
        senders = jnp.sum(action * (state.buffer > 0))
        return after, (_CLUSTERS.encode(after.arrival), senders, jnp.sum(slot.delivered))

    def one(key: PRNGKeyArray) -> dict[str, Array]:
        _, (joint, senders, delivered) = jax.lax.scan(step, system.initial(), jax.random.split(key, slots))
        place = jnp.arange(len(_TRUTH.clusters))
        arrival = jnp.zeros(_TRUTH.arrival.shape).at[place, 0, joint].add(1.0)
        return {
            "log_arrival": arrival,
            "log_reception": jnp.zeros(_TRUTH.reception.shape).at[senders, delivered].add(1.0),
        }

    return jax.jit(jax.vmap(one))(jax.random.split(key, runs))


def _realised(key: PRNGKeyArray, truth: Mapping[str, Array], runs: int) -> dict[str, np.ndarray]:
    """The metrics of an episode of the true network for each run."""
    system = PhysicalKernel.of(_TRUTH)

    def one(key: PRNGKeyArray) -> dict[str, Array]:
        slots = rollout(key, system, truth, _POLICY, HORIZON)
        return {name: metric(slots) for name, metric in METRICS.items()}

    values = jax.jit(jax.vmap(one))(jax.random.split(key, runs))
    return {name: np.asarray(value) for name, value in values.items()}
