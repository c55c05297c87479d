"""Does tuned cross-prediction ever lose, and do its intervals cover? A grid of sizes, folds and predictors.

The estimated quantity is the mean label. For each cell: mean square error of tuned CPPI over the smaller of
those of ERM and CPPI, which should never exceed 1.02, and the coverage of its 90% intervals.
"""

import itertools
from collections.abc import Mapping
from functools import partial
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy import stats

from dtprob.models.prediction_powered.arrays import Values
from dtprob.models.prediction_powered.covariance import spread
from dtprob.models.prediction_powered.moments import Evaluation, Group
from dtprob.models.prediction_powered.schemes import Mix
from dtprob.models.prediction_powered.tuning import CAREFUL, Practice, fixed, tune, tuning_cost
from dtprob.physical.labels import QUALITIES, LabelStudy, Quality, Setting, label_study
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 20_000
LABELLED: Final = (30, 50, 100, 300)
UNLABELLED: Final = (100, 2000, 38_000)
FOLDS: Final = (2, 5, 10)
SCHEMES: Final = ("erm", "cppi", "tuned_cppi")
LEVEL: Final = 0.9
_BATCH: Final = 500
_UNTRAINED: Final = ("perfect", "useless")
"""Qualities of predictors that are given, so that folds make no difference."""


