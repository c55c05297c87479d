"""Readings that are exactly alike, more of them than a continuous distribution gives, or than counts next to them.

So are those of a receiver at its ceiling or floor, of a sensor that is stuck, and a default where nothing was measured.
Data are rounded, so that some readings are alike under a right twin too: a value is expected as often as the values next
to it are there, and as often as the fitted twin's density there gives within the gaps to these. As coarse a value may be
read again and again in a row: no longer than neighbours are alike elsewhere, or than the density gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from dtprob.gap.model.problem import Problem
from dtprob.gap.model.quick import quick_jit
from dtprob.gap.observation import whiten
from dtprob.gap.observation.likelihoods import is_continuous, is_discrete, likelihood
from dtprob.gap.where.count_piles import FEWEST, MOST, TIMES, count_piles
from dtprob.gap.where.site_finding import SURE, SiteFinding

_BESIDE: Final = 4
"""Distinct values on each side of which the one that is read most often tells how often one is."""
_OFTEN: Final = 0.25
"""Share of neighbours that are alike up to which a run of one value tells something: slow errors, rounded, stay long."""
_MOST: Final = 64
"""Values of one observation that are looked at, those that are read most often."""


class _Repeated(NamedTuple):
    """A value, how often it is read, in words, and the chance that any value is read so."""

    value: float
    often: str
    p_value: float


def repeats(problem: Problem, x: np.ndarray) -> Iterator[SiteFinding]:
    """For each observation the value that is surely read too often, if there is one.

    Args:
        problem: the model on its data.
        x: the fit.
    """
    for name, observed in problem.compiled.observations(x).items():
        values, counted = np.asarray(problem.observed.values[name]), problem.observed.counted[name]
        if is_continuous(observed.family):
            found = _readings(observed, values, counted)
        elif is_discrete(observed.family) and not likelihood(observed.family).is_outcome:
            found = _counts(observed, values, counted)
        else:
            continue
        sure = next((one for one in found if one.p_value <= SURE), None)
        if sure is not None:
            place = f"the value {sure.value:.6g}, read {sure.often}"
            yield SiteFinding(name, "repeats", "each", sure.p_value, None, place=place)


def _readings(observed: whiten.Observation, values: np.ndarray, counted: np.ndarray) -> list[_Repeated]:
    """The value that is read most surely too often, and the runs of one value, the surest first."""
    distinct, count = np.unique(values[counted], return_counts=True)
    if len(distinct) < 2 or count.max() < FEWEST:
        return []
    apart = _entries_apart(observed)
    alike = {i: _alike(values, counted, i) for i in range(values.ndim) if values.shape[i] > 1}
    share = max(float(along.mean()) for along in alike.values())
    together = 1 / max(1 - share, 1 / values.size) ** 2
    pile = _pile(apart, values.shape, distinct, count, together=together)
    return [pile, *sorted(_runs(apart, values, alike, distinct), key=lambda one: one.p_value)]


def _counts(observed: whiten.Observation, values: np.ndarray, counted: np.ndarray) -> list[_Repeated]:
    """The count that is seen most surely too often."""
    own = values[counted]
    if not own.size or np.ptp(own) > MOST or np.any(own != np.round(own)):
        return []
    at = np.arange(own.min(), own.max() + 1.0)
    seen = np.bincount((own - own.min()).astype(int), minlength=len(at))
    expected = _expected(
        observed.parameters, at, np.ones(len(at)), family=observed.family, shape=values.shape
    )
    tail = count_piles(seen.astype(float), np.asarray(expected))
    worst = int(np.argmin(tail))
    p_value = float((seen > 0).sum() * tail[worst])
    return [_Repeated(at[worst], f"{seen[worst]} times", p_value)]


def _pile(
    observed: whiten.Observation,
    shape: tuple[int, ...],
    distinct: np.ndarray,
    count: np.ndarray,
    *,
    together: float,
) -> _Repeated:
    """The value that is read most surely too often, of ascending ones and how often each is read.

    So many readings count as one: where errors go together, so do those that are alike, and they come back together.
    """
    often = np.argsort(-count)[:_MOST]
    often = often[count[often] >= FEWEST]
    at, room = distinct[often], _room(distinct)[often]
    by_twin = _expected(observed.parameters, at, room, family=observed.family, shape=shape)
    expected = np.maximum(np.maximum(_beside(count)[often], by_twin), 1.0)
    tail = stats.poisson.sf(np.floor(count[often] / together) - 1, expected / together)
    tail[count[often] < TIMES * expected] = 1.0
    worst = int(np.argmin(tail))
    return _Repeated(at[worst], f"{count[often][worst]} times", float(len(distinct) * tail[worst]))


def _runs(
    observed: whiten.Observation, values: np.ndarray, alike: Mapping[int, np.ndarray], distinct: np.ndarray
) -> Iterator[_Repeated]:
    """Along each axis the longest run of one value."""
    for axis, same in alike.items():
        length = np.zeros((len(same) + 1, *same.shape[1:]), int)
        for i, again in enumerate(same):
            length[i + 1] = np.where(again, length[i] + 1, 0)
        steps = int(length.max())
        elsewhere = (same.sum() - steps + 1) / (same.size - steps + 1)
        if steps + 1 < FEWEST or elsewhere > _OFTEN:
            continue
        end, *beside = np.unravel_index(int(length.argmax()), length.shape)
        run = (slice(end - steps + 1, end + 1), *beside)
        value = np.moveaxis(values, axis, 0)[run][0]
        room = _room(distinct)[np.searchsorted(distinct, value)]
        chance = _chances(observed.parameters, value, room, family=observed.family, shape=values.shape)
        each = np.maximum(np.moveaxis(np.asarray(chance), axis, 0)[run], elsewhere)
        yield _Repeated(float(value), f"{steps + 1} times in a row", float(same.size * np.prod(each)))


def _alike(values: np.ndarray, counted: np.ndarray, axis: int) -> np.ndarray:
    """Which entries, but the first, are like the one before along an axis, which comes first."""
    own, counts = np.moveaxis(values, axis, 0), np.moveaxis(counted, axis, 0)
    return (own[1:] == own[:-1]) & counts[1:] & counts[:-1]


def _entries_apart(observed: whiten.Observation) -> whiten.Observation:
    """The observation, each entry of a vector by itself."""
    if not whiten.is_joint(observed.family):
        return observed
    factor = observed.parameters["scale_tril"]
    own = {"loc": observed.parameters["loc"], "scale": jnp.sqrt(jnp.sum(factor**2, axis=-1))}
    kept = {n: v for n, v in observed.parameters.items() if n == "mask"}
    return whiten.Observation("Normal", own | kept)


def _chance(
    parameters: whiten.Parameters, value: jax.Array, room: jax.Array, *, family: str, shape: tuple[int, ...]
) -> jax.Array:
    """The chance of each reading, in the shape of all, to be rounded to a value of such a width; 0 where none counts."""
    observed = whiten.Observation(family, parameters)
    density = jnp.exp(whiten.log_prob(observed, jnp.full(shape, value)))
    return observed.masked(jnp.minimum(jnp.nan_to_num(density) * room, 1.0))


_chances: Final = quick_jit(_chance, static_argnames=("family", "shape"))


@partial(quick_jit, static_argnames=("family", "shape"))
def _expected(
    parameters: whiten.Parameters, at: jax.Array, room: jax.Array, *, family: str, shape: tuple[int, ...]
) -> jax.Array:
    """How many readings the fitted twin expects at each of some values."""
    return jax.lax.map(lambda one: jnp.sum(_chance(parameters, *one, family=family, shape=shape)), (at, room))


def _room(distinct: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Width of what is rounded to each of ascending values, at most."""
    gap = np.diff(distinct)
    return (np.append(gap, gap[-1]) + np.append(gap[0], gap)) / 2


def _beside(count: np.ndarray) -> np.ndarray:
    """How often the most frequent one of the values next to each is read."""
    padded = np.pad(count, _BESIDE)
    shifts = [s for s in range(2 * _BESIDE + 1) if s != _BESIDE]
    return np.max([padded[s : s + len(count)] for s in shifts], axis=0)
