"""Random keys of a diagnosis, each for one use."""

from __future__ import annotations

import zlib

import jax


def key_for(key: jax.Array, use: str) -> jax.Array:
    """The key of one use of a key, by its name.

    Numbers would do if nothing else split the same key: `jax.random.split(key, n)[i]` is `jax.random.fold_in(key, i)`.

    Args:
        key: typed JAX key; nothing is drawn from it itself where it has named uses.
        use: what for, such as "search".
    """
    return jax.random.fold_in(key, zlib.crc32(use.encode()))
