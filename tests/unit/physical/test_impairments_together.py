"""Impairments beside each other: the order of drawing, what random components add, what the twin hides."""

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical import front_end, placement, propagation
from dtprob.physical.bench import prepare
from dtprob.physical.draws import FAMILIES
from tests.unit.physical.conftest import MATERIALS
from tests.unit.physical.test_impairments import RELATIVE, clean, drawn, error


def test_what_diffuse_scatterers_may_add_does_not_depend_on_what_they_did(bench):
    rng = np.random.default_rng(0)
    offset, deviation = rng.uniform(3, 9, (6, 5, 3)), np.sqrt(np.arange(1, 6) / 15) * np.ones((6, 1))
    columns, shifts = [], []
    for _ in range(200):
        draw = (rng.standard_normal((6, 5)) + 1j * rng.standard_normal((6, 5))) / np.sqrt(2)
        made = propagation.diffuse_scattering(offset, deviation, draw)
        assert made.spread is not None
        columns.append(made.spread(bench.world, bench.base.rays, bench.sounding, 0.1))
        shifts.append(bench.difference(made, 0.1))
    np.testing.assert_array_equal(columns[0], columns[1])
    power = np.sum(np.abs(columns[0]) ** 2, axis=(1, 2))
    seen = np.sum(np.abs(np.reshape(shifts, (200, 6, -1))) ** 2, axis=2).mean(axis=0)
    np.testing.assert_allclose(seen, power, rtol=0.25)


@pytest.mark.parametrize("family", ["phase_noise", "carrier_phase_drift", "phase_error", "shadowing"])
def test_what_random_components_add_is_the_variance_of_draws(family, bench, setting):
    size, total = 1e-3, np.zeros(bench.base.mean.size)
    for seed in range(300):
        made = drawn(family, setting, seed)
        total += np.abs(bench.difference(made, size)) ** 2 / 300
    made = drawn(family, setting, 1)
    assert made.spread is not None
    columns = made.spread(bench.base.world, bench.base.rays, bench.sounding, size)
    power = np.sum(np.abs(columns) ** 2, axis=1).sum()
    assert total.sum() == pytest.approx(power, rel=0.15)


@pytest.mark.parametrize("family", ["phase_noise", "carrier_phase_drift", "shadowing"])
def test_packets_of_unknown_phase_hide_common_phases(family, bench, setting, trace):
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (6, 3))
    always = ((front_end.packet_phase(angles), 1.0),)
    other = prepare(
        bench.world, bench.sounding, bench.noise, trace, MATERIALS, phase="per_packet", always=always
    )
    made = drawn(family, setting)
    found, known = (one.information(made, 0.05) for one in (other, bench))
    assert known > 10
    assert found < 1e-6 if family != "shadowing" else 0.5 * known < found < 1.01 * known


def test_elements_turn_with_their_array(bench, world):
    turned = placement.antenna_orientation((0.0, 0.0, 1.0)), np.pi / 2
    slanted = placement.polarization_mismatch(), np.pi / 2
    pattern = propagation.antenna_pattern(), 2.0
    axis = np.array([0.0, -1.0, 0.0])  # of elements that stood upright
    for one in (turned, slanted):
        plain, found = bench.simulate(one).rays, bench.simulate(one, pattern).rays
        expected = 1 - (plain.arrival @ axis) ** 2
        np.testing.assert_allclose(np.abs(found.gain[:, 0]), np.abs(plain.gain[:, 0]) * expected)


def test_two_impairments_cannot_both_replace_the_sum_over_paths(bench):
    with pytest.raises(InputError, match="at most one"):
        bench.simulate((propagation.near_field(), 1.0), (propagation.beam_squint(), 1.0))


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_any_two_that_do_not_both_replace_the_sum_go_together(family, bench, setting):
    one = drawn(family, setting)
    for other in (drawn(name, setting, 1) for name in sorted(FAMILIES)):
        if not (one.synthesis and other.synthesis):
            found = bench.simulate((one, 0.01 * one.limit), (other, 0.01 * other.limit))
            assert np.all(np.isfinite(found.mean))


def test_a_phase_error_leaves_a_path_that_was_joined(bench, setting):
    pole, error_ = drawn("extra_path", setting), drawn("phase_error", setting)
    both = bench.simulate((pole, 1.0), (error_, 0.3)).mean
    apart = bench.simulate((error_, 0.3), (pole, 1.0)).mean
    assert error(both, apart) < RELATIVE


@pytest.mark.parametrize("family", ["extra_path", "diffuse_scattering", "pedestrian"])
@pytest.mark.parametrize("other", ["doppler", "shadowing", "antenna_pattern", "atmospheric_attenuation"])
def test_the_order_of_drawing_does_not_matter_to_joined_paths(family, other, bench, setting):
    joined, after = drawn(family, setting), drawn(other, setting, 1)
    size, more = 0.1 * joined.limit, 0.2 * after.limit
    first = bench.simulate((joined, size), (after, more)).mean
    second = bench.simulate((after, more), (joined, size)).mean
    assert error(first, second) < RELATIVE
    assert error(first, bench.simulate((joined, size)).mean) > 1e-3


def test_a_joined_path_moves_with_the_receiver(bench, sounding):
    point, velocity = np.array([12.0, 3.0, 1.0]), np.array([3.0, 1.0, 0.0])
    pole, drive = propagation.extra_path(point), propagation.doppler(velocity)
    both = bench.simulate((drive, 1.0), (pole, 5.0)).mean
    moved = both - bench.simulate((drive, 1.0)).mean
    for index, time in enumerate(sounding.snapshot_time):
        there = placement.receiver_displacement(velocity)
        alone = bench.simulate((there, time)).mean[:, 0]
        expected = bench.simulate((there, time), (pole, 5.0)).mean[:, 0] - alone
        assert error(moved[:, index], expected) < 0.02


def test_a_pedestrian_is_a_pole_that_walks(bench, sounding):
    start, velocity = np.array([12.0, 3.0, 1.0]), np.array([1.0, -0.5, 0.0])
    found = bench.simulate((propagation.pedestrian(start, velocity), 5.0)).mean - clean(bench)
    for index, time in enumerate(sounding.snapshot_time):
        pole = propagation.extra_path(start + velocity * time)
        expected = bench.simulate((pole, 5.0)).mean - clean(bench)
        assert error(found[:, index], expected[:, index]) < 0.02
