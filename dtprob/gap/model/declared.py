"""A declared model on data of which the arrays come with every call, so that programs serve all data of the same shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax

from dtprob.models.arguments import Data, Model
from dtprob.models.declaration import Declaration
from dtprob.models.execution import trace_model


@dataclass(frozen=True)
class Declared:
    """A model, its sites, and those of its arguments that are no arrays."""

    model: Model
    declaration: Declaration
    static: Any

    def data(self, arrays: Any) -> Data:
        """All arguments by name."""
        return eqx.combine(arrays, self.static)

    def trace(
        self, arrays: Any, key: jax.Array | None = None, given: Mapping[str, Any] | None = None
    ) -> Mapping[str, Any]:
        """One run of the model, with given values of some sites; the shapes of sites are the same in all."""
        key = jax.random.key(0) if key is None else key
        return trace_model(self.model, self.data(arrays), key, dict(given or {}))
