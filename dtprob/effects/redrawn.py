"""Handlers that draw latent sites in another way, those inside NumPyro's `scan` among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpyro
from numpyro import handlers
from numpyro.infer.reparam import Reparam

from dtprob.effects.changing import is_scan

DRAWN: Final = "_drawn"
"""What the latent site is called after that gives a site its value."""


class Redrawn(handlers.reparam):
    """Draws each site in the way that is given for it, as `numpyro.handlers.reparam` does, in the bodies of scans, too."""

    def __init__(self, ways: Mapping[str, Reparam]) -> None:
        super().__init__(config=dict(ways))

    def process_message(self, msg: dict[str, Any]) -> None:
        """Redraw the site, or those of a scan's body."""
        if is_scan(msg):
            body, *rest = msg["args"]
            msg["args"] = (handlers.reparam(body, config=self.config), *rest)
        else:
            super().process_message(msg)


class _Apart(Reparam):
    """Draws a site under another name, so that its own is that of a value which may change."""

    def __call__(self, name: str, fn: Any, obs: Any) -> tuple[Any, Any]:
        return (None, numpyro.sample(f"{name}{DRAWN}", fn)) if obs is None else (fn, obs)


def drawn_apart(sites: Iterable[str]) -> Redrawn:
    """A handler in which effects may rewrite these sites though the model draws them.

    A latent site `k` becomes a deterministic one with the value of the latent `k_drawn`; all other sites stay.
    """
    return Redrawn(dict.fromkeys(sites, _Apart()))
