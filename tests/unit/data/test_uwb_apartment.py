"""The figures that the description of the measured apartment states."""

import numpy as np
import pytest

from dtprob.data import ChannelData, read, uwb_apartment
from dtprob.data.alignment import weighted_mean
from dtprob.data.location import measured_data
from dtprob.errors import InputError

pytestmark = pytest.mark.measured


@pytest.fixture(scope="module")
def folder():
    try:
        return measured_data(uwb_apartment.NAME)
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def links(folder):
    return uwb_apartment.read_links(folder)


@pytest.fixture(scope="module")
def aligned(folder, links):
    radio = uwb_apartment.read_radio(folder)
    return {link.number: uwb_apartment.align_link(link, radio) for link in links}


@pytest.fixture(scope="module")
def channels(folder):
    data = read(folder)
    assert isinstance(data, ChannelData)
    return data


def decibels(ratio):
    return 10 * np.log10(ratio)


def test_links_and_packets(links):
    assert len(links) == 36
    counts = [len(link.impulse_response) for link in links]
    assert (sum(counts), min(counts), max(counts)) == (10_867, 108, 383)
    assert {link.label for link in links} == {"LOS", "NLOS", "NDP NLOS"}
    assert {link.impulse_response.shape[1] for link in links} == {128}
    np.testing.assert_allclose([link.distance for link in links][:2], [2.4924, 1.1851], atol=1e-4)


def test_packets_agree_once_aligned(aligned):
    residual = {number: decibels(np.median(found.residual)) for number, found in aligned.items()}
    assert -21 < np.median(list(residual.values())) < -20
    assert sorted(residual, key=residual.get)[-5:] == [51, 42, 27, 48, 44]
    assert -7 < residual[44] < -6.5
    assert max(residual[number] for number in (51, 42, 27, 48)) < -10.5


def test_first_path_index_tells_the_delay(links, aligned):
    tap = 1.0016e-9
    error = {link.number: link.first_path_index * tap - aligned[link.number].delay for link in links}
    robust = [1.4826 * np.median(np.abs(e - np.median(e))) for e in error.values()]
    assert 0.08e-9 < np.median(robust) < 0.12e-9
    assert {number for number, e in error.items() if np.ptp(np.percentile(e, [5, 95])) > 2e-9} == {9, 27, 29}


def test_repeats_hold_the_drift(channels, aligned):
    assert channels.channel.shape == (36, 8, 1, 1, 62)
    ratio = -decibels(channels.noise_power)
    assert 25 < np.median(ratio) < 26
    assert (np.min(ratio).round(), np.max(ratio).round()) == (11, 41)
    np.testing.assert_allclose(
        np.mean(np.abs(channels.channel.mean(axis=1)) ** 2, axis=(1, 2, 3)), 1.0, rtol=1e-12
    )
    interleaved = []
    for found in aligned.values():
        means = np.stack([weighted_mean(found.aligned[i::8], found.gain[i::8]) for i in range(8)])
        spread = np.sum(np.abs(means - means.mean(axis=0)) ** 2, axis=0) / 7
        interleaved.append(decibels(np.mean(np.abs(means.mean(axis=0)) ** 2) / np.mean(spread)))
    assert 34.5 < np.median(interleaved) < 36


def test_the_band(channels):
    power = np.mean(np.abs(channels.channel) ** 2, axis=(0, 1, 2, 3))
    offset = np.abs(channels.subcarrier_frequency)
    assert offset.max() < 249.6e6
    assert offset.min() > 7e6
    shoulder = power[(offset > 150e6) & (offset < 225e6)]
    assert decibels(shoulder.max() / shoulder.min()) < 2.5
    assert -7 < decibels(np.mean(power[offset < 40e6]) / power.max()) < -5


def test_the_first_path_lies_at_the_ranged_time(links, channels):
    late = []
    for link, response in zip(links, channels.channel.mean(axis=1)[:, 0, 0], strict=True):
        if link.line_of_sight and link.distance < 2:
            time = np.arange(0, 20e-9, 0.1e-9)
            profile = np.abs(np.exp(2j * np.pi * np.outer(time, channels.subcarrier_frequency)) @ response)
            late.append(time[np.argmax(profile)] - link.ranged_distance / 299_792_458.0)
    assert len(late) == 3
    assert 1e-9 < np.mean(late) < 2e-9


def test_missing_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("DTPROB_DATA", str(tmp_path))
    with pytest.raises(InputError, match="Set DTPROB_DATA"):
        measured_data(uwb_apartment.NAME)
