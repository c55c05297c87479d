"""Unit tests compile longer than they run: the compiler leaves most of its passes out, also in processes begun here."""

from collections.abc import Iterator

import jax
import pytest

_OPTION = "jax_disable_most_optimizations"


@pytest.fixture(autouse=True, scope="module")
def _compiled_quickly() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(_OPTION.upper(), "true")
        jax.config.update(_OPTION, True)
        yield
        jax.config.update(_OPTION, False)
