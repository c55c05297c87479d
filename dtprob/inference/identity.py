"""What a run is, so that a checkpoint of another one is refused."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from dtprob.inference.assemble import provenance
from dtprob.inference.engine import AbstractEngine
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
    """SHA-256 of the log density's program, memory addresses left out."""
    program = str(jax.make_jaxpr(target.log_density)(jnp.zeros(target.dimension), inputs))
    return hashlib.sha256(re.sub(r"0x[0-9a-f]+", "", program).encode()).hexdigest()
