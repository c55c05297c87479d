"""Scores of an observed distribution as linear regression rows.

For each observation the gradient of log p in the distribution's parameters is turned into residuals e with mean zero and
unit covariance under the model, and a change of the parameters into the matching whitened shift. With W the whitened
tangents of the model, scores are W^T e and the Fisher information is W^T W, whatever the distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.effects.distributions import ComplexStudentT
from dtprob.errors import InputError
from dtprob.models.complex_normal import ComplexNormal

type Parameters = dict[str, jax.Array]


@dataclass(frozen=True)
class Observation:
    """The elementwise distribution of an observed site.

    Attributes:
        family: name of the distribution's class.
        parameters: each broadcast to the value's shape; "mask" is 0 where an entry does not count, if any does not.
    """

    family: str
    parameters: Parameters

    def masked(self, rows: jax.Array) -> jax.Array:
        """Rows (..., *value) with zeros where the mask is."""
        return jnp.where(self.parameters["mask"] > 0, rows, 0.0) if "mask" in self.parameters else rows


_FAMILIES: Mapping[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "ComplexNormal": (ComplexNormal, ("loc", "variance")),
    "ComplexStudentT": (ComplexStudentT, ("loc", "variance", "tail")),
    "Normal": (dist.Normal, ("loc", "scale")),
    "LogNormal": (dist.LogNormal, ("loc", "scale")),
    "StudentT": (dist.StudentT, ("loc", "scale", "df")),
    "BernoulliLogits": (dist.Bernoulli, ("logits",)),
    "BernoulliProbs": (dist.Bernoulli, ("probs",)),
    "Poisson": (dist.Poisson, ("rate",)),
    "CategoricalLogits": (dist.Categorical, ("logits",)),
    "CategoricalProbs": (dist.Categorical, ("probs",)),
}
"""For each family its distribution and the names of the parameters."""


def observation(fn: Any, value: Any, name: str) -> Observation:
    """Unwrap the distribution of an observed site.

    Raises:
        InputError: the diagnosis has no whitening for the distribution.
    """
    mask: Any = None
    while hasattr(fn, "base_dist") and not isinstance(fn, dist.LogNormal):
        if isinstance(fn, dist.MaskedDistribution):
            mask = fn._mask if mask is None else mask & fn._mask  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
        fn = fn.base_dist
    family = type(fn).__name__
    if family not in _FAMILIES:
        raise InputError(
            f"observed site {name!r}",
            f"a distribution among {', '.join(_FAMILIES)}",
            family,
            "Declare the observation with one of these to diagnose its gap.",
        )
    shape = jnp.shape(value)
    parameters = {}
    for parameter in _FAMILIES[family][1]:
        array = jnp.asarray(getattr(fn, parameter))
        trailing = array.shape[-1:] if family.startswith("Categorical") else ()
        parameters[parameter] = jnp.broadcast_to(array, shape + trailing)
    if mask is not None:
        parameters["mask"] = jnp.broadcast_to(jnp.asarray(mask, float), shape)
    return Observation(family, parameters)


def log_prob(observed: Observation, value: jax.Array) -> jax.Array:
    """Elementwise log density, zero where masked; shape of the value."""
    return observed.masked(distribution(observed).log_prob(value))


def sample(observed: Observation, key: jax.Array) -> jax.Array:
    """A replicate of the observation."""
    return distribution(observed).sample(key)


def distribution(observed: Observation) -> Any:
    """The elementwise NumPyro distribution."""
    parameters = {n: v for n, v in observed.parameters.items() if n != "mask"}
    return _FAMILIES[observed.family][0](**parameters)


def residual(observed: Observation, value: jax.Array) -> jax.Array:
    """Whitened residuals, shape (component, *shape of the value): zero mean and identity covariance under the model."""
    p = observed.parameters
    match observed.family:
        case "ComplexNormal":
            r = (value - p["loc"]) * jnp.sqrt(2.0 / p["variance"])
            square = jnp.real(r) ** 2 + jnp.imag(r) ** 2
            rows = jnp.stack([jnp.real(r), jnp.imag(r), square / 2 - 1.0])
        case "ComplexStudentT":
            rows = _complex_student_residual(p, value)
        case "Normal" | "LogNormal":
            data = jnp.log(value) if observed.family == "LogNormal" else value
            r = (data - p["loc"]) / p["scale"]
            rows = jnp.stack([r, (r**2 - 1.0) / jnp.sqrt(2.0)])
        case "StudentT":
            rows = _student_residual(p, value)
        case "Poisson":
            rows = ((value - p["rate"]) / jnp.sqrt(p["rate"]))[None]
        case "BernoulliLogits":  # finite where the probability rounds to zero or one
            rows = jnp.where(value > 0, jnp.exp(-p["logits"] / 2), -jnp.exp(p["logits"] / 2))[None]
        case "BernoulliProbs":
            rows = ((value - p["probs"]) / jnp.sqrt(p["probs"] * (1 - p["probs"])))[None]
        case _:
            rows = _categorical_residual(_probability(observed), value)
    return observed.masked(rows)


def shift(observed: Observation, tangent: Mapping[str, jax.Array]) -> jax.Array:
    """Whitened shift of a change of the parameters, shape (component, *shape of the value)."""
    p, t = observed.parameters, tangent
    match observed.family:
        case "ComplexNormal":
            d = t["loc"] * jnp.sqrt(2.0 / p["variance"])
            rows = jnp.stack([jnp.real(d), jnp.imag(d), t["variance"] / p["variance"]])
        case "ComplexStudentT":
            tail = p["tail"]
            d = t["loc"] * jnp.sqrt(2.0 / p["variance"]) * (1 + tail) / jnp.sqrt(1 + 2 * tail)
            variance = t["variance"] / p["variance"] / jnp.sqrt(1 + 2 * tail)
            rows = jnp.stack([jnp.real(d), jnp.imag(d), variance, t["tail"]])
        case "Normal" | "LogNormal":
            rows = jnp.stack([t["loc"], jnp.sqrt(2.0) * t["scale"]]) / p["scale"]
        case "StudentT":
            v = p["df"]
            rows = (
                jnp.stack([t["loc"] * jnp.sqrt((v + 1) / (v + 3)), t["scale"] * jnp.sqrt(2 * v / (v + 3))])
                / p["scale"]
            )
        case "Poisson":
            rows = (t["rate"] / jnp.sqrt(p["rate"]))[None]
        case "BernoulliLogits":
            rows = (t["logits"] * jnp.sqrt(jax.nn.sigmoid(p["logits"]) * jax.nn.sigmoid(-p["logits"])))[None]
        case "BernoulliProbs":
            rows = (t["probs"] / jnp.sqrt(p["probs"] * (1 - p["probs"])))[None]
        case _:
            rows = _categorical_shift(observed, t)
    return observed.masked(rows)


def location_rows(family: str, n_rows: int) -> int:
    """How many of an observation's rows stand for its location or probability rather than its spread."""
    return {"ComplexNormal": 2, "ComplexStudentT": 2, "Normal": 1, "LogNormal": 1, "StudentT": 1}.get(
        family, n_rows
    )


