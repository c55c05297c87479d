"""The hash of a program tells programs apart by what they compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.inference.program import program_hash


def plain(held):
    return lambda x: jnp.sum(x * held)


def compiled_within(held):
    inner = jax.jit(lambda x: x + jnp.asarray(held))
    return lambda x: jnp.sum(inner(x))


def scanned(held):
    inner = jax.jit(lambda x: x + jnp.asarray(held))
    return lambda x: jax.lax.scan(lambda total, _: (total + inner(x), None), x, None, length=2)[0]


@pytest.mark.parametrize("make", [plain, compiled_within, scanned])
def test_a_constant_counts_wherever_it_is_held(make):
    one, again, other = (
        program_hash(jax.make_jaxpr(make(jnp.asarray(held)))(jnp.zeros(3)))
        for held in (np.arange(3.0), np.arange(3.0), np.arange(3.0) + 1)
    )
    assert one == again
    assert one != other
