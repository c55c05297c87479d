"""Data that a posterior foresees: what a model would observe at parameters drawn from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.engine import check_key
from dtprob.inference.posterior import Posterior
from dtprob.models.arguments import Model, model_name, select_arguments, split_static
from dtprob.models.declaration import declare, is_factor
from dtprob.models.execution import trace_model

_BATCH: Final = 32
"""Draws that are foreseen side by side."""
_MOST: Final = 200_000_000
"""Numbers of a prediction."""


def predictive(key: PRNGKeyArray, posterior: Posterior, model: Model, data: Mapping[str, Any]) -> Posterior:
    """The posterior with what the model would observe at each of its draws, for checks of the model and for new places.

    Args:
        key: typed JAX key.
        posterior: of the model.
        model: a NumPyro model that draws what is observed where its argument is None.
        data: its arguments by name: those of the fit, or of other places; what was observed is left out.

    Returns:
        the posterior, whose `predicted` holds each site that the model draws besides the posterior's own,
        (chain, draw, *event); in `to_datatree` it is the group posterior_predictive.

    Raises:
        InputError: the model cannot run without what is observed, draws nothing then, or has arguments of other shapes
            than the posterior.
    """
    check_key(key)
    given = _without_observed(model, data)
    arrays, static = split_static(given)
    total = posterior.chains * posterior.draws_per_chain

    def one(key: PRNGKeyArray, drawn: dict[str, Array]) -> dict[str, Array]:
        trace = trace_model(model, eqx.combine(arrays, static), key, drawn)
        return {
            name: jnp.asarray(m["value"]) for name, m in trace.items() if _is_drawn(m) and name not in drawn
        }

    with numpyro.validation_enabled(is_validate=False):
        try:
            drawn_anew = jax.eval_shape(lambda key: one(key, {}), key)
        except (AttributeError, TypeError) as error:
            what, got = f"model {model_name(model)}", str(error).split("\n", maxsplit=1)[0]
            remedy = "Size plates by other arguments, and let the observed one be None"
            raise InputError(what, "one that draws what it observes", got, remedy) from error
        _check(posterior, {name: value.shape for name, value in drawn_anew.items()})
        draws = {name: jnp.asarray(posterior.flat(name)) for name in posterior.latent}
        keys = jax.random.split(key, total)
        found = jax.lax.map(lambda each: one(*each), (keys, draws), batch_size=min(_BATCH, total))
    layout = posterior.chains, posterior.draws_per_chain
    predicted = {name: np.asarray(value).reshape(*layout, *value.shape[1:]) for name, value in found.items()}
    return replace(posterior, predicted=predicted)


def _without_observed(model: Model, data: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments with None for those that hold what is observed."""
    chosen = select_arguments(model, data)
    sites = declare(model, chosen, needs="nothing").observed.values()
    return chosen | {site.argument: None for site in sites if site.argument is not None}


def _is_drawn(message: Mapping[str, Any]) -> bool:
    """Whether a site is drawn; what a model observes all the same is not."""
    return message["type"] == "sample" and not message["is_observed"] and not is_factor(message)


def _check(posterior: Posterior, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse a posterior that is not of what the model draws, of these shapes.

    Raises:
        InputError: see `predictive`.
    """
    for name in posterior.latent:
        wanted = posterior.draws[name].shape[2:]
        if shapes.get(name) != wanted:
            got = f"one of shape {shapes[name]}" if name in shapes else "none"
            remedy = "Give the model and as many units as were fitted"
            raise InputError(f"posterior of {name!r}", f"a site of shape {wanted}", got, remedy)
    new = [int(np.prod(shape, dtype=int)) for name, shape in shapes.items() if name not in posterior.latent]
    if not new:
        remedy = "Let the model observe an argument"
        raise InputError("data of a prediction", "sites that the model draws", "none", remedy)
    count = sum(new) * posterior.chains * posterior.draws_per_chain
    if count > _MOST:
        remedy = "Fit with fewer draws, or foresee fewer rows at once"
        raise InputError("prediction", f"at most {_MOST:.0e} numbers", f"{count:.0e}", remedy)
