"""Handlers that change the values of deterministic sites, those inside NumPyro's `scan` among them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from numpyro.contrib.control_flow.scan import scan_wrapper
from numpyro.primitives import Messenger

_OWN = "_dtprob_changing"


class Changing(Messenger):
    """A handler that gives deterministic sites other values.

    Inside a `scan` it changes whole series, time first, as it would change a site of that shape outside: the body is run
    to learn the series, and run again with what the change adds. Where a changed site acts on later steps by way
    of the carried state this is repeated, so that changes are exact to first order in their size and beyond.
    """

    is_sum = False
    """Whether the change adds the same whatever the value is."""

    @abstractmethod
    def touches(self, name: str) -> bool:
        """Whether a deterministic site gets another value."""

    @abstractmethod
    def change(self, msg: Mapping[str, Any]) -> Any:
        """The new value of such a site."""

    def remember(self, msg: Mapping[str, Any]) -> None:
        """Called with the final value of every site, in order."""

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Change a deterministic site's value."""
        if is_scan(msg):
            if _OWN not in msg:
                msg[_OWN] = []
                msg["fn"] = partial(_changed, msg[_OWN])
            msg[_OWN].append(self)
        elif msg["type"] == "deterministic" and not is_scanned(msg) and self.touches(msg["name"]):
            msg["value"] = self.change(msg)

    def postprocess_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Remember the value, after all handlers have seen it."""
        if msg["type"] in ("deterministic", "sample"):
            self.remember(msg)


class Shift(Changing):
    """Adds to deterministic sites.

    Args:
        added: what, by the site's name.
    """

    is_sum = True

    def __init__(self, added: Mapping[str, Any]) -> None:
        super().__init__(None)
        self._added = added

    def touches(self, name: str) -> bool:
        """Whether something is added to a site."""
        return name in self._added

    def change(self, msg: Mapping[str, Any]) -> Any:
        """The value with what is added."""
        return msg["value"] + self._added[msg["name"]]


def is_scan(msg: Mapping[str, Any]) -> bool:
    """Whether a `scan` is about to run; a `cond` is another kind of control flow."""
    return msg["type"] == "control_flow" and (msg["fn"] is scan_wrapper or _OWN in msg)


def is_scanned(msg: Mapping[str, Any]) -> bool:
    """Whether a site is told of after its `scan` has run."""
    return msg.get("_control_flow_done", False)


def _changed(
    handlers: Sequence[Changing], body: Callable[..., Any], init: Any, xs: Any, *settings: Any, **how: Any
) -> Any:
    """`scan_wrapper` under handlers, the innermost first."""

    def scanned(added: Mapping[str, Any]) -> Any:
        def step(carry: Any, x: Any) -> Any:
            own, now = x
            with Shift(now):
                return body(carry, own)

        return scan_wrapper(step, init, (xs, dict(added)), *settings, **how)

    sites = _sites(jax.eval_shape(scanned, {}))
    acting = {
        name: [handler for handler in handlers if handler.touches(name)]
        for name, msg in sites.items()
        if msg["type"] == "deterministic"
    }
    acting = {name: those for name, those in acting.items() if those}
    added: dict[str, Any] = {}
    for name, those in acting.items():
        value = sites[name]["value"]
        sums = [handler for handler in those if handler.is_sum]
        added[name] = _final(sums, sites[name], jnp.zeros(value.shape, value.dtype))
    moving = sum(not all(handler.is_sum for handler in those) for those in acting.values())
    for _ in range(moving + 1 if moving else 0):
        added = _additions(handlers, acting, _sites(scanned(added)), added)
    return scanned(added)


def _sites(result: Any) -> dict[str, Any]:
    """The messages of the sites in what `scan_wrapper` returns."""
    return result[1][0].trace


def _final(handlers: Sequence[Changing], msg: Mapping[str, Any], value: Any) -> Any:
    for handler in handlers:
        value = handler.change({**msg, "value": value})
    return value


def _additions(
    handlers: Sequence[Changing],
    acting: Mapping[str, Sequence[Changing]],
    sites: Mapping[str, Any],
    added: Mapping[str, Any],
) -> dict[str, Any]:
    """What the handlers add to each series, given the series with what was added before."""
    found = {}
    for name, msg in sites.items():
        value = msg["value"]
        if name in acting:
            before = value - added[name]
            value = _final(acting[name], msg, before)
            found[name] = value - before
        if msg["type"] in ("deterministic", "sample"):
            for handler in handlers:
                handler.remember({**msg, "value": value})
    return found
