"""The error that contract checks raise."""

from __future__ import annotations

import numpy as np

from dtprob.errors import InputError


class ContractError(InputError):
    """A model, engine or effect does not keep its contract."""


def expect(condition: object, what: str, expected: str, got: object, remedy: str) -> None:
    """Raise unless the condition holds; the text is that of `InputError`.

    Raises:
        ContractError: the condition does not hold.
    """
    if not bool(condition):
        raise ContractError(what, expected, str(got), remedy)


def same(first: object, second: object) -> bool:
    """Whether two arrays agree in shape, type and every value, without rounding; zeros of either sign are one value."""
    a, b = np.asarray(first), np.asarray(second)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return a.tobytes() == b.tobytes() or np.array_equal(a, b)