class Cell(NamedTuple):
    """Results of one cell, for ERM, CPPI and tuned CPPI.

    Attributes:
        error: mean square errors.
        coverage: of the intervals.
        lam: mean lambda.
    """

    error: Float[np.ndarray, " scheme"]
    coverage: Float[np.ndarray, " scheme"]
    lam: Float[np.ndarray, " scheme"]

    @property
    def ratio(self) -> float:
        """Error of the tuned scheme over the smaller of the others'."""
        return float(self.error[2] / min(self.error[0], self.error[1]))


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The grid; see the module."""

    def cell(setting: Setting) -> Cell:
        if setting.quality in _UNTRAINED:
            setting = setting._replace(folds=FOLDS[0])
        return Cell(**progress.part(str(tuple(setting)), lambda: study(key, runs, setting)._asdict()))

    settings = itertools.starmap(Setting, itertools.product(QUALITIES, LABELLED, UNLABELLED, FOLDS))
    cells = {setting: cell(setting) for setting in settings}
    ratios = {setting: cell.ratio for setting, cell in cells.items()}
    coverages = {setting: float(cell.coverage[2]) for setting, cell in cells.items()}
    worst = max(ratios, key=lambda setting: ratios[setting])
    many = [value for setting, value in coverages.items() if setting.n >= 50]
    few = [value for setting, value in coverages.items() if setting.n < 50]
    return Figure(
        "label_grid",
        "tuned cross-prediction-powered mean",
        (
            Panel("error against the better of ERM and CPPI", *_AXES[0], _series(ratios)),
            Panel("coverage of 90% intervals", *_AXES[1], _series(coverages)),
        ),
        runs,
        (
            f"largest ratio of mean square errors: {ratios[worst]:.4f}, at {tuple(worst)}",
            f"coverage for n from 50: {min(many):.4f} to {max(many):.4f}",
            f"coverage for n = 30: {min(few):.4f} to {max(few):.4f}",
        ),
    )


_AXES: Final = tuple(
    (Quantity("labelled samples", is_log=True), Quantity(name))
    for name in ("ratio of mean square errors", "coverage")
)


def _series(values: Mapping[Setting, float]) -> tuple[Series, ...]:
    """One curve per quality: middle and range over the numbers of unlabelled samples and folds."""

    def curve(quality: Quality) -> Series:
        columns = [[v for s, v in values.items() if s.quality == quality and s.n == n] for n in LABELLED]
        table = np.array(columns)
        middle, low, high = np.median(table, axis=1), table.min(axis=1), table.max(axis=1)
        return Series(quality, np.array(LABELLED, float), middle, low, high)

    return tuple(curve(quality) for quality in QUALITIES)


def study(key: PRNGKeyArray, runs: int, setting: Setting, practice: Practice = CAREFUL) -> Cell:
    """Mean square error, coverage and lambda over many data sets of one kind.

    Args:
        key: typed JAX key; the same data sets are drawn for every scheme and practice.
        runs: data sets.
        setting: their kind.
        practice: conventions of tuning and intervals.
    """
    shape = setting._replace(unlabelled=0)
    found = _runs(jax.random.split(key, runs), jnp.asarray(float(setting.unlabelled)), shape, practice)
    point, error, degrees, lam = (np.asarray(part) for part in found)
    return Cell((point**2).mean(axis=0), _coverage(point, error, degrees, practice), lam.mean(axis=0))


@partial(jax.jit, static_argnums=(2, 3))
def _runs(
    keys: PRNGKeyArray, count: Float[Array, ""], shape: Setting, practice: Practice
) -> tuple[Array, Array, Array, Array]:
    """Estimates, their standard errors and degrees of freedom, and lambda, each per run and scheme.

    The number of unlabelled samples is an argument, so that cells that differ in it are compiled once.
    """

    def one(own: PRNGKeyArray) -> tuple[Array, Array, Array, Array]:
        evaluation = evaluation_of(label_study(own, shape._replace(unlabelled=count)), count)
        tuned = tune(evaluation, jnp.ones((1, 1)), "overall", practice)
        lams = [fixed(0.0, evaluation).value, fixed(1.0, evaluation).value, tuned.value]
        costs = 0, 0, tuning_cost(tuned.value, "overall") if practice.lost is None else 0
        rows = [_estimate(evaluation, lam, practice, cost) for lam, cost in zip(lams, costs, strict=True)]
        point, error, degrees = (jnp.stack(column) for column in zip(*rows, strict=True))
        return point, error, degrees, jnp.stack([lam[0, 0] for lam in lams])

    return jax.lax.map(one, keys, batch_size=min(_BATCH, len(keys)))


def evaluation_of(study: LabelStudy, count: Float[Array, ""]) -> Evaluation:
    """The data of a study as the estimators see them: gradients of the mean's loss at 0."""
    one = jnp.ones((1, 1, 1))

    def group(mean: Array, square: Array) -> Group:
        return Group(square[None] / 2, -mean[None, None], one, square[None, None, None])

    return Evaluation(
        labelled=group(jnp.mean(study.y), jnp.mean(study.y**2)),
        predicted=group(jnp.mean(study.prediction), jnp.mean(study.prediction**2)),
        unlabelled=group(study.unlabelled_mean, study.unlabelled_square),
        gradient=-study.y[:, None],
        predicted_gradient=-study.prediction[:, None],
        context=jnp.zeros(len(study.y), int),
        n=jnp.asarray(float(len(study.y))),
        n_unlabelled=count,
    )


def _estimate(
    evaluation: Evaluation, lam: Values, practice: Practice, cost: Int[Values, ""] | int
) -> tuple[Values, Values, Values]:
    """Estimate, standard error and degrees of freedom."""
    correction = evaluation.unlabelled.gradient[0] - evaluation.predicted.gradient[0]
    point = -(evaluation.labelled.gradient[0] + lam[0] * correction)
    found = spread(evaluation, Mix(jnp.ones(()), lam, lam), jnp.ones((1, 1)), practice, cost)
    return point[0], jnp.sqrt(found.covariance[0, 0]), found.degrees[0]


def _coverage(
    point: Float[np.ndarray, "run scheme"],
    error: Float[np.ndarray, "run scheme"],
    degrees: Float[np.ndarray, "run scheme"],
    practice: Practice,
) -> Float[np.ndarray, " scheme"]:
    chance = (1 + LEVEL) / 2
    width = stats.norm.ppf(chance) if practice.reference == "normal" else stats.t.ppf(chance, degrees)
    return np.mean(np.abs(point) <= width * error, axis=0)
