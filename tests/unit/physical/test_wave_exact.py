"""Simulated waves against fields that are known exactly, and against an independent simulation."""

import math

import numpy as np
import pytest

from dtprob.physical.wave import CONCRETE, METAL, Medium, Rectangle, Scene2D, simulate
from tests.unit.physical.wave_exact import (
    FREQUENCY,
    WAVELENGTH,
    by_way_of,
    error,
    half_space,
    line_source,
    slab,
)

SOURCE = (0.0, 0.0)
PROBES = WAVELENGTH * np.array([[1.0, -1.5], [2, 0.5], [3.03, 1.2], [4, -0.51], [-2, 0.9], [0, -1.8]])
AWAY = np.hypot(*PROBES.T)
DEPTH = 1.7 * WAVELENGTH
DURATION = 3e-9


def scene(*rectangles):
    low, high = np.array([-2.5, -2.0]) * WAVELENGTH, np.array([4.5, 2.5]) * WAVELENGTH
    return Scene2D(tuple(low), tuple(high), rectangles)


def ground(medium, thickness=math.inf):
    return Rectangle((-math.inf, DEPTH), (math.inf, DEPTH + thickness), medium)


def field(*rectangles, probes=PROBES, cells=20.0, **options):
    return simulate(scene(*rectangles), SOURCE, probes, FREQUENCY, duration=DURATION, cells=cells, **options)


def reflected(law, probes=PROBES):
    return by_way_of(law, probes[:, 0], 2 * DEPTH - probes[:, 1])


def test_sommerfelds_integral_of_one_is_the_line_source():
    found = by_way_of(lambda cosine: np.ones((1, len(cosine))), PROBES[:, 0], np.abs(PROBES[:, 1]))
    np.testing.assert_allclose(found, line_source(AWAY), rtol=1e-9)


def test_free_space_is_hankels_function():
    found = field()
    assert error(found.field, line_source(AWAY)).max() < 5e-4
    assert found.tail < 1e-4
    assert found.misaligned == 0


def test_far_away_only_the_fourth_order_of_dispersion_is_left():
    """Twelve wavelengths along an axis and a diagonal; uncorrected, the phase would be off by 3 degrees."""
    wide = Scene2D((-WAVELENGTH, -WAVELENGTH), (13 * WAVELENGTH, 9 * WAVELENGTH))
    probes = np.array([[12.0, 0.0], [8.5, 8.5]]) * WAVELENGTH
    found = simulate(wide, SOURCE, probes, FREQUENCY, duration=4e-9, cells=15).field
    turn = np.angle(found / line_source(np.hypot(*probes.T)))
    assert np.abs(turn).max() < np.deg2rad(0.15)


def test_metal_is_an_image_source():
    found = field(ground(METAL)).field
    image = np.hypot(PROBES[:, 0], 2 * DEPTH - PROBES[:, 1])
    assert error(found, line_source(AWAY) - line_source(image)).max() < 5e-4


@pytest.mark.parametrize("medium", [CONCRETE, Medium(4.0, 0.05), Medium(2.0, 0.3)])
def test_lossy_half_space(medium):
    """The field to 1% and the reflection alone to 2%, at 30 cells; the worst is the one that conducts best."""
    found = field(ground(medium), cells=30.0).field
    exact = reflected(half_space(*medium))
    assert error(found, line_source(AWAY) + exact).max() < 0.01
    assert error(found - line_source(AWAY), exact).max() < 0.02


def test_a_wall_reflects_and_lets_through():
    medium, thickness = Medium(4.0, 0.05), 0.6 * WAVELENGTH
    behind = WAVELENGTH * np.array([[x, 2.4] for x in (-1.0, 0.0, 1.0, 2.0, 3.0, 3.5)])
    back, through = slab(*medium, thickness)
    before, after = (field(ground(medium, thickness), probes=p, cells=30.0).field for p in (PROBES, behind))
    assert error(before, line_source(AWAY) + reflected(back)).max() < 0.01
    assert error(after, by_way_of(through, behind[:, 0], behind[:, 1] - thickness)).max() < 0.02


