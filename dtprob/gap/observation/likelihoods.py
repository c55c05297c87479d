"""The distributions of observations that a diagnosis knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.effects.distributions import ComplexStudentT
from dtprob.gap.observation import discrete, residuals
from dtprob.gap.observation.residuals import Parameters
from dtprob.models.complex_normal import ComplexNormal

type Rows = Callable[[Parameters, Any], jax.Array]
type Move = Callable[[Parameters, jax.Array], Parameters]

_ROOT_TWO: Final = 2.0**0.5
_CERTAIN: Final = 0.05
"""Standard deviation of an outcome below which it is nearly certain."""


@dataclass(frozen=True)
class Likelihood:
    """One family of distributions.

    Attributes:
        make: the NumPyro distribution from its parameters.
        parameters: names of the parameters, each an attribute of the distribution.
        residual: (parameters, values) -> rows (component, *shape of the value).
        shift: (parameters, a change of each) -> what it adds to the rows.
        located: how many of the rows, the first ones, stand for a location or probability; None for all.
        relocate: (parameters, step) -> parameters whose first row is shifted by the step; None where that is not possible.
        respread: the same for the first row that is no location.
        log_scale: of families whose first rows are normal, the logarithm of the scale for a unit step of that row.
        probability: (parameters, first row) -> probability of a smaller value, of families that are neither normal nor
            discrete and whose first row grows with the value.
        is_outcome: whether one of a few outcomes is seen.
        is_complex: whether the first two rows are the real and the imaginary part of one.
        trailing: axes that a parameter has beyond those of the value.
        log_prob: log density of each entry given those before it, where the entries of the last axis are one vector.
    """

    make: Callable[..., Any]
    parameters: tuple[str, ...]
    residual: Rows
    shift: Rows
    located: int | None = None
    relocate: Move | None = None
    respread: Move | None = None
    log_scale: float | None = None
    probability: Rows | None = None
    is_outcome: bool = False
    is_complex: bool = False
    trailing: Mapping[str, int] = field(default_factory=dict)
    log_prob: Rows | None = None


def _to_loc(deviation: Callable[[Parameters], jax.Array]) -> Move:
    """Moves a location by steps of a deviation."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        return {**p, "loc": p["loc"] + step * deviation(p)}

    return move


