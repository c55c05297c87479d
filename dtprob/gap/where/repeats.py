"""Readings that are exactly alike, more of them than a continuous distribution gives.

So are those of a receiver at its ceiling or floor, of a sensor that is stuck, and a default where nothing was measured.
Data are rounded, so that some readings are alike under a right twin too: a value is expected as often as the values next
to it are there, and as often as the fitted twin's density there gives within the gaps to these.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from dtprob.gap.model.problem import Problem
from dtprob.gap.model.quick import quick_jit
from dtprob.gap.observation import whiten
from dtprob.gap.observation.likelihoods import is_continuous
from dtprob.gap.where.site_finding import SURE, SiteFinding

_FEWEST: Final = 5
"""Readings that are alike from which on they are looked at."""
_BESIDE: Final = 4
"""Distinct values on each side of which the one that is read most often tells how often one is."""
_MOST: Final = 64
"""Values of one observation that are looked at, those that are read most often."""


def repeats(problem: Problem, x: np.ndarray) -> Iterator[SiteFinding]:
    """For each observation the value that is surely read too often, if there is one.

    Args:
        problem: the model on its data.
        x: the fit.
    """
    for name, observed in problem.compiled.observations(x).items():
        if not is_continuous(observed.family):
            continue
        values = np.asarray(problem.observed.values[name])
        distinct, count = np.unique(values[problem.observed.counted[name]], return_counts=True)
        often = np.argsort(-count)[:_MOST]
        often = often[count[often] >= _FEWEST]
        if len(distinct) < 2 or not len(often):
            continue
        by_twin = _expected(observed, values.shape, distinct[often], _room(distinct)[often])
        expected = np.maximum(np.maximum(_beside(count)[often], by_twin), 1.0)
        tail = stats.poisson.sf(count[often] - 1, expected)
        worst = int(np.argmin(tail))
        p_value = float(len(distinct) * tail[worst])
        if p_value <= SURE:
            place = f"the value {distinct[often][worst]:.6g}, read {count[often][worst]} times"
            yield SiteFinding(name, "repeats, each", p_value, None, place=place)


def _expected(
    observed: whiten.Observation,
    shape: tuple[int, ...],
    at: Float[np.ndarray, " n"],
    room: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """How many readings the fitted twin expects to be rounded to some values, each of such a width."""
    if whiten.is_joint(observed.family):  # each entry of a vector by itself
        factor = observed.parameters["scale_tril"]
        own = {"loc": observed.parameters["loc"], "scale": jnp.sqrt(jnp.sum(factor**2, axis=-1))}
        kept = {n: v for n, v in observed.parameters.items() if n == "mask"}
        observed = whiten.Observation("Normal", own | kept)
    return np.asarray(_summed(observed.parameters, at, room, family=observed.family, shape=shape))


@partial(quick_jit, static_argnames=("family", "shape"))
def _summed(
    parameters: whiten.Parameters,
    at: jax.Array,
    room: jax.Array,
    *,
    family: str,
    shape: tuple[int, ...],
) -> jax.Array:
    observed = whiten.Observation(family, parameters)

    def one(place: tuple[jax.Array, jax.Array]) -> jax.Array:
        density = jnp.exp(whiten.log_prob(observed, jnp.full(shape, place[0])))
        chance = jnp.minimum(jnp.nan_to_num(density) * place[1], 1.0)
        return jnp.sum(observed.masked(chance))

    return jax.lax.map(one, (at, room))


def _room(distinct: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Width of what is rounded to each of ascending values, at most."""
    gap = np.diff(distinct)
    return (np.append(gap, gap[-1]) + np.append(gap[0], gap)) / 2


def _beside(count: np.ndarray) -> np.ndarray:
    """How often the most frequent one of the values next to each is read."""
    padded = np.pad(count, _BESIDE)
    shifts = [s for s in range(2 * _BESIDE + 1) if s != _BESIDE]
    return np.max([padded[s : s + len(count)] for s in shifts], axis=0)
