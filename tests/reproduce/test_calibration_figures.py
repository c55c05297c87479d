"""Figures of calibration in small: the toy with one wall misplaced, and the parts of the urban study."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

from dtprob.errors import InputError
from dtprob.physical import tracing
from dtprob.physical.channel import subcarriers
from dtprob.raytracing.field import frequency_response, path_gain, synthesize
from dtprob.raytracing.trace import load_scene
from dtprob.raytracing.walls import between_walls
from dtprob.reproduce import FIGURES, calibration_urban, fig5, fig7
from dtprob.reproduce.progress import Progress


def test_the_toys_truth_is_the_twins_channel_where_no_wall_is_misplaced(monkeypatch):
    monkeypatch.setattr(fig5, "SHIFT", 0.0)
    grid = subcarriers(16, 100e6)
    clean, power = fig5._truth(grid)
    twin = between_walls(fig5.DISTANCE, fig5.WALLS, fig5.FREQUENCY)
    gain = path_gain(twin, jnp.full(2, 5.31), jnp.full(2, 0.139), law="half_space")
    found = np.asarray(synthesize(gain, frequency_response(twin, jnp.asarray(grid)))).reshape(-1)
    np.testing.assert_allclose(found, clean, rtol=1e-6)
    assert power == pytest.approx(float(jnp.sum(jnp.abs(gain) ** 2)), rel=1e-9)


@pytest.mark.study
def test_the_toy_in_small(monkeypatch):
    monkeypatch.setattr(fig5, "BANDWIDTHS", (500e6,))
    monkeypatch.setattr(fig5, "SNAPSHOTS", 4)
    monkeypatch.setattr(fig5, "SCHEMES", ("aware", "oblivious"))
    made = fig5.run(jax.random.key(0), 2, Progress())
    (panel,) = made.panels
    error = {series.name: float(series.median[0]) for series in panel.series}
    assert list(error) == ["aware", "oblivious"]
    # at 500 MHz the paths are resolved: who knows of phase errors finds the material, who does not cannot
    assert error["aware"] < 0.02
    assert error["oblivious"] > 5 * error["aware"]


@pytest.mark.parametrize("concentration", [0.358, 2.25, 25.0])
def test_quantiles_of_von_mises(concentration):
    points = calibration_urban.von_mises(np.array([0.1, 0.5, 0.8]), concentration)
    for probability, point in zip((0.1, 0.5, 0.8), points, strict=True):
        area = integrate.quad(lambda z: np.exp(concentration * (np.cos(z) - 1)), -np.pi, point)[0]
        assert area / (2 * np.pi * special.i0e(concentration)) == pytest.approx(probability, abs=1e-5)


def test_quantiles_at_the_ends():
    assert np.all(calibration_urban.von_mises(np.array([0.1, 0.9]), np.inf) == 0)
    np.testing.assert_allclose(
        calibration_urban.von_mises(np.array([0.0, 0.25, 1.0]), 0.0), [-np.pi, -np.pi / 2, np.pi]
    )


def test_figures_of_calibration_are_offered():
    assert {"fig5", "fig6a", "fig6b", "fig7"} <= set(FIGURES)


@pytest.mark.study
@pytest.mark.libllvm
def test_displaced_receivers_traced_afresh_see_what_images_say(street_corner):
    """Over half a wavelength the list of paths, their gains and directions hardly change; their phases do."""
    place = dataclasses.replace(calibration_urban.world(1), rays=calibration_urban.DISPLACED_RAYS)
    truth = calibration_urban.Truth(place, tracing.trace(place))
    displacement = np.array([[0.0, 0.0, 0.0], [0.02, 0.01, -0.01]])
    found = calibration_urban.displaced(truth, displacement)
    rays = truth.rays.shifted(displacement[None])
    tones = calibration_urban.FREQUENCY + calibration_urban.sounding().subcarrier_frequency
    phasors = np.exp(-2j * np.pi * np.modf(rays.delay[0, :, :, None] * tones)[0])
    expected = np.einsum("p,spk->sk", truth.rays.gain[0, 0], phasors)
    apart = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert np.all(apart < [1e-6, 5e-3])
    assert np.linalg.norm(found[1] - found[0]) > 0.1 * np.linalg.norm(found[0])


@pytest.mark.libllvm
def test_cells_that_rays_cross_are_where_paths_are(street_corner, monkeypatch):
    monkeypatch.setattr(fig7, "CELL", 20.0)
    monkeypatch.setattr(fig7, "SEARCH_RAYS", 500_000)
    crossed, cells = fig7.crossed(street_corner), fig7.cells()
    assert crossed.shape == (len(cells),)
    here = np.all(np.abs(cells[:, :2] - calibration_urban.RECEIVER[:2]) <= 10.0, axis=1)
    assert crossed[here].all()
    assert 0.1 < crossed.mean() < 0.7
    assert list(street_corner.transmitters) == []


@pytest.fixture(scope="module")
def street_corner():
    """The scene of figures 6 and 7, or a skip where it cannot be loaded."""
    try:
        return load_scene(calibration_urban.SCENE, calibration_urban.FREQUENCY)
    except InputError as error:
        pytest.skip(str(error))
