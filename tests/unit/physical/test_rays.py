"""Isometries of mirrors, and the channel they make, against closed forms."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dtprob.errors import InputError
from dtprob.physical.channel import Sounding, subcarriers, synthesise, synthesise_wide
from dtprob.physical.rays import Rays, join, reflections, turning
from dtprob.physical.world import (
    SPEED_OF_LIGHT,
    World,
    displace_receivers,
    move_object,
    planar_array,
    rotation,
)

UNIT = st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1)


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


@settings(deadline=None)
@given(UNIT, UNIT, UNIT)
def test_two_mirrors_are_two_mirror_images(first, second, point):
    normals = np.stack([unit(first), unit(second)])[None]
    points = np.array([[[0.3, 0.1, 2.0], [-1.0, 0.5, 0.2]]])
    mirror, shift = reflections(points, normals, np.ones((1, 2), bool))
    image = np.asarray(point)
    for step in (1, 0):
        image = image - 2 * ((image - points[0, step]) @ normals[0, step]) * normals[0, step]
    np.testing.assert_allclose(mirror[0] @ point + shift[0], image, atol=1e-12)


def test_a_missing_mirror_does_nothing():
    mirror, shift = reflections(np.ones((1, 2, 3)), np.ones((1, 2, 3)), np.zeros((1, 2), bool))
    np.testing.assert_array_equal(mirror[0], np.eye(3))
    np.testing.assert_array_equal(shift[0], 0)


@settings(deadline=None)
@given(UNIT, UNIT)
@example([0.0, 0.0, 1.0], [0.0, 1.192092896e-07, 0.75])  # nearly one direction
@example([0.0, 0.6, 0.8], [0.0, -0.6, -0.8])
def test_turning_maps_one_direction_to_the_other(start, end):
    start, end = unit(start), unit(end)
    found = turning(start[None], end[None])[0]
    np.testing.assert_allclose(found @ start, end, atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)


def test_delay_of_a_reflection_is_that_of_the_image(world, rays):
    floor = 1 + rays.objects.index("floor")
    image = world.rx_position * [1, 1, -1]
    expected = np.linalg.norm(image - world.tx_position, axis=1) / SPEED_OF_LIGHT
    np.testing.assert_allclose(rays.delay[:, 0, floor], expected, rtol=1e-14)


def test_departure_and_arrival_meet_at_the_wall(world, rays):
    wall = 1 + rays.objects.index("wall")
    d, a = rays.departure[:, wall], rays.arrival[:, wall]
    distance = (8.0 - world.tx_position[:, 1]) / d[:, 1]
    hit = world.tx_position + distance[:, None] * d
    rest = world.rx_position - hit
    np.testing.assert_allclose(a, rest / np.linalg.norm(rest, axis=1, keepdims=True), atol=1e-12)


def test_shifted_rays_are_those_of_displaced_receivers(world, trace):
    step = np.array([0.4, -0.2, 0.1])
    moved = trace(displace_receivers(world, step))
    shifted = trace(world).shifted(step[None, None])
    np.testing.assert_allclose(shifted.unfolded, moved.unfolded, atol=1e-12)


def test_a_moved_wall_changes_delays_as_geometry_says(world, trace):
    step = 0.03
    before, after = trace(world), trace(move_object(world, "wall", (0.0, step, 0.0)))
    wall = 1 + before.objects.index("wall")
    across = (16 + 2 * step) - world.tx_position[:, 1] - world.rx_position[:, 1]
    along = (world.rx_position - world.tx_position)[:, [0, 2]]
    expected = np.hypot(across, np.linalg.norm(along, axis=1))
    np.testing.assert_allclose(after.length[:, 0, wall], expected, rtol=1e-14)
    others = [p for p in range(4) if p != wall]
    np.testing.assert_array_equal(after.length[..., others], before.length[..., others])


def test_joined_paths_run_over_the_scatterer(world, rays):
    point = np.array([10.0, 4.0, 2.0])
    gain = np.full((world.n_link, 1), 0.5 + 0j)
    more = join(
        rays, gain, np.broadcast_to(point, (world.n_link, 1, 3)), world.tx_position, world.rx_position
    )
    out, back = point - world.tx_position, world.rx_position - point
    lengths = np.linalg.norm(out, axis=1) + np.linalg.norm(back, axis=1)
    np.testing.assert_allclose(more.length[:, 0, -1], lengths)
    np.testing.assert_allclose(more.arrival[:, -1], back / np.linalg.norm(back, axis=1, keepdims=True))
    assert more.mask[:, -1].all()
    assert not more.meets[:, -1].any()


def free_space(array: int = 1) -> tuple[World, Rays]:
    half = SPEED_OF_LIGHT / 6e9 / 2
    world = World(
        "no file",
        6e9,
        np.zeros((1, 3)),
        np.array([[30.0, 4.0, 2.0]]),
        planar_array(1, 1, half),
        planar_array(1, array, half),
    )
    away = world.rx_position - world.tx_position
    gain = world.wavelength / (4 * np.pi * np.linalg.norm(away))
    flat = np.zeros((1, 1, 0), bool)
    return world, Rays(
        np.full((1, 1, 1), gain + 0j),
        away[:, None, None],
        np.eye(3)[None, None],
        np.ones((1, 1), bool),
        flat,
        (),
    )


def test_free_space_channel():
    world, rays = free_space()
    sounding = Sounding(subcarriers(8, 100e6), np.zeros(1))
    distance = np.sqrt(30.0**2 + 16 + 4)
    frequency = 6e9 + sounding.subcarrier_frequency
    expected = (
        world.wavelength
        / (4 * np.pi * distance)
        * np.exp(-2j * np.pi * np.float64(1) * np.modf(frequency * distance / SPEED_OF_LIGHT)[0])
    )
    found = synthesise(world, rays, sounding)[0, 0, 0, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_arrays_see_the_exact_distances_to_first_order():
    world, rays = free_space(4)
    sounding = Sounding(subcarriers(4, 1e3), np.zeros(1))
    exact = np.linalg.norm(world.rx_position + world.rx_array - world.tx_position, axis=1)
    plane = synthesise(world, rays, sounding)[0, 0, :, 0, 0]
    phase = np.angle(plane * np.exp(2j * np.pi * np.modf(exact / world.wavelength)[0]))
    bend = np.pi * (world.rx_array[:, 1] ** 2) / (world.wavelength * 30)
    np.testing.assert_allclose(np.abs(phase), 0, atol=1.2 * bend.max() + 1e-6)
    curved = synthesise_wide(world, rays, sounding, 1.0, 1.0)[0, 0, :, 0, 0]
    np.testing.assert_allclose(
        np.angle(curved * np.exp(2j * np.pi * np.modf(exact / world.wavelength)[0])), 0, atol=1e-3
    )


def test_wide_synthesis_without_its_effects_is_the_plain_one(world, rays, sounding):
    plain = synthesise(world, rays, sounding)
    np.testing.assert_allclose(synthesise_wide(world, rays, sounding, 0.0, 0.0), plain, atol=1e-15)


def test_squint_uses_the_wavelength_of_each_subcarrier():
    world, rays = free_space(2)
    sounding = Sounding(subcarriers(2, 1e9), np.zeros(1))
    found = synthesise_wide(world, rays, sounding, 0.0, 1.0)[0, 0, :, 0]
    step = (world.rx_array[1] - world.rx_array[0]) @ rays.arrival[0, 0]
    expected = -2 * np.pi * (6e9 + sounding.subcarrier_frequency) * step / SPEED_OF_LIGHT
    np.testing.assert_allclose(np.angle(found[1] / found[0]), expected, atol=1e-9)


def test_rotation_is_yaw_pitch_roll():
    np.testing.assert_allclose(rotation((np.pi / 2, 0, 0)) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation((0, np.pi / 2, 0)) @ [1, 0, 0], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(rotation((0, 0, np.pi / 2)) @ [0, 1, 0], [0, 0, 1], atol=1e-15)


def test_positions_must_be_points_and_pairs():
    with pytest.raises(InputError, match="shape"):
        World("x", 6e9, np.zeros(3), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(InputError, match="per link"):
        World("x", 6e9, np.zeros((2, 3)), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)))


def test_the_trace_key_tells_worlds_apart(world):
    moved = move_object(world, "wall", (0.0, 0.1, 0.0))
    assert world.trace_key() != moved.trace_key()
    assert moved.trace_key() == move_object(world, "wall", (0.0, 0.1, 0.0)).trace_key()
    assert move_object(moved, "wall", (0.0, 0.1, 0.0)).moved["wall"][1] == pytest.approx(0.2)
