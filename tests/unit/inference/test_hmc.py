"""Trajectories of shared lengths."""

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference.hmc import HMC, SharedLength


@pytest.mark.parametrize("most", [1, 3, 8, 40])
def test_every_length_up_to_the_longest_comes_as_often(most):
    """A low-discrepancy sequence: over any 1,000 transitions each share is right to 1%."""
    for first in (0, 10**6):
        steps = np.asarray(SharedLength(most).steps(first + np.arange(1000)))
        assert set(steps) == set(range(1, most + 1))
        assert np.abs(np.bincount(steps)[1:] / 1000 - 1 / most).max() < 0.01


def test_lengths_that_cannot_be_counted_are_refused():
    """Beyond them the product of a length and a fraction overflows, and lengths begin anew."""
    most = 65_536
    steps = np.asarray(HMC(leapfrog=most).kernel(0).trajectory.steps(np.arange(2000)))
    assert steps.max() > 0.99 * most
    with pytest.raises(InputError, match="leapfrog of engine hmc: expected at most 65536, got 65537"):
        HMC(leapfrog=most + 1).kernel(0)
    with pytest.raises(
        InputError, match="target_accept of engine hmc: expected a rate between 0 and 1, got 80"
    ):
        HMC(target_accept=80).schedule()
