"""What a run is, so that a checkpoint of another one is refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from dtprob.inference.assemble import provenance
from dtprob.inference.engine import AbstractEngine
from dtprob.inference.program import program_hash
from dtprob.inference.target import Inputs, Target


def identity(
    target: Target, inputs: Inputs, engine: AbstractEngine, key: PRNGKeyArray, *, free: Sequence[str] = ()
) -> dict[str, Any]:
    """Everything that a run depends on.

    Args:
        target: what it works on.
        inputs: the target's arrays.
        engine: who runs.
        key: the run's key.
        free: the engine's settings that may change between an interruption and its continuation.
    """
    facts = provenance(target, inputs, engine, key)
    facts["settings"] = {name: value for name, value in facts["settings"].items() if name not in free}
    return facts | {"density": _density_hash(target, inputs)}


def _density_hash(target: Target, inputs: Inputs) -> str:
    """Hash of the log density's program, with what the model holds besides its data."""
    return program_hash(jax.make_jaxpr(target.log_density)(jnp.zeros(target.dimension), inputs))
