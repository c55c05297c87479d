"""The grid, the scene and the promises of the wave simulation; fields are in `test_wave_exact.py`."""

import math

import jax
import numpy as np
import pytest
from scipy.constants import epsilon_0

from dtprob.errors import InputError
from dtprob.physical.wave import AIR, CONCRETE, METAL, Medium, Rectangle, Scene2D, cost, simulate
from dtprob.physical.wave.fdtd import advance, factors, patches, rest
from dtprob.physical.wave.grid import (
    COURANT,
    Grid,
    acting,
    grid_frequency,
    grid_wavenumber,
    make_grid,
    source_gain,
)
from dtprob.physical.wave.scene import Acting, rasterise
from dtprob.physical.wave.simulate import ricker

C = 299_792_458.0
WAVELENGTH = C / 6e9
GRID = Grid(WAVELENGTH / 20, (0.0, 0.0), (100, 90))
FREQUENCY = np.array([5.9e9, 6e9, 6.1e9])
SMALL = Scene2D((0.0, 0.0), (2 * WAVELENGTH, 1.5 * WAVELENGTH))
PROBES = np.array([[1.6, 0.7], [1.13, 1.21]]) * WAVELENGTH
SOURCE = (0.3 * WAVELENGTH, 0.6 * WAVELENGTH)


def itself(medium):
    return Acting(medium.permittivity, medium.conductivity, 1.0)


def small(scene=SMALL, source=SOURCE, probes=PROBES, **options):
    return simulate(scene, source, probes, FREQUENCY, **({"duration": 2e-9, "cells": 20.0} | options))


def test_shares_of_a_cell_are_exact():
    """Two media that meet inside a cell, one of them over a third, and a hole in metal."""
    nodes = np.arange(6.0)
    four, nine = Medium(4.0, 0.2), Medium(9.0, 0.0)
    rectangles = (
        Rectangle((-math.inf, -math.inf), (2.25, math.inf), four),
        Rectangle((2.25, -math.inf), (2.75, 2.0), nine),
    )
    found = rasterise(Scene2D((0.0, 0.0), (5.0, 5.0), rectangles), nodes, nodes, itself)
    np.testing.assert_allclose(found.permittivity[:, 0], [4, 4, 0.75 * 4 + 0.25 * 9, 0.25 * 9 + 0.75, 1, 1])
    np.testing.assert_allclose(found.permittivity[2, :4], [5.25, 5.25, 0.5 * 5.25 + 0.5 * 3.25, 3.25])
    np.testing.assert_allclose(found.conductivity[2], 0.75 * 0.2)
    assert not found.metal.any()


def test_metal_is_where_it_is_drawn_and_no_further():
    nodes = np.arange(6.0)
    plates = (Rectangle((1.0, 1.0), (4.0, 4.0), METAL), Rectangle((2.0, 2.0), (4.0, 3.5), AIR))
    metal = rasterise(Scene2D((0.0, 0.0), (5.0, 5.0), plates), nodes, nodes, itself).metal
    expected = np.zeros((6, 6), bool)
    expected[1:5, 1:5] = True
    expected[3, 3] = False
    assert np.array_equal(metal, expected)


def test_metal_that_would_vanish_between_the_nodes_is_refused():
    nodes = np.arange(6.0)

    def metal(plate):
        return rasterise(Scene2D((0.0, 0.0), (5.0, 5.0), (plate,)), nodes, nodes, itself).metal

    with pytest.raises(InputError, match="metal rectangle: expected a node of the grid"):
        metal(Rectangle((4.2, 1.0), (4.8, 3.0), METAL))
    assert not metal(Rectangle((4.2, 1.0), (4.8, 3.0), CONCRETE)).any()
    assert not metal(Rectangle((7.2, 1.0), (7.8, 3.0), METAL)).any()
    assert metal(Rectangle((4.2, 1.0), (5.2, 3.0), METAL)).sum() == 3


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 4, 1.2])
def test_plane_waves_obey_the_dispersion_relation(angle):
    """A plane wave of the closed form's wavenumber goes through one time step of the scheme as it should."""
    frequency, grid = 6e9, GRID
    k = float(grid_wavenumber(grid, np.asarray(frequency), np.asarray(angle)))
    turn = np.pi * frequency * grid.step
    x, y = np.meshgrid(grid.x, grid.y, indexing="ij")
    wave = np.exp(-1j * k * (x * np.cos(angle) + y * np.sin(angle)))
    second_x, second_y = (np.roll(wave, 1, a) - 2 * wave + np.roll(wave, -1, a) for a in (0, 1))
    mixed = np.roll(second_x, 1, 1) - 2 * second_x + np.roll(second_x, -1, 1)
    change = COURANT**2 * (second_x + second_y + mixed / 6)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(change[inner], -4 * np.sin(turn) ** 2 * wave[inner], rtol=1e-9)


