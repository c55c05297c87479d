"""How likely each window of a log is under each draw of a sampler, factor by factor; all in log space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import handlers
from numpyro.infer.util import compute_log_probs

from dtprob.errors import InputError, unknown_name
from dtprob.models.arguments import Data, Model, split_static
from dtprob.models.declaration import Declaration, declare
from dtprob.xla import warn_of_miscompilation

type Likelihoods = dict[str, Float[np.ndarray, "draw window"]]

_BATCH = 16


def window_likelihoods(
    model: Model,
    data: Data,
    draws: Mapping[str, Any],
    *,
    window: str | None = None,
    apart: Sequence[str] = (),
) -> Likelihoods:
    """Log likelihood of each window under each draw, for each factor (observed site) of any model.

    Args:
        model: a NumPyro model.
        data: its arguments by name, the observed ones present.
        draws: of every latent site, (draw, *event); a point estimate is one draw.
        window: the axis whose entries are windows; the model's cluster by default.
        apart: axes whose entries are factors of their own, as "cluster" makes arrivals[0] and arrivals[1].

    Raises:
        InputError: draws of a latent site are missing or of another shape, an observed site has no such window, an axis to
            keep apart that no observed site has, a window's likelihood that is not a number, or a model that adds to it by
            a `numpyro.factor` of the data, which belongs to no window.
    """
    warn_of_miscompilation()
    declaration = declare(model, data)
    _check_draws(draws, declaration)
    _check_factors(model, data, draws, declaration)
    axis = window or declaration.cluster
    axes = {name: site.axes for name, site in declaration.observed.items()}
    for name, own in axes.items():
        if axis not in own:
            remedy = "Name the axis of the windows"
            raise InputError(f"windows of {name!r}", f"one of {', '.join(own)}", repr(axis), remedy)
    check_apart(apart)
    others = {each for own in axes.values() for each in own} - {axis}
    for name in apart:
        if name not in others:
            raise unknown_name("axes to keep apart", name, others, "axis")
    latent = {name: jnp.asarray(draws[name]) for name in declaration.latent}
    arrays, static = split_static(data)
    arrays = jax.tree.map(jnp.asarray, arrays)
    found = _likelihoods(latent, arrays, static, model, axes, window=str(axis), apart=tuple(apart))
    told = {label: part for name, value in found.items() for label, part in _parts(name, np.asarray(value))}
    for label, part in told.items():
        lost = np.isnan(part).any(axis=0)
        if lost.any():
            expected, got = "a number of each window", f"NaN in window {int(lost.argmax())}"
            raise InputError(
                f"log likelihood of {label}", expected, got, "Correct the reading there, or mask it"
            )
    return told


def check_apart(apart: Sequence[str]) -> None:
    """Refuse one name in the place of several: its letters would be taken for axes.

    Raises:
        InputError: text.
    """
    if isinstance(apart, str):
        raise InputError("axes to keep apart", "several names", repr(apart), f"Write ({apart!r},)")


def _check_draws(draws: Mapping[str, Any], declaration: Declaration) -> None:
    """Refuse draws that the model cannot have had; a table of other rows would be read at the wrong ones."""
    for name, site in declaration.latent.items():
        if name not in draws:
            remedy = "Sample them from a posterior of this model"
            raise InputError("draws", f"every latent site of {declaration.name}", f"no {name!r}", remedy)
        if (found := np.shape(draws[name])[1:]) != site.shape:
            remedy = "Give the data and options (such as traffic) that the draws were learned with"
            raise InputError(
                f"draws of {name!r}", f"(draw, ...) with {site.shape} each", f"{found} each", remedy
            )


def _check_factors(model: Model, data: Data, draws: Mapping[str, Any], declaration: Declaration) -> None:
    """Refuse a `numpyro.factor` of the data, which is of no window; one of unknowns alone is a prior."""
    if not declaration.factors:
        return
    first = {name: jnp.asarray(draws[name])[0] for name in declaration.latent}
    fixed = handlers.substitute(handlers.seed(model, jax.random.key(0)), data=first)
    arrays, static = split_static(data)
    told = []
    for times in (1.0, 1.5):
        moved = jax.tree.map(
            lambda x, times=times: x * times if jnp.issubdtype(x.dtype, jnp.inexact) else x, arrays
        )
        terms, _ = compute_log_probs(fixed, (), dict(eqx.combine(moved, static)), {})
        told.append({name: float(terms[name]) for name in declaration.factors})
    for name in declaration.factors:
        if told[0][name] != told[1][name]:
            remedy = "Observe a distribution instead, or watch by a model that does"
            expected, got = "all that data tell at observed sites", f"numpyro.factor {name!r} of them"
            raise InputError(f"windows of {declaration.name}", expected, got, remedy)


@eqx.filter_jit
def _likelihoods(
    latent: Mapping[str, Array],
    arrays: Mapping[str, Any],
    static: Mapping[str, Any],
    model: Model,
    axes: Mapping[str, tuple[str, ...]],
    *,
    window: str,
    apart: tuple[str, ...],
) -> dict[str, Float[Array, "draw window *part"]]:
    """One draw after another, a few at a time; compiled once per model and shapes."""

    def one(value: Mapping[str, Array]) -> dict[str, Array]:
        fixed = handlers.substitute(handlers.seed(model, jax.random.key(0)), data=dict(value))
        terms, trace = compute_log_probs(fixed, (), dict(eqx.combine(arrays, static)), {}, sum_log_prob=False)
        told = {name: _told(terms[name], trace[name]["value"]) for name in axes}
        return {name: _summed(told[name], own, window, apart) for name, own in axes.items()}

    return jax.lax.map(one, latent, batch_size=_BATCH)


def _told(term: Array, value: Any) -> Array:
    """A site's log likelihoods; NaN for a value that is no number, which NumPyro takes for one that cannot be."""
    lost = jnp.isnan(jnp.asarray(value, jnp.result_type(value, float)))
    lost = jnp.any(lost, axis=tuple(range(term.ndim, lost.ndim)))
    return jnp.where(lost & jnp.isneginf(term), jnp.nan, term)


def _summed(term: Array, axes: tuple[str, ...], window: str, apart: Sequence[str]) -> Array:
    """Summed over all axes but the window's, which comes first, and those that stay apart."""
    kept = [i for i, axis in enumerate(axes) if axis in apart and axis != window]
    moved = jnp.moveaxis(term, [axes.index(window), *kept], range(1 + len(kept)))
    return jnp.sum(moved, axis=tuple(range(1 + len(kept), moved.ndim)))


def _parts(name: str, value: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if value.ndim == 2:
        return [(name, value)]
    return [
        (f"{name}[{','.join(map(str, index))}]", value[(slice(None), slice(None), *index)])
        for index in np.ndindex(*value.shape[2:])
    ]


def table_likelihoods(counts: Mapping[str, np.ndarray], draws: Mapping[str, np.ndarray]) -> Likelihoods:
    """The same from counts alone, where the model is tables of log-probabilities.

    Args:
        counts: for each table, how often each entry occurred in each window, (window, *table).
        draws: for each table, (draw, *table).
    """
    found: Likelihoods = {}
    for name, count in counts.items():
        table = np.asarray(draws[name], float).reshape(len(draws[name]), -1)
        occurred = count.reshape(len(count), -1).T
        never = np.isneginf(table)
        value = np.where(never, 0.0, table) @ occurred
        found[name] = np.where(never.astype(float) @ (occurred > 0) > 0, -np.inf, value)
    return found
