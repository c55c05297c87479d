"""Which family of observations a NumPyro distribution is of, and its parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from numpyro.distributions.discrete import ZeroInflatedProbs

from dtprob.errors import InputError
from dtprob.gap.observation import numeric
from dtprob.gap.observation.likelihoods import COMPOUNDS, LIKELIHOODS, SAME, likelihood
from dtprob.gap.observation.limited import TRUNCATED
from dtprob.gap.observation.mixed import mixed
from dtprob.gap.observation.normal_scores import NORMAL_SCORES
from dtprob.wrapping import unwrapped

_IN_TURN: Final = "the first of all, the second of what the first leaves, and so on"
_INSTEAD: Final = {
    **dict.fromkeys(
        ("MultinomialProbs", "MultinomialLogits"), f"Observe Binomial counts of the classes: {_IN_TURN}"
    ),
    "Dirichlet": f"Observe Beta shares: {_IN_TURN}",
}
"""What says the same in distributions that are known, by the name of one that is not."""


class _Found(NamedTuple):
    """A family, and its parameters without common shape."""

    family: str
    parameters: Mapping[str, Any]


def recognised(
    fn: Any, value: Any, name: str, counted: jax.Array | None = None
) -> tuple[str, dict[str, jax.Array]]:
    """Family and parameters of an unwrapped distribution, each broadcast to the value's shape and its further axes.

    Args:
        fn: the distribution.
        value: the data.
        name: of the site.
        counted: above 0 where a value counts; None where all do.

    Raises:
        InputError: the diagnosis does not know the distribution.
    """
    found = _compound(fn, value, counted) or _plain(fn) or _own(fn)
    if found is None:
        raise InputError(
            f"observed site {name!r}",
            f"a distribution among {', '.join(LIKELIHOODS)}, a kind of these such as OrderedLogistic or NegativeBinomial2, "
            f"one of them that is {', '.join(COMPOUNDS)} (the last six: of {', '.join(NORMAL_SCORES)}), or a class of "
            "numbers with arg_constraints, log_prob, sample and a support that does not depend on its parameters",
            _described(fn),
            _INSTEAD.get(type(fn).__name__, "Declare the observation with one of these to diagnose its gap."),
        )
    parameters = {}
    for parameter, given in found.parameters.items():
        array = jnp.asarray(given)
        array = array if jnp.issubdtype(array.dtype, jnp.inexact) else array.astype(float)
        trailing = array.shape[array.ndim - likelihood(found.family).trailing.get(parameter, 0) :]
        parameters[parameter] = jnp.broadcast_to(array, jnp.shape(value) + trailing)
    return found.family, parameters


def _described(fn: Any) -> str:
    """The class of a distribution, and of what it is made of."""
    parts = [type(part).__name__ for part in _parts(fn)]
    return f"{type(fn).__name__} of {', '.join(parts)}" if parts else type(fn).__name__


def _parts(fn: Any) -> Iterator[Any]:
    for name in ("base_dist", "component_distribution"):
        if isinstance(getattr(fn, name, None), dist.Distribution):
            yield unwrapped(getattr(fn, name))[0]


def _plain(fn: Any) -> _Found | None:
    """One of the distributions that stand alone; a class of one's own may differ from what it is derived from."""
    kinds = type(fn).__mro__ if type(fn).__module__.startswith("numpyro.") else [type(fn)]
    names = (SAME.get(kind.__name__, kind.__name__) for kind in kinds)
    family = next((known for known in names if known in LIKELIHOODS), None)
    if family is None:
        return None
    return _Found(family, {n: getattr(fn, n) for n in LIKELIHOODS[family].parameters})


def _own(fn: Any) -> _Found | None:
    """One that is known by its density and its draws."""
    parameters = numeric.parameters_of(fn)
    return None if parameters is None else _Found(numeric.family_of(type(fn)), parameters)


def _compound(fn: Any, value: Any, counted: jax.Array | None) -> _Found | None:
    """One that is made of another."""
    if isinstance(fn, (dist.MixtureSameFamily, dist.MixtureGeneral)):
        return _mixed(fn) or _mixed_otherwise(fn)
    if isinstance(fn, ZeroInflatedProbs):
        found = _plain(unwrapped(fn.base_dist)[0])
        if found is None or LIKELIHOODS[found.family].is_outcome:
            return None
        return _Found(f"ZeroInflated {found.family}", {**found.parameters, "gate": fn.gate})
    if isinstance(fn, (dist.LeftCensoredDistribution, dist.RightCensoredDistribution)):
        kind = "LeftCensored" if isinstance(fn, dist.LeftCensoredDistribution) else "RightCensored"
        censored = jnp.broadcast_to(fn.censored, jnp.shape(value))
        return _of(kind, fn.base_dist, _limits(kind, censored, value, counted))
    for kind, (made, bounds) in TRUNCATED.items():
        if type(fn) is made:
            return _of(kind, fn.base_dist, {n: getattr(fn, n) for n in bounds})
    return None


