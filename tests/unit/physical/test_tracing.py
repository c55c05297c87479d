"""Traced worlds against closed forms; these need the ray tracer."""

import dataclasses

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical import tracing
from dtprob.physical.channel import Sounding, subcarriers, synthesise
from dtprob.physical.tracing import object_classes, scene_materials, trace
from dtprob.physical.world import (
    SPEED_OF_LIGHT,
    Material,
    Part,
    World,
    add_object,
    move_object,
    planar_array,
    remove_object,
    swap_material,
    turn_object,
)

pytestmark = pytest.mark.libllvm
HALF_SPACE = Material(5.0, 0.2, 5.0)
"""So thick that nothing comes back from its far side."""
FREQUENCY = 6e9
EPSILON_0 = 8.8541878128e-12
TX, RX = np.array([-0.3, 0.0, 0.8]), np.array([0.35, 0.05, 0.6])


def plate(**changes) -> World:
    """A square of 1 m at z = 0, one antenna at each end above it."""
    one = planar_array(1, 1, 0.025)
    world = World("simple_reflector", FREQUENCY, TX[None], RX[None], one, one, max_depth=1, rays=20_000)
    return dataclasses.replace(swap_material(world, "reflector", HALF_SPACE), **changes)


def street(links: int = 8) -> World:
    rng = np.random.default_rng(0)
    rx = np.stack([rng.uniform(-10, 30, links), rng.uniform(-5, 5, links), np.full(links, 1.5)], axis=-1)
    one = planar_array(1, 1, 0.025)
    return World(
        "simple_street_canyon", FREQUENCY, np.tile([-24.0, 3.0, 6.0], (links, 1)), rx, one, one, rays=50_000
    )


def vertical_reflection(cosine: float) -> complex:
    eta = HALF_SPACE.permittivity - 1j * HALF_SPACE.conductivity / (2 * np.pi * FREQUENCY * EPSILON_0)
    root = np.sqrt(eta - (1 - cosine**2))
    return complex((eta * cosine - root) / (eta * cosine + root))


def test_two_rays_over_a_plate_follow_fresnel():
    world = plate()
    sounding = Sounding(subcarriers(8, 200e6), np.zeros(1))
    found = synthesise(world, trace(world), sounding)[0, 0, 0, 0]
    direct, image = np.linalg.norm(RX - TX), np.linalg.norm(RX * [1, 1, -1] - TX)
    reflection = vertical_reflection((TX[2] + RX[2]) / image)
    frequency = FREQUENCY + sounding.subcarrier_frequency
    waves = [np.exp(-2j * np.pi * frequency * length / SPEED_OF_LIGHT) / length for length in (direct, image)]
    expected = world.wavelength / (4 * np.pi) * (waves[0] + reflection * waves[1])
    np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_beside_the_plate_there_is_free_space():
    world = plate(rx_position=np.array([[-2.0, 1.0, 0.9]]))
    rays = trace(world)
    assert rays.mask.sum() == 1
    distance = np.linalg.norm([-1.7, 1.0, 0.1])
    assert rays.gain[0, 0, 0] == pytest.approx(world.wavelength / (4 * np.pi * distance), rel=1e-5)
    assert rays.delay[0, 0, 0] == pytest.approx(distance / SPEED_OF_LIGHT, rel=1e-14)


def test_a_lifted_plate_shortens_its_reflection():
    for lift in (0.0, 1e-5, 0.01, 0.1):
        rays = trace(move_object(plate(), "reflector", (0.0, 0.0, lift)))
        level = np.hypot(*(RX - TX)[:2])
        expected = np.hypot(level, TX[2] + RX[2] - 2 * lift)
        assert rays.length[0, 0, 1] == pytest.approx(expected, rel=1e-14)


def test_a_slanted_receiver_sees_the_cosine():
    straight, slanted = (trace(plate(rx_slant=angle)).gain[0, 0, 0] for angle in (0.0, 0.3))
    away = RX - TX
    elevation = np.arctan2(away[2], np.hypot(away[0], away[1]))
    assert abs(slanted / straight) == pytest.approx(np.cos(0.3), abs=0.1)
    assert abs(slanted) < abs(straight)
    assert abs(elevation) < 0.4


def test_a_removed_plate_reflects_nothing():
    assert trace(plate()).mask.sum() == 2
    world = dataclasses.replace(plate(), object_materials={})
    other = Part(mesh="", position=(0, 0, 0), material=HALF_SPACE)
    with pytest.raises(InputError, match="PLY"):
        trace(add_object(world, "box", other))