def test_waves_on_the_grid_have_the_right_length_at_the_grids_frequency():
    angles = np.linspace(0, np.pi / 2, 19)[:, None]
    exact = 2 * np.pi * FREQUENCY / C
    corrected = grid_wavenumber(GRID, grid_frequency(GRID, FREQUENCY), angles)
    assert np.all(np.abs(corrected / exact - 1) < 3.6e-4 * (exact * GRID.spacing) ** 4)
    uncorrected = grid_wavenumber(GRID, FREQUENCY, angles) / exact - 1
    assert uncorrected.min() > 1e-3
    assert np.all(grid_frequency(GRID, FREQUENCY) < FREQUENCY)
    fine = GRID._replace(spacing=GRID.spacing / 10)
    np.testing.assert_allclose(grid_frequency(fine, FREQUENCY), FREQUENCY, rtol=2e-5)
    np.testing.assert_allclose(source_gain(fine, FREQUENCY), 1, atol=2e-4)


def test_media_act_as_themselves_on_a_fine_grid():
    fine = GRID._replace(spacing=WAVELENGTH / 2000)
    np.testing.assert_allclose(acting(fine, 6e9, CONCRETE), (*CONCRETE, 1.0), rtol=1e-4)
    np.testing.assert_allclose(acting(GRID, 6e9, AIR), (1, 0, 1), atol=1e-12)
    coarse = acting(GRID, 6e9, CONCRETE)
    assert coarse.permeability < 1 < coarse.permittivity / CONCRETE.permittivity


def test_places_between_nodes_are_interpolated_by_cubics():
    """Exactly for cubic polynomials; a node is itself."""
    random = np.random.default_rng(0)
    places = np.concatenate([random.uniform(3, 80, (5, 2)), [[4.0, 7.0]]]) * GRID.spacing
    found = patches(GRID, places)
    nodes = np.stack(np.meshgrid(np.arange(4), np.arange(4), indexing="ij"), -1)

    def cubic(p):
        return 1 + p[..., 0] - 0.02 * p[..., 0] ** 3 + 0.01 * p[..., 0] ** 2 * p[..., 1] ** 3

    at_nodes = cubic((np.asarray(found.corner)[:, None, None] + nodes).astype(float))
    value = np.sum(at_nodes * np.asarray(found.weight, float), axis=(1, 2))
    np.testing.assert_allclose(value, cubic(places / GRID.spacing), rtol=1e-4)
    assert np.count_nonzero(np.asarray(found.weight[-1])) == 1


def test_source_and_probe_may_change_places():
    walls = (
        Rectangle((-math.inf, 1.3 * WAVELENGTH), (math.inf, math.inf), CONCRETE),
        Rectangle((0.9 * WAVELENGTH, 0.5 * WAVELENGTH), (1.0 * WAVELENGTH, 0.9 * WAVELENGTH), METAL),
    )
    scene = Scene2D(SMALL.lower, SMALL.upper, walls)
    there = small(scene, probes=PROBES[:1]).field[0]
    back = small(scene, source=tuple(PROBES[0]), probes=np.array([SOURCE])).field[0]
    np.testing.assert_allclose(there, back, rtol=1e-4)
    assert np.abs(there - small(probes=PROBES[:1]).field[0]).min() > 0.1


def test_the_transform_is_that_of_the_record():
    found = small(keep_record=True)
    assert found.record is not None
    assert found.record.shape == (2, cost(SMALL, FREQUENCY, duration=2e-9, cells=20.0).steps)
    grid = make_grid(SMALL, WAVELENGTH / 20)
    time = found.step * (1 + np.arange(found.record.shape[1]))
    spectrum = found.record @ np.exp(-2j * np.pi * time[:, None] * grid_frequency(grid, FREQUENCY))
    ratio = spectrum / found.field
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=1e-9)
    np.testing.assert_allclose(found.channel, WAVELENGTH / (4 * np.pi) * found.field, rtol=1e-12)
    assert small().record is None


def test_the_same_again_without_compiling_again():
    seen = []
    first = small(report=lambda done, steps: seen.append((done, steps)))
    compiled = advance._cache_size()
    moved = Rectangle((1.0 * WAVELENGTH, -math.inf), (math.inf, math.inf), Medium(3.0, 0.1))
    small(Scene2D(SMALL.lower, SMALL.upper, (moved,)), source=(SOURCE[0] / 2, SOURCE[1]))
    assert np.array_equal(first.field, small().field)
    assert advance._cache_size() == compiled
    assert seen[-1][0] == seen[-1][1]
    assert len(seen) == math.ceil(seen[-1][1] / 500)


