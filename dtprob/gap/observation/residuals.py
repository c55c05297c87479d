"""Scores of observations as whitened regression rows, for each family of continuous distributions.

Rows e(y) have mean zero and, up to directions that no change of the parameters takes, unit covariance under the model; a
change of the parameters shifts them, to first order, by s. So e . s is the score along the change and s . s its Fisher
information. Sources: location and scale families, Lehmann and Casella, Theory of Point Estimation (1998), section 2.5; the
others by direct calculation, each held against its density by a test.

A residual takes parameters and values, a shift parameters and a change of each; both give (component, *shape of the value).
"""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import digamma, i0e, i1e, polygamma

from dtprob.effects.distributions import ComplexStudentT

type Parameters = dict[str, jax.Array]

EULER: Final = 0.5772156649015329
_ROOT_TWO: Final = 2.0**0.5
_SMALL: Final = 0.01
"""Concentration of an angle below which a series tells its mean cosine."""
_NORMAL_FROM: Final = 3e3
"""Degrees of freedom from which on the data tell nothing of their number."""


def complex_normal_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a complex normal distribution."""
    r = (value - p["loc"]) * jnp.sqrt(2.0 / p["variance"])
    square = jnp.real(r) ** 2 + jnp.imag(r) ** 2
    return jnp.stack([jnp.real(r), jnp.imag(r), square / 2 - 1.0])


def complex_normal_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a complex normal distribution."""
    d = t["loc"] * jnp.sqrt(2.0 / p["variance"])
    return jnp.stack([jnp.real(d), jnp.imag(d), t["variance"] / p["variance"]])


def complex_student_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows for location, variance and tail; the last is the plain score, of unit variance where the tail is zero."""
    tail = p["tail"]
    r = (value - p["loc"]) * jnp.sqrt((1 + tail) / p["variance"])
    square = jnp.real(r) ** 2 + jnp.imag(r) ** 2
    weight = (1 + tail) / (1 + tail * square)
    location = r * weight * jnp.sqrt(2 * (1 + 2 * tail) / (1 + tail))
    variance = (weight * square - 1.0) * jnp.sqrt(1 + 2 * tail)
    score = jax.grad(lambda t: jnp.sum(ComplexStudentT(p["loc"], p["variance"], t).log_prob(value)))(tail)
    return jnp.stack([jnp.real(location), jnp.imag(location), variance, score])


def complex_student_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a complex Student t distribution."""
    tail = p["tail"]
    d = t["loc"] * jnp.sqrt(2.0 / p["variance"]) * (1 + tail) / jnp.sqrt(1 + 2 * tail)
    variance = t["variance"] / p["variance"] / jnp.sqrt(1 + 2 * tail)
    return jnp.stack([jnp.real(d), jnp.imag(d), variance, t["tail"]])


def _normal_rows(r: jax.Array) -> jax.Array:
    return jnp.stack([r, (r**2 - 1.0) / _ROOT_TWO])


def normal_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a normal distribution."""
    return _normal_rows((value - p["loc"]) / p["scale"])


def log_normal_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a log-normal distribution."""
    return _normal_rows((jnp.log(value) - p["loc"]) / p["scale"])


def normal_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a normal distribution."""
    return jnp.stack([t["loc"], _ROOT_TWO * t["scale"]]) / p["scale"]


def student_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Student t distribution: location, scale, and degrees of freedom where the scale is free."""
    v = p["df"]
    r = (value - p["loc"]) / p["scale"]
    weight = (v + 1) / (v + r**2)
    location = weight * r / jnp.sqrt((v + 1) / (v + 3))
    scale = weight * r**2 - 1.0
    root, common, spread = student_information(v)
    w = jnp.minimum(v, _NORMAL_FROM)
    heavier = (w + 1) / (w + r**2) * r**2
    df = (digamma((w + 1) / 2) - digamma(w / 2) - 1 / w - jnp.log1p(r**2 / w) + heavier / w) / 2
    return jnp.stack([location, scale / root, (df - common / root**2 * (heavier - 1.0)) / spread])


def student_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Student t distribution."""
    v = p["df"]
    root, common, spread = student_information(v)
    location, scale = t["loc"] * jnp.sqrt((v + 1) / (v + 3)) / p["scale"], t["scale"] * root / p["scale"]
    return jnp.stack([location, scale + t["df"] * common / root, t["df"] * spread])


def student_information(v: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Root of a Student t's information on the log scale, that on it and v, and the root of v's where the scale is free.

    Source: Lange, Little and Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84 (1989), appendix B.
    """
    v = jnp.minimum(v, _NORMAL_FROM)
    scale, common = 2 * v / (v + 3), -2 / ((v + 1) * (v + 3))
    own = (polygamma(1, v / 2) - polygamma(1, (v + 1) / 2)) / 4 - (v + 5) / (2 * v * (v + 1) * (v + 3))
    return jnp.sqrt(scale), common, jnp.sqrt(own - common**2 / scale)


def laplace_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Laplace distribution."""
    r = (value - p["loc"]) / p["scale"]
    return jnp.stack([jnp.sign(r), jnp.abs(r) - 1.0])


def laplace_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Laplace distribution."""
    return jnp.stack([t["loc"], t["scale"]]) / p["scale"]


def half_normal_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a half-normal distribution."""
    return (((value / p["scale"]) ** 2 - 1.0) / _ROOT_TWO)[None]


def half_normal_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a half-normal distribution."""
    return (_ROOT_TWO * t["scale"] / p["scale"])[None]


def exponential_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of an exponential distribution."""
    return (p["rate"] * value - 1.0)[None]


def exponential_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of an exponential distribution."""
    return (-t["rate"] / p["rate"])[None]


