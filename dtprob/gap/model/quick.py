"""Compilation for functions that run a few times (half the compile time, slower code) or may turn out to run often."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final, final

import equinox as eqx
import jax
import numpy as np

quick_jit = partial(
    jax.jit,
    compiler_options={"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True},
)
"""`jax.jit` without the compiler's expensive passes."""

_OFTEN: Final = 200
"""Calls from which a function is worth the expensive passes, which make gradients up to ten times as fast."""


@final
class Adaptive:
    """A compiled function that is compiled anew, with the expensive passes, once it has been called often.

    Args:
        function: of arrays, to arrays.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._quick, self._fast, self._calls = quick_jit(function), jax.jit(function), 0

    def __call__(self, *arguments: Any) -> Any:
        """The function's value."""
        self._calls += 1
        return (self._quick if self._calls <= _OFTEN else self._fast)(*arguments)


@final
class Hoisted:
    """A compiled function, the arrays that it closes over among the program's arguments.

    Otherwise they would be constants of the program, which then serves no other data of the same shapes, and which takes
    longer to compile the larger they are.

    Args:
        function: of arrays, to arrays.
        compiler: `jax.jit` where the function runs for longer than it is compiled.
    """

    def __init__(
        self, function: Callable[..., Any], compiler: Callable[..., Callable[..., Any]] = quick_jit
    ) -> None:
        self._function, self._compiler = function, compiler
        self._programs: dict[Any, tuple[Any, Callable[..., Any]]] = {}

    def __call__(self, *arguments: Any) -> Any:
        """The function's value; compiled once for each set of shapes."""
        leaves, structure = jax.tree.flatten(arguments)
        shapes = structure, tuple(map(jax.typeof, leaves))
        if shapes not in self._programs:
            self._programs[shapes] = self._program(arguments)
        closed, run = self._programs[shapes]
        return run(closed, *arguments)

    def _program(self, arguments: tuple[Any, ...]) -> tuple[Any, Callable[..., Any]]:
        """The arrays that the function closes over, and the program that takes them before its arguments."""
        converted = eqx.filter_closure_convert(self._function, *arguments)
        closed, rest = eqx.partition(converted, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))
        return closed, self._compiler(lambda closed, *given: eqx.combine(closed, rest)(*given))
