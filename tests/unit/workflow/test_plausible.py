"""Numbers that look as if they were in another unit are told, and those in the right one are not."""

from types import SimpleNamespace

import numpy as np
import pytest

from dtprob.case import SceneSection
from dtprob.data import ChannelData, PowerData
from dtprob.errors import InputError
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize
from dtprob.testing.room import room_paths
from dtprob.workflow.plausible import doubts, mirrored, strayed
from dtprob.workflow.scene import paths_of

CARRIER = 3e9


def channel(**changed):
    rng = np.random.default_rng(0)
    shape = (3, 1, 2, 1, 4)
    right = {
        "channel": 1e-4 * (rng.normal(size=shape) + 1j * rng.normal(size=shape)),
        "subcarrier_frequency": 1e5 * np.arange(4),
        "rx_position": np.array([[1.0, 2.0, 1.5], [3.0, 4.0, 1.5], [5.0, 6.0, 1.5]]),
        "tx_position": np.array([[0.0, 0.0, 10.0]] * 3),
        "rx_array": np.array([[0.0, -0.025, 0.0], [0.0, 0.025, 0.0]]),
        "noise_power": np.float64(1e-10),
    }
    return ChannelData(**right | changed)


def test_right_units_are_in_no_doubt():
    assert not list(doubts(channel(), CARRIER))
    assert not list(doubts(channel(noise_power=None, rx_array=np.zeros((2, 3))), CARRIER))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"rx_array": np.array([[0, -0.25, 0], [0, 0.25, 0]])}, "rx_array are 0.5 m apart, 5 wavelengths"),
        ({"noise_power": np.float64(1.0)}, "noise_power is 78 dB above the power that was measured with it"),
    ],
)
def test_other_units_are_told(changed, said):
    (doubt,) = doubts(channel(**changed), CARRIER)
    assert said in doubt


def test_noise_above_the_powers_is_told():
    rng = np.random.default_rng(1)
    places = {"rx_position": rng.normal(size=(3, 3)), "tx_position": np.zeros((3, 3))}
    (doubt,) = doubts(
        PowerData(power=np.full((3, 1, 1), 1e-9), noise_power=np.float64(1e-6), **places), CARRIER
    )
    assert "noise_power is 30 dB above" in doubt


@pytest.mark.parametrize(("tones", "antennas"), [(32, 1), (16, 4), (1, 1)])
def test_conjugated_channels_are_told_and_no_others(tones, antennas):
    paths = room_paths(20, 6)
    frequency = 4e6 * (np.arange(tones) - (tones - 1) / 2)
    array = np.outer(np.arange(antennas) - (antennas - 1) / 2, [0.0, paths.wavelength / 2, 0.0])
    gain = path_gain(paths, paths.permittivity, paths.conductivity)
    there = steering(array, paths.arrival, paths.frequency, -1.0)
    noiseless = np.asarray(synthesize(gain, frequency_response(paths, frequency), there))
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(2, 20, 3, antennas, 1, tones)) * np.sqrt(np.mean(np.abs(noiseless) ** 2) / 20)
    right = noiseless + noise[0] + 1j * noise[1]
    ends = {"rx_position": np.asarray(paths.rx_position), "tx_position": np.asarray(paths.tx_position)}

    def said(channel):
        data = ChannelData(channel=channel, subcarrier_frequency=frequency, rx_array=array, **ends)
        return list(mirrored(data, paths))

    assert not said(right)
    assert not said(right[rng.permutation(20)])
    assert not said(np.zeros_like(right))
    told = said(right.conj())
    assert len(told) == (tones > 1)
    assert all("of its conjugate: a delay tau has to turn it by exp(-2j pi f tau)" in line for line in told)


def test_ends_outside_of_the_scene_are_told():
    corner = SimpleNamespace(min=[-10.0, -10.0, 0.0], max=[10.0, 10.0, 20.0])
    scene = SimpleNamespace(mi_scene=SimpleNamespace(bbox=lambda: corner))
    assert not list(strayed(channel(), scene))
    (doubt,) = strayed(channel(rx_position=channel().rx_position * 3), scene)
    assert doubt.startswith("rx_position of 2 of 3 links lies outside of the scene (x -10 to 10 m")


def test_a_carrier_in_gigahertz_is_refused(tmp_path):
    scene = SceneSection(file="simple_street_canyon", frequency=3.5)
    case = SimpleNamespace(path=tmp_path / "case.toml", scene=scene)
    with pytest.raises(InputError, match=r"case\.toml \[scene\] frequency: .*such as 3\.5e9, got 3\.5\."):
        paths_of(case, channel(), None, lambda _: None)
