"""What data say of each parameter: how much narrower its posterior is than its prior, and how far it has moved."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import jax
import numpy as np
from scipy import special

from dtprob.inference import Posterior
from dtprob.inference.build import build_target
from dtprob.inference.circular import arc_interval, resultant_length
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model

_WIDTH_LEFT: Final = 0.9
"""Data say nothing where more than this share of the prior's width is left, and less than its inverse, ..."""
_STANDS_STILL: Final = 0.5
"""... and the centre has moved by less than this, in prior standard deviations."""
_FAR: Final = 3.0
"""Data contradict the prior of a parameter from here on, in prior standard deviations; of many, from a bit further on."""
_TOO_WIDE: Final = 2.0
"""Data contradict a prior that is narrower than its posterior by this factor."""
_BATCHES: Final = 16
_MIDDLE: Final = 0.5
_SCORES: Final = np.linspace(-2.0, 2.0, 41)
"""Normal scores between which draws of the prior are interpolated; beyond them their outer half goes on in a line."""


class Learnt(NamedTuple):
    """What data say of the entries of one site; NaN for entries whose draws are all the same, as a point estimate's.

    Attributes:
        contraction: one minus the variance of the posterior over that of the prior: 1 is known exactly. Variances are
            squares of the width of the middle half, which far draws do not change (Betancourt, arXiv:1803.08393).
        shift: how far the centre has moved from the prior's, in prior standard deviations.
        width: of the posterior over that of the prior.

    Shift and width are of the scale on which the prior is normal, so that a skewed one does not matter.
    """

    contraction: np.ndarray
    shift: np.ndarray
    width: np.ndarray

    @property
    def is_idle(self) -> np.ndarray:
        """Which entries the data say nothing of: the posterior is the prior."""
        same = (self.width > _WIDTH_LEFT) & (self.width < 1 / _WIDTH_LEFT)
        return same & (np.abs(self.shift) < _STANDS_STILL)

    def contradicts(self, entries: int) -> np.ndarray:
        """Which entries the data put where the prior is not, if they are some of so many."""
        far = -special.ndtri(special.ndtr(-_FAR) / max(entries, 1))
        return (np.abs(self.shift) > far) | (self.width > _TOO_WIDE)


def learnt(
    posterior: Posterior, model: Model, data: Mapping[str, Any], sites: list[str]
) -> dict[str, Learnt]:
    """Compare each entry's posterior with its prior.

    Args:
        posterior: of the model on the data.
        model: a NumPyro model.
        data: its arguments by name.
        sites: latent sites to look at.
    """
    target, inputs = build_target(model, data)
    keys = jax.random.split(jax.random.key(0), _BATCHES)
    drawn: list[dict[str, np.ndarray]] = []
    for key in keys:
        values = target.compiled(_prior_values)(key, inputs)
        drawn.append({name: np.asarray(values[name]) for name in sites})
    prior = {name: np.concatenate([values[name] for values in drawn]) for name in sites}
    return {
        name: _compared(posterior.flat(name), prior[name], circular=name in posterior.circular)
        for name in sites
    }


def _prior_values(target: Target, key: jax.Array, inputs: Inputs) -> dict[str, jax.Array]:
    """Latent sites at draws of the prior, (draw, *event)."""
    draws = target.prior_draws(key, inputs, {})
    values = jax.vmap(lambda u: target.constrain(u, inputs))(draws)
    return {name: values[name] for name in target.coordinates}


def _compared(draws: np.ndarray, prior: np.ndarray, *, circular: bool) -> Learnt:
    draws, prior = (
        np.where(np.isfinite(v).all(axis=0), v, 0.0) for v in (draws, prior)
    )  # what cannot happen
    ratio = _width(draws, circular=circular) / _width(prior, circular=circular)
    if circular:
        there = [np.mean(np.exp(1j * angle), axis=0) for angle in (draws, prior)]
        spread = np.sqrt(-2 * np.log(np.clip(resultant_length(prior), 1e-300, 1 - 1e-12)))
        shift = np.where(np.isnan(ratio), np.nan, np.abs(there[0] - there[1]) / spread)
        return Learnt(1 - ratio**2, shift, ratio)
    places = np.quantile(draws, [_MIDDLE / 2, 0.5, 1 - _MIDDLE / 2], axis=0).reshape(3, -1)
    columns = zip(places.T, prior.reshape(len(prior), -1).T, strict=True)
    scores = np.array([_scores(*column) for column in columns]).reshape(*draws.shape[1:], 3)
    width = (scores[..., 2] - scores[..., 0]) / (2 * special.ndtri(1 - _MIDDLE / 2))
    known = np.isnan(ratio)
    return Learnt(1 - ratio**2, np.where(known, np.nan, scores[..., 1]), np.where(known, np.nan, width))


def _scores(places: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Where values lie on the scale on which the prior is standard normal; a positive one goes on by its logarithm."""
    if np.min(prior) > 0 and np.min(places) > 0:
        places, prior = np.log(places), np.log(prior)
    knots = np.quantile(prior, special.ndtr(_SCORES))
    inner = np.interp([-1.0, 1.0], _SCORES, knots)
    low, high = inner[0] - knots[0], knots[-1] - inner[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        below, above = np.minimum(places - knots[0], 0) / low, np.maximum(places - knots[-1], 0) / high
    return np.interp(places, knots, _SCORES) + below + above


def _width(values: np.ndarray, *, circular: bool) -> np.ndarray:
    """Of the middle half, by entry; NaN where all draws are the same."""
    if not circular:
        low, high = np.quantile(values, [_MIDDLE / 2, 1 - _MIDDLE / 2], axis=0)
        return np.where(np.ptp(values, axis=0) > 0, high - low, np.nan)
    flat = values.reshape(len(values), -1)
    ends = np.array([arc_interval(column, _MIDDLE) for column in flat.T]).reshape(-1, 2)
    width = np.mod(ends[:, 1] - ends[:, 0], 2 * np.pi)
    return np.where(np.ptp(flat, axis=0) > 0, width, np.nan).reshape(values.shape[1:])
