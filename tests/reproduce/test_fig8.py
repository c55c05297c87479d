"""Figure 8: the twin's rays are right, what is foreseen follows the model, and knowing of phase errors pays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import epsilon_0, speed_of_light

from dtprob.physical.wave import CONCRETE, cost
from dtprob.raytracing.calibration import Calibration
from dtprob.reproduce import fig8, fig8_scene
from dtprob.reproduce.fig8_scene import (
    BANDWIDTHS,
    CARRIER,
    DURATION,
    LOWER,
    THICKNESS,
    UPPER,
    WAVELENGTH,
    read_simulated,
    scene,
    subcarrier_frequency,
)
from dtprob.reproduce.fig8_twin import SHIFT, Materials, expected_profile, profile, ray_channel, trace_scene
from dtprob.reproduce.progress import Progress

TRUE = Materials(*CONCRETE)
FREQUENCY = subcarrier_frequency(500e6)


def reflection(cosine):
    """Of a concrete wall of finite thickness, field along the wall."""
    eta = CONCRETE.permittivity - 1j * CONCRETE.conductivity / (2 * np.pi * CARRIER * epsilon_0)
    root = np.sqrt(eta - 1 + cosine**2)
    surface = (cosine - root) / (cosine + root)
    twice = np.exp(-4j * np.pi * CARRIER / speed_of_light * THICKNESS * root)
    return surface * (1 - twice) / (1 - surface**2 * twice)


def image(bounces, first_is_upper, lower=LOWER):
    """Height of the transmitter's image after some reflections by the two walls in turn."""
    height = 0.0
    for number in range(bounces):
        wall = UPPER if (number % 2 == 0) == first_is_upper else lower
        height = 2 * wall - height
    return height


def test_rays_to_the_third_receiver_are_those_of_image_sources():
    paths = trace_scene(TRUE, 0.0)
    found = np.sort(np.asarray(paths.length[2])[np.asarray(paths.mask[2])])
    across = 70 * WAVELENGTH
    kept = [(1, True), (1, False), (2, True), (3, True), (3, False)]
    heights = np.array([image(*one) for one in kept])
    lengths = np.hypot(across, heights)
    np.testing.assert_allclose(found, np.sort(lengths), rtol=1e-12)
    bounces = np.array([one[0] for one in kept])
    waves = np.exp(-2j * np.pi * np.outer(lengths, CARRIER + FREQUENCY) / speed_of_light)
    gains = reflection(np.abs(heights) / lengths) ** bounces / np.sqrt(lengths)
    exact = WAVELENGTH / (4 * np.pi) * gains @ waves
    np.testing.assert_allclose(ray_channel(paths, FREQUENCY)[2], exact, rtol=1e-6)


def test_the_blocker_cuts_the_line_of_sight_and_what_folds_onto_it():
    """By walking along every ray in small steps."""
    paths = trace_scene(TRUE, 0.0)
    for link, row in enumerate(np.asarray(paths.mask)):
        for number, is_open in enumerate(row):
            count = int(np.count_nonzero(paths.interaction[link, number]))
            corners = [paths.tx_position[link], *paths.vertex[link, number, :count], paths.rx_position[link]]
            steps = np.linspace(0, 1, 20_001)[:, None]
            walk = np.concatenate(
                [a + steps * (b - a) for a, b in zip(corners[:-1], np.array(corners[1:]), strict=True)]
            )
            x, y = np.asarray(walk).T[:2] / WAVELENGTH
            assert is_open == (not np.any((np.abs(x) < 0.5) & (y > -16) & (y < 14)))


def test_the_twins_lower_wall_is_elsewhere():
    moved, there = (np.asarray(trace_scene(TRUE, shift).length) for shift in (SHIFT, 0.0))
    assert np.array_equal(moved[:, :2], there[:, :2])
    np.testing.assert_allclose(
        moved[2, 2], np.hypot(70 * WAVELENGTH, image(1, first_is_upper=False, lower=LOWER + SHIFT))
    )


def test_the_wave_and_the_rays_agree():
    """Two computations that share nothing; what is left is diffraction at the blocker, which rays leave out."""
    simulated = read_simulated()
    residual = fig8.residual(simulated, trace_scene(TRUE, 0.0), 500e6)
    assert residual < 0.03
    assert fig8.residual(simulated, trace_scene(TRUE), 500e6) > 1


def test_the_file_is_of_this_scene():
    simulated = read_simulated()
    assert simulated.channel.shape == (3, len(BANDWIDTHS), 64)
    assert simulated.cells >= 16
    wave = cost(scene(), np.array([CARRIER]), duration=DURATION, cells=20)
    assert wave.steps == 15_000
    corners = np.array([scene().lower, scene().upper]) / WAVELENGTH
    assert np.allclose(corners, np.round(corners))


def test_the_command_that_makes_the_file_anew(tmp_path, monkeypatch):
    made = fig8_scene.Simulated(np.ones((3, 3, 64), complex), 0.01, 17.0)
    monkeypatch.setattr(fig8_scene, "simulate_scene", lambda cells, report: made._replace(cells=cells))
    monkeypatch.setattr("sys.argv", ["fig8_scene", str(tmp_path / "field.npz"), "17"])
    fig8_scene.main()
    found = read_simulated(tmp_path / "field.npz")
    assert np.array_equal(found.channel, made.channel)
    assert (found.tail, found.cells) == (0.01, 17.0)


def test_the_profile_has_the_power_of_the_channel():
    channel = np.exp(1j * np.arange(64.0)) * np.linspace(1, 2, 64)
    delay, power = profile(channel, FREQUENCY)
    window = np.hanning(66)[1:-1]
    assert power.sum() == pytest.approx(np.sum(np.abs(window * channel) ** 2) / 256)
    assert delay[1] == pytest.approx(1 / (4 * 500e6))


def test_the_expected_profile_is_the_mean_over_phase_errors():
    paths = trace_scene(TRUE)
    gain = CONCRETE.permittivity, CONCRETE.conductivity

    def expected(concentration):
        found = Calibration(
            *(jnp.full(2, value) for value in gain),
            jnp.asarray(concentration),
            jnp.ones(3),
            jnp.zeros(1),
            jnp.zeros(()),
        )
        return expected_profile(paths, found, FREQUENCY, 2)[1]

    coherent = profile(ray_channel(paths, FREQUENCY)[2], FREQUENCY)[1]
    np.testing.assert_allclose(expected(np.inf), coherent, rtol=1e-9)
    count, concentration = 4000, 1.5
    errors = np.random.default_rng(0).vonmises(0, concentration, (count, paths.n_path))
    single = []
    for number in range(paths.n_path):
        only = np.zeros(paths.n_path, bool)
        only[number] = True
        single.append(ray_channel(_masked(paths, only), FREQUENCY)[2])
    drawn = [profile(np.exp(1j * error) @ np.array(single), FREQUENCY)[1] for error in errors]
    spread = np.std(drawn, axis=0) / np.sqrt(count)
    assert np.all(np.abs(np.mean(drawn, axis=0) - expected(concentration)) < 5 * spread + 1e-20)


def _masked(paths, only):
    return eqx.tree_at(lambda p: p.mask, paths, paths.mask & only)


@pytest.mark.study
def test_knowing_of_phase_errors_pays():
    found = fig8.band(jax.random.key(0), 2, read_simulated(), 200e6, Progress())
    error = {scheme: np.median(one.error) for scheme, one in found.outcomes.items()}
    assert error["aware"] < 0.2 * min(error["oblivious"], error["uniform"])
    assert found.measured.sum() == pytest.approx(1)