def _probability(observed: Observation) -> jax.Array:
    """Probabilities of a categorical observation."""
    p = observed.parameters
    return p["probs"] if "probs" in p else jax.nn.softmax(p["logits"])


def _complex_student_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows for location, variance and tail; the last is the plain score, of unit variance where the tail is zero."""
    tail = p["tail"]
    r = (value - p["loc"]) * jnp.sqrt((1 + tail) / p["variance"])
    square = jnp.real(r) ** 2 + jnp.imag(r) ** 2
    weight = (1 + tail) / (1 + tail * square)
    location = r * weight * jnp.sqrt(2 * (1 + 2 * tail) / (1 + tail))
    variance = (weight * square - 1.0) * jnp.sqrt(1 + 2 * tail)
    score = jax.grad(lambda t: jnp.sum(ComplexStudentT(p["loc"], p["variance"], t).log_prob(value)))(tail)
    return jnp.stack([jnp.real(location), jnp.imag(location), variance, score])


def _student_residual(p: Parameters, value: jax.Array) -> jax.Array:
    v = p["df"]
    r = (value - p["loc"]) / p["scale"]
    weight = (v + 1) / (v + r**2)
    location = weight * r / jnp.sqrt((v + 1) / (v + 3))
    scale = (weight * r**2 - 1.0) / jnp.sqrt(2 * v / (v + 3))
    return jnp.stack([location, scale])


def _categorical_residual(probability: jax.Array, value: jax.Array) -> jax.Array:
    one_hot = jax.nn.one_hot(value, probability.shape[-1], dtype=probability.dtype)
    rows = (one_hot - probability) / jnp.sqrt(jnp.maximum(probability, 1e-30))
    return jnp.moveaxis(rows, -1, 0)


def _categorical_shift(observed: Observation, tangent: Mapping[str, jax.Array]) -> jax.Array:
    probability = _probability(observed)
    if "logits" in tangent:
        mean = jnp.sum(probability * tangent["logits"], axis=-1, keepdims=True)
        rows = jnp.sqrt(probability) * (tangent["logits"] - mean)
    else:
        rows = tangent["probs"] / jnp.sqrt(jnp.maximum(probability, 1e-30))
    return jnp.moveaxis(rows, -1, 0)