def test_an_edit_in_the_street_changes_what_it_should():
    base = trace(street())
    gone = trace(remove_object(street(), "building_4"))
    assert base.meeting("building_4").any()
    assert "building_4" not in gone.objects
    assert gone.mask.sum() < base.mask.sum()
    metal = trace(swap_material(street(), "building_4", Material(1.0, 1e7)))
    met = base.meeting("building_4")
    np.testing.assert_array_equal(metal.mask, base.mask)
    assert np.all(np.abs(metal.gain[:, 0][met]) > np.abs(base.gain[:, 0][met]) - 1e-9)
    np.testing.assert_allclose(metal.gain[:, 0][~met], base.gain[:, 0][~met])


def test_what_was_done_to_a_removed_object_does_not_matter():
    gone = remove_object(street(2), "building_4")
    edited = turn_object(move_object(gone, "building_4", (0.0, 0.1, 0.0)), "building_4", 0.1)
    edited = swap_material(edited, "building_4", HALF_SPACE)
    np.testing.assert_array_equal(trace(edited).unfolded, trace(gone).unfolded)


def test_a_part_is_put_into_the_street():
    from sionna import rt

    car = Part(str(rt.scene.low_poly_car), (5.0, 0.0, 0.8), Material(1.0, 1e7, 0.01))
    rays = trace(add_object(street(), "car", car))
    assert "car" in rays.objects


def test_a_moved_wall_is_not_found_twice():
    base = trace(street())
    for step in (8e-4, 1e-3, 3e-3):
        moved = trace(move_object(street(), "building_6", (0.0, step, 0.0)))
        np.testing.assert_array_equal(moved.mask, base.mask)
        assert np.abs(moved.length - base.length).max() < 4 * step


def test_a_small_turn_is_nearly_a_small_move():
    base, turned = trace(street()), trace(turn_object(street(), "building_6", 1e-4))
    np.testing.assert_array_equal(turned.mask, base.mask)
    met = base.meeting("building_6")
    changed = np.abs(turned.length - base.length)[:, 0]
    assert changed[met].max() > 1e-5
    np.testing.assert_allclose(changed[~met], 0, atol=1e-12)


def test_every_traced_path_lies_on_its_mirrors():
    rays = trace(street())
    np.testing.assert_allclose(
        rays.mirror @ np.swapaxes(rays.mirror, -1, -2),
        np.broadcast_to(np.eye(3), rays.mirror.shape),
        atol=1e-12,
    )
    assert np.all(np.diff(np.where(rays.mask, rays.meets.sum(-1), 9), axis=1)[:, 0] >= 0)


def test_tracing_twice_gives_the_same_bits():
    first, second = trace(street()), trace(street())
    np.testing.assert_array_equal(first.gain, second.gain)
    np.testing.assert_array_equal(first.unfolded, second.unfolded)


def test_materials_and_classes_of_a_world():
    world = dataclasses.replace(street(), materials={"glass": Material(6.0, 0.01)})
    found = scene_materials(world)
    assert found["glass"].permittivity == pytest.approx(6.0)
    assert found["glass"].thickness == pytest.approx(0.1)
    assert object_classes(world)["building_6"] == "wood"


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="building_6"):
        trace(move_object(street(), "bilding_6", (0, 1, 0)))
    with pytest.raises(InputError, match="glass"):
        trace(dataclasses.replace(street(), materials={"glas": Material(6.0, 0.01)}))


def test_many_receivers_at_once_have_the_paths_they_have_alone(monkeypatch):
    world = dataclasses.replace(street(4), rays=10_000)
    together = trace(world)
    monkeypatch.setattr(tracing, "MAX_PATHS", 100)  # no room for them all: they are traced group by group
    grouped = trace(world)
    np.testing.assert_array_equal(grouped.mask, together.mask)
    np.testing.assert_allclose(grouped.gain, together.gain, rtol=1e-6)
    np.testing.assert_array_equal(grouped.unfolded, together.unfolded)


def test_a_receiver_with_too_many_candidates_is_told(monkeypatch):
    monkeypatch.setattr(tracing, "MAX_PATHS", 10)
    with pytest.warns(RuntimeWarning, match="room for 10 candidate paths"):
        trace(dataclasses.replace(street(1), rays=10_000))
