"""Scores of an observed distribution as linear regression rows.

For each observation the gradient of log p in the distribution's parameters is turned into residuals e with mean zero and
unit covariance under the model, and a change of the parameters into the matching whitened shift. With W the whitened
tangents of the model, scores are W^T e and the Fisher information is W^T W, whatever the distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from dtprob.gap.observation.likelihood import About
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.observation.recognise import recognised
from dtprob.gap.observation.residuals import Parameters
from dtprob.wrapping import unwrapped


@dataclass(frozen=True)
class Observation:
    """The distribution of an observed site.

    Attributes:
        family: name of the distribution's class.
        parameters: each broadcast to the value's shape, those of classes and covariances with an axis more; "mask" is 0
            where an entry does not count, if any does not.
    """

    family: str
    parameters: Parameters

    def masked(self, rows: jax.Array) -> jax.Array:
        """Rows (..., *value) with zeros where the mask is."""
        return jnp.where(self.parameters["mask"] > 0, rows, 0.0) if "mask" in self.parameters else rows


def observation(fn: Any, value: Any, name: str, mask: Any = None) -> Observation:
    """Unwrap the distribution of an observed site.

    Args:
        fn: the distribution.
        value: the data.
        name: of the site.
        mask: which entries count, instead of what the distribution says.

    Raises:
        InputError: the diagnosis has no whitening for the distribution.
    """
    fn, own = unwrapped(fn)
    mask = own if mask is None else mask
    counted = None if mask is None else jnp.broadcast_to(jnp.asarray(mask, float), jnp.shape(value))
    family, parameters = recognised(fn, value, name, counted)
    if counted is not None:
        parameters["mask"] = counted
    return Observation(family, parameters)


def rewritten(observed: Observation, fn: Any, value: Any, name: str) -> Observation:
    """Unwrap a distribution that was made from `distribution(observed)`, with the mask of the observation itself."""
    return observation(fn, value, name, observed.parameters.get("mask"))


def log_prob(observed: Observation, value: jax.Array) -> jax.Array:
    """Elementwise log density, zero where masked; shape of the value."""
    known = likelihood(observed.family)
    if known.log_prob is not None:
        return observed.masked(known.log_prob(observed.parameters, value))
    value = _filled(observed, value)
    if known.density is not None:
        return observed.masked(known.density(observed.parameters, value))
    return observed.masked(distribution(observed).log_prob(value))


def impossible(observed: Observation, value: jax.Array) -> jax.Array:
    """Which values that count cannot be, as a count where the rate is 0; shape of the value."""
    found, told = ~(log_prob(observed, value) > -jnp.inf), likelihood(observed.family).impossible
    if told is not None:
        found |= told(observed.parameters, value)
    return observed.masked(found) > 0


def _filled(observed: Observation, value: jax.Array) -> jax.Array:
    """Values that can be instead of those that do not count: an infinite density has no gradient, masked or not."""
    if "mask" not in observed.parameters:
        return value
    support: Any = distribution(observed).support
    return jnp.where(
        observed.parameters["mask"] > 0, value, jnp.asarray(support.feasible_like(value), value.dtype)
    )


def sample(observed: Observation, key: jax.Array) -> jax.Array:
    """A replicate of the observation."""
    return distribution(observed).sample(key)


def distribution(observed: Observation) -> Any:
    """The NumPyro distribution, without its mask."""
    parameters = {n: v for n, v in observed.parameters.items() if n != "mask"}
    return likelihood(observed.family).make(**parameters)


def about(observed: Observation) -> About:
    """Residuals of values and shifts of changes, as `residual` and `shift` tell them, for loops over either."""
    known = likelihood(observed.family)
    if known.about is None:
        rows = About(partial(known.residual, observed.parameters), partial(known.shift, observed.parameters))
    else:
        rows = known.about(observed.parameters)

    def residuals(value: jax.Array) -> jax.Array:
        value = value if known.log_prob is not None else _filled(observed, value)
        return observed.masked(rows.residual(value))

    return About(residuals, lambda change: observed.masked(rows.shift(change)))


def residual(observed: Observation, value: jax.Array) -> jax.Array:
    """Whitened residuals, shape (component, *shape of the value): zero mean and identity covariance under the model."""
    return about(observed).residual(value)


def shift(observed: Observation, tangent: Mapping[str, jax.Array]) -> jax.Array:
    """Whitened shift of a change of the parameters, shape (component, *shape of the value)."""
    return about(observed).shift(dict(tangent))


def location_rows(family: str, n_rows: int) -> int:
    """How many of an observation's rows stand for its location or probability rather than its spread."""
    located = likelihood(family).located
    return n_rows if located is None else located


def is_joint(family: str) -> bool:
    """Whether entries along the last axis are one vector, of which no entry stands alone."""
    return likelihood(family).log_prob is not None


def moved(observed: Observation, step: jax.Array, *, spread: bool, about: bool = False) -> Observation | None:
    """The observation with its location, or its spread, moved by whitened steps; None where its family has no such move.

    Args:
        observed: what is observed.
        step: of the row, one for each value.
        spread: whether the first row that is no location is moved.
        about: whether steps near these will do, where theirs are slow to tell.
    """
    known = likelihood(observed.family)
    move = known.respread if spread else known.relocate
    if about and spread and known.respread_about is not None:
        move = known.respread_about
    return None if move is None else Observation(observed.family, move(observed.parameters, step))
