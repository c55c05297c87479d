"""What a program computes, as a hash: the same in another process, another one where a constant differs."""

from __future__ import annotations

import hashlib
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def program_hash(closed: Any) -> str:
    """SHA-256 of a traced program and the values of its constants, memory addresses left out.

    Args:
        closed: from `jax.make_jaxpr`.
    """
    digest = hashlib.sha256(re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr)).encode())
    for constant in closed.consts:
        is_key = jnp.issubdtype(constant.dtype, jax.dtypes.prng_key)
        digest.update(np.asarray(jax.random.key_data(constant) if is_key else constant).tobytes())
    return digest.hexdigest()
