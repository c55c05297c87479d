"""Effects of the user's own that change the model where they should do nothing, or that are no numbers there."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.effect import FIELD, Context, Effect
from dtprob.effects.rewriting import rewritten
from dtprob.errors import InputError
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.rewrites import derivative, null_vector
from dtprob.gap.observation import whiten

_ROUNDING = 1e-5
"""Share of the largest value of a site that single precision may lose."""
_LIBRARY = "dtprob.effects."
"""Where the functions of its effects are defined."""


def check_nulls(problem: Problem) -> None:
    """Look at each effect that the library has not made: at its null, sites have to stay what they are.

    Raises:
        InputError: one changes a site there, or makes it infinite or not a number, or has no slope there; or
            a site is of whole numbers that cannot be real ones.
    """
    for effect in problem.effects:
        if effect.kind == "variance" and effect.distributions:
            expected = "a random field that acts on deterministic sites, where it has scores"
            got = f"one that rewrites the distribution of {', '.join(effect.distributions)}"
            raise InputError(
                f"effect {effect.name}", expected, got, "Let it rewrite a site that the model computes"
            )
        _check_real(problem, effect)
    own = [e for e in problem.effects if not _is_of_library(e)]
    if not own:
        return
    there = problem.prior_spread.middle + problem.prior_spread.deviation
    values = dict(problem.compiled.sites(there))
    observed = problem.compiled.observations(there)
    context = Context(problem.data, values)
    for effect in own:
        given = effect.null()
        if effect.kind == "variance":
            given[FIELD] = jax.random.normal(jax.random.key(0), problem.field_shapes[effect.name])
        for site in effect.rewrites:
            before = np.asarray(values[site])
            after = np.asarray(rewritten(effect, site, values[site], given, context))
            _check_finite(effect, site, before, after)
            size, off = (np.abs(v[np.isfinite(v)]).max(initial=0.0) for v in (before, after - before))
            if off > _ROUNDING * size:
                raise InputError(
                    f"effect {effect.name}",
                    f"site {site!r} unchanged at its null, {_named(effect.null())}",
                    f"up to {off:.3g} away from values up to {size:.3g}",
                    "Make the rewrite the identity there, or give the parameter another null",
                )
        for site in effect.distributions:
            _check_density(effect, site, observed[site], problem.observed.values[site], context)
        if effect.kind == "mean":
            _check_slope(effect, values, context)


def _is_of_library(effect: Effect) -> bool:
    """Whether its rewrites are those of the library, which its own tests check; a name that is there tells nothing."""
    rewrites = (*effect.rewrites.values(), *effect.distributions.values())
    return all(str(getattr(rewrite, "__module__", "")).startswith(_LIBRARY) for rewrite in rewrites)


def _check_real(problem: Problem, effect: Effect) -> None:
    """What is of whole numbers, as an index, has no gradient, and so no effect on it has a score."""
    for site in effect.rewrites:
        declared = problem.declaration.sites[site]
        if declared.kind == "deterministic" and declared.size and site not in problem.float_sites:
            got = "true and false, or whole numbers that the model takes only as such"
            remedy = "Let the effect rewrite a site that the model computes from it"
            raise InputError(f"effect {effect.name}", f"real numbers at site {site!r}", got, remedy)


def _check_density(
    effect: Effect, site: str, before: whiten.Observation, value: jax.Array, context: Context
) -> None:
    """A rewritten distribution gives the data the density that they had."""
    fn = rewritten(effect, site, whiten.distribution(before), effect.null(), context)
    after = whiten.rewritten(before, fn, value, site)
    was, now = (np.asarray(whiten.log_prob(o, value)) for o in (before, after))
    told = np.isfinite(was)
    off = np.abs(now - was)[told].max(initial=0.0)
    if not off <= _ROUNDING * (1 + np.abs(was[told]).max(initial=0.0)):
        raise InputError(
            f"effect {effect.name}",
            f"the distribution of {site!r} unchanged at its null, {_named(effect.null())}",
            f"log densities up to {off:.3g} away",
            "Make the rewrite the identity there, or give the parameter another null",
        )


def _check_finite(effect: Effect, site: str, before: np.ndarray, after: np.ndarray) -> None:
    """A column with a missing value would make the effect's score nothing."""
    before = np.broadcast_to(before, np.broadcast_shapes(before.shape, after.shape))
    lost = np.isfinite(before) & ~np.isfinite(after)
    if lost.any():
        read = ", ".join(effect.requires) or "the columns that it reads"
        remedy = f"Look for missing values in {read}; leave those rows out or fill them"
        if lost.sum() == np.isfinite(before).sum():
            remedy = f"Give parameters another null than {_named(effect.null())}, as where one divides"
        got = f"{int(lost.sum())} of {lost.size} that are not"
        raise InputError(f"effect {effect.name}", f"finite values of site {site!r}", got, remedy)


def _check_slope(effect: Effect, values: Mapping[str, jax.Array], context: Context) -> None:
    """What has no slope at its null, as a parameter's square or root, has no score there."""
    what, null = f"effect {effect.name}", null_vector(effect)
    slopes = [np.asarray(derivative(effect, site, values[site], null, context)) for site in effect.rewrites]
    if not all(np.isfinite(slope).all() for slope in slopes):
        remedy = "Keep the rewrite smooth there; see where a root or an absolute value acts on a parameter"
        raise InputError(what, "a finite derivative at its null", "inf or nan", remedy)
    if any(slope.any() for slope in slopes):
        return
    moved = {p.name: jnp.full(p.shape, p.null if p.is_place else p.null + 1.0) for p in effect.parameters}
    after = (rewritten(effect, site, values[site], moved, context) for site in effect.rewrites)
    acts = any(
        not np.array_equal(np.asarray(a), np.broadcast_to(values[s], np.shape(a)), equal_nan=True)
        for a, s in zip(after, effect.rewrites, strict=True)
    )
    if acts:
        remedy = (
            "Let the size enter by its first power (p['b'] for p['b'] ** 2), and name a place with is_place"
        )
        raise InputError(what, "a derivative at its null that is not 0", "0", remedy)


def _named(values: dict[str, object]) -> str:
    return ", ".join(f"{name} = {np.asarray(value)}" for name, value in values.items())
