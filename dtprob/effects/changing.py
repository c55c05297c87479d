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
        if msg["type"] == "control_flow":
            if msg["fn"] is scan_wrapper:
                msg[_OWN] = []
                msg["fn"] = partial(_changed, msg[_OWN])
            if _OWN in msg:
                msg[_OWN].append(self)
        elif msg["type"] == "deterministic" and not is_scanned(msg) and self.touches(msg["name"]):
            msg["value"] = self.change(msg)

    def postprocess_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Remember the value, after all handlers have seen it."""
        if msg["type"] in ("deterministic", "sample"):
            self.remember(msg)


def is_scanned(msg: Mapping[str, Any]) -> bool:
    """Whether a site is told of after its `scan` has run."""
    return msg.get("_control_flow_done", False)


class _Added(Messenger):
    """Adds to deterministic sites."""

    def __init__(self, added: Mapping[str, Any]) -> None:
        super().__init__(None)
        self._added = added

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if msg["type"] == "deterministic" and msg["name"] in self._added:
            msg["value"] = msg["value"] + self._added[msg["name"]]


def _changed(
    handlers: Sequence[Changing], body: Callable[..., Any], init: Any, xs: Any, *settings: Any, **how: Any
) -> Any:
    """`scan_wrapper` under handlers, the innermost first."""

    def scanned(added: Mapping[str, Any]) -> Any:
        def step(carry: Any, x: Any) -> Any:
            own, now = x
            with _Added(now):
                return body(carry, own)

        return scan_wrapper(step, init, (xs, dict(added)), *settings, **how)

    sites = _sites(jax.eval_shape(scanned, {}))
    touched = [n for n, m in sites.items() if m["type"] == "deterministic" and _of(handlers, n)]
    moving = [n for n in touched if not all(h.is_sum for h in _of(handlers, n))]
    nothing = {n: jnp.zeros(sites[n]["value"].shape, sites[n]["value"].dtype) for n in touched}
    added = {n: _final([h for h in _of(handlers, n) if h.is_sum], sites[n], z) for n, z in nothing.items()}
    for _ in range(len(moving) + 1 if moving else 0):
        added = _additions(handlers, _sites(scanned(added)), added)
    return scanned(added)


def _sites(result: Any) -> dict[str, Any]:
    """The messages of the sites in what `scan_wrapper` returns."""
    return result[1][0].trace


def _of(handlers: Sequence[Changing], name: str) -> list[Changing]:
    return [handler for handler in handlers if handler.touches(name)]


def _final(handlers: Sequence[Changing], msg: Mapping[str, Any], value: Any) -> Any:
    for handler in handlers:
        value = handler.change({**msg, "value": value})
    return value


def _additions(
    handlers: Sequence[Changing], sites: Mapping[str, Any], added: Mapping[str, Any]
) -> dict[str, Any]:
    """What the handlers add to each series, given the series with what was added before."""
    found = {}
    for name, msg in sites.items():
        value = msg["value"]
        if name in added:
            before = value - added[name]
            value = _final(_of(handlers, name), msg, before)
            found[name] = value - before
        if msg["type"] in ("deterministic", "sample"):
            for handler in handlers:
                handler.remember({**msg, "value": value})
    return found
