"""Changes of laws given by logits: exact where nothing changes, and right however unlikely an outcome was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.effects.network.laws import from_then_on, mix, thinned, tilted


@pytest.mark.parametrize("logit", [-20.0, -80.0, -131.0, -900.0, -np.inf])
def test_another_law_takes_its_share_however_unlikely_its_outcome_was(logit):
    mixed = jax.nn.softmax(mix(jnp.array([logit, 0.0]), jnp.array([1.0, 0.0]), 3.0))
    np.testing.assert_allclose(mixed, [1 - np.exp(-3.0), np.exp(-3.0)], rtol=1e-6)


@pytest.mark.parametrize("amount", [0.0, 1e-9, 0.5, 50.0])
def test_a_mixture_has_the_derivatives_of_its_probabilities(amount):
    logits, other = jnp.array([-1.0, 0.3, -40.0, -75.0]), jnp.array([0.3, 0.0, 0.3, 0.4])

    def law(logits, amount):
        return jax.nn.softmax(mix(logits, other, amount))

    def direct(logits, amount):
        return jnp.exp(-amount) * jax.nn.softmax(logits) - jnp.expm1(-amount) * other

    for index in (0, 1):
        slope, expected = (jax.jacrev(f, index)(logits, jnp.array(amount)) for f in (law, direct))
        np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-6)
    bent, expected = (jax.jacfwd(jax.jacfwd(f, 1), 1)(logits[:2], jnp.array(amount)) for f in (
        lambda logits, amount: jax.nn.softmax(mix(logits, jnp.array([1.0, 0.0]), amount)),
        lambda logits, amount: jnp.exp(-amount) * (jax.nn.softmax(logits) - jnp.array([1.0, 0.0])),
    ))  # fmt: skip
    np.testing.assert_allclose(bent, expected, rtol=1e-5, atol=1e-6)


def test_nothing_mixed_in_leaves_the_logits_bit_for_bit():
    logits, other = jnp.array([0.1, -3.7, -131.0, -jnp.inf, -jnp.inf]), jnp.array([0.0, 0.2, 0.4, 0.4, 0.0])
    np.testing.assert_array_equal(mix(logits, other, 0.0), logits)
    slope = jax.jacrev(lambda logits: mix(logits, other, 0.7))(logits)
    assert np.isfinite(slope[:4, :4]).all()
    assert np.isneginf(mix(logits, other, 0.7)[4])  # neither law has it


@pytest.mark.parametrize("onset", [0.0, 0.31, 0.37, 0.9])
@pytest.mark.parametrize("windows", [3, 10, 33])
def test_what_sets_in_with_amount_zero_is_nothing(windows, onset):
    logits = jnp.broadcast_to(jnp.array([-131.0, 0.0, -80.0, -90.0]), (windows, 4))

    def changed(loss):
        return mix(logits, thinned(logits, 1), from_then_on(loss, windows, onset)[:, None])

    np.testing.assert_array_equal(from_then_on(0.0, windows, onset), 0.0)
    np.testing.assert_array_equal(changed(0.0), logits)
    after = (np.arange(windows) + 0.5) - onset * windows
    np.testing.assert_allclose(
        jax.jacrev(lambda loss: from_then_on(loss, windows, onset))(0.0), jax.nn.sigmoid(after), rtol=1e-6
    )


@pytest.mark.parametrize("amount", [0.2, 1.0, 3.0, 80.0])
def test_what_sets_in_is_a_share_of_the_slots_of_each_window(amount):
    value, slope = jax.jvp(lambda a: from_then_on(a, 40, 0.3), (amount,), (1.0,))
    after = np.arange(40) + 0.5 - 12.0
    rest = 1 / (1 + np.exp(after)) + np.exp(-amount) / (1 + np.exp(-after))
    np.testing.assert_allclose(value, -np.log(rest), rtol=1e-5, atol=1e-7)
    assert np.isfinite(slope).all()


def test_odds_that_do_not_change_leave_the_logits_bit_for_bit():
    logits = jnp.array([-100.0, -110.0, 0.0, -0.4])
    np.testing.assert_array_equal(tilted(logits, 1, 0.0), logits)
    moved = tilted(logits, 1, 2.0)
    np.testing.assert_allclose(moved[1] - moved[0], -8.0, rtol=1e-6)
    np.testing.assert_allclose(jnp.logaddexp(*moved[:2]), jnp.logaddexp(*logits[:2]), rtol=1e-6)
