"""Functions that turn out to run often are compiled in full."""

import jax.numpy as jnp

from dtprob.gap.model import quick
from dtprob.gap.model.quick import Adaptive


def test_a_function_that_is_called_often_is_compiled_anew_and_means_the_same(monkeypatch):
    monkeypatch.setattr(quick, "_OFTEN", 3)
    found = Adaptive(lambda x: x**2)
    assert [float(found(jnp.asarray(float(i)))) for i in range(6)] == [0.0, 1.0, 4.0, 9.0, 16.0, 25.0]
    assert (found._quick._cache_size(), found._fast._cache_size()) == (1, 1)