def _grown(name: str, rate: Callable[[Parameters], Any] = lambda _: 1.0) -> Move:
    """Multiplies a positive parameter by exp(step times rate)."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        return {**p, name: p[name] * jnp.exp(step * rate(p))}

    return move


def _at_same_mean(spread: Callable[[Parameters], jax.Array]) -> Move:
    """Another concentration, of which there is so much information, and the rate with it."""

    def move(p: Parameters, step: jax.Array) -> Parameters:
        factor = jnp.exp(step / (p["concentration"] * spread(p)))
        return {**p, "concentration": p["concentration"] * factor, "rate": p["rate"] * factor}

    return move


def _weibull_respread(p: Parameters, step: jax.Array) -> Parameters:
    """Another concentration, the scale changed so that the first row stays."""
    change = step * 6.0**0.5 / jnp.pi
    scale = p["scale"] * jnp.exp((1 - residuals.EULER) * change / p["concentration"])
    return {**p, "concentration": p["concentration"] * jnp.exp(change), "scale": scale}


def _to_odds(p: Parameters, step: jax.Array) -> Parameters:
    """Other log odds of the same total concentration."""
    change = step / residuals.beta_spread(p)[2]
    up, down = (jnp.exp(sign * change / p[n]) for sign, n in ((1, "concentration1"), (-1, "concentration0")))
    return {**p, "concentration1": p["concentration1"] * up, "concentration0": p["concentration0"] * down}


def _beta_respread(p: Parameters, step: jax.Array) -> Parameters:
    """Another total concentration of the same log odds."""
    first, second, odds_spread, size_spread = residuals.beta_spread(p)
    change = step / size_spread / odds_spread**2
    return {
        **p,
        "concentration1": p["concentration1"] * jnp.exp(change * second / p["concentration1"]),
        "concentration0": p["concentration0"] * jnp.exp(change * first / p["concentration0"]),
    }


def _to_logits(p: Parameters, step: jax.Array) -> Parameters:
    """Logits that shift the row by the step; less far where the outcome is nearly certain."""
    return {**p, "logits": p["logits"] + step / jnp.maximum(discrete.logits_deviation(p), _CERTAIN)}


def _binomial(total_count: jax.Array, **chance: Any) -> Any:
    return dist.Binomial(jnp.asarray(total_count, int), **chance)


_SCALED: Final[Mapping[str, Any]] = {
    "located": 1,
    "relocate": _to_loc(lambda p: p["scale"]),
    "respread": _grown("scale", lambda _: 0.5**0.5),
    "log_scale": 0.5**0.5,
}
_CLASSES: Final[Mapping[str, Any]] = {
    "residual": discrete.categorical_residual,
    "shift": discrete.categorical_shift,
    "is_outcome": True,
}

LIKELIHOODS: Final[Mapping[str, Likelihood]] = {
    "ComplexNormal": Likelihood(
        ComplexNormal,
        ("loc", "variance"),
        residuals.complex_normal_residual,
        residuals.complex_normal_shift,
        located=2,
        is_complex=True,
        relocate=_to_loc(lambda p: jnp.sqrt(p["variance"] / 2)),
        respread=_grown("variance"),
        log_scale=0.5,
    ),
    "ComplexStudentT": Likelihood(
        ComplexStudentT,
        ("loc", "variance", "tail"),
        residuals.complex_student_residual,
        residuals.complex_student_shift,
        located=2,
        is_complex=True,
        relocate=_to_loc(
            lambda p: jnp.sqrt(p["variance"] * (1 + 2 * p["tail"]) / 2) / (1 + p["tail"]),
        ),
        respread=_grown("variance", lambda p: jnp.sqrt(1 + 2 * p["tail"])),
    ),
    "Normal": Likelihood(
        dist.Normal, ("loc", "scale"), residuals.normal_residual, residuals.normal_shift, **_SCALED
    ),
    "LogNormal": Likelihood(
        dist.LogNormal, ("loc", "scale"), residuals.log_normal_residual, residuals.normal_shift, **_SCALED
    ),
    "StudentT": Likelihood(
        dist.StudentT,
        ("loc", "scale", "df"),
        residuals.student_residual,
        residuals.student_shift,
        located=1,
        relocate=_to_loc(lambda p: p["scale"] * jnp.sqrt((p["df"] + 3) / (p["df"] + 1))),
        respread=_grown("scale", lambda p: jnp.sqrt((p["df"] + 3) / (2 * p["df"]))),
    ),
    "Laplace": Likelihood(
        dist.Laplace,
        ("loc", "scale"),
        residuals.laplace_residual,
        residuals.laplace_shift,
        located=1,
        relocate=_to_loc(lambda p: p["scale"]),
        respread=_grown("scale"),
    ),
    "MultivariateNormal": Likelihood(
        lambda loc, scale_tril: dist.MultivariateNormal(loc, scale_tril=scale_tril),
        ("loc", "scale_tril"),
        residuals.multivariate_normal_residual,
        residuals.multivariate_normal_shift,
        located=1,
        relocate=lambda p, step: {**p, "loc": p["loc"] + jnp.einsum("...ij,...j", p["scale_tril"], step)},
        respread=lambda p, step: {
            **p,
            "scale_tril": p["scale_tril"] * jnp.exp(step / _ROOT_TWO)[..., None, :],
        },
        log_scale=0.5**0.5,
        trailing={"scale_tril": 1},
        log_prob=residuals.multivariate_normal_log_prob,
    ),
    "Exponential": Likelihood(
        dist.Exponential,
        ("rate",),
        residuals.exponential_residual,
        residuals.exponential_shift,
        relocate=_grown("rate", lambda _: -1.0),
        probability=lambda _, row: -jnp.expm1(-jnp.maximum(1.0 + row, 0.0)),
    ),
    "Gamma": Likelihood(
        dist.Gamma,
        ("concentration", "rate"),
        residuals.gamma_residual,
        residuals.gamma_shift,
        located=1,
        relocate=_grown("rate", lambda p: -(p["concentration"] ** -0.5)),
        respread=_at_same_mean(residuals.gamma_spread),
        probability=residuals.gamma_probability,
    ),
    "Weibull": Likelihood(
        dist.Weibull,
        ("scale", "concentration"),
        residuals.weibull_residual,
        residuals.weibull_shift,
        located=1,
        relocate=_grown("scale", lambda p: 1 / p["concentration"]),
        respread=_weibull_respread,
    ),
    "Beta": Likelihood(
        dist.Beta,
        ("concentration1", "concentration0"),
        residuals.beta_residual,
        residuals.beta_shift,
        located=1,
        relocate=_to_odds,
        respread=_beta_respread,
    ),
    "VonMises": Likelihood(
        dist.VonMises,
        ("loc", "concentration"),
        residuals.von_mises_residual,
        residuals.von_mises_shift,
        located=1,
        relocate=_to_loc(lambda p: 1 / residuals.von_mises_spread(p)[1]),
        respread=_grown(
            "concentration", lambda p: 1 / (p["concentration"] * residuals.von_mises_spread(p)[2])
        ),
    ),
    "GammaPoisson": Likelihood(
        dist.GammaPoisson,
        ("concentration", "rate"),
        discrete.counts_residual,
        discrete.counts_shift,
        located=1,
        relocate=_grown("rate", lambda p: -discrete.counts_deviation(p) * p["rate"] / p["concentration"]),
        respread=_at_same_mean(discrete.counts_spread),
    ),
    "Poisson": Likelihood(
        dist.Poisson,
        ("rate",),
        discrete.poisson_residual,
        discrete.poisson_shift,
        relocate=_grown("rate", lambda p: p["rate"] ** -0.5),
    ),
    "BernoulliLogits": Likelihood(
        lambda logits: dist.Bernoulli(logits=logits),
        ("logits",),
        discrete.bernoulli_residual,
        discrete.bernoulli_shift,
        relocate=_to_logits,
        is_outcome=True,
    ),
    "BernoulliProbs": Likelihood(
        dist.Bernoulli, ("probs",), discrete.probs_residual, discrete.probs_shift, is_outcome=True
    ),
    "BinomialLogits": Likelihood(
        _binomial,
        ("total_count", "logits"),
        discrete.bernoulli_residual,
        discrete.bernoulli_shift,
        relocate=_to_logits,
    ),
    "BinomialProbs": Likelihood(
        _binomial, ("total_count", "probs"), discrete.probs_residual, discrete.probs_shift
    ),
    "CategoricalLogits": Likelihood(
        lambda logits: dist.Categorical(logits=logits), ("logits",), **_CLASSES, trailing={"logits": 1}
    ),
    "CategoricalProbs": Likelihood(dist.Categorical, ("probs",), **_CLASSES, trailing={"probs": 1}),
}
"""By the name of the distribution's class."""

SAME: Final[Mapping[str, str]] = {
    "NegativeBinomial2": "GammaPoisson",
    "NegativeBinomialLogits": "GammaPoisson",
    "NegativeBinomialProbs": "GammaPoisson",
    "BetaProportion": "Beta",
    "Chi2": "Gamma",
}
"""Classes that are another one with parameters of their own, which they turn into its."""


def is_discrete(family: str) -> bool:
    """Whether outcomes or counts are observed."""
    known = getattr(dist, family, None)
    return known is not None and bool(known.support.is_discrete)
