"""A model whose nuisances earlier data inform instead of its prior."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import handlers

from dtprob.gap.model.layout import fold, transform_of
from dtprob.models.arguments import Model


def informed(model: Model, known: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Model:
    """The model with a normal density, in unconstrained coordinates, in place of some sites' priors.

    Args:
        model: any model.
        known: mean (n,) and precision (n, n) of the flattened sites that earlier data inform.
    """
    if not known:
        return model

    @functools.wraps(model)
    def replaced(*args: Any, **data: Any) -> Any:
        with handlers.trace() as trace:
            result = model(*args, **data)
        for name, (mean, precision) in known.items():
            fn, value = trace[name]["fn"], trace[name]["value"]
            transform = transform_of(fn)
            u = transform.inv(value)
            jacobian = fold(transform.log_abs_det_jacobian(u, value), fn.batch_shape)
            deviation = u.reshape(-1) - mean
            prior = jnp.sum(fn.log_prob(value) + jacobian)
            numpyro.factor(f"{name}_reference", -0.5 * deviation @ (precision @ deviation) - prior)
        return result

    replaced.__signature__ = inspect.signature(model)  # pyright: ignore[reportAttributeAccessIssue]
    return replaced
