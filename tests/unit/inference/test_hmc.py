"""Trajectories of shared lengths."""

import numpy as np
import pytest

from dtprob.inference.hmc import SharedLength


@pytest.mark.parametrize("most", [1, 3, 8, 40])
def test_every_length_up_to_the_longest_comes_as_often(most):
    """A low-discrepancy sequence: over any 1,000 transitions each share is right to 1%."""
    for first in (0, 10**6):
        steps = np.asarray(SharedLength(most).steps(first + np.arange(1000)))
        assert set(steps) == set(range(1, most + 1))
        assert np.abs(np.bincount(steps)[1:] / 1000 - 1 / most).max() < 0.01
