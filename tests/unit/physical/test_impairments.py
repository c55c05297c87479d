"""Impairments: nothing at size zero, and what physics says elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical import antennas, front_end, placement, propagation
from dtprob.physical.channel import Sounding, mean_power, subcarriers
from dtprob.physical.draws import FAMILIES, draw
from dtprob.physical.impairment import Tracer, measure
from dtprob.physical.waveform import chirp, symmetric_pilot, to_time

RELATIVE = 1e-11


def drawn(family, setting, seed=0):
    made = draw(np.random.default_rng(seed), family, setting)
    assert made is not None
    return made


def clean(bench):
    return bench.base.mean


def error(found, expected):
    return np.max(np.abs(found - expected)) / np.max(np.abs(expected))


@pytest.mark.parametrize("family", sorted(FAMILIES))
@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_at_size_zero(family, seed, bench, setting):
    found = bench.simulate((drawn(family, setting, seed), 0.0))
    assert error(found.mean, clean(bench)) < RELATIVE
    assert found.noise.information(found.mean, bench.sounding, bench.tangents) < 1e-6
    assert found.noise.mean_power(found.mean.shape) == pytest.approx(bench.noise_power)


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_size_of_given_information_exists(family, bench, setting):
    made = drawn(family, setting)
    size, found = bench.size_for(made, 30.0)
    assert found == pytest.approx(30, rel=0.05)
    assert 0 < size <= made.limit
    assert found == pytest.approx(bench.information(made, size))


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_size_changes_something(family, bench, setting):
    made = drawn(family, setting)
    found = bench.simulate((made, 0.05 * made.limit))
    changed = error(found.mean, clean(bench)) > 1e-6
    assert changed != (made.noise is not None)
    if made.noise is not None:
        assert found.noise.information(found.mean, bench.sounding, bench.tangents) > 0


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_the_same_seed_draws_the_same(family, bench, setting):
    first, second = (bench.simulate((drawn(family, setting, 5), 0.01)) for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)


def test_a_single_snapshot_has_no_place_for_what_shows_over_time(bench, setting):
    one = replace(setting, sounding=replace(setting.sounding, snapshot_time=np.zeros(1)))
    missing = {family for family in FAMILIES if draw(np.random.default_rng(0), family, one) is None}
    over_time = {"doppler", "sampling_clock_offset", "carrier_frequency_offset", "gain_drift", "pedestrian"}
    assert missing == over_time


def test_an_unknown_family_names_the_nearest(setting):
    with pytest.raises(InputError, match="timing_offset"):
        draw(np.random.default_rng(0), "timing_ofset", setting)


def test_timing_offset_is_a_slope_of_the_baseband_phase(bench, sounding):
    delay = 3.1e-9
    found = bench.simulate((front_end.timing_offset(), delay)).mean
    expected = clean(bench) * np.exp(-2j * np.pi * sounding.subcarrier_frequency * delay)
    assert error(found, expected) < 1e-12


def test_clock_offset_delays_later_snapshots_more(bench, sounding):
    slope = 1e-6
    found = bench.simulate((front_end.sampling_clock_offset(), slope)).mean
    late = slope * sounding.snapshot_time[:, None, None, None]
    expected = clean(bench) * np.exp(-2j * np.pi * sounding.subcarrier_frequency * late)
    assert error(found, expected) < 1e-4
    assert error(clean(bench), expected) > 1e-2


def test_carrier_offset_turns_snapshots(bench, sounding):
    offset = 90.0
    found = bench.simulate((front_end.carrier_frequency_offset(), offset)).mean
    turn = np.exp(2j * np.pi * offset * sounding.snapshot_time)
    assert error(found, clean(bench) * turn[:, None, None, None]) < 1e-4


def test_carrier_offset_leaks_between_subcarriers(bench, sounding):
    found = bench.simulate((front_end.carrier_frequency_offset(), 0.3 * sounding.spacing)).mean
    ratio = mean_power(found) / mean_power(clean(bench))
    assert ratio == pytest.approx(1, rel=1e-12)
    own = np.vdot(clean(bench)[:, 0], found[:, 0]) / np.vdot(clean(bench)[:, 0], clean(bench)[:, 0])
    assert abs(own) < 0.95


def test_iq_imbalance_mixes_in_the_mirror_image(bench):
    gain, phase = 0.04, 0.06
    pilot = symmetric_pilot(np.random.default_rng(0), 16)
    found = bench.simulate((front_end.iq_imbalance((gain, phase), pilot), 1.0)).mean
    direct = np.cos(phase / 2) + 1j * gain / 2 * np.sin(phase / 2)
    image = gain / 2 * np.cos(phase / 2) - 1j * np.sin(phase / 2)
    expected = direct * clean(bench) + image * np.conj(clean(bench)[..., ::-1])
    assert error(found, expected) < 1e-11


def test_rapp_saturates_and_is_linear_below(bench):
    small = bench.simulate((front_end.amplifier_nonlinearity(1.0), 1e-3)).mean
    assert error(small, clean(bench)) < 1e-4
    hard = bench.simulate((front_end.amplifier_nonlinearity(2.0), 1e3)).mean
    np.testing.assert_allclose(np.abs(hard) / np.sqrt(mean_power(clean(bench))) * 1e3, 1.0, rtol=1e-4)
    np.testing.assert_allclose(np.angle(hard / clean(bench)), 0, atol=1e-12)


def test_a_stepped_sounder_compresses_each_entry_by_its_own_power(bench):
    size = 0.1
    found = bench.simulate((front_end.amplifier_nonlinearity(1.0), size)).mean
    level = np.abs(clean(bench)) ** 2 / mean_power(clean(bench))
    assert error(found, clean(bench) / np.sqrt(1 + size**2 * level)) < 1e-12


def test_many_tones_at_once_compress_one_another(bench):
    made = front_end.amplifier_nonlinearity(2.0, chirp(16))
    found = bench.simulate((made, 1e3)).mean
    wave = to_time(found * chirp(16), bench.sounding)
    np.testing.assert_allclose(np.abs(wave) / np.sqrt(mean_power(clean(bench))) * 1e3, 1.0, rtol=1e-3)


def test_butterworth_halves_the_power_at_its_corner(bench, sounding):
    for order in (1, 2, 3):
        found = bench.simulate((front_end.frequency_response(order), 0.9)).mean
        ratio = np.abs(found / clean(bench)) ** 2
        relative = 0.9 * sounding.subcarrier_frequency / (sounding.bandwidth / 2)
        expected = np.broadcast_to(1 / (1 + relative ** (2 * order)), ratio.shape)
        np.testing.assert_allclose(ratio, expected, rtol=1e-9)


def test_butterworth_has_no_delay_at_the_carrier(bench):
    for order in (1, 2, 3):
        found = bench.simulate((front_end.frequency_response(order), 0.05)).mean
        assert np.max(np.abs(np.angle(found / clean(bench)))) < 0.05**3


def test_ripple_is_an_echo(bench, sounding):
    found = bench.simulate((front_end.frequency_ripple(2e-8), 0.2)).mean
    expected = clean(bench) * (1 + 0.2 * np.exp(-2j * np.pi * sounding.subcarrier_frequency * 2e-8))
    assert error(found, expected) < 1e-12


def test_oscillators_walk_or_stay(world):
    rng = np.random.default_rng(0)
    times = 1e-3 * np.arange(40)
    sounding = Sounding(subcarriers(4, 1e8), times)
    draws = rng.standard_normal((400, 40, 4))
    ones = np.ones((400, 40, 1, 1, 4), complex)
    walk = front_end.carrier_phase_drift(draws).channel
    stay = front_end.phase_noise(draws, 1e5).channel
    assert walk is not None
    assert stay is not None
    angle = np.unwrap(np.angle(walk(world, ones, sounding, 0.1).mean(axis=-1)[..., 0, 0]), axis=1)
    np.testing.assert_allclose(angle.var(axis=0)[[1, 10, 39]], 0.01 * np.array([1, 10, 39]), rtol=0.25)
    assert angle[:, 0].std() < 1e-3
    angle = np.angle(stay(world, ones, sounding, 0.1).mean(axis=-1)[..., 0, 0])
    np.testing.assert_allclose(angle.std(axis=0), 0.1, rtol=0.2)
    assert abs(np.mean(angle[:, 1:] * angle[:, :-1])) < 5e-4


def test_dipoles_have_the_impedances_of_the_textbook():
    found = antennas.impedance_matrix(np.array([[0, 0, 0], [0, 0.5, 0], [0, 1.0, 0], [0, 0, 0.5]]))
    assert found[0, 0] == pytest.approx(73.1 + 42.5j, abs=0.5)
    assert found[0, 1] == pytest.approx(-12.53 - 29.93j, abs=0.05)
    assert found[0, 2] == pytest.approx(4.01 + 17.73j, abs=0.05)
    assert found[0, 3] == pytest.approx(26.40 + 20.15j, abs=0.05)
    np.testing.assert_allclose(found, found.T)


def test_coupling_reaches_farther_neighbours_less(bench):
    only = np.zeros((1, 1, 4, 1, 1), complex)
    only[0, 0, 0] = 1
    couple = antennas.mutual_coupling().channel
    assert couple is not None
    found = np.abs(couple(bench.world, only, bench.sounding, 1.0)[0, 0, :, 0, 0])
    assert found[0] == pytest.approx(1, abs=0.1)
    assert found[1] > found[2] > found[3] > 0.01


def test_a_cable_delays_one_element(bench, sounding):
    found = bench.simulate((antennas.cable_delay(2), 1e-9)).mean
    slope = np.exp(-2j * np.pi * sounding.subcarrier_frequency * 1e-9)
    assert error(found[:, :, 2], clean(bench)[:, :, 2] * slope) < 1e-12
    np.testing.assert_array_equal(found[:, :, 1], clean(bench)[:, :, 1])


def test_doppler_is_the_change_of_path_lengths(bench, world, trace, sounding):
    velocity = np.array([1.0, 0.3, 0.0])
    found = bench.simulate((propagation.doppler(velocity), 20.0)).mean
    for index, time in enumerate(sounding.snapshot_time):
        moved = placement.receiver_displacement(velocity)
        there = bench.simulate((moved, 20.0 * time)).mean[:, 0]
        assert error(found[:, index], there) < 0.02


def test_a_wide_strip_hides_the_line_of_sight_and_an_edge_halves_it(bench, rays, world):
    link = 0
    away = world.rx_position[link] - world.tx_position[link]
    azimuth = float(np.arctan2(away[1], away[0]))
    wide = propagation.blockage(azimuth, 2.0).rays
    edge = propagation.blockage(azimuth + np.arctan(5.0 / 2.0), 2.0).rays
    assert wide is not None
    assert edge is not None
    hidden = wide(world, rays, bench.sounding, 10.0).gain / rays.gain
    assert abs(hidden[link, 0, 0]) < 0.05
    assert abs((edge(world, rays, bench.sounding, 10.0).gain / rays.gain)[link, 0, 0]) == pytest.approx(
        0.5, abs=0.03
    )


def test_a_scatterer_obeys_the_radar_equation(bench, rays, world):
    point = np.array([12.0, 3.0, 1.0])
    scatter = propagation.extra_path(point).joins
    assert scatter is not None
    gain = np.abs(scatter(world, rays, bench.sounding, 2.0).gain[:, 0, -1]) ** 2
    out, back = (np.sum((point - place) ** 2, axis=1) for place in (world.tx_position, world.rx_position))
    expected = world.wavelength**2 * 4.0 / ((4 * np.pi) ** 3 * out * back)
    np.testing.assert_allclose(gain, expected)


def test_impairments_compose_by_stage(bench, sounding):
    late, louder = front_end.timing_offset(), front_end.gain_offset()
    found = bench.simulate((louder, 6.0), (late, 2e-9)).mean
    slope = np.exp(-2j * np.pi * sounding.subcarrier_frequency * 2e-9)
    assert error(found, clean(bench) * 10**0.3 * slope) < 1e-12


def test_the_tracer_remembers(world, trace, monkeypatch):
    calls = []
    monkeypatch.setattr("dtprob.physical.impairment.trace", lambda w: calls.append(w) or trace(w))
    tracer = Tracer(remember=1)
    other = placement.object_displacement("wall", (0, 1, 0)).world
    assert other is not None
    tracer(world), tracer(world), tracer(other(world, 0.1)), tracer(world)
    assert len(calls) == 3


def test_measuring_is_repeatable(bench):
    first, second = (measure(np.random.default_rng(4), bench.base, bench.sounding) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert mean_power(first - clean(bench)) == pytest.approx(bench.noise_power, rel=0.1)
