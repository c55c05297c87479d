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


def wrapped(new: Any, like: Any, mask: Any) -> Any:
    """A distribution in the place of another: of its batch and event shape, and with its mask.

    Args:
        new: without wrappers, or with those that it is to have besides.
        like: the other one.
        mask: of that one, as `unwrapped` tells it.
    """
    events = max(len(like.event_shape) - len(new.event_shape), 0)
    whole = (*like.batch_shape, *like.event_shape[:events])
    new = new if new.batch_shape == whole else new.expand(whole)
    if mask is not None and unwrapped(new)[1] is None:
        own = jnp.asarray(mask)
        new = new.mask(own.reshape(own.shape[: max(own.ndim - len(new.event_shape), 0)]))
    return new.to_event(events) if events else new
