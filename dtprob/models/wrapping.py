"""A distribution within what changes its shape or its weight and not its density."""

from __future__ import annotations

from typing import Any, Final

import jax.numpy as jnp
import numpyro.distributions as dist

_WRAPPERS: Final = (dist.Independent, dist.ExpandedDistribution, dist.MaskedDistribution)


def unwrapped(fn: Any) -> tuple[Any, Any]:
    """A distribution without what changes its shape or its mask, and the mask; None where all counts."""
    mask: Any = None
    while isinstance(fn, _WRAPPERS):
        if isinstance(fn, dist.MaskedDistribution):
            own = jnp.asarray(fn._mask)  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
            own = own.reshape(own.shape + (1,) * (len(fn.event_shape) if own.ndim else 0))
            mask = own if mask is None else mask & own
        fn = fn.base_dist
    return fn, mask
