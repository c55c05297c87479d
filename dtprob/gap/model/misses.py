"""By how much predictions miss what was seen: in the units of the data, and in numbers that a model's users speak of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp

from dtprob.gap.model.running import Outcome, Runner
from dtprob.gap.observation import whiten
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.models.arguments import Data
from dtprob.models.declaration import metadata

_DECIBELS: Final = 10.0 / math.log(10.0)


class Miss(NamedTuple):
    """Sums over each cluster (cluster,).

    Attributes:
        error: of squared errors; those of log-normal observations, as received powers are, in dB.
        signal: of squares of complex numbers that were seen; zero of all else, of which a relative error says nothing.
        count: of entries.
    """

    error: Any
    signal: Any
    count: Any


def misses(runner: Runner, found: Outcome, data: Data) -> dict[str, Miss]:
    """Of every observed site with a mean, and of every measure that the model declares."""
    observed = runner.around(found.parameters)
    result = {}
    for name, one in observed.items():
        entries = _entries(one, found.values[name])
        if entries is not None:
            result[name] = Miss(*(_by_cluster(runner, name, one.masked(part)) for part in entries))
    sites = found.everything
    for name, measure in metadata(runner.declared.model).measures.items():
        one = observed[measure.site]
        predicted, seen = measure.numbers(sites, data)
        shape = runner.rows.shapes[measure.site][1:]
        excess = jnp.broadcast_to(jnp.asarray(predicted - seen, float), shape)
        count = _by_cluster(runner, measure.site, one.masked(jnp.ones(shape)))
        mean = _by_cluster(runner, measure.site, one.masked(excess)) / jnp.maximum(count, 1.0)
        result[name] = Miss(mean**2, jnp.zeros_like(mean), jnp.sign(count))
    return result


def _entries(
    observation: whiten.Observation, value: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array] | None:
    """Squared error, squared signal and one for each entry; None of outcomes and classes, which have no mean."""
    parameters, one, nothing = observation.parameters, jnp.ones(value.shape), jnp.zeros(value.shape)
    if observation.family == "LogNormal":
        return (_DECIBELS * (jnp.log(value) - parameters["loc"])) ** 2, nothing, one
    if observation.family == "VonMises":
        return jnp.angle(jnp.exp(1j * (value - parameters["loc"]))) ** 2, nothing, one
    expected = likelihood(observation.family).mean
    if expected is not None:
        return (value - expected(parameters)) ** 2, nothing, one
    if "loc" in parameters:
        signal = jnp.abs(value) ** 2 if jnp.iscomplexobj(value) else nothing
        return jnp.abs(value - parameters["loc"]) ** 2, signal, one
    if likelihood(observation.family).is_outcome:
        return None
    return (value - whiten.distribution(observation).mean) ** 2, nothing, one


def _by_cluster(runner: Runner, name: str, entries: jax.Array) -> jax.Array:
    """Sums (cluster,) of one site's entries."""
    rows: Mapping[str, jax.Array] = {n: jnp.zeros(shape) for n, shape in runner.rows.shapes.items()}
    return runner.rows.stack({**rows, name: rows[name].at[0].set(entries)}).sum(1)
