"""Data of links: a choice of links is taken from every array that has a row per link, and from no other."""

import numpy as np
import pytest

from dtprob.data import ChannelData, PowerData

HERE = np.arange(9.0).reshape(3, 3)


@pytest.mark.parametrize("noise", [np.array(2.0), np.array([1.0, 2.0, 3.0])])
def test_some_links(noise):
    arrays = {"rx_position": HERE, "tx_position": -HERE, "noise_power": noise}
    channel = np.arange(3)[:, None, None, None, None] * np.ones((3, 1, 1, 1, 3)) + 0j
    band = np.array([-1e6, 0.0, 1e6])  # as many subcarriers as links
    found = ChannelData(channel=channel, subcarrier_frequency=band, **arrays).take(np.array([2, 0]))
    np.testing.assert_array_equal(found.channel[:, 0, 0, 0, 0], [2, 0])
    np.testing.assert_array_equal(found.subcarrier_frequency, band)
    np.testing.assert_array_equal(found.tx_position, -HERE[[2, 0]])
    np.testing.assert_array_equal(found.noise_power, noise[[2, 0]] if noise.ndim else noise)
    powers = PowerData(power=np.ones((3, 1, 1)) * HERE[:, :1, None], **arrays).take(np.array([1]))
    assert powers.power.shape == (1, 1, 1)
    assert powers.power[0, 0, 0] == 3.0
    np.testing.assert_array_equal(powers.rx_position, HERE[[1]])
