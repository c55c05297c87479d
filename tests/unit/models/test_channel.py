"""Ray-traced channel models against the sum of paths written out, and against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from scipy import stats

from dtprob.errors import InputError
from dtprob.models.channel import phase_error_channel, ray_traced_channel
from dtprob.models.declaration import declare
from dtprob.raytracing.field import path_gain
from tests import small_world

FREQUENCY = np.linspace(-40e6, 40e6, 5)
RX = np.array([[0.0, 0.02, 0.01], [0.0, -0.02, -0.01]])
TX = np.array([[0.0, 0.0, 0.03], [0.0, 0.0, 0.0], [0.0, 0.0, -0.03]])


@pytest.fixture(scope="module")
def paths():
    return small_world.trace()


@pytest.fixture(scope="module")
def data(paths):
    rng = np.random.default_rng(0)
    channel = rng.normal(size=(3, 2, 2, 3, 5, 2)) @ [1, 1j] * 1e-3
    return {
        "paths": paths,
        "subcarrier_frequency": jnp.asarray(FREQUENCY),
        "rx_array": jnp.asarray(RX),
        "tx_array": jnp.asarray(TX),
        "snapshot_time": jnp.array([0.0, 1e-3]),
        "noise_power": 1e-6,
        "channel": jnp.asarray(channel),
    }


def run(model, data, values, **options):
    """Trace of a model with given values of its latent sites."""
    substituted = handlers.substitute(handlers.seed(model, 0), data=values)
    return handlers.trace(substituted).get_trace(**{**data, **options})


def materials(paths):
    """Values of the scene itself, per class."""
    return {
        "material_permittivity": jnp.array([paths.permittivity[0], paths.permittivity[1]]),
        "material_conductivity": jnp.array([paths.conductivity[0], paths.conductivity[1]]),
        "noise_level": jnp.array(1.3),
    }


def by_hand(paths, error=None):
    """H as a sum over paths, term by term."""
    gain, wave = (
        np.asarray(path_gain(paths, paths.permittivity, paths.conductivity)),
        2 * np.pi / paths.wavelength,
    )
    result = np.zeros((3, 2, 2, 3, 5), complex)
    for link, path in np.argwhere(np.asarray(paths.mask)):
        delay = float(paths.delay[link, path])
        turn = np.exp(-2j * np.pi * (paths.frequency + FREQUENCY) * delay)
        rx = np.exp(-1j * wave * RX @ np.asarray(paths.arrival)[link, path])
        tx = np.exp(1j * wave * TX @ np.asarray(paths.departure)[link, path])
        term = gain[link, path] * rx[:, None, None] * tx[:, None] * turn
        for snapshot in range(2):
            phase = 0.0 if error is None else error[link, snapshot, path]
            result[link, snapshot] += term * np.exp(1j * phase)
    return result


def test_the_channel_is_the_sum_of_its_paths(paths, data):
    trace = run(ray_traced_channel, data, materials(paths))
    found = np.broadcast_to(trace["noiseless_channel"]["value"], (3, 2, 2, 3, 5))
    np.testing.assert_allclose(found, by_hand(paths), rtol=1e-8, atol=1e-14)


def test_each_path_has_a_response_over_the_band(paths, data):
    """What a gap that depends on path and frequency at once shows at."""
    found = run(ray_traced_channel, data, materials(paths))["path_response"]["value"]
    mask, delay = np.asarray(paths.mask), np.asarray(paths.delay)
    expected = np.exp(-2j * np.pi * (paths.frequency + FREQUENCY) * delay[..., None])
    np.testing.assert_allclose(np.asarray(found)[mask], expected[mask], atol=1e-6)


def test_phase_errors_turn_paths(paths, data):
    error = np.random.default_rng(1).uniform(-3, 3, (3, 2, 7))
    values = {**materials(paths), "phase_concentration": jnp.array(2.0), "phase_error": jnp.asarray(error)}
    trace = run(phase_error_channel, data, values)
    np.testing.assert_allclose(
        trace["noiseless_channel"]["value"], by_hand(paths, error), rtol=1e-8, atol=1e-14
    )
    log_prior = trace["phase_error"]["fn"].log_prob(error)
    np.testing.assert_allclose(log_prior, stats.vonmises.logpdf(error, 2.0), rtol=1e-9)


def test_without_errors_both_models_are_one(paths, data):
    values = {**materials(paths), "phase_concentration": jnp.array(2.0), "phase_error": jnp.zeros((3, 2, 7))}
    ours = run(phase_error_channel, data, values)["noiseless_channel"]["value"]
    base = run(ray_traced_channel, data, materials(paths))["noiseless_channel"]["value"]
    np.testing.assert_allclose(ours, np.broadcast_to(base, ours.shape), rtol=1e-12)


def test_the_measurement_is_the_channel_in_noise(paths, data):
    trace = run(ray_traced_channel, data, materials(paths))
    residual = np.abs(np.asarray(data["channel"]) - by_hand(paths)) ** 2
    expected = -residual / 1.3e-6 - np.log(np.pi * 1.3e-6)
    site = trace["channel"]
    np.testing.assert_allclose(site["fn"].log_prob(site["value"]), expected, rtol=1e-8)


def test_packets_have_a_phase_each(paths, data):
    phase = np.array([[0.3, -2.0], [1.0, 0.0], [3.0, 0.5]])
    trace = run(ray_traced_channel, data, {**materials(paths), "packet_phase": phase}, phase="per_packet")
    expected = by_hand(paths) * np.exp(1j * phase)[:, :, None, None, None]
    np.testing.assert_allclose(trace["noiseless_channel"]["value"], expected, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize(("materials", "size"), [("per_material", 2), ("per_object", 4), ("shared", 1)])
def test_which_materials_are_unknown(data, materials, size):
    found = declare(ray_traced_channel, {**data, "materials": materials})
    assert found.latent["material_permittivity"].shape == (size,)
    assert found.sites["permittivity"].shape == (4,)


def test_known_materials_are_the_scenes(paths, data):
    found = declare(ray_traced_channel, {**data, "materials": "known"})
    assert set(found.latent) == {"noise_level"}
    trace = run(ray_traced_channel, data, {}, materials="known")
    np.testing.assert_array_equal(trace["permittivity"]["value"], paths.permittivity)


@pytest.mark.parametrize(
    ("power", "got"),
    [(0.0, "got 0"), (np.array([1.0, -2.0, 1.0]), "got -2"), (np.ones(2), r"got shape \(2,\)")],
)
def test_noise_powers_that_do_not_fit(paths, data, power, got):
    with pytest.raises(InputError, match=f"noise_power: expected positive values, one .* of 3 links, {got}"):
        run(ray_traced_channel, data, {}, noise_power=power)


def test_an_unknown_noise_power_is_learned(paths, data):
    free = {name: value for name, value in data.items() if name != "noise_power"}
    prior = run(ray_traced_channel, free, materials(paths))["noise_level"]["fn"]
    assert float(jnp.sqrt(prior.base_dist.variance)) > 3


def test_half_spaces_reflect_otherwise(paths, data):
    slab = run(ray_traced_channel, data, materials(paths))["path_gain"]["value"]
    half = run(ray_traced_channel, data, materials(paths), law="half_space")["path_gain"]["value"]
    expected = path_gain(paths, paths.permittivity, paths.conductivity, law="half_space")
    np.testing.assert_allclose(half, expected)
    assert np.abs(half - slab).max() > 0.01 * np.abs(slab).max()


def test_gradients_agree_with_differences(paths, data):
    """Of the log likelihood, in the logarithms of all materials and of the noise level."""

    def total(logs):
        values = {
            "material_permittivity": 1 + jnp.exp(logs[:2]),
            "material_conductivity": jnp.exp(logs[2:4]),
            "noise_level": jnp.exp(logs[4]),
        }
        site = run(ray_traced_channel, data, values)["channel"]
        return jnp.sum(site["fn"].log_prob(site["value"]))

    total = jax.jit(total)
    at = jnp.array([1.1, 1.4, -3.0, -4.0, 0.2])
    slope = jax.grad(total)(at)
    for j in range(5):
        step = 1e-5
        difference = (total(at.at[j].add(step)) - total(at.at[j].add(-step))) / (2 * step)
        assert float(slope[j]) == pytest.approx(float(difference), rel=2e-5, abs=1e-4)


def test_axes_have_names(data):
    found = declare(ray_traced_channel, data)
    assert found.cluster == "link"
    assert found.observed["channel"].axes == ("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier")
    assert found.sites["path_gain"].axes == ("link", "path")


def test_a_channel_of_another_shape(data):
    wrong = {**data, "channel": data["channel"][:2]}
    with pytest.raises(InputError, match=r"shape \(3, 2, 2, 3, 5\)"):
        declare(ray_traced_channel, wrong)
