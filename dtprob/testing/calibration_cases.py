"""Models to calibrate engines on: small ones, and one of each kind that dtprob declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import PRNGKeyArray

from dtprob.models.channel import phase_error_channel
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.multi_access import Clusters, multi_access
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.generalised import posterior_data, prediction_powered
from dtprob.models.prediction_powered.sample import Sample
from dtprob.testing.calibration import Case, Simulated, from_prior
from dtprob.testing.room import room_paths


def normal() -> Case:
    """A linear regression."""
    return from_prior(_line, {"x": np.linspace(-1, 2, 6)})


def circular() -> Case:
    """A phase with an amplitude."""
    return from_prior(_wave, {"x": np.linspace(-1, 2, 6)})


def hierarchical() -> Case:
    """Groups around a common centre."""
    return from_prior(_groups, {"x": np.linspace(0.3, 1.2, 5)})


def network(slots: int = 50) -> Case:
    """Dynamics of three devices under random access: tables of arrivals and of receptions."""
    random = np.random.default_rng(0)
    data = {
        "sending": random.random((1, slots, 3)) < 0.5,
        "previous": np.zeros((1, slots, 2), np.int32),
        "valid": np.ones((1, slots), bool),
        "clusters": Clusters(((0, 1), (2,))),
        "concentration": 1.0,
    }
    return from_prior(multi_access, data)


def channel(links: int = 6) -> Case:
    """A room whose material, noise and phase errors are unknown: 3 paths, 16 tones over 400 MHz, about 10 dB."""
    data = {
        "paths": room_paths(links, 3),
        "subcarrier_frequency": 25.0e6 * (np.arange(16) - 7.5),
        "noise_power": 1e-7,
        "law": "half_space",
    }
    return from_prior(phase_error_channel, data)


def labels(n: int = 60, count: int = 500) -> Case:
    """A regression from few labels and many predictions, whose generalised posterior is calibrated."""
    coefficient = np.asarray([0.5, -0.8, 0.3])

    def simulate(key: PRNGKeyArray) -> Simulated:
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        x = np.column_stack([np.ones(n + count), random.normal(size=(n + count, 2))])
        y = x @ coefficient + random.normal(size=n + count)
        guess = 0.9 * y[:, None] + 0.2 + 0.5 * random.normal(size=(n + count, 3))
        sample = Sample(
            x=x[:n],
            y=y[:n],
            prediction=guess[np.arange(n), np.arange(n) % 3],
            x_unlabelled=x[n:],
            prediction_unlabelled=guess[n:],
        )
        found = estimate("ols", sample, "tuned_cppi")
        return Simulated(posterior_data("ols", sample, found), {"theta": coefficient})

    return Case(prediction_powered, simulate)


def custom() -> Case:
    """A user's own model: one level and noise power behind links that each have a phase."""
    return from_prior(_phasors, {"x": np.exp(0.7j * np.arange(5)), "links": 4})


CASES: Mapping[str, Callable[[], Case]] = {
    "normal": normal,
    "circular": circular,
    "hierarchical": hierarchical,
    "multi_access": network,
    "phase_error_channel": channel,
    "prediction_powered": labels,
    "custom": custom,
}
"""By name, what makes the case."""


def _line(x: Any, y: Any = None) -> None:
    level = numpyro.sample("level", dist.Normal(1.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(level + slope * x, 1.0), obs=y)


def _wave(x: Any, y: Any = None) -> None:
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    angle = numpyro.sample("angle", dist.VonMises(np.pi, 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(scale * jnp.cos(angle - x), 0.7), obs=y)


def _groups(x: Any, y: Any = None) -> None:
    centre = numpyro.sample("centre", dist.Normal(0.0, 1.0))
    spread = numpyro.sample("spread", dist.LogNormal(-0.5, 0.5))
    with numpyro.plate("group", len(x)):
        level = numpyro.sample("level", dist.Normal(centre, spread))
        numpyro.sample("y", dist.Normal(level, x), obs=y)


def _phasors(x: Any, links: int, y: Any = None) -> None:
    level = numpyro.sample("level", dist.LogNormal(0.0, 0.5))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("link", links, dim=-2):
        phase = numpyro.sample("phase", dist.VonMises(0.0, 1.0))
        with numpyro.plate("row", len(x), dim=-1):
            numpyro.sample("y", ComplexNormal(level * jnp.exp(1j * phase) * x, noise), obs=y)
