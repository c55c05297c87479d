"""Maps, places and beams by a calibrated twin, on links between walls whose paths are written down."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference import PointMass, Posterior
from dtprob.raytracing.calibration import project
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize
from dtprob.raytracing.walls import between_walls
from dtprob.twin.beamforming import Beams, gathered, statistical_beams
from dtprob.twin.coverage import CoverageMap, _powers, coverage_map
from dtprob.twin.localise import localise

KEY = jax.random.key(0)
CARRIER = 6e9
TONES = jnp.linspace(-40e6, 40e6, 16)


@pytest.fixture(scope="module")
def paths():
    return between_walls(24.0, (6.0, -9.0, 14.0), CARRIER)


@pytest.fixture(scope="module")
def array(paths):
    return jnp.asarray([[x, y, 0.0] for x in range(3) for y in range(3)]) * paths.wavelength / 2


def power(paths, permittivity, conductivity):
    gain = path_gain(paths, jnp.full(3, permittivity), jnp.full(3, conductivity), law="half_space")
    return float(jnp.sum(jnp.abs(gain) ** 2))


def channel(paths, array, angles, gain):
    """Channels of paths turned by `angles` (snapshot, path), for a receiving and a transmitting array."""
    return synthesize(
        gain,
        frequency_response(paths, TONES),
        steering(array, paths.arrival, paths.frequency, -1.0),
        steering(array, paths.departure, paths.frequency, 1.0),
        jnp.exp(1j * jnp.asarray(angles))[None],
    )


def test_a_map_of_one_calibration_has_no_spread(paths):
    sampler = PointMass({"permittivity": np.full(3, 4.0), "conductivity": np.full(3, 0.1)})
    found = coverage_map(KEY, sampler, paths, draws=3, law="half_space")
    assert found.power.shape == (3, 1)
    np.testing.assert_allclose(found.power, power(paths, 4.0, 0.1))
    assert found.covered.tolist() == [True]
    assert found.outage(0.5 * power(paths, 4.0, 0.1)).tolist() == [0.0]
    assert found.outage(2.0 * power(paths, 4.0, 0.1)).tolist() == [1.0]


def test_maps_of_one_size_are_compiled_once(paths):
    before = _powers._cache_size()
    for permittivity in (4.0, 5.0):
        values = {"permittivity": np.full(3, permittivity), "conductivity": np.full(3, 0.1)}
        coverage_map(KEY, PointMass(values), paths, draws=7)
    assert _powers._cache_size() == before + 1


def test_a_map_spreads_as_the_materials_do(paths):
    values = np.linspace(2.0, 8.0, 101)
    draws = {
        "permittivity": np.tile(values[None, :, None], (1, 1, 3)),
        "conductivity": np.full((1, 101, 3), 0.1),
    }
    found = coverage_map(KEY, Posterior(draws=draws), paths, draws=101, law="half_space")
    low, high = found.interval(0.9)
    # reflections grow with the contrast: quantiles of the power are the powers of the quantiles
    assert low[0] == pytest.approx(power(paths, 2.3, 0.1), rel=1e-3)
    assert high[0] == pytest.approx(power(paths, 7.7, 0.1), rel=1e-3)
    assert low[0] < found.mean[0] < high[0]


def test_materials_that_do_not_fit_the_map_are_named(paths):
    with pytest.raises(InputError, match="a site 'permittivity'"):
        coverage_map(KEY, PointMass({"noise_level": 1.0}), paths)
    sampler = PointMass({"permittivity": np.full(2, 4.0), "conductivity": np.full(2, 0.1)})
    with pytest.raises(InputError, match="values of the 3 objects"):
        coverage_map(KEY, sampler, paths)


def test_an_interval_of_no_probability_is_refused():
    with pytest.raises(InputError, match="expected between 0 and 1, got 2"):
        CoverageMap(np.ones((3, 1))).interval(2.0)


def joined(candidates):
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *candidates)


def test_receivers_are_found_among_places_whatever_their_phases(array):
    distances = (18.0, 24.0, 30.0, 36.0)
    candidates = [between_walls(d, (6.0, -9.0, 14.0), CARRIER) for d in distances]
    ones = jnp.ones(3)
    gains = [path_gain(c, 5.0 * ones, 0.1 * ones, law="half_space") for c in candidates]
    random = np.random.default_rng(3)
    measured, noise_power = [], 1e-4 * power(candidates[1], 5.0, 0.1)
    for each, gain in zip(candidates, gains, strict=True):
        h = np.asarray(channel(each, array, random.uniform(-np.pi, np.pi, (5, 3)), gain))[0]
        noise = random.standard_normal((2, *h.shape)) * np.sqrt(noise_power / 2)
        measured.append(h + noise[0] + 1j * noise[1])
    h = np.concatenate(measured)
    statistics = [
        project(c, TONES, h[None], rx_array=array, tx_array=array, powers=False) for c in candidates
    ]
    found = localise(joined(statistics), jnp.concatenate(gains), noise_power)
    assert found.candidate.tolist() == np.repeat(range(4), 5).tolist()
    np.testing.assert_allclose(found.probability.sum(axis=1), 1.0)


def test_the_density_of_places_is_that_of_the_normal_channel(paths):
    """Differences of log probabilities against the covariance matrix written out."""
    gain = path_gain(paths, jnp.full(3, 5.0), jnp.full(3, 0.1), law="half_space")
    louder = jnp.concatenate([gain, 2.0 * gain])
    h = channel(paths, jnp.zeros((1, 3)), np.zeros((1, 3)), gain * jnp.exp(1j * jnp.arange(3.0)))
    noise_power = 0.1 * power(paths, 5.0, 0.1)
    once = project(paths, TONES, h, powers=False)
    found = localise(joined([once, once]), louder, noise_power)
    b = np.asarray(frequency_response(paths, TONES))[0].T
    flat, density = np.asarray(h).reshape(-1), []
    for scale in (1.0, 2.0):
        spread = np.abs(scale * np.asarray(gain[0])) ** 2
        covariance = b @ np.diag(spread) @ b.conj().T + noise_power * np.eye(len(b))
        fit = np.real(flat.conj() @ np.linalg.solve(covariance, flat))
        density.append(-fit - np.linalg.slogdet(covariance)[1])
    ratio = np.diff(np.log(np.asarray(found.probability[0])))
    assert ratio[0] == pytest.approx(density[1] - density[0], rel=1e-6)


def test_one_path_is_gathered_whole(paths, array):
    gain = path_gain(paths, jnp.full(3, 5.0), jnp.full(3, 0.1), law="half_space") * jnp.asarray(
        [1.0, 0.0, 0.0]
    )
    beams = statistical_beams(paths, gain, array, array)
    np.testing.assert_allclose(gathered(beams, channel(paths, array, np.zeros((2, 3)), gain)), 1.0, rtol=1e-9)


def test_beams_lose_what_a_wrong_twin_aims_past(paths, array):
    random = np.random.default_rng(5)
    gain = path_gain(paths, jnp.full(3, 5.0), jnp.full(3, 0.1), law="half_space")
    h = channel(paths, array, random.uniform(-np.pi, np.pi, (40, 3)), gain)
    right = gathered(statistical_beams(paths, gain, array, array), h)
    wrong = gathered(statistical_beams(paths, gain * jnp.asarray([0.1, 1.0, 0.1]), array, array), h)
    assert jnp.all((right >= 0) & (right <= 1 + 1e-9))
    assert float(jnp.mean(wrong)) < float(jnp.mean(right))
    noise = random.standard_normal((4, 1, 9))
    blind = Beams(
        *(part / np.linalg.norm(part) for part in (noise[0] + 1j * noise[1], noise[2] + 1j * noise[3]))
    )
    assert float(jnp.mean(gathered(blind, h))) < float(jnp.mean(right))