def test_surfaces_between_nodes_are_right_to_second_order():
    errors = []
    for cells in (20.0, 30.0):
        depth = DEPTH + WAVELENGTH / cells / 2
        found = field(Rectangle((-math.inf, depth), (math.inf, math.inf), CONCRETE), cells=cells)
        assert found.misaligned == pytest.approx(0.5)
        exact = by_way_of(half_space(*CONCRETE), PROBES[:, 0], 2 * depth - PROBES[:, 1])
        errors.append(error(found.field, line_source(AWAY) + exact).max())
    assert errors[1] < 0.025
    assert np.log(errors[0] / errors[1]) / np.log(1.5) > 1.8


def test_the_absorbing_layer_reflects_less_than_90_db():
    """Against the same scene in so wide an air that its edges cannot be heard yet; a wall runs into the layer."""
    wall = ground(CONCRETE)
    near = field(wall, keep_record=True).record
    low, high = np.array([-12.0, -11.0]) * WAVELENGTH, np.array([14.0, 11.0]) * WAVELENGTH
    wide = Scene2D(tuple(low), tuple(high), (wall,))
    far = simulate(wide, SOURCE, PROBES, FREQUENCY, duration=DURATION, cells=20.0, keep_record=True).record
    assert near is not None
    assert far is not None
    echo = np.abs(near - far).max(axis=1) / np.abs(far).max(axis=1)
    assert 20 * np.log10(echo.max()) < -90


@pytest.mark.study
def test_beamz_sees_the_same_field():
    """An independent simulation (plain Yee scheme) of a wall and a metal block, at 94 places."""
    import beamz

    cells, side, step_count = 40, 200, 1200
    spacing = WAVELENGTH / cells
    width = side * spacing
    step = 0.9 * spacing / 299_792_458.0 / math.sqrt(2)
    time = np.arange(step_count) * step
    turns = (np.pi * 6e9 * (time - 0.2e-9)) ** 2
    wall, block = Medium(4.0, 0.1), (100, 60, 110, 100)
    places = np.stack(np.meshgrid(*2 * [np.arange(24, 178, 16)], indexing="ij"), -1).reshape(-1, 2)
    start = np.array([60, 50])
    inside = np.all((places >= block[:2]) & (places <= block[2:]), axis=1)
    places = places[~inside & (np.hypot(*(places - start).T) > cells / 2)]
    solid = beamz.Rectangle(
        position=(block[0] * spacing, block[1] * spacing),
        width=(block[2] - block[0]) * spacing,
        height=(block[3] - block[1]) * spacing,
        material=beamz.Material(1.0, conductivity=1e7),
    )
    concrete = beamz.Rectangle(
        position=(0.0, 140 * spacing),
        width=width,
        height=60 * spacing,
        material=beamz.Material(4.0, conductivity=0.1),
    )
    seen = (
        beamz.Simulation(
            design=beamz.Design(width=width, height=width, structures=(concrete, solid)),
            resolution=spacing,
            time=time,
            sources=[
                beamz.CustomSource(
                    "Ez",
                    "e",
                    (start[1], start[0]),
                    1.0,
                    (1 - 2 * turns) * np.exp(-turns),
                    (side + 1, side + 1),
                )
            ],
            monitors=[beamz.FieldRecorder(("Ez",), interval=6, name="all")],
            boundaries=[beamz.PML(thickness=20 * spacing, formulation="cpml")],
            normalize_source=None,
        )
        .run()
        .monitors["all"]
    )
    series = np.asarray(seen.fields["Ez"], float)[:, places[:, 1], places[:, 0]]
    instants = np.asarray(seen.field_times, float)
    theirs = series.T @ np.exp(-2j * np.pi * instants[:, None] * FREQUENCY)
    metal = Rectangle(tuple(np.array(block[:2]) * spacing), tuple(np.array(block[2:]) * spacing), METAL)
    ours = simulate(
        Scene2D(
            (0.0, 0.0),
            (width, width),
            (Rectangle((-math.inf, 140 * spacing), (math.inf, math.inf), wall), metal),
        ),
        tuple(start * spacing),
        places * spacing,
        FREQUENCY,
        duration=DURATION,
        cells=cells,
    ).field
    strength = (ours.conj() * theirs).sum(axis=0) / (np.abs(ours) ** 2).sum(axis=0)
    assert len(places) == 94
    assert error(theirs / strength, ours).max() < 0.01
