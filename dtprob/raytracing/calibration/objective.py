"""What the schemes minimise over the gains of the paths, and what a measurement leaves of it."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dtprob.errors import InputError
from dtprob.raytracing.calibration.phases import Phasors
from dtprob.raytracing.calibration.settings import Settings
from dtprob.raytracing.calibration.statistics import Statistics


def turned(statistics: Statistics, turn: Array) -> Statistics:
    """The statistics of the measurement turned back by its common phases."""
    return eqx.tree_at(lambda s: s.product, statistics, statistics.product * jnp.conj(turn))


def residual(gain: Array, phasors: Phasors, statistics: Statistics) -> Float[Array, "link snapshot"]:
    """E |h - sum_p exp(j z_p) a_p|^2."""
    means = phasors.mean * gain[:, None]
    own = jnp.abs(gain) ** 2 * jnp.real(jnp.diagonal(statistics.gram, axis1=1, axis2=2))
    crossed = jnp.real(jnp.einsum("lsp,lpq,lsq->ls", jnp.conj(means), statistics.gram, means))
    matched = jnp.real(jnp.sum(jnp.conj(means) * statistics.product, axis=2))
    spread = jnp.sum(own[:, None] * (1 - phasors.length**2), axis=2)
    return statistics.energy - 2 * matched + crossed + spread


def objective_of(settings: Settings, phasors: Phasors, statistics: Statistics) -> Callable[[Array], Array]:
    """What a scheme minimises, as a function of the gains (link, path).

    Each is quadratic, in the gains or in their powers, with coefficients that hold all snapshots.
    """
    if settings.scheme == "uniform":
        return _of_powers(statistics)
    if settings.scheme == "oblivious":
        weight = jnp.full_like(statistics.energy, 1 / jnp.sum(statistics.energy))
        mean, length = jnp.ones_like(phasors.mean), jnp.ones_like(phasors.length)
    else:
        heard = statistics.energy > 0  # a link of which nothing was received says nothing of the gains
        weight = jnp.where(heard, 1 / jnp.where(heard, statistics.energy, 1.0), 0.0) / statistics.energy.size
        mean, length = phasors.mean, phasors.length
    linear = jnp.einsum("ls,lsp,lsp->lp", weight, jnp.conj(mean), statistics.product)
    pairs = jnp.einsum("ls,lsp,lsq->lpq", weight, jnp.conj(mean), mean) * statistics.gram
    own = jnp.real(jnp.diagonal(statistics.gram, axis1=1, axis2=2))
    spread = own * jnp.einsum("ls,lsp->lp", weight, 1 - length**2)
    constant = jnp.sum(weight * statistics.energy)

    def objective(gain: Array) -> Array:
        fit = jnp.sum(jnp.conj(gain) * jnp.einsum("lpq,lq->lp", pairs, gain))
        fit -= 2 * jnp.sum(jnp.conj(gain) * linear)
        return constant + jnp.real(fit) + jnp.sum(spread * jnp.abs(gain) ** 2)

    return objective


def _of_powers(statistics: Statistics) -> Callable[[Array], Array]:
    """Squared difference of measured and modelled powers over the square of the measured ones."""
    kept = statistics.power
    if kept is None:
        raise InputError("statistics for the scheme 'uniform'", "powers", "none", "Project with powers=True")
    total = jnp.sum(kept.square)

    def objective(gain: Array) -> Array:
        power = jnp.real(gain) ** 2 + jnp.imag(gain) ** 2
        fit = jnp.einsum("lp,lpq,lq->", power, kept.normal, power)
        return (total - 2 * jnp.sum(power * kept.right) + fit) / total

    return objective
