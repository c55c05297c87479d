"""Lambda, the weight of the correction: in closed form, with its standard error, guarded against noise.

The error of the estimate is -H^-1 [mean g + lambda (mean f~ - mean f)] to first order, where g and f are the
gradients of labelled samples at labels and predictions and f~ those of unlabelled samples. Its mean square is
quadratic in lambda, whose minimiser is a ratio of covariances (PPI++, section 6; for cross-prediction,
arXiv 2405.15415). One lambda may serve all parameters or each its own, and all contexts or each its own.
"""

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values, compiled_for_jax, each, namespace
from dtprob.models.prediction_powered.moments import Evaluation, centred, each_part

type By = Literal["overall", "parameter", "context"]

_SWEEPS: Final = 200


@final
@dataclass(frozen=True, kw_only=True)
class Practice:
    """Conventions on which results depend in finite samples.

    Attributes:
        pilot: lambda of the estimate at which the first lambda is computed.
        rounds: how often lambda is computed, each time at the latest estimate.
        guard: pull lambda towards 0, or towards the value for a calibrated predictor, whichever is nearer, by
            its squared standard error over its distance from there. An estimated lambda costs up to 1/(2n) of
            the mean square error where the predictor is useless; the guard takes two thirds of that away.
        pooled_spread: estimate the spread of f and f~ from both together, as if they had one distribution;
            otherwise each from its own samples.
        lost: degrees of freedom that the labelled samples lose; None counts the parameters, and
            two for each tuned lambda (`tuning_cost`).
        form: "loss" minimises the corrected loss; "estimates" corrects the minimiser instead: labels' own
            plus lambda times (that of unlabelled predictions minus that of labelled ones), as PPBoot does.
        reference: "t" compares with Student's t with Welch's degrees of freedom, "normal" with the normal.
    """

    pilot: float = 0.5
    rounds: int = 2
    guard: bool = True
    pooled_spread: bool = False
    lost: int | None = None
    form: Literal["loss", "estimates"] = "loss"
    reference: Literal["normal", "t"] = "t"

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        if self.rounds < 1 or not 0 <= self.pilot <= 1:
            got = f"rounds {self.rounds}, pilot {self.pilot}"
            raise InputError("practice", "rounds from 1, a pilot from 0 to 1", got, "Correct them")


CAREFUL: Final = Practice()
"""dtprob's own: right also for fewer than a hundred labels."""

PUBLISHED: Final = Practice(pilot=1.0, rounds=1, guard=False, pooled_spread=True, lost=1, reference="normal")
"""The formulas of the PPI++ paper as its authors' package computes them, right for many labels."""


class Lambda(NamedTuple):
    """Lambda per parameter and context.

    Attributes:
        value: what is used, in [0, 1].
        raw: the closed form before guard and clip.
        standard_error: of the closed form.
    """

    value: Float[Values, "parameter context"]
    raw: Float[Values, "parameter context"]
    standard_error: Float[Values, "parameter context"]


def fixed(lam: float, evaluation: Evaluation) -> Lambda:
    """A lambda that was given."""
    shape = evaluation.gradient.shape[1], evaluation.unlabelled.value.shape[0]
    xp = namespace(evaluation.gradient)
    return Lambda(xp.full(shape, lam), xp.full(shape, lam), xp.zeros(shape))


def tuning_cost(lam: Float[Values, "parameter context"], by: By) -> Values:
    """Degrees of freedom that tuned lambdas cost: two for each that lies inside of [0, 1].

    Regression of labels on predictions, whose slope lambda is, takes one of the residuals and, by its error, as much
    as another of the estimate (Cochran, Sampling Techniques, 1977, section 7.9). A lambda at 0 or 1 was not fitted.
    """
    inside = (lam > 0) & (lam < 1)
    counts = inside.sum(axis=1) if by == "context" else inside.any(axis=1)
    return namespace(lam).asarray(2 * counts.max())


