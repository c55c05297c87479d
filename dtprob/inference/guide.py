"""The family of distributions that variational inference chooses from: von Mises for angles, normal for the rest.

A guide is measured from an anchor, a point with a scale: near the mode and in units of its curvature every
parameter is of order one, whatever the decades between the model's own units.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.inference import von_mises
from dtprob.inference.circular import wrap
from dtprob.inference.optimise import DENSE_LIMIT, curvature, gradient_and_hessian
from dtprob.inference.target import Inputs, Target

type Family = Literal["mean_field", "low_rank", "full_rank"]

_FLATTEST = 0.1  # least curvature in units of the prior, whose own is about one
_PROBES = 64
_FACTOR = 0.01


class Anchor(NamedTuple):
    """Where a guide is measured from.

    Attributes:
        point: all coordinates, (dimension,).
        root: of the linear coordinates, a square root of their covariance; as a vector where it is diagonal.
        concentration: of the angles.
    """

    point: Float[Array, " dimension"]
    root: Float[Array, " linear *linear"]
    concentration: Float[Array, " angle"]


class Guide(NamedTuple):
    """A distribution's parameters, measured from an anchor: linear coordinates = point + root v.

    Attributes:
        location: mean of v.
        log_scale: log of v's own standard deviations.
        factor: how entries of v move together: with its strict lower triangle added to the diagonal of
            standard deviations a square root of the covariance (full rank), or columns times the standard
            deviations (low rank); no columns in the mean field.
        turn: the angles' directions from the point, in units of (1 + anchor's concentration)^-1/2.
        log_concentration: log of the concentrations over the anchor's.
    """

    location: Float[Array, " linear"]
    log_scale: Float[Array, " linear"]
    factor: Float[Array, "linear column"]
    turn: Float[Array, " angle"]
    log_concentration: Float[Array, " angle"]


def initial_guide(target: Target, family: Family, rank: int) -> Guide:
    """The guide that stands at its anchor.

    Args:
        target: what it is a guide for.
        family: which covariances of the linear coordinates it has.
        rank: columns of a low-rank factor.
    """
    angles, linear = target.angles.size, target.dimension - target.angles.size
    columns = {"mean_field": 0, "low_rank": min(rank, linear), "full_rank": linear}[family]
    # A factor of zeros is a saddle point of a low-rank covariance.
    size = _FACTOR if family == "low_rank" else 0.0
    factor = size * jax.random.normal(jax.random.key(0), (linear, columns))
    return Guide(jnp.zeros(linear), jnp.zeros(linear), factor, jnp.zeros(angles), jnp.zeros(angles))


def draw(
    target: Target, family: Family, guide: Guide, anchor: Anchor, key: PRNGKeyArray
) -> Float[Array, " dimension"]:
    """One draw, angles unwrapped; differentiable in the guide."""
    linear_key, angle_key = jax.random.split(key)
    v = jnp.asarray(_normal(family, guide).sample(linear_key))
    linear = target.linear
    z = von_mises.sample(angle_key, *_angles(target, guide, anchor), 1)[0]
    u = anchor.point.at[linear].add(_scaled(anchor, v))
    return u.at[target.angles].set(z)


def log_density(
    target: Target, family: Family, guide: Guide, anchor: Anchor, u: Float[Array, " dimension"]
) -> Scalar:
    """Log density of the guide at a point."""
    linear = target.linear
    offset = u[linear] - anchor.point[linear]
    if anchor.root.ndim == 1:
        v, volume = offset / anchor.root, jnp.sum(jnp.log(anchor.root))
    else:
        v, volume = jnp.linalg.solve(anchor.root, offset), jnp.linalg.slogdet(anchor.root)[1]
    angles = dist.VonMises(*_angles(target, guide, anchor)).log_prob(wrap(u[target.angles]))
    return jnp.asarray(_normal(family, guide).log_prob(v)) - volume + jnp.sum(angles)


def _scaled(anchor: Anchor, v: Array) -> Array:
    return anchor.root * v if anchor.root.ndim == 1 else anchor.root @ v


def _angles(target: Target, guide: Guide, anchor: Anchor) -> tuple[Array, Array]:
    direction = anchor.point[target.angles] + guide.turn / jnp.sqrt(1 + anchor.concentration)
    return direction, anchor.concentration * jnp.exp(guide.log_concentration)


def _normal(family: Family, guide: Guide) -> dist.Distribution:
    scale = jnp.exp(guide.log_scale)
    if family == "mean_field":
        return dist.Normal(guide.location, scale).to_event(1)
    if family == "low_rank":
        return dist.LowRankMultivariateNormal(guide.location, scale[:, None] * guide.factor, scale**2)
    return dist.MultivariateNormal(guide.location, scale_tril=jnp.tril(guide.factor, -1) + jnp.diag(scale))


def anchor_at(target: Target, family: Family, point: Float[Array, " dimension"], inputs: Inputs) -> Anchor:
    """The anchor at a point, with the scales that the density's curvature there suggests."""
    linear = target.linear

    def function(u: Array) -> Array:
        return -target.log_density(u, inputs)

    if target.dimension > DENSE_LIMIT:
        diagonal = _diagonal(function, point)
        return Anchor(point, _steep(diagonal[linear]) ** -0.5, _steep(diagonal[target.angles]))
    hessian = gradient_and_hessian(function, point)[1]
    diagonal = jnp.diag(hessian)
    root = _steep(diagonal[linear]) ** -0.5
    if family == "full_rank":
        values, vectors = curvature(hessian[jnp.ix_(linear, linear)])
        root = vectors * _steep(values) ** -0.5
    return Anchor(point, root, _steep(diagonal[target.angles]))


def prior_anchor(target: Target, like: Anchor) -> Anchor:
    """The anchor at the prior's median, with the prior's scales, its root of the same shape as another's."""
    ones = jnp.ones(target.linear.size)
    root = ones if like.root.ndim == 1 else jnp.diag(ones)
    return Anchor(jnp.zeros(target.dimension), root, jnp.ones(target.angles.size))


def _steep(values: Array) -> Array:
    return jnp.maximum(jnp.abs(jnp.nan_to_num(values, nan=1.0)), _FLATTEST)


def _diagonal(function: Callable[[Array], Array], point: Array) -> Array:
    """The Hessian's diagonal by random signs (Hutchinson), for dimensions where it is too large."""
    _, product = jax.linearize(jax.grad(function), point)
    signs = jax.random.rademacher(jax.random.key(0), (_PROBES, point.size), point.dtype)
    return jnp.mean(signs * jax.lax.map(product, signs), axis=0)
