"""A wave's field vector on its way along a path: reflection and refraction without a basis of polarisation.

With E the field in world axes, k the direction of travel, n the normal of the wall, w = k x n (length
sin theta) and R = I - 2 n n^T,

    reflection: E' = (r_te + r_tm) (E.w) w / sin^2 - r_tm R E,    k' = R k
    refraction: E' = (t_te - t_tm) (E.w) w / sin^2 + t_tm E,      k' = k

The first term vanishes at normal incidence, where r_te = -r_tm and t_te = t_tm, so there is no special case.
Steps are taken by `lax.scan`: the time to compile does not grow with the depth of the paths.
"""

from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Shaped

from dtprob.raytracing.slab import Coefficients, Pair

type Vector = tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]
"""The three components apart, which keeps loops over links and paths contiguous."""

_SMALL: Final = 1e-12
"""Added to sin^2 below the fraction bar."""


class Encounters(NamedTuple):
    """How every wave meets the walls on its way; the first axis of each array is the step.

    Attributes:
        normal: of the wall, of either sign.
        across: k x n.
        cosine: of the angle of incidence.
        reflects: whether the wave is reflected there.
    """

    normal: Vector
    across: Vector
    cosine: Float[Array, "depth link path"]
    reflects: Bool[Array, "depth link path"]


class Factors(NamedTuple):
    """Complex factors of (E.w) w, and of the field carried on: R E where reflected, E elsewhere."""

    across: Pair
    carried: Pair


def components(vector: Shaped[Array, "*n 3"]) -> Vector:
    """The components of vectors, apart."""
    return vector[..., 0], vector[..., 1], vector[..., 2]


def dot(a: Vector, b: Vector) -> Float[Array, "*n"]:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def meet(departure: Vector, normal: Vector, reflects: Bool[Array, "depth link path"]) -> Encounters:
    """Follow the directions of travel.

    Args:
        departure: unit vectors of travel leaving the transmitter.
        normal: unit normals of the walls, step by step.
        reflects: which waves are reflected there; the others go straight on.
    """

    def step(k: Vector, wall: tuple[Vector, Array]) -> tuple[Vector, tuple[Vector, Array]]:
        n, turns = wall
        across = k[1] * n[2] - k[2] * n[1], k[2] * n[0] - k[0] * n[2], k[0] * n[1] - k[1] * n[0]
        return _mirror(k, n, turns), (across, jnp.abs(dot(k, n)))

    _, (across, cosine) = lax.scan(step, departure, (normal, reflects))
    return Encounters(normal, across, cosine, reflects)


def factors(
    walls: Encounters,
    found: Coefficients,
    passes: Bool[Array, "depth link path"],
    kept: Float[Array, "depth link path"],
) -> Factors:
    """What the walls do to the two parts of the field.

    Args:
        walls: how they are met.
        found: their coefficients.
        passes: which waves are refracted; those neither reflected nor refracted are left as they are.
        kept: factor of a specular reflection, sqrt(1 - S^2).
    """

    def pick(reflected: Array, transmitted: Array, untouched: float) -> Array:
        return jnp.where(walls.reflects, kept * reflected, jnp.where(passes, transmitted, untouched))

    te = [pick(r, t, u) for r, t, u in zip(found.reflected_te, found.transmitted_te, (1.0, 0.0), strict=True)]
    tm = [
        pick(-r, t, u) for r, t, u in zip(found.reflected_tm, found.transmitted_tm, (1.0, 0.0), strict=True)
    ]
    scale = 1.0 / (dot(walls.across, walls.across) + _SMALL)
    return Factors(((te[0] - tm[0]) * scale, (te[1] - tm[1]) * scale), (tm[0], tm[1]))


def carry(real: Vector, imaginary: Vector, walls: Encounters, through: Factors) -> tuple[Vector, Vector]:
    """Real and imaginary part of the field vectors after all walls.

    Args:
        real: real part at the start.
        imaginary: imaginary part at the start.
        walls: how they are met.
        through: their factors.
    """

    def step(
        field: tuple[Vector, Vector], wall: tuple[Encounters, Factors]
    ) -> tuple[tuple[Vector, Vector], None]:
        (re, im), (met, (across, c)) = field, wall
        u, v = dot(re, met.across), dot(im, met.across)
        along = across[0] * u - across[1] * v, across[0] * v + across[1] * u
        re, im = _mirror(re, met.normal, met.reflects), _mirror(im, met.normal, met.reflects)
        return (
            _sum((along[0], c[0], -c[1]), met.across, re, im),
            _sum((along[1], c[1], c[0]), met.across, re, im),
        ), None

    kind = jnp.result_type(*jax.tree.leaves((real, imaginary, walls.normal, walls.across, through)))
    start = jax.tree.map(lambda part: jnp.asarray(part, kind), (real, imaginary))
    field, _ = lax.scan(step, start, (walls, through))
    return field


def _sum(weights: tuple[Array, Array, Array], x: Vector, y: Vector, z: Vector) -> Vector:
    """The vector a x + b y + c z."""
    a, b, c = weights
    return (
        a * x[0] + b * y[0] + c * z[0],
        a * x[1] + b * y[1] + c * z[1],
        a * x[2] + b * y[2] + c * z[2],
    )


def _mirror(vector: Vector, normal: Vector, where: Bool[Array, "*n"]) -> Vector:
    """R v where asked, v elsewhere."""
    twice = jnp.where(where, 2 * dot(vector, normal), 0.0)
    return vector[0] - twice * normal[0], vector[1] - twice * normal[1], vector[2] - twice * normal[2]