@compiled_for_jax
def tune(
    evaluation: Evaluation,
    inverse: Float[Values, "parameter parameter"],
    by: By,
    practice: Practice = CAREFUL,
) -> Lambda:
    """The lambda that minimises the mean square error, estimated.

    Args:
        evaluation: the data at a pilot estimate.
        inverse: inverse of the mean second derivative there.
        by: one lambda overall, or one per parameter (which minimises that parameter's error), or one per
            context (which together minimise the error of all parameters).
        practice: conventions.
    """
    d, n_context = len(inverse), evaluation.unlabelled.value.shape[0]
    if by != "context":
        evaluation = _merged(evaluation)
    if by == "parameter":
        best = each(lambda column: _tune(evaluation, column[:, None], practice), inverse.T)
    else:
        best = _tune(evaluation, inverse, practice)
    xp = namespace(evaluation.gradient)
    return Lambda(*(xp.broadcast_to(part, (d, n_context)) for part in best))


def _merged(evaluation: Evaluation) -> Evaluation:
    """The data as if all contexts were one."""
    predicted, unlabelled = (
        each_part(lambda part: part.sum(axis=0, keepdims=True), group)
        for group in (evaluation.predicted, evaluation.unlabelled)
    )
    context = namespace(evaluation.context).zeros_like(evaluation.context)
    return evaluation._replace(predicted=predicted, unlabelled=unlabelled, context=context)


def _tune(evaluation: Evaluation, root: Float[Values, "parameter r"], practice: Practice) -> Lambda:
    """Lambda per context for the error in the directions `root`."""
    xp = namespace(evaluation.gradient)
    quadratic, linear, spread = _normal_equations(evaluation, root, practice)
    diagonal = xp.diagonal(quadratic)
    usable = diagonal > 0
    safe = quadratic + xp.diag(xp.where(usable, 0.0, 1.0))
    raw = xp.where(usable, xp.linalg.solve(safe, linear), 0.0)
    standard_error = xp.where(usable, _standard_error(evaluation, root, safe, raw), 0.0)
    value = xp.asarray(_in_box(safe, linear)) if len(linear) > 1 else raw
    if practice.guard:
        calibrated = xp.where(usable, spread / xp.diagonal(safe), 0.0)
        value = _guarded(value, standard_error, calibrated)
    return Lambda(xp.clip(value, 0.0, 1.0), raw, standard_error)


def _normal_equations(
    evaluation: Evaluation, root: Float[Values, "parameter r"], practice: Practice
) -> tuple[Values, Values, Values]:
    """(A, b, diagonal of A without its unlabelled part) of the error lambda^T A lambda - 2 b^T lambda."""
    xp = namespace(evaluation.gradient)
    g, f = projections(evaluation, root)
    n = evaluation.n
    linear = xp.einsum("nr,ncr->c", g, f) / n
    spread = xp.einsum("ncr,ndr->cd", f, f) / n
    unlabelled = unlabelled_covariance(evaluation, root)
    ratio = n / evaluation.n_unlabelled
    if practice.pooled_spread:
        pooled = _pooled(evaluation, root)
        return (1 + ratio) * pooled, linear, xp.diagonal(pooled)
    return spread + ratio * unlabelled, linear, xp.diagonal(spread)


def projections(evaluation: Evaluation, root: Float[Values, "parameter r"]) -> tuple[Values, Values]:
    """Centred labelled gradients g (n, r) and f per context (n, context, r) along the directions `root`."""
    xp, n_context = namespace(evaluation.gradient), evaluation.unlabelled.value.shape[0]
    g = evaluation.gradient @ root
    f = evaluation.predicted_gradient @ root
    inside = evaluation.context[:, None] == xp.arange(n_context)
    f = inside[:, :, None] * f[:, None, :]
    return centred(g, evaluation.weight), centred(f, evaluation.weight)


