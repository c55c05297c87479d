"""Phase errors of paths given their responses: two E-steps, and the free energy that one of them lowers.

h = sum_p exp(j z_p) a_p + noise, z_p ~ von Mises(0, k0); the z_p of a snapshot get independent von Mises
distributions of direction mu_p and concentration k_p, of mean phasor m_p = R(k_p) exp(j mu_p), R = I1 / I0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import i0e, i1e
from jaxtyping import Array, Complex, Float

_LARGEST = 1e8


class Field(NamedTuple):
    """Inner products of the paths' responses a_p with one another and with the measurement, over the noise power.

    Attributes:
        matched: a_p^H h / s2.
        coupling: a_p^H a_q / s2.
        concentration: k0.
    """

    matched: Complex[Array, "link snapshot path"]
    coupling: Complex[Array, "link path path"]
    concentration: Float[Array, ""]

    @property
    def snr(self) -> Float[Array, "link path"]:
        """|a_p|^2 / s2."""
        return jnp.real(jnp.diagonal(self.coupling, axis1=1, axis2=2))


class Phasors(NamedTuple):
    """The angles' distributions.

    Attributes:
        mean: m_p.
        concentration: k_p.
    """

    mean: Complex[Array, "link snapshot path"]
    concentration: Float[Array, "link snapshot path"]

    @property
    def length(self) -> Float[Array, "link snapshot path"]:
        """R(k_p)."""
        return resultant(self.concentration)


def resultant(concentration: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """R(k) = I1(k) / I0(k), the mean of cos z."""
    return i1e(concentration) / i0e(concentration)


def concentration_of(length: Float[Array, ""]) -> Float[Array, ""]:
    """The concentration of a mean of cos z; 0 where that is negative.

    Newton's steps from the approximation of Best and Fisher (1981).
    """
    precision = jnp.finfo(jnp.result_type(length, 1.0))
    r = jnp.clip(length, 0.0, 1.0 - max(1.0 / _LARGEST, float(precision.eps)))
    small = 2 * r + r**3 + 5 * r**5 / 6
    large = 1 / jnp.maximum(r * (1 - r) * (3 - r), precision.tiny)
    told = min(1e4, 0.2 / float(precision.eps) ** 0.5)  # above it the slope is lost in rounding
    middle = -0.4 + 1.39 * r + 0.43 / (1 - r)
    kappa = jnp.where(r < 0.53, small, jnp.where(r < 0.85, middle, large))
    for _ in range(3):
        found = resultant(kappa)
        slope = 1 - found**2 - found / jnp.maximum(kappa, 1e-12)
        moved = kappa - (found - r) / jnp.maximum(slope, precision.tiny)
        kappa = jnp.where((kappa > 1e-6) & (kappa < told), jnp.maximum(moved, 0.0), kappa)
    return kappa


def no_error(field: Field) -> Phasors:
    """All angles zero, for certain."""
    return certain(jnp.ones_like(field.matched))


def certain(mean: Complex[Array, "link snapshot path"]) -> Phasors:
    """Angles that are known: those of phasors of length 1."""
    return Phasors(mean, jnp.full(mean.shape, _LARGEST, jnp.real(mean).dtype))


def reference(field: Field) -> Phasors:
    """The paper's E-step: phasors by least squares as if they were free numbers, of which the directions are kept."""
    identity = jnp.eye(field.coupling.shape[-1])
    # paths that are missing, and those that nothing tells apart, make the matrix singular
    ridge = max(1e-12, 10 * float(jnp.finfo(field.snr.dtype).eps))
    added = jnp.where(field.snr > 0, ridge * jnp.max(field.snr, axis=1, keepdims=True), 1.0)
    inverse = jnp.linalg.inv(field.coupling + added[:, :, None] * identity)
    free = jnp.einsum("lpq,lsq->lsp", inverse, field.matched + 0.5 * field.concentration)
    snr = jnp.broadcast_to(field.snr[:, None], free.shape)
    kappa = jnp.where(snr > 1, 2 * jnp.sqrt(snr * jnp.maximum(snr - 1, 0.0)), 0.0)
    return Phasors(_mean(kappa * jnp.exp(1j * jnp.angle(free))), kappa)


def swept(field: Field, start: Phasors, sweeps: int) -> Phasors:
    """Exact updates of one angle after the other, each of which lowers the free energy."""
    # the path's axis first: an update then touches one stretch of memory
    linear = jnp.moveaxis(field.concentration + 2 * field.matched, 2, 0)
    others = 1 - jnp.eye(linear.shape[0])
    rows = jnp.moveaxis(2 * field.coupling * others, 1, 0)

    def update(path: Array, mean_and_eta: tuple[Array, Array]) -> tuple[Array, Array]:
        mean, eta = mean_and_eta
        own = linear[path] - jnp.einsum("lq,qls->ls", rows[path], mean)
        return mean.at[path].set(_mean(own)), eta.at[path].set(own)

    def sweep(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        return lax.fori_loop(0, linear.shape[0], update, state)

    begin = jnp.moveaxis(start.mean, 2, 0)
    mean, eta = lax.fori_loop(0, sweeps, sweep, (begin, jnp.zeros_like(begin)))
    return Phasors(jnp.moveaxis(mean, 0, 2), jnp.moveaxis(jnp.abs(eta), 0, 2))


def best(field: Field, starts: tuple[Phasors, ...], sweeps: int) -> Phasors:
    """The exact E-step from several starts; every snapshot keeps that of the lowest free energy."""

    def arrive(start: Phasors) -> tuple[Phasors, Float[Array, "link snapshot"]]:
        found = swept(field, start, sweeps)
        return found, free_energy(field, found)

    found, energy = lax.map(arrive, jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts))
    lowest = jnp.argmin(energy, axis=0)[None, ..., None]
    return jax.tree.map(lambda leaf: jnp.take_along_axis(leaf, lowest, axis=0)[0], found)


def free_energy(field: Field, phasors: Phasors) -> Float[Array, "link snapshot"]:
    """E[log q] - E[log p] in nats, without L log(pi s2) + |h|^2 / s2, which no angle changes."""
    mean, kappa = phasors
    length = phasors.length
    fit = -2 * jnp.real(jnp.sum(jnp.conj(mean) * field.matched, axis=-1))
    fit += jnp.real(jnp.einsum("lsp,lpq,lsq->ls", jnp.conj(mean), field.coupling, mean))
    fit += jnp.sum(field.snr[:, None] * (1 - length**2), axis=-1)
    k0 = field.concentration
    exists = (field.snr > 0)[:, None]
    prior = k0 * (jnp.real(mean) - 1) - jnp.log(i0e(k0))
    entropy = jnp.log(i0e(kappa)) + kappa * (1 - length)
    return fit - jnp.sum(jnp.where(exists, prior + entropy, 0.0), axis=-1)


def _mean(eta: Complex[Array, "*n"]) -> Complex[Array, "*n"]:
    """Mean phasor of a von Mises distribution of this natural parameter."""
    size = jnp.abs(eta)
    return eta * jnp.where(size > 0, resultant(size) / jnp.where(size > 0, size, 1.0), 0.5)
