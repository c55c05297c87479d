"""A model whose nuisances earlier data inform instead of its prior."""

from __future__ import annotations

import functools
import inspect
from typing import Any

import jax.numpy as jnp
import numpyro
from numpyro import handlers

from dtprob.gap.model.layout import Known, fold, transform_of
from dtprob.models.arguments import Model


def informed(model: Model, known: Known) -> Model:
    """The model with a normal density, in unconstrained coordinates, in place of some sites' priors.

    Args:
        model: any model.
        known: mean and precision of the flattened sites that earlier data inform.
    """
    if not known:
        return model

    @functools.wraps(model)
    def replaced(*args: Any, **data: Any) -> Any:
        with handlers.trace() as trace:
            result = model(*args, **data)
        for names, (mean, precision) in known.items():
            flat, prior = [], jnp.zeros(())
            for name in names:
                fn, value = trace[name]["fn"], trace[name]["value"]
                transform = transform_of(fn)
                u = transform.inv(value)
                jacobian = fold(transform.log_abs_det_jacobian(u, value), fn, value)
                flat.append(u.reshape(-1))
                prior = prior + jnp.sum(fn.log_prob(value) + jacobian)
            deviation = jnp.concatenate(flat) - mean
            name = f"{'_'.join(names)}_reference"
            numpyro.factor(name, -0.5 * deviation @ (precision @ deviation) - prior)
        return result

    replaced.__signature__ = inspect.signature(model)  # pyright: ignore[reportAttributeAccessIssue]
    return replaced
