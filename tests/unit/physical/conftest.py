"""A street without ray tracer: line of sight, floor, porch and a wall at y = 8 m, in closed form."""

import numpy as np
import pytest

from dtprob.physical.bench import Bench, prepare
from dtprob.physical.channel import Sounding, mean_power, subcarriers, synthesise
from dtprob.physical.draws import Setting
from dtprob.physical.impairment import thermal
from dtprob.physical.rays import Rays, reflections
from dtprob.physical.world import Material, World, planar_array, rotation

MATERIALS = {"concrete": Material(5.0, 0.1, 0.1), "brick": Material(4.0, 0.05, 0.1)}
CLASSES = {"floor": "concrete", "porch": "concrete", "wall": "concrete"}
PLANES = {
    "floor": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "porch": ((0.0, 0.0, 4.0), (0.0, 0.0, 1.0)),
    "wall": ((0.0, 8.0, 0.0), (0.0, 1.0, 0.0)),
}


def trace_street(world: World) -> Rays:
    """One path per object and the line of sight; a smooth function of everything in the world."""
    names = tuple(sorted(PLANES))
    count = world.n_link
    mirrors, shifts, gains = [np.eye(3)], [np.zeros(3)], [np.ones(1)]
    for name in names:
        point, normal = (np.asarray(value) for value in PLANES[name])
        point = point + np.asarray(world.moved.get(name, (0.0, 0.0, 0.0)))
        normal = rotation((world.turned.get(name, 0.0), 0.0, 0.0)) @ normal
        mirror, shift = reflections(point[None, None], normal[None, None], np.ones((1, 1), bool))
        material = world.materials.get(CLASSES[name], MATERIALS[CLASSES[name]])
        material = world.object_materials.get(name, material)
        root = np.sqrt(material.permittivity - 1j * material.conductivity / 0.3)
        thick = 0.9 + (material.thickness or 0.0)
        mirrors.append(mirror[0])
        shifts.append(shift[0])
        gains.append((1 - root) / (1 + root) * np.atleast_1d(thick))
    mirror = np.tile(np.stack(mirrors), (count, 1, 1, 1))
    images = np.einsum("lpij,lj->lpi", mirror, world.rx_position) + np.stack(shifts)
    unfolded = images - world.tx_position[:, None]
    turned = np.cos(world.rx_slant) * np.cos(world.rx_turn[2]) * np.cos(world.rx_turn[1])
    gain = turned * np.concatenate(gains) * world.wavelength / (4 * np.pi * np.linalg.norm(unfolded, axis=-1))
    meets = np.tile(np.concatenate([np.zeros((1, 3)), np.eye(3)]).astype(bool), (count, 1, 1))
    here = np.ones(gain.shape, bool)
    return Rays(gain.astype(complex)[:, None], unfolded[:, None], mirror, here, meets, names)


def make_world(links: int = 6) -> World:
    rng = np.random.default_rng(3)
    half = 299_792_458.0 / 6e9 / 2
    rx = np.stack([np.linspace(5, 40, links), rng.uniform(-3, 3, links), np.full(links, 1.5)], axis=-1)
    tx = np.tile([0.0, 0.0, 6.0], (links, 1))
    return World("no file", 6e9, tx, rx, planar_array(1, 2, half), planar_array(1, 4, half))


@pytest.fixture
def world() -> World:
    return make_world()


@pytest.fixture
def sounding() -> Sounding:
    return Sounding(subcarriers(16, 100e6), np.array([0.0, 1e-3, 2e-3]))


@pytest.fixture
def rays(world: World) -> Rays:
    return trace_street(world)


@pytest.fixture
def bench(world: World, rays: Rays, sounding: Sounding) -> Bench:
    noise = thermal(mean_power(synthesise(world, rays, sounding)) / 100)
    return prepare(world, sounding, noise, trace_street, MATERIALS)


@pytest.fixture
def setting(world: World, rays: Rays, sounding: Sounding) -> Setting:
    return Setting(world, rays, sounding, CLASSES, MATERIALS)


@pytest.fixture
def trace():
    return trace_street
