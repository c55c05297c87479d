"""Latent sites under a mask, as the padded rows of groups have them: what is masked tells nothing, and its prior counts.

Left out, the prior of a masked entry is flat: no mode exists, and what the data tell of everything else is the same.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from numpyro.primitives import Messenger

from dtprob.effects.changing import is_scan
from dtprob.models.arguments import Data, Model, within
from dtprob.models.execution import look_at_trace
from dtprob.wrapping import unwrapped, wrapped


class _Counted(Messenger):
    """Takes the masks off latent sites, those in the bodies of scans among them."""

    def process_message(self, msg: dict[str, Any]) -> None:
        """Take the mask off, if this is one."""
        if is_scan(msg):
            body, *rest = msg["args"]
            msg["args"] = (_Counted(body), *rest)
        elif _is_masked(msg):
            own, _ = unwrapped(msg["fn"])
            msg["fn"] = wrapped(own, msg["fn"], None)


def counted(model: Model, data: Data) -> Model:
    """The model with the prior of all entries of its latent sites; itself where none is masked.

    Args:
        model: any model.
        data: its arguments by name.
    """
    masked: list[bool] = []
    look_at_trace(model, data, lambda _, message: masked.append(_is_masked(message)))
    return within(model, _Counted) if any(masked) else model


def _is_masked(message: dict[str, Any]) -> bool:
    """Whether this is a latent site with a mask over its entries; one masked as a whole is meant to have no prior."""
    is_latent = message["type"] == "sample" and not message["is_observed"]
    mask = unwrapped(message["fn"])[1] if is_latent else None
    return mask is not None and jnp.ndim(mask) > 0