def gamma_spread(p: Parameters) -> jax.Array:
    """Root of the information on the concentration a where the mean is held, psi'(a) - 1 / a."""
    return jnp.sqrt(polygamma(1, p["concentration"]) - 1 / p["concentration"])


def gamma_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a gamma distribution."""
    a, ratio = p["concentration"], value * p["rate"] / p["concentration"]
    shape = jnp.log(ratio) - ratio + 1.0 + jnp.log(a) - digamma(a)
    return jnp.stack([jnp.sqrt(a) * (ratio - 1.0), shape / gamma_spread(p)])


def gamma_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a gamma distribution."""
    a = p["concentration"]
    mean = t["concentration"] / a - t["rate"] / p["rate"]
    return jnp.stack([jnp.sqrt(a) * mean, t["concentration"] * gamma_spread(p)])


def weibull_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Weibull distribution."""
    log_power = p["concentration"] * jnp.log(value / p["scale"])
    size = jnp.expm1(log_power)
    shape = 1.0 - log_power * size + (1 - EULER) * size
    return jnp.stack([size, shape * jnp.sqrt(6.0) / jnp.pi])


def weibull_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Weibull distribution."""
    k = p["concentration"]
    size = k * t["scale"] / p["scale"] - (1 - EULER) * t["concentration"] / k
    return jnp.stack([size, t["concentration"] / k * jnp.pi / jnp.sqrt(6.0)])


def beta_spread(p: Parameters) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """psi'(a), psi'(b), and the roots of the information on a - b along the log odds and on a + b beside it."""
    first, second = polygamma(1, p["concentration1"]), polygamma(1, p["concentration0"])
    both = polygamma(1, p["concentration1"] + p["concentration0"])
    total = first + second
    return first, second, jnp.sqrt(total), jnp.sqrt(first * second / total - both)


def beta_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a beta distribution: its log odds, and how far it is from both ends."""
    a, b = p["concentration1"], p["concentration0"]
    first, _, odds_spread, size_spread = beta_spread(p)
    yes = jnp.log(value) - digamma(a) + digamma(a + b)
    odds = yes - jnp.log1p(-value) + digamma(b) - digamma(a + b)
    return jnp.stack([odds / odds_spread, (yes - first / odds_spread**2 * odds) / size_spread])


def beta_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a beta distribution."""
    first, second, odds_spread, size_spread = beta_spread(p)
    odds = t["concentration1"] * first - t["concentration0"] * second
    return jnp.stack([odds / odds_spread, (t["concentration1"] + t["concentration0"]) * size_spread])


def von_mises_spread(p: Parameters) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean cosine A, and the roots of A / k and of the information on the concentration k, 1 - A / k - A^2.

    The information on the location is k A. At small k A is k / 2 - k^3 / 16 + k^5 / 96; the difference is one that rounding
    swallows where k is large: (1 + 1 / 2 k) / 2 k^2 there.
    """
    k = p["concentration"]
    near = jnp.where(k < _SMALL, k, 0.0)
    mean = i1e(k) / i0e(k)
    ratio = jnp.where(k < _SMALL, 0.5 - near**2 / 16 + near**4 / 96, mean / jnp.where(k < _SMALL, 1.0, k))
    large = float(jnp.finfo(mean.dtype).eps) ** -0.25
    far = jnp.maximum(k, large)
    spread = jnp.where(k < large, 1 - ratio - mean**2, (1 + 0.5 / far) / (2 * far**2))
    return mean, jnp.sqrt(ratio), jnp.sqrt(spread)


def von_mises_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a von Mises distribution (Mardia and Jupp, Directional Statistics, 2000, section 5.3)."""
    mean, ratio, spread = von_mises_spread(p)
    away = value - p["loc"]
    return jnp.stack([jnp.sin(away) / ratio, (jnp.cos(away) - mean) / spread])


def von_mises_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a von Mises distribution; of a location that tells nothing, none."""
    _, ratio, spread = von_mises_spread(p)
    return jnp.stack([t["loc"] * p["concentration"] * ratio, t["concentration"] * spread])


def multivariate_normal_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of the innovations of the entries in their order, of their squares, and of their products with later ones.

    Products are taken in a circle: with the next entry, with the one after it, to the opposite one, which has each pair
    twice.
    """
    r = _innovations(p, value)
    products = [r * jnp.roll(r, -k, axis=-1) * weight for k, weight in _distances(r.shape[-1])]
    return jnp.stack([r, (r**2 - 1.0) / _ROOT_TWO, *products])


def multivariate_normal_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a multivariate normal distribution."""
    root = p["scale_tril"]
    location = solve_triangular(root, t["loc"][..., None], lower=True)[..., 0]
    relative = solve_triangular(root, t["scale_tril"], lower=True)
    change = relative + jnp.swapaxes(relative, -1, -2)
    size = root.shape[-1]
    at = jnp.arange(size)
    products = [change[..., at, (at + k) % size] * weight for k, weight in _distances(size)]
    return jnp.stack([location, change[..., at, at] / _ROOT_TWO, *products])


def _distances(size: int) -> list[tuple[int, float]]:
    """Distances along a circle of entries, each with the weight of its products."""
    return [(k, _ROOT_TWO**-1 if 2 * k == size else 1.0) for k in range(1, size // 2 + 1)]


def _innovations(p: Parameters, value: jax.Array) -> jax.Array:
    return solve_triangular(p["scale_tril"], (value - p["loc"])[..., None], lower=True)[..., 0]


def multivariate_normal_log_prob(p: Parameters, value: jax.Array) -> jax.Array:
    """Log density of each entry given those before it."""
    scale = jnp.diagonal(p["scale_tril"], axis1=-2, axis2=-1)
    return dist.Normal(0.0, 1.0).log_prob(_innovations(p, value)) - jnp.log(scale)
