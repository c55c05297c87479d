"""Compilation for functions that run a few times: half the compile time, slower code."""

from __future__ import annotations

from functools import partial

import jax

quick_jit = partial(
    jax.jit,
    compiler_options={"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True},
)
"""`jax.jit` without the compiler's expensive passes."""
