"""Changes of the parameters of a family of observations that shift one of its rows by a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp

from dtprob.gap.observation import discrete, residuals
from dtprob.gap.observation.likelihood import Move
from dtprob.gap.observation.residuals import Parameters

_CERTAIN: Final = 0.05
"""Root of an information below which a row tells nearly nothing, as the deviation of an outcome that is nearly certain."""


def held(root: jax.Array) -> jax.Array:
    """The step that goes with the root of an information, less far where there is nearly none."""
    return 1 / jnp.maximum(root, _CERTAIN)


def to_loc(deviation: Callable[[Parameters], jax.Array]) -> Move:
    """Moves a location by steps of a deviation."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        return {**p, "loc": p["loc"] + step * deviation(p)}

    return move


def grown(name: str, rate: Callable[[Parameters], Any] = lambda _: 1.0) -> Move:
    """Multiplies a positive parameter by exp(step times rate)."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        return {**p, name: p[name] * jnp.exp(step * rate(p))}

    return move


def at_same_mean(spread: Callable[[Parameters], jax.Array]) -> Move:
    """Another concentration, of which there is so much information, and the rate with it."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        factor = jnp.exp(step / (p["concentration"] * spread(p)))
        return {**p, "concentration": p["concentration"] * factor, "rate": p["rate"] * factor}

    return move


def weibull_respread(p: Parameters, step: jax.Array) -> Parameters:
    """Another concentration, the scale changed so that the first row stays."""
    change = step * 6.0**0.5 / jnp.pi
    scale = p["scale"] * jnp.exp((1 - residuals.EULER) * change / p["concentration"])
    return {**p, "concentration": p["concentration"] * jnp.exp(change), "scale": scale}


def to_odds(p: Parameters, step: jax.Array) -> Parameters:
    """Other log odds of the same total concentration."""
    change = step / residuals.beta_spread(p)[2]
    up, down = (jnp.exp(sign * change / p[n]) for sign, n in ((1, "concentration1"), (-1, "concentration0")))
    return {**p, "concentration1": p["concentration1"] * up, "concentration0": p["concentration0"] * down}


def beta_respread(p: Parameters, step: jax.Array) -> Parameters:
    """Another total concentration of the same log odds."""
    first, second, odds_spread, size_spread = residuals.beta_spread(p)
    change = step / size_spread / odds_spread**2
    return {
        **p,
        "concentration1": p["concentration1"] * jnp.exp(change * second / p["concentration1"]),
        "concentration0": p["concentration0"] * jnp.exp(change * first / p["concentration0"]),
    }


def to_logits(p: Parameters, step: jax.Array) -> Parameters:
    """Logits that shift the row by the step; less far where the outcome is nearly certain."""
    return {**p, "logits": p["logits"] + step * held(discrete.logits_deviation(p))}
