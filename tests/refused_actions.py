"""What an environment of several devices has to refuse, whichever it is."""

import numpy as np
import pytest

from dtprob.errors import InputError

NO_ACTIONS = [7, -1, 0.9, float("nan"), None, "1"]


def check_refused(network, action):
    """A network in an episode refuses this action and a device that there is not, and takes right ones."""
    everyone = dict.fromkeys(network.agents, np.int64(1))
    with pytest.raises(InputError, match=r"action of device_0: expected 0 \(silent\) or 1 \(sends\)"):
        network.step({**everyone, "device_0": action})
    with pytest.raises(InputError, match="one of 'device_9'"):
        network.step({**everyone, "device_9": 1})
    assert network.step(everyone)[0]["device_0"][3] == 1
