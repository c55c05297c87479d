"""What data say of each parameter: how much narrower its posterior is than its prior."""

from collections.abc import Mapping
from typing import Any, Final

import jax
import numpy as np

from dtprob.inference import Posterior
from dtprob.inference.build import build_target
from dtprob.inference.circular import arc_interval
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model

UNIDENTIFIED: Final = 1 - 0.9**2
"""A contraction below this is that of data that say nothing: nine tenths of the prior's width are left."""
_BATCHES: Final = 8
_MIDDLE: Final = 0.5


def contraction(
    posterior: Posterior, model: Model, data: Mapping[str, Any], sites: list[str]
) -> dict[str, np.ndarray]:
    """One minus the variance of each entry's posterior over that of its prior: 1 is known exactly, 0 is not identified.

    Variances are squares of the width of the middle half, which far draws do not change; a negative number means a
    posterior wider than the prior (Betancourt, arXiv:1803.08393). An entry whose draws are all the same, as a point
    estimate's are, has none (NaN).

    Args:
        posterior: of the model on the data.
        model: a NumPyro model.
        data: its arguments by name.
        sites: latent sites to look at.
    """
    target, inputs = build_target(model, data)
    keys = jax.random.split(jax.random.key(0), _BATCHES)
    drawn = [target.compiled(_prior_values)(key, inputs) for key in keys]
    prior = {name: np.concatenate([np.asarray(values[name]) for values in drawn]) for name in sites}
    return {
        name: 1
        - (
            _width(posterior.flat(name), circular=name in posterior.circular)
            / _width(prior[name], circular=name in posterior.circular)
        )
        ** 2
        for name in sites
    }


def _prior_values(target: Target, key: jax.Array, inputs: Inputs) -> dict[str, jax.Array]:
    """Latent sites at draws of the prior, (draw, *event)."""
    draws = target.prior_draws(key, inputs, {})
    values = jax.vmap(lambda u: target.constrain(u, inputs))(draws)
    return {name: values[name] for name in target.coordinates}


def _width(values: np.ndarray, *, circular: bool) -> np.ndarray:
    """Of the middle half, by entry; NaN where all draws are the same or some not finite, as of what cannot happen."""
    values = np.where(np.isfinite(values).all(axis=0), values, 0.0)
    if not circular:
        low, high = np.quantile(values, [_MIDDLE / 2, 1 - _MIDDLE / 2], axis=0)
        return np.where(np.ptp(values, axis=0) > 0, high - low, np.nan)
    flat = values.reshape(len(values), -1)
    ends = np.array([arc_interval(column, _MIDDLE) for column in flat.T]).reshape(-1, 2)
    width = np.mod(ends[:, 1] - ends[:, 0], 2 * np.pi)
    return np.where(np.ptp(flat, axis=0) > 0, width, np.nan).reshape(values.shape[1:])