def test_single_precision_whatever_jax_defaults_to():
    grid = make_grid(SMALL, WAVELENGTH / 20)
    media = factors(grid, rasterise(SMALL, grid.x, grid.y, itself), 6e9)
    leaves = jax.tree.leaves((rest(grid), media))
    assert {leaf.dtype for leaf in leaves} == {np.dtype("float32")}


def test_memory_is_as_foretold():
    wide = Scene2D((0.0, 0.0), (20 * WAVELENGTH, 20 * WAVELENGTH))
    grid = make_grid(wide, WAVELENGTH / 20)
    media = factors(grid, rasterise(wide, grid.x, grid.y, itself), 6e9)
    places = (patches(grid, np.full((count, 2), WAVELENGTH)) for count in (1, 2))
    program = advance.lower(rest(grid), media, *places, np.zeros(500, np.float32)).compile()
    found = program.memory_analysis()
    used = found.argument_size_in_bytes + found.temp_size_in_bytes
    assert used == pytest.approx(cost(wide, FREQUENCY, duration=2e-9, cells=20.0).bytes, rel=0.2)


def test_the_energy_leaves():
    assert small(duration=8e-9).tail < 1e-5


def test_the_tail_is_that_of_the_probe_that_hears_most_of_it():
    found = small(keep_record=True, duration=0.7e-9)
    size = np.abs(found.record)
    shares = size[:, int(0.95 * size.shape[1]) :].max(axis=1) / size.max(axis=1)
    assert found.tail == pytest.approx(shares.max(), rel=1e-6)
    late = size[:, int(0.95 * size.shape[1]) :].max() / size.max()
    assert late < 0.95 * shares.max()


def test_a_probe_that_hears_nothing_has_its_all_cut_off():
    """Behind metal all round."""
    (x, y), wall = PROBES[0], 0.1 * WAVELENGTH
    box = [Rectangle((x - 3 * wall, y - 3 * wall), (x + 3 * wall, y + 3 * wall), METAL)]
    room = [*box, Rectangle((x - 2 * wall, y - 2 * wall), (x + 2 * wall, y + 2 * wall), AIR)]
    assert small(Scene2D(SMALL.lower, SMALL.upper, tuple(room)), probes=PROBES[:1]).tail == 1.0


def test_the_pulse_is_strongest_at_its_frequency():
    time = np.linspace(-1e-9, 1e-9, 4001)
    spectrum = [abs(np.sum(ricker(time, 6e9) * np.exp(-2j * np.pi * f * time))) for f in (5e9, 6e9, 7e9)]
    assert spectrum[1] == max(spectrum)


def test_concrete_is_that_of_the_recommendation():
    assert pytest.approx((5.31, 0.139), abs=5e-4) == CONCRETE
    loss = CONCRETE.conductivity / (2 * np.pi * 6e9 * epsilon_0)
    assert loss == pytest.approx(0.416, abs=0.001)


BLOCK = Scene2D(SMALL.lower, SMALL.upper, (Rectangle((0.0, 0.0), (0.05, 0.05), METAL),))
STONE = Scene2D(SMALL.lower, SMALL.upper, (Rectangle((0.0, 0.0), (0.05, 0.05), Medium(12.0, 0.0)),))


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: Scene2D((0, 0), (0, 1)), "scene: expected a lower corner below and left of the upper one"),
        (lambda: Scene2D((0, 0), (1, math.inf)), "scene: expected finite corners"),
        (lambda: Rectangle((0, 2), (1, 1), AIR), "rectangle: expected a lower corner"),
        (lambda: Rectangle((0, 0), (1, 1), Medium(0.5, 0.0)), "relative permittivity from 1"),
        (lambda: Rectangle((0, 0), (1, 1), Medium(2.0, -0.1)), "conductivity in S/m from 0"),
        (lambda: small(source=(-1.0, 0.0)), "source: expected a place inside the scene and in air"),
        (lambda: small(BLOCK), "source: expected a place inside the scene and in air"),
        (
            lambda: small(BLOCK, source=(0.09, 0.07), probes=np.array([[0.01, 0.01]])),
            "probe 0: .* outside metal",
        ),
        (lambda: small(cells=8), "cells per wavelength: expected at least 10"),
        (lambda: small(STONE, source=(0.09, 0.07)), "cells per wavelength: expected at least 21.8"),
        (
            lambda: small(duration=5e-10),
            "duration: expected at least the 6.17e-10 s in which the pulse has passed",
        ),
        (lambda: small(probes=PROBES[0]), r"probes: expected shape \(probe, 2\), in m, got shape \(2,\)"),
        (lambda: simulate(SMALL, SOURCE, PROBES, np.array([1e9, 6e9]), duration=2e-9), "around one carrier"),
    ],
)
def test_bad_input(call, text):
    with pytest.raises(InputError, match=text):
        call()
