"""A concentration that is learned: its weights by enumeration, its draws by their moments, what it refuses."""

import itertools
import math

import jax
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference.concentrations import LearnedConcentration

ALLOWED = np.array([[True, True, False], [True, True, True]])
COUNTS = np.array([[3.0, 0.0, 0.0], [1.0, 2.0, 0.0]])


def evidence(concentration, counts, allowed):
    """By the chain rule, one outcome after the other."""
    value = 0.0
    for row, mask in zip(counts, allowed, strict=True):
        seen = np.zeros(len(row))
        for outcome in itertools.chain.from_iterable([i] * int(n) for i, n in enumerate(row)):
            a = np.where(mask, concentration, 0.0) + seen
            value += math.log(a[outcome] / a.sum())
            seen[outcome] += 1
    return value


def test_weights_are_the_evidence():
    law = LearnedConcentration({"t": ALLOWED}, {"t": COUNTS}, (0.1, 1.0, 3.0))
    expected = np.array([evidence(a, COUNTS, ALLOWED) for a in law.grid])
    expected -= np.log(np.exp(expected).sum())
    np.testing.assert_allclose(law.log_weights("t"), expected, rtol=1e-10)


def test_draws_have_the_mixtures_mean_and_never_what_cannot_be():
    law = LearnedConcentration({"t": ALLOWED}, {"t": COUNTS})
    draws = np.exp(law.sample(jax.random.key(0), 20_000)["t"])
    weight = np.exp(law.log_weights("t"))
    means = []
    for a in law.grid:
        posterior = np.where(ALLOWED, a + COUNTS, 0.0)
        means.append(posterior / posterior.sum(axis=-1, keepdims=True))
    expected = np.tensordot(weight, means, 1)
    assert np.all(draws[:, 0, 2] == 0)
    error = 4 * draws.std(axis=0) / np.sqrt(len(draws)) + 1e-6
    assert np.all(np.abs(draws.mean(axis=0) - expected) < error)


def test_a_batch_is_posteriors_of_their_own():
    other = np.array([[0.0, 0.0, 0.0], [40.0, 40.0, 40.0]])
    law = LearnedConcentration({"t": ALLOWED}, {"t": np.stack([COUNTS, other])})
    weight = law.log_weights("t")
    for place, counts in enumerate((COUNTS, other)):
        np.testing.assert_allclose(
            weight[place], LearnedConcentration({"t": ALLOWED}, {"t": counts}).log_weights("t")
        )
    assert weight[1].argmax() == len(law.grid) - 1  # even rows speak for a large concentration
    assert law.sample(jax.random.key(1), 7)["t"].shape == (7, 2, 2, 3)


@pytest.mark.parametrize("count", [1.0, -1.0, np.nan])
def test_counts_of_what_cannot_happen_are_refused(count):
    """No concentration explains them, so that all weights would be no numbers."""
    counts = COUNTS.copy()
    counts[0, 2] = count
    with pytest.raises(InputError, match=r"counts of 't': .* at \[0, 2\]"):
        LearnedConcentration({"t": ALLOWED}, {"t": counts})


@pytest.mark.parametrize(("counts", "grid"), [(COUNTS[:1], (0.1,)), (COUNTS, (0.0, 1.0)), (COUNTS, ())])
def test_what_cannot_be_is_refused(counts, grid):
    with pytest.raises(InputError):
        LearnedConcentration({"t": ALLOWED}, {"t": counts}, grid)
