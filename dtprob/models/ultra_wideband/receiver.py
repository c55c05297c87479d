"""What is unknown of a receiver of pulses: its levels, its time origin, the response of pulse and filters."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

GAIN_SPREAD: Final = 0.35
"""Standard deviation of a link's departure from the gain law, Np."""
RANGING_SPREAD: Final = 0.6e-9
"""Scale of a link's error of two-way ranging, s, Student's t with `RANGING_TAIL` degrees of freedom."""
RANGING_TAIL: Final = 3.0
_RANGING_OFFSET: Final = (2.0e-9, 1.0e-9)
"""Mean and standard deviation, s, of what is common to all errors of ranging, the rise of the pulse included."""
_LOG_GAINS: Final = range(1, 9)
_PHASES: Final = range(2, 9)
_TRANSMITTED: Final = 3.7e-5
_SATURATED: Final = 1.3e-11


class Receiver(NamedTuple):
    """What is unknown of the receiver, per link, and its gain law.

    Attributes:
        delay: of its time origin, s, (link,).
        log_gain: departure from the gain law, Np, (link,).
        transmitted: radiated power, W.
        saturated: the reported level that no link exceeds, W.
    """

    delay: jax.Array
    log_gain: jax.Array
    transmitted: jax.Array
    saturated: jax.Array


def unknown_levels() -> tuple[jax.Array, jax.Array]:
    """Radiated power and the level that no link exceeds, W."""
    transmitted: Any = numpyro.sample("transmitted_power", dist.LogNormal(np.log(_TRANSMITTED), 1.0))
    saturated: Any = numpyro.sample("saturated_level", dist.LogNormal(np.log(_SATURATED), 0.5))
    return transmitted, saturated


def ranging_offset() -> jax.Array:
    """What all time origins are late by where two-way ranging says them, s."""
    offset: Any = numpyro.sample("ranging_offset", dist.Normal(0.0, 1.0))
    return jnp.asarray(_RANGING_OFFSET[0] + _RANGING_OFFSET[1] * offset)


def unknown_pulse(subcarrier_frequency: jax.Array) -> jax.Array:
    """Response of pulse and filters, (subcarrier,): common to all links, no constant, no delay."""
    low, high = jnp.min(subcarrier_frequency), jnp.max(subcarrier_frequency)
    x = (2.0 * subcarrier_frequency - low - high) / (high - low)
    orders = _legendre(x, max(*_LOG_GAINS, *_PHASES))
    with numpyro.plate("log_gain_order", len(_LOG_GAINS)):
        log_gain: Any = numpyro.sample("pulse_log_gain", dist.Normal(0.0, 0.3))
    with numpyro.plate("phase_order", len(_PHASES)):
        angle: Any = numpyro.sample("pulse_phase", dist.Normal(0.0, 0.5))
    exponent = log_gain @ orders[_LOG_GAINS.start : _LOG_GAINS.stop]
    return jnp.exp(exponent) * turn(angle @ orders[_PHASES.start : _PHASES.stop])


def turn(angle: jax.Array) -> jax.Array:
    """exp(j angle)."""
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def gain_law(level: jax.Array, receiver: Receiver) -> jax.Array:
    """Amplitude by which the receiver scales the channel, (link,), given its path gain in power."""
    return jnp.exp(receiver.log_gain) * jnp.sqrt(
        receiver.transmitted / (1.0 + receiver.transmitted * level / receiver.saturated)
    )


def _legendre(x: jax.Array, highest: int) -> jax.Array:
    """Legendre polynomials of orders 0 to `highest`, (order, subcarrier)."""
    rows = [jnp.ones_like(x), x]
    for n in range(1, highest):
        rows.append(((2 * n + 1) * x * rows[n] - n * rows[n - 1]) / (n + 1))
    return jnp.stack(rows)
