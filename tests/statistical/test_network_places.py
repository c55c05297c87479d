"""A device that dies late in a log is noticed, and when it died is known."""

import jax
import numpy as np
import pytest

from dtprob.effects import catalogue
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.places import place
from dtprob.models.declaration import declare
from dtprob.models.multi_access import multi_access, records
from tests.small_network import CLUSTERS, simulate

WINDOWS, SLOTS = 60, 10
FAST = Settings(replicates=99, site_replicates=99)
NAME = "device_disconnected[device_2]"


def died(data, device, window):
    """The data with no packets of a device from a window on."""
    cluster = int(data["clusters"].cluster_of[device])
    bit = int(data["clusters"].weight[cluster, device])
    changed = {name: np.array(data[name]) for name in ("arrivals", "previous")}
    for values in changed.values():
        values[window:, :, cluster] &= ~bit
    return {**data, **changed}


@pytest.fixture(scope="module")
def log():
    data = records(simulate(WINDOWS * SLOTS, 3), clusters=CLUSTERS, window=SLOTS)
    return {**data, "concentration": 1.0}


@pytest.fixture(scope="module")
def looked(log):
    """The first window that is silent -> the effect's best place, and its p-value."""

    def at(window):
        data = died(log, 2, window)
        effects = [e for e in catalogue(declare(multi_access, data).sites, data) if e.name == NAME]
        problem = Problem(multi_access, data, effects)
        base = fit_base(problem, jax.random.key(0), polished=0)
        drawn = replicate(problem, base, project(problem, base), jax.random.key(1), FAST)
        moved, found = place(problem, base, drawn)
        onset = next(p for p in moved.effects[0].parameters if p.name == "onset")
        return found[NAME].p_value, onset.null

    return at


@pytest.mark.study
@pytest.mark.parametrize("window", [30, 54])
def test_when_a_device_died_is_found(looked, window):
    p, onset = looked(window)
    assert p < 1e-4
    assert onset == pytest.approx(window / WINDOWS, abs=1.5 / WINDOWS)


@pytest.mark.study
def test_a_device_that_lives_is_not_missed(looked):
    assert looked(WINDOWS)[0] > 0.01