def _mixed(fn: dist.MixtureSameFamily | dist.MixtureGeneral) -> _Found | None:
    """Parts along a last axis, each with its chance; one that never comes tells nothing."""
    listed = isinstance(fn, dist.MixtureGeneral)
    parts = _stacked(fn.component_distributions) if listed else _of("Mixture", fn.component_distribution, {})
    if parts is None:
        return None
    chance = jnp.asarray(fn.mixing_distribution.probs)
    least = jnp.finfo(chance.dtype).tiny
    given = {**parts.parameters, "log_weight": jnp.log(jnp.maximum(chance, least))}
    shapes = {n: jnp.broadcast_shapes(jnp.shape(v), chance.shape[-1:]) for n, v in given.items()}
    return _Found(parts.family, {n: jnp.broadcast_to(v, shapes[n]) for n, v in given.items()})


def _mixed_otherwise(fn: dist.MixtureSameFamily | dist.MixtureGeneral) -> _Found | None:
    """Parts of several families, or of one without quadratures of its own: parameters of each by its number."""
    chance: Any = fn.mixing_distribution.probs
    if isinstance(fn, dist.MixtureGeneral):
        parts = [_single(unwrapped(part)[0]) for part in fn.component_distributions]
    else:
        shape = fn.component_distribution.batch_shape
        parts = _numbered(_single(unwrapped(fn.component_distribution)[0]), shape, chance.shape[-1])
    found = [part for part in parts if part is not None]
    families = [part.family for part in found]
    kind = mixed(families, [likelihood(family) for family in families]) if len(found) == len(parts) else None
    if kind is None:
        return None
    log = jnp.log(jnp.maximum(jnp.asarray(chance), jnp.finfo(float).tiny))
    odds = {f"odds_{k}": log[..., k] - log[..., 0] for k in range(1, len(found))}
    own = {f"{k}_{n}": value for k, part in enumerate(found) for n, value in part.parameters.items()}
    return _Found(numeric.family_of(kind), {**own, **odds})


def _numbered(one: _Found | None, shape: tuple[int, ...], count: int) -> list[_Found | None]:
    """The parts whose parameters lie along a last axis."""
    if one is None:
        return [None]
    wide = {n: jnp.broadcast_to(jnp.asarray(value), shape) for n, value in one.parameters.items()}
    return [_Found(one.family, {n: value[..., k] for n, value in wide.items()}) for k in range(count)]


def _single(fn: Any) -> _Found | None:
    """A part: one that stands alone, of single numbers whose parameters are such."""
    found = _plain(fn) or _own(fn)
    return None if found is None or fn.event_shape or likelihood(found.family).trailing else found


def _stacked(parts: Sequence[Any]) -> _Found | None:
    """Parts of one family along a last axis; None where they are of several."""
    found = [_of("Mixture", part, {}) for part in parts]
    first = found[0]
    if first is None or any(one is None or one.family != first.family for one in found):
        return None
    every = {n: [one.parameters[n] for one in found if one is not None] for n in first.parameters}
    wide = {n: jnp.broadcast_shapes(*map(jnp.shape, values)) for n, values in every.items()}
    return _Found(
        first.family,
        {n: jnp.stack([jnp.broadcast_to(v, wide[n]) for v in values], -1) for n, values in every.items()},
    )


def _of(kind: str, base: Any, further: Mapping[str, Any]) -> _Found | None:
    found = _plain(unwrapped(base)[0])
    if found is None or found.family not in NORMAL_SCORES:
        return None
    return _Found(f"{kind} {found.family}", {**found.parameters, **further})


def _limits(kind: str, censored: jax.Array, value: Any, counted: jax.Array | None) -> dict[str, jax.Array]:
    """Where each reading would have been censored, and the farthest such limit of any that counts, the same for all.

    Those that were are at their limit; the others are taken to have had the farthest, if they are within it.
    """
    sign = 1.0 if kind == "LeftCensored" else -1.0
    own = sign * jnp.asarray(value, float)
    among = censored & jnp.isfinite(own)
    telling = among if counted is None else among & (counted > 0)
    farthest = jnp.where(telling, own, jnp.inf).min()
    limit = jnp.where(among, own, jnp.where(own > farthest, farthest, -jnp.inf))
    known = jnp.where(jnp.isfinite(farthest), farthest, -jnp.inf)
    return {
        "limit": sign * limit,
        "farthest": jnp.broadcast_to(sign * known, own.shape),
        "censored": censored,
    }
