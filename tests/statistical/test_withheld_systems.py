"""Two withheld cases of networks and, a study, one of a ray-traced channel; see `tests.withheld_study` for the bounds."""

import pytest

from tests.withheld_study import at_most, studied


def test_networks(tmp_path):
    found = studied(tmp_path, "network", ["null", "listed"], seed=20)
    alarms, of = found["null"]["alarm"]
    assert of == 1
    assert alarms <= at_most(of, 0.01)
    missed, of = found["listed"]["missed"]
    assert missed <= at_most(of, 0.01)


@pytest.mark.study
@pytest.mark.libllvm
def test_channels(tmp_path):
    found = studied(tmp_path, "channel", ["null"], seed=20)
    alarms, of = found["null"]["alarm"]
    assert of == 1
    assert alarms <= at_most(of, 0.01)
