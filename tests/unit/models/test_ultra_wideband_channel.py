"""The channel as ultra-wideband receivers report it: gain law, delay and variance against closed forms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.models.declaration import declare
from dtprob.models.execution import trace_model
from dtprob.models.ultra_wideband import link_power, rough_delay, ultra_wideband_channel
from dtprob.raytracing import field, storage
from dtprob.testing import check_model

PATHS = Path(__file__).parents[3] / "dtprob" / "data" / "demo" / "paths.nc"
FREQUENCY = np.concatenate([np.arange(-24.0, 0.0), np.arange(1.0, 25.0)]) * 10e6


@pytest.fixture(scope="module")
def paths():
    return storage.load(PATHS).take(np.arange(5))


@pytest.fixture(scope="module")
def traced(paths):
    gain = field.path_gain(paths, paths.permittivity, paths.conductivity)
    response = field.frequency_response(paths, jnp.asarray(FREQUENCY))
    return np.asarray(field.synthesize(gain, response))[:, 0, 0, 0]


def at(paths, options=None, **values):
    """The sites with materials as traced, a flat pulse and a receiver on its law, but for `values`."""
    n = paths.n_link
    data = {"paths": paths, "subcarrier_frequency": jnp.asarray(FREQUENCY), "materials": "known"} | (
        options or {}
    )
    null = {"link_phase": n, "link_delay": n, "link_gain": n, "pulse_log_gain": 8, "pulse_phase": 7}
    start = {name: jnp.zeros(size) for name, size in null.items()}
    start |= {"transmitted_power": jnp.asarray(1e-5), "saturated_level": jnp.asarray(1e-11)}
    trace = trace_model(ultra_wideband_channel, data, jax.random.key(0), start | values)
    return {name: np.asarray(message["value"]) for name, message in trace.items()}


def power(channel):
    return np.mean(np.abs(channel) ** 2, axis=(1, 2, 3, 4))


@pytest.mark.parametrize("saturated", [1e-3, 1e-12, 1e-20])
def test_the_level_follows_the_law(paths, traced, saturated):
    sites = at(paths, saturated_level=jnp.asarray(saturated))
    x = 1e-5 * np.mean(np.abs(traced) ** 2, axis=1) / saturated
    np.testing.assert_allclose(power(sites["noiseless_channel"]), saturated * x / (1 + x), rtol=1e-9)


def test_each_link_departs_in_gain_phase_and_delay(paths):
    plain = at(paths)["noiseless_channel"]
    gain, phase, delay = np.array([0.0, 1, 0, -1, 2]), np.arange(5) / 3, np.array([0.0, 0, 2, -1, 1])
    sites = at(paths, link_gain=gain, link_phase=phase, link_delay=delay)
    factor = np.exp(0.35 * gain + 1j * phase)[:, None] * np.exp(
        -2j * np.pi * 0.5e-9 * np.outer(delay, FREQUENCY)
    )
    expected = plain[:, 0, 0, 0] * factor
    np.testing.assert_allclose(sites["noiseless_channel"][:, 0, 0, 0], expected, rtol=1e-9)


def test_a_ranged_origin_does_not_look_at_the_twin(paths):
    late = {"rough_delay": jnp.full(5, 7e-9)}
    assert np.allclose(at(paths, late)["receiver_delay"], 7e-9)
    ranged = late | {"time_origin": "ranged"}
    delay = np.array([0.0, 0, 2, -1, 1])
    sites = at(paths, ranged, ranging_offset=jnp.asarray(0.5), link_delay=delay)
    np.testing.assert_allclose(sites["receiver_delay"], 2.5e-9 + 0.6e-9 * delay, rtol=1e-6)
    measured = {"channel": jnp.zeros((5, 1, 1, 1, 48), complex)}
    data = {"paths": paths, "subcarrier_frequency": jnp.asarray(FREQUENCY), **ranged, **measured}
    found = declare(ultra_wideband_channel, data).sites
    assert (found["link_delay"].distribution, found["ranging_offset"].distribution) == ("StudentT", "Normal")
    with pytest.raises(InputError, match="searched or ranged"):
        at(paths, {"time_origin": "range"})


def test_the_pulse_weighs_all_links_alike(paths):
    log_gain, phase = np.zeros(8), np.zeros(7)
    log_gain[1], phase[1] = 0.3, 0.4
    factor = at(paths, pulse_log_gain=log_gain, pulse_phase=phase)["frequency_response"]
    x = FREQUENCY / FREQUENCY.max()
    np.testing.assert_allclose(np.log(np.abs(factor)), 0.3 * (3 * x**2 - 1) / 2, atol=1e-12)
    np.testing.assert_allclose(np.angle(factor), 0.4 * (5 * x**3 - 3 * x) / 2, atol=1e-12)


def test_the_rough_delay_is_found(paths, traced):
    late = np.array([0.0, 3e-9, 1e-9, 11e-9, 6e-9])
    measured = traced * np.exp(-2j * np.pi * np.outer(late, FREQUENCY) + 1j)
    data = {
        "paths": paths,
        "subcarrier_frequency": jnp.asarray(FREQUENCY),
        "channel": measured[:, None, None, None],
    }
    np.testing.assert_allclose(rough_delay(data), late, atol=0.051e-9)


def test_the_mean_over_snapshots_is_as_uncertain_as_declared(paths, traced):
    measured = jnp.asarray(np.repeat(traced[:, None, None, None], 4, axis=1))
    reference = link_power({"channel": measured})
    data = {
        "paths": paths,
        "subcarrier_frequency": jnp.asarray(FREQUENCY),
        "channel": measured,
        "noise_power": 1e-3 * reference,
        "link_power": reference,
        "model_error": 0.2,
    }
    trace = trace_model(ultra_wideband_channel, data, jax.random.key(0))
    variance = np.asarray(trace["noise_power"]["value"])[:, 0, 0, 0, 0] / 4
    np.testing.assert_allclose(variance, (1e-3 / 4 + 0.2) * reference, rtol=1e-9)


@pytest.mark.study
def test_the_contract_and_the_sites_that_effects_need(paths):
    data = {"paths": paths, "subcarrier_frequency": jnp.asarray(FREQUENCY), "phase": "per_packet"}
    drawn = trace_model(ultra_wideband_channel, data, jax.random.key(1))["channel"]["value"]
    data["channel"] = drawn
    check_model(ultra_wideband_channel, data)
    declaration = declare(ultra_wideband_channel, data)
    assert declaration.cluster == "link"
    needed = {"thickness", "path_gain", "path_delay", "path_phase", "frequency_response", "noiseless_channel"}
    assert needed <= set(declaration.deterministic)


def test_another_phase_is_refused(paths):
    data = {"paths": paths, "subcarrier_frequency": jnp.asarray(FREQUENCY), "phase": "coherent"}
    with pytest.raises(InputError, match='Set phase = "per_packet"'):
        trace_model(ultra_wideband_channel, data, jax.random.key(0))
