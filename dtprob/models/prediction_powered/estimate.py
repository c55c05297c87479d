"""Estimates and their intervals under each scheme."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, final, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import special

from dtprob.errors import InputError, unknown_name
from dtprob.models.prediction_powered.arrays import Values, namespace
from dtprob.models.prediction_powered.clusters import check_clusters, cluster_weights, clustered
from dtprob.models.prediction_powered.covariance import effective_number, inverse_hessian, spread
from dtprob.models.prediction_powered.losses import LOSSES, AbstractLoss, SmoothQuantile, named_loss
from dtprob.models.prediction_powered.moments import Evaluation, evaluate
from dtprob.models.prediction_powered.quantile import Quantile, estimate_quantile
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.schemes import Mix, Scheme, named_scheme
from dtprob.models.prediction_powered.solve import minimise
from dtprob.models.prediction_powered.tuning import CAREFUL, By, Lambda, Practice, fixed, tune, tuning_cost

NO_UNLABELLED: Final = "There are no unlabelled samples with predictions, so this is plain ERM."
BIASED: Final = "The interval does not cover the bias of the predictor."
_FEWEST_PER_CONTEXT: Final = 20
"""Labels of a context below which its lambda is hardly known."""
_FEWEST_BEYOND: Final = 5
"""Labels expected beyond a quantile below which its normal approximation is poor."""
_FEWEST_EFFECTIVE: Final = 30
"""Effective labels below which intervals are not right to first order."""


def estimate(
    loss: str | AbstractLoss | Quantile,
    sample: Sample,
    scheme: str = "tuned_cppi",
    *,
    lam: float | None = None,
    by: By = "overall",
    level: float = 0.9,
    practice: Practice = CAREFUL,
) -> Estimate:
    """The minimiser of a scheme's corrected loss, with an interval for each parameter.

    Args:
        loss: "mean", "ols", "logistic", "poisson", a `Quantile`, or a loss of the user's own.
        sample: the data; for "ppi" and "tuned_ppi" its predictions come from one predictor that saw none of
            the labels, for "cppi" and "tuned_cppi" from K predictors trained without one fold each.
        scheme: "erm", "ss", "ppi", "tuned_ppi", "cppi" or "tuned_cppi".
        lam: weight of the correction, from 0 to 1, instead of the scheme's.
        by: with a tuned scheme, one lambda overall, per parameter or per context (not for a
            quantile).
        level: of the intervals.
        practice: conventions for finite samples; for a quantile only those of lambda.

    Raises:
        InputError: an unknown name, a level or lambda out of range, data on which the loss has no minimiser.
    """
    chosen = _checked(named_scheme(scheme), lam, level)
    notes: tuple[str, ...] = ()
    if not sample.has_predictions and chosen.name != "erm":
        chosen, notes = named_scheme("erm"), (NO_UNLABELLED,)
    elif chosen.pooled:
        notes = (BIASED,)
    _check_contexts(by, loss, sample, practice)
    alone = "a quantile" if isinstance(loss, Quantile) else "pooled_spread" if practice.pooled_spread else ""
    check_clusters(sample, pooled=chosen.pooled, what=alone)
    if isinstance(loss, Quantile):
        result = estimate_quantile(loss, sample, chosen, level=level, practice=practice)
    else:
        known = named_loss(loss)
        check_labels(known, sample.y)
        result = _estimate(_problem(known, sample, chosen, practice), by, level)
    return replace(result, notes=(*notes, *_few(loss, sample, chosen, by)))


def _few(loss: str | AbstractLoss | Quantile, sample: Sample, scheme: Scheme, by: By) -> Iterator[str]:
    """Where so few labels tell the variance, a quantile or a lambda that the interval may be too narrow."""
    number = float(effective_number(cluster_weights(sample)))
    if isinstance(loss, Quantile | SmoothQuantile):
        beyond = number * min(loss.level, 1 - loss.level)
        if beyond < _FEWEST_BEYOND:
            yield (
                f"Only {beyond:.1f} labels are expected beyond the quantile {loss.level:g}, so that the interval may be "
                f"too narrow. Give more labels, or ask for a quantile nearer to the median."
            )
    if number < _FEWEST_EFFECTIVE and (sample.weight is not None or not isinstance(loss, Quantile)):
        left = (
            f"{sample.n} labels" if sample.weight is None else f"{number:.0f} effective labels of {sample.n}"
        )
        left = left if sample.cluster is None else f"{number:.0f} effective clusters of labels"
        yield f"With {left} the interval may be too narrow, unless errors are nearly normal."
    if by == "context" and scheme.is_tuned:
        poor = np.flatnonzero(np.bincount(sample.labelled_context) < _FEWEST_PER_CONTEXT)
        if len(poor):
            shown = ", ".join(map(str, poor[:10])) + (", ..." if len(poor) > 10 else "")
            yield (
                f"Fewer than {_FEWEST_PER_CONTEXT} labels in contexts {shown}, so that the interval may be too narrow. "
                "Join contexts, or tune overall."
            )


def _checked(scheme: Scheme, lam: float | None, level: float) -> Scheme:
    if not 0 < level < 1:
        raise InputError("level", "a number between 0 and 1", repr(level), "Give 0.9 for 90% intervals")
    if lam is None:
        return scheme
    if scheme.pooled or (scheme.training == "none" and lam > 0):
        raise InputError("lam", f"nothing with scheme {scheme.name}", repr(lam), "Use ppi or cppi")
    if not 0 <= lam <= 1:
        raise InputError("lam", "a number from 0 to 1", repr(lam), "Leave it out to tune it")
    return replace(scheme, lam=lam)


def _estimate(problem: _Problem, by: By, level: float) -> Estimate:
    # what only shifts has entries that do not share residuals: each loses one degree of freedom
    lost = 1 if problem.is_translation and problem.practice.lost is None else problem.practice.lost
    practice, lam = replace(problem.practice, lost=lost), fixed(problem.first_lambda, problem.start)
    tells_all = problem.is_translation and problem.rounds > 0
    theta = problem.theta if tells_all else problem.solve(lam, problem.theta, problem.start)
    evaluation = problem.at(theta)
    inverse = problem.inverse(evaluation, lam)
    for _ in range(problem.rounds):
        lam = tune(evaluation, inverse, by, practice)
        theta = problem.solve(lam, theta, evaluation)
        evaluation = problem.at(theta)
        inverse = inverse if problem.is_translation else problem.inverse(evaluation, lam)
    found = spread(evaluation, problem.mixes(lam.value), inverse, practice, problem.cost(lam, by))
    alone = spread(evaluation, problem.labels_alone(lam), inverse, practice)
    covariance, degrees = np.asarray(found.covariance), np.asarray(found.degrees)
    chance = (1 + level) / 2
    is_normal = practice.reference == "normal"
    quantile = special.ndtri(chance) if is_normal else special.stdtrit(degrees, chance)
    half = quantile * np.sqrt(np.diagonal(covariance))
    point, sample = np.asarray(theta), problem.sample
    return Estimate(
        theta=point,
        covariance=covariance,
        degrees=degrees,
        low=point - half,
        high=point + half,
        level=level,
        lam=jax.tree.map(np.asarray, lam),
        labels_only_variance=np.diagonal(np.asarray(alone.covariance)),
        scheme=problem.scheme,
        n=sample.n,
        n_unlabelled=sample.n_unlabelled if sample.has_predictions else 0,
    )


def check_labels(loss: AbstractLoss, y: np.ndarray) -> None:
    """Refuse labels outside of what a named loss is made for, such as classes -1 and 1 of a logistic regression.

    Args:
        loss: any.
        y: labels, (n,) or (n, label).

    Raises:
        InputError: a label that the loss does not allow, with the names of other losses.
    """
    name = next((name for name, one in LOSSES.items() if one is loss), "")
    allowed = {"logistic": (y >= 0) & (y <= 1), "poisson": y >= 0}.get(name, np.ones(y.shape, bool))
    if not allowed.all():
        wrong = float(y[~allowed][0])
        expected = "labels 0 and 1" if name == "logistic" else "labels from 0 up"
        others = ", ".join(other for other in LOSSES if other != name)
        raise InputError(f"y with loss {name}", expected, f"{wrong:g}", f"Correct y, or use {others}")


def _check_contexts(by: By, loss: str | AbstractLoss | Quantile, sample: Sample, practice: Practice) -> None:
    if by not in get_args(By.__value__):
        raise unknown_name("by", by, get_args(By.__value__), "choice")
    if by == "context" and isinstance(loss, Quantile):
        raise InputError("by", "overall, for a quantile", "'context'", "Leave it out, or use SmoothQuantile")
    if by == "context" and practice.form == "estimates":
        remedy = "Use form loss, or tune overall"
        raise InputError("practice", "form loss, to tune by context", "form estimates", remedy)
    if by == "context" and sample.has_predictions and sample.context_unlabelled is None:
        remedy = "Give context and context_unlabelled"
        raise InputError("sample", "contexts of all samples, to tune by context", "none", remedy)


def _problem(loss: AbstractLoss, sample: Sample, scheme: Scheme, practice: Practice) -> _Problem:
    xp = np if loss.traits.numpy else jnp
    theta = loss.start(xp.asarray(sample.features), xp.asarray(sample.y))
    if loss.traits.linear_in_label and not loss.traits.quadratic and sample.n_unlabelled > sample.n:
        theta = _labels_alone(loss, sample, theta)
    return _Problem(loss, sample, scheme, practice, theta, _evaluated(loss, sample, theta))


def _evaluated(loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"]) -> Evaluation:
    """The data at theta, by clusters where there are any."""
    found = evaluate(loss, sample, theta)
    return found if sample.cluster is None else clustered(loss, sample, theta, found)


def _labels_alone(
    loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"]
) -> Float[Values, " parameter"]:
    """What labels alone say, from where fewer passes over the unlabelled samples are left; or theta."""
    alone = Sample(x=sample.features, y=sample.y, weight=sample.weight)
    start = evaluate(loss, alone, theta)
    try:
        return minimise(
            loss, alone, named_scheme("erm").mix(start.n, start.n, 0 * start.n[None]), start, theta
        )
    except InputError:
        return theta


@final
@dataclass(frozen=True)
class _Problem:
    """A loss, a scheme and data, with the data's evaluation at a starting point."""

    loss: AbstractLoss
    sample: Sample
    scheme: Scheme
    practice: Practice
    theta: Float[Values, " parameter"]
    start: Evaluation

    @property
    def first_lambda(self) -> float:
        """The scheme's lambda, or that of the pilot."""
        return self.practice.pilot if self.scheme.lam is None else self.scheme.lam

    @property
    def rounds(self) -> int:
        """How often lambda is tuned."""
        if not self.scheme.is_tuned:
            return 0
        return 1 if self.is_translation else self.practice.rounds

    @property
    def is_translation(self) -> bool:
        """Whether theta only shifts the gradients, so that one evaluation tells all."""
        weighted = self.sample.weight is not None or self.sample.weight_unlabelled is not None
        return self.loss.traits.translation and not weighted

    def cost(self, lam: Lambda, by: By) -> Int[Values, ""] | int:
        """Degrees of freedom that the tuned lambdas cost, none where `lost` is given."""
        counts = self.rounds > 0 and self.practice.lost is None
        return tuning_cost(lam.value, by) if counts else 0

    def at(self, theta: Float[Values, " parameter"]) -> Evaluation:
        return self.start if self.is_translation else _evaluated(self.loss, self.sample, theta)

    def mixes(self, lam: Float[Values, "*parameter context"]) -> Mix:
        return self.scheme.mix(self.start.n, self.start.n_unlabelled, lam)

    def labels_alone(self, lam: Lambda) -> Mix:
        """The weights without predictions, which a pooled scheme has at no lambda."""
        return named_scheme("erm").mix(self.start.n, self.start.n_unlabelled, 0 * lam.value)

    def inverse(self, evaluation: Evaluation, lam: Lambda) -> Float[Values, "parameter parameter"]:
        return inverse_hessian(self.loss, evaluation, self.mixes(lam.value.mean(axis=0)))

    def solve(
        self, lam: Lambda, theta: Float[Values, " parameter"], evaluation: Evaluation
    ) -> Float[Values, " parameter"]:
        """Each parameter from the corrected loss with its own lambda, sought from `theta`."""
        if self.is_translation:
            theta = self.theta
        xp = namespace(theta)
        if (lam.value == lam.value[:1]).all():
            return self._minimise(xp.asarray(lam.value[0]), theta, evaluation)
        rows, inverse = np.unique(np.asarray(lam.value), axis=0, return_inverse=True)
        found = [self._minimise(xp.asarray(row), theta, evaluation) for row in rows]
        return xp.stack(found)[inverse.reshape(-1), np.arange(len(self.theta))]

    def _minimise(
        self, lam: Float[Values, " context"], theta: Float[Values, " parameter"], evaluation: Evaluation
    ) -> Float[Values, " parameter"]:
        def least(mix: Mix) -> Values:
            return minimise(self.loss, self.sample, mix, evaluation, theta)

        mix = self.mixes(lam)
        if self.practice.form == "loss" or self.scheme.pooled:
            return least(mix)
        zero, one = 0 * mix.true, 0 * lam + 1
        own = least(Mix(mix.true, 0 * one, 0 * one))
        if not bool((lam > 0).any()):
            return own
        return own + lam[0] * (least(Mix(zero, one, 0 * one)) - least(Mix(zero, 0 * one, -one)))
