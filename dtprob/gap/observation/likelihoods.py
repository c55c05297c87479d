"""The distributions of observations that a diagnosis knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.effects.distributions import ComplexStudentT
from dtprob.gap.observation import (
    compound,
    discrete,
    limited,
    location_scale,
    moves,
    numeric,
    probabilities,
    residuals,
)
from dtprob.gap.observation.beta_binomial import BETA_BINOMIAL
from dtprob.gap.observation.likelihood import Likelihood
from dtprob.models.complex_normal import ComplexNormal

_ROOT_TWO: Final = 2.0**0.5


def _binomial(total_count: jax.Array, **chance: Any) -> Any:
    return dist.Binomial(jnp.asarray(total_count, int), **chance)


_SCALED: Final[Mapping[str, Any]] = {
    "located": 1,
    "relocate": moves.to_loc(lambda p: p["scale"]),
    "respread": moves.grown("scale", lambda _: 0.5**0.5),
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
        relocate=moves.to_loc(lambda p: jnp.sqrt(p["variance"] / 2)),
        respread=moves.grown("variance"),
        log_scale=0.5,
    ),
    "ComplexStudentT": Likelihood(
        ComplexStudentT,
        ("loc", "variance", "tail"),
        residuals.complex_student_residual,
        residuals.complex_student_shift,
        located=2,
        is_complex=True,
        relocate=moves.to_loc(
            lambda p: jnp.sqrt(p["variance"] * (1 + 2 * p["tail"]) / 2) / (1 + p["tail"]),
        ),
        respread=moves.grown("variance", lambda p: jnp.sqrt(1 + 2 * p["tail"])),
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
        relocate=moves.to_loc(lambda p: p["scale"] * jnp.sqrt((p["df"] + 3) / (p["df"] + 1))),
        respread=moves.grown("scale", lambda p: jnp.sqrt((p["df"] + 3) / (2 * p["df"]))),
        probability=probabilities.student,
    ),
    "Laplace": Likelihood(
        dist.Laplace,
        ("loc", "scale"),
        residuals.laplace_residual,
        residuals.laplace_shift,
        located=1,
        relocate=moves.to_loc(lambda p: p["scale"]),
        respread=moves.grown("scale"),
        probability=probabilities.laplace,
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
        relocate=moves.grown("rate", lambda _: -1.0),
        probability=probabilities.exponential,
    ),
    "Gamma": Likelihood(
        dist.Gamma,
        ("concentration", "rate"),
        residuals.gamma_residual,
        residuals.gamma_shift,
        located=1,
        relocate=moves.grown("rate", lambda p: -(p["concentration"] ** -0.5)),
        respread=moves.at_same_mean(residuals.gamma_spread),
        probability=probabilities.gamma,
    ),
    "Weibull": Likelihood(
        dist.Weibull,
        ("scale", "concentration"),
        residuals.weibull_residual,
        residuals.weibull_shift,
        located=1,
        relocate=moves.grown("scale", lambda p: 1 / p["concentration"]),
        respread=moves.weibull_respread,
        probability=probabilities.exponential,
    ),
    "Beta": Likelihood(
        dist.Beta,
        ("concentration1", "concentration0"),
        residuals.beta_residual,
        residuals.beta_shift,
        located=1,
        relocate=moves.to_odds,
        respread=moves.beta_respread,
        probability=probabilities.beta,
    ),
    "Logistic": location_scale.LOGISTIC,
    "Gumbel": location_scale.GUMBEL,
    "Cauchy": location_scale.CAUCHY,
    "HalfNormal": Likelihood(
        dist.HalfNormal,
        ("scale",),
        residuals.half_normal_residual,
        residuals.half_normal_shift,
        relocate=moves.grown("scale", lambda _: 0.5**0.5),
        probability=probabilities.half_normal,
    ),
    "InverseGamma": Likelihood(
        dist.InverseGamma,
        ("concentration", "rate"),
        lambda p, value: residuals.gamma_residual(p, 1 / value),
        residuals.gamma_shift,
        located=1,
        relocate=moves.grown("rate", lambda p: -(p["concentration"] ** -0.5)),
        respread=moves.at_same_mean(residuals.gamma_spread),
        probability=probabilities.inverse_gamma,
    ),
    "VonMises": Likelihood(
        dist.VonMises,
        ("loc", "concentration"),
        residuals.von_mises_residual,
        residuals.von_mises_shift,
        located=1,
        relocate=moves.to_loc(lambda p: moves.held(p["concentration"] * residuals.von_mises_spread(p)[1])),
        respread=moves.grown(
            "concentration", lambda p: moves.held(p["concentration"] * residuals.von_mises_spread(p)[2])
        ),
        probability=probabilities.von_mises,
    ),
    "GammaPoisson": Likelihood(
        dist.GammaPoisson,
        ("concentration", "rate"),
        discrete.counts_residual,
        discrete.counts_shift,
        located=1,
        relocate=moves.grown(
            "rate", lambda p: -discrete.counts_deviation(p) * p["rate"] / p["concentration"]
        ),
        respread=moves.at_same_mean(discrete.counts_spread),
        respread_about=moves.at_same_mean(discrete.counts_spread_about),
        probability=probabilities.gamma_poisson,
    ),
    "Poisson": Likelihood(
        dist.Poisson,
        ("rate",),
        discrete.poisson_residual,
        discrete.poisson_shift,
        relocate=moves.grown("rate", lambda p: jnp.where(p["rate"] > 0, p["rate"], 1.0) ** -0.5),
        density=discrete.poisson_density,
        probability=probabilities.poisson,
    ),
    "GeometricProbs": Likelihood(
        dist.Geometric,
        ("probs",),
        discrete.geometric_residual,
        discrete.geometric_shift,
        relocate=discrete.geometric_relocate,
        density=discrete.geometric_density,
        probability=probabilities.geometric,
    ),
    "BetaBinomial": BETA_BINOMIAL,
    "BernoulliLogits": Likelihood(
        lambda logits: dist.Bernoulli(logits=logits),
        ("logits",),
        discrete.bernoulli_residual,
        discrete.bernoulli_shift,
        relocate=moves.to_logits,
        is_outcome=True,
    ),
    "BernoulliProbs": Likelihood(
        dist.Bernoulli,
        ("probs",),
        discrete.probs_residual,
        discrete.probs_shift,
        is_outcome=True,
        density=discrete.probs_density,
        impossible=discrete.probs_impossible,
    ),
    "BinomialLogits": Likelihood(
        _binomial,
        ("total_count", "logits"),
        discrete.bernoulli_residual,
        discrete.bernoulli_shift,
        relocate=moves.to_logits,
        probability=probabilities.binomial,
    ),
    "BinomialProbs": Likelihood(
        _binomial,
        ("total_count", "probs"),
        discrete.probs_residual,
        discrete.probs_shift,
        density=discrete.probs_density,
        impossible=discrete.probs_impossible,
        probability=probabilities.binomial,
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
    "GeometricLogits": "GeometricProbs",
}
"""Classes that are another one with parameters of their own, which they turn into its."""


COMPOUNDS: Final[Mapping[str, Callable[[Likelihood, str], Likelihood]]] = {
    "ZeroInflated": compound.zero_inflated,
    "LeftCensored": partial(limited.censored, left=True),
    "RightCensored": partial(limited.censored, left=False),
    **{kind: partial(limited.truncated, kind=kind) for kind in limited.TRUNCATED},
    "Mixture": compound.mixture,
}
"""What is made of another distribution, by the first word of its family, "Mixture Normal"."""


def likelihood(family: str) -> Likelihood:
    """What is known of a family: one of `LIKELIHOODS`, a word of `COMPOUNDS` before one, or what `numeric` has met."""
    own = numeric.met(family)
    return _listed(family) if own is None else own[1]


@cache
def _listed(family: str) -> Likelihood:
    kind, _, base = family.rpartition(" ")
    return COMPOUNDS[kind](LIKELIHOODS[base], base) if kind else LIKELIHOODS[base]


def is_discrete(family: str) -> bool:
    """Whether outcomes or counts are observed."""
    own = numeric.met(family)
    known: Any = getattr(dist, family.rsplit(" ", maxsplit=1)[-1], None) if own is None else own[0]
    return known is not None and bool(known.support.is_discrete)


def is_continuous(family: str) -> bool:
    """Whether single numbers are observed that are hardly ever alike; not where they are cut off at a limit."""
    return not (is_discrete(family) or likelihood(family).is_complex or "Censored" in family)
