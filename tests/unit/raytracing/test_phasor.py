"""Phases counted in turns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.raytracing.phasor import cosine_sine, phasor


@pytest.mark.parametrize(("dtype", "error"), [(np.float64, 6e-16), (np.float32, 2e-7)])
def test_cosine_and_sine_are_exact_to_rounding(dtype, error):
    turns = np.random.default_rng(0).uniform(-3, 3, 20_000).astype(dtype)
    turns[:9] = np.arange(-4, 5) / 8
    cosine, sine = cosine_sine(jnp.asarray(turns))
    exact = 2 * np.pi * (turns - np.round(turns)).astype(np.float64)
    assert cosine.dtype == dtype
    assert np.max(np.abs(cosine - np.cos(exact))) < error
    assert np.max(np.abs(sine - np.sin(exact))) < error


def test_quarter_turns_are_exact():
    expected = [1, 1j, -1, -1j, 1]
    assert np.array_equal(phasor(jnp.array([0.0, 0.25, 0.5, 0.75, 1e6])), expected)


def test_whole_turns_do_not_matter():
    turns = jnp.asarray(np.random.default_rng(1).integers(0, 2**20, 100) / 2**20)
    assert np.array_equal(phasor(turns + 1e5), phasor(turns))


@pytest.mark.parametrize("differentiated", [jax.grad, jax.jacfwd])
def test_derivatives(differentiated):
    turns = jnp.linspace(-1.3, 1.3, 101)
    for part, (first, second) in enumerate(
        ((-np.sin(angle := 2 * np.pi * turns), -np.cos(angle)), (np.cos(angle), -np.sin(angle)))
    ):

        def one(t, part=part):
            return cosine_sine(t)[part]

        assert np.max(np.abs(jax.vmap(differentiated(one))(turns) - 2 * np.pi * first)) < 1e-14
        assert (
            np.max(np.abs(jax.vmap(jax.grad(differentiated(one)))(turns) - (2 * np.pi) ** 2 * second)) < 1e-13
        )


def test_a_gradient_is_no_longer_program_than_cosine_and_sine():
    turns = jnp.linspace(-1.3, 1.3, 101)
    value = jax.jit(lambda t: sum(map(jnp.sum, cosine_sine(t))))
    sizes = [len(f.lower(turns).as_text().splitlines()) for f in (value, jax.jit(jax.grad(value)))]
    assert sizes[1] < 1.2 * sizes[0]