def unlabelled_covariance(evaluation: Evaluation, root: Float[Values, "parameter r"]) -> Values:
    """Covariance between contexts of the unlabelled gradients, summed over directions, (context, context)."""
    mean, offset = (part @ root for part in (evaluation.unlabelled.gradient, evaluation.unlabelled.offset))
    outer = mean @ offset.T
    return namespace(mean).diag(_squares(evaluation, root)) - (outer + outer.T)


def _squares(evaluation: Evaluation, root: Float[Values, "parameter r"]) -> Float[Values, " context"]:
    """Mean squares of the unlabelled gradients, summed over directions."""
    return (root * (evaluation.unlabelled.second @ root)).sum(axis=(1, 2))


def _pooled(evaluation: Evaluation, root: Float[Values, "parameter r"]) -> Values:
    """Covariance of labelled and unlabelled gradients taken together, as of one sample."""
    xp = namespace(evaluation.gradient)
    n, count, total = evaluation.n, evaluation.n_unlabelled, evaluation.n + evaluation.n_unlabelled
    f, weight, unlabelled = evaluation.predicted_gradient, evaluation.weight, evaluation.unlabelled
    n_context = unlabelled.value.shape[0]
    inside = (evaluation.context[:, None] == xp.arange(n_context)).astype(f.dtype)
    twice, square = unlabelled.squares
    own_twice, own_square = (f, n) if weight is None else (weight[:, None] * f, weight @ weight)
    mean = (count * unlabelled.gradient + inside.T @ f) / total
    offset = (count * twice + inside.T @ own_twice) / total - (count * square + own_square) / total / 2 * mean
    outer = (mean @ root) @ (offset @ root).T
    labelled = xp.einsum("nc,nr->c", inside, (f @ root) ** 2)
    second = count * _squares(evaluation, root) + labelled
    return (xp.diag(second) - total * (outer + outer.T)) / (total - 1)


def _standard_error(
    evaluation: Evaluation,
    root: Float[Values, "parameter r"],
    quadratic: Float[Values, "context context"],
    raw: Float[Values, " context"],
) -> Float[Values, " context"]:
    """By the delta method over the labelled samples."""
    xp = namespace(evaluation.gradient)
    g, f = projections(evaluation, root)
    rest = g - xp.einsum("ncr,c->nr", f, raw)
    influence = xp.einsum("nr,ncr->nc", rest, f)
    influence = influence - xp.mean(influence, axis=0)
    n = evaluation.n
    covariance = influence.T @ influence / (n * xp.maximum(n - 2, 1.0))
    inverse = xp.linalg.inv(quadratic)
    return xp.sqrt(xp.maximum(xp.diagonal(inverse @ covariance @ inverse), 0.0))


@jax.jit
def _in_box(quadratic: Float[Array, "context context"], linear: Float[Array, " context"]) -> Array:
    """The minimiser of lambda^T A lambda - 2 b^T lambda over [0, 1]^context, by coordinate descent."""
    diagonal = jnp.diagonal(quadratic)

    def one(index: Array, lam: Array) -> Array:
        rest = linear[index] - quadratic[index] @ lam + diagonal[index] * lam[index]
        return lam.at[index].set(jnp.clip(rest / diagonal[index], 0.0, 1.0))

    def sweep(_: Array, lam: Array) -> Array:
        return jax.lax.fori_loop(0, len(linear), one, lam)

    return jax.lax.fori_loop(0, _SWEEPS, sweep, jnp.clip(linear / diagonal, 0.0, 1.0))


def _guarded(value: Values, standard_error: Values, calibrated: Values) -> Values:
    xp = namespace(value)
    anchor = xp.where(value < calibrated / 2, 0.0, calibrated)
    distance = value - anchor
    tiny = xp.finfo(value.dtype).tiny
    kept = xp.maximum(0.0, 1 - standard_error**2 / xp.maximum(distance**2, tiny))
    return anchor + distance * xp.where(standard_error > 0, kept, 1.0)
