"""Tests of variance effects: level under the null, power for faint and for strong fields."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.gap.model.rewrites import _weights
from dtprob.gap.tails import variance_ratio_tail
from dtprob.gap.which.fields import field_tests

INFORMATION = np.geomspace(0.1, 100.0, 24)


def energies(scores):
    """Weighted sums of squares, with the information that the replicates show."""
    weights = np.asarray(_weights(jnp.asarray(np.mean(scores[1:] ** 2, axis=0))))
    return scores**2 @ weights.T


def draw(rng, spread, replicates=99):
    size = np.sqrt(INFORMATION)
    null = rng.normal(size=(1 + replicates, len(size))) * size
    null[0] += INFORMATION * spread * rng.normal(size=len(size))
    return energies(null)


def test_the_level_holds():
    """Chance of p <= 5% over 400 data sets without a field: within the limits that 1 in 1,000 would leave."""
    rng = np.random.default_rng(0)
    alarms = sum(field_tests({"a": draw(rng, 0.0)}, ["a"], 99).p_value[0] <= 0.05 for _ in range(400))
    assert alarms <= stats.binom.ppf(0.999, 400, 0.065)
    assert alarms >= stats.binom.ppf(0.001, 400, 0.03)


@pytest.mark.parametrize(("spread", "least"), [(0.3, 0.5), (1.0, 0.95)])
def test_power(spread, least):
    rng = np.random.default_rng(1)
    found = sum(field_tests({"a": draw(rng, spread)}, ["a"], 99).p_value[0] <= 0.01 for _ in range(200))
    assert found >= stats.binom.ppf(0.001, 200, least)


def test_a_strong_field_is_seen_where_equal_weights_miss_it():
    """With half of the energy in one entry equal weights have one degree of freedom."""
    rng = np.random.default_rng(2)
    equal, best = 0, 0
    for _ in range(200):
        energy = draw(rng, 0.5)
        equal += field_tests({"a": energy[:, :1]}, ["a"], 99).p_value[0] <= 0.01
        best += field_tests({"a": energy}, ["a"], 99).p_value[0] <= 0.01
    assert best > equal


def test_effects_have_replicates_of_their_own():
    rng = np.random.default_rng(3)
    one, other = draw(rng, 0.0), draw(rng, 0.0)
    both = field_tests({"a": one, "b": other}, ["a", "b"], 99)
    each = [field_tests({"x": e}, ["x"], 99).replicates for e in (one, other)]
    np.testing.assert_allclose(both.replicates, np.concatenate(each, axis=1))
    assert field_tests({}, [], 7).replicates.shape == (7, 0)


def test_a_square_over_a_variance_from_replicates_is_a_t():
    values = np.array([1.0, 3.0, 5.0])
    found = variance_ratio_tail(values**2, 1.0, 2.0, 98)
    np.testing.assert_allclose(found, 2 * stats.t.sf(values, 98), rtol=1e-9)
    many = variance_ratio_tail(np.array([20.0, 60.0]), 10.0, 20.0, 10**7)
    np.testing.assert_allclose(many, stats.chi2.sf([20.0, 60.0], 10), rtol=1e-3)
    assert variance_ratio_tail(np.array([1e300]), 1.0, 2.0, 98)[0] > 0
