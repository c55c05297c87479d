"""Power over the delay: random phases by Monte Carlo, the tail's closed form, taps of a measured channel."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

from dtprob.data.kinds import ChannelData
from dtprob.effects import Rewriting, catalogue
from dtprob.errors import InputError
from dtprob.models.declaration import declare
from dtprob.models.execution import trace_model
from dtprob.models.ultra_wideband import delay_profile, ultra_wideband_profile
from dtprob.raytracing import field, storage
from dtprob.testing import check_model

PATHS = Path(__file__).parents[3] / "dtprob" / "data" / "demo" / "paths.nc"
FREQUENCY = np.concatenate([np.arange(-24.0, 0.0), np.arange(1.0, 25.0)]) * 10e6
TAPS = (np.arange(49) - 2) / 490e6
TRANSMITTED, SATURATED = 1e-5, 1e-3


@pytest.fixture(scope="module")
def paths():
    return storage.load(PATHS).take(np.arange(5))


def measured(channel, frequency=FREQUENCY, **more):
    links = len(channel)
    place = np.column_stack([np.arange(links), np.zeros(links), np.ones(links)])
    return ChannelData(
        channel=channel, subcarrier_frequency=frequency, rx_position=place, tx_position=place, **more
    )


def at(paths, given=None, **values):
    """Values of the sites of `traced`."""
    return {name: np.asarray(message["value"]) for name, message in traced(paths, given, **values).items()}


def traced(paths, given=None, **values):
    """The sites with a flat pulse, a receiver on its law far from saturation and no tail, but for `values`.

    Arguments of the model may be given.
    """
    n = paths.n_link
    data = {"paths": paths, "subcarrier_frequency": jnp.asarray(FREQUENCY), "tap_delay": jnp.asarray(TAPS)}
    null = {"link_delay": n, "link_gain": n, "pulse_log_gain": 8, "pulse_phase": 7}
    single = {
        "transmitted_power": TRANSMITTED,
        "saturated_level": SATURATED,
        "ranging_offset": -2.0,
        "tail_share": 1e-12,
        "floor": 1e-12,
        "shape": 1.0,
    }
    start = {name: jnp.zeros(size) for name, size in null.items()}
    start |= {name: jnp.asarray(value) for name, value in single.items()}
    return trace_model(ultra_wideband_profile, data | (given or {}), jax.random.key(0), start | values)


def test_taps_hold_what_paths_of_random_phases_bring(paths):
    rng = np.random.default_rng(0)
    gain = np.asarray(field.path_gain(paths, paths.permittivity, paths.conductivity))
    phase = rng.uniform(0, 2 * np.pi, (20_000, *gain.shape))
    turned = np.exp(-2j * np.pi * np.asarray(paths.delay)[..., None] * FREQUENCY)
    back = np.exp(2j * np.pi * np.outer(FREQUENCY, TAPS)) / len(FREQUENCY)
    x = FREQUENCY / FREQUENCY.max()
    pulse = np.exp(0.4 * x + 0.8j * (5 * x**3 - 3 * x) / 2)
    each = gain[..., None] * ((pulse * turned) @ back)
    drawn = np.abs(np.einsum("nlp,lpt->nlt", np.exp(1j * phase), each)) ** 2
    error = drawn.std(axis=0) / np.sqrt(len(drawn))
    shaped = {"pulse_log_gain": np.eye(8)[0] * 0.4, "pulse_phase": np.eye(7)[1] * 0.8}
    expected = at(paths, **shaped)["tap_power"] / TRANSMITTED
    assert np.abs((drawn.mean(axis=0) - expected) / error).max() < 5


def test_the_tail_is_exponential_behind_the_first_path(paths):
    decay = 8e-9
    shares = {"tail_share": jnp.asarray(0.2), "tail_decay": jnp.asarray(decay)}
    sites = at(paths, **shares, ranging_offset=jnp.asarray(0.5))
    mask, delay = np.asarray(paths.mask), np.asarray(paths.delay)
    first = np.where(mask, delay, np.inf).min(axis=1)
    free = (1 / (4 * np.pi * float(paths.frequency) * first)) ** 2
    step = TAPS[1] - TAPS[0]
    for tail, start, level in zip(sites["tail"], first, free, strict=True):
        behind = TAPS - start - 2.5e-9
        assert np.all(tail[behind <= 0] == 0)
        late = behind > 8 * step
        expected = 0.2 * level * step / decay * np.exp(-behind[late] / decay)
        np.testing.assert_allclose(tail[late], expected, rtol=1e-3)


def test_the_tail_of_a_link_is_its_own_by_so_many_decibels(paths):
    common = {"tail_share": jnp.asarray(0.2), "tail_decay": jnp.asarray(8e-9)}
    strength = np.array([0.0, 1, -1, 2, 0.5])
    own = {"tail_strength": jnp.asarray(strength)}
    found = traced(paths, {"tail_spread_db": 3.0}, **common, **own)
    plain = traced(paths, **common)
    expected = np.asarray(plain["tail"]["value"]) * 10 ** (0.3 * strength)[:, None]
    np.testing.assert_allclose(found["tail"]["value"], expected, rtol=1e-6)
    assert "tail_strength" not in plain
    unknown = declare(ultra_wideband_profile, arguments(paths) | {"tail_spread_db": 3.0}).sites[
        "tail_strength"
    ]
    assert (unknown.shape, unknown.distribution) == ((5,), "Normal")


def test_the_floor_is_the_same_under_all_taps(paths):
    plain, sites = at(paths)["tap_power"], at(paths, floor=jnp.asarray(0.3))["tap_power"]
    np.testing.assert_allclose(
        sites - plain, np.repeat(0.3 * plain.mean(axis=1, keepdims=True), 49, axis=1), rtol=1e-2
    )


def test_the_time_origin_is_late_by_the_errors_of_ranging(paths):
    delay = np.array([0.0, 0, 2, -1, 1])
    sites = at(paths, ranging_offset=jnp.asarray(0.5), link_delay=jnp.asarray(delay))
    np.testing.assert_allclose(sites["receiver_delay"], 2.5e-9 + 0.6e-9 * delay, rtol=1e-6)
    found = declare(ultra_wideband_profile, arguments(paths)).sites
    assert (found["link_delay"].distribution, found["power"].distribution) == ("StudentT", "Gamma")


def test_taps_spread_as_the_shape_says_about_a_mean_that_noise_raises(paths):
    noise = jnp.full(5, 1e-9)
    quiet = traced(paths)["tap_power"]["value"]
    trace = traced(paths, {"tap_noise": noise}, shape=jnp.asarray(2.0))
    law, mean = trace["power"]["fn"], np.asarray(trace["tap_power"]["value"])
    np.testing.assert_allclose(mean, quiet + noise[:, None], rtol=1e-6)
    np.testing.assert_allclose(law.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(law.variance, mean**2 / 2.0, rtol=1e-6)


@pytest.mark.study
def test_second_derivatives_hold_at_a_picowatt_in_single_precision(paths):
    """A rate of 1e13 per watt, whose second derivative by the power is beyond what single precision holds."""

    def density(level):
        given = {"floor": jnp.asarray(1e-3), "shape": jnp.asarray(2.0)}
        trace = traced(paths, **given, transmitted_power=TRANSMITTED * level)
        law = trace["power"]["fn"]
        return jnp.sum(law.log_prob(jnp.full(law.mean.shape, 1e-13)))

    with jax.enable_x64(False):
        found = jax.grad(jax.grad(density))(jnp.asarray(1.0))
    assert jnp.isfinite(found)


def test_the_density_has_no_corner_where_the_tail_begins(paths):
    """A tap that the tail's foot moves over is as steep on both sides."""
    first = np.where(np.asarray(paths.mask), np.asarray(paths.delay), np.inf).min(axis=1)[0]
    late = (TAPS[20] - first) / 1e-9 / 0.6  # the foot of the first link's tail lies at a tap
    shares = {
        "tail_share": jnp.asarray(0.2),
        "tail_decay": jnp.asarray(8e-9),
        "ranging_offset": jnp.asarray(-2.0),
    }

    def tail(moved):
        delay = jnp.zeros(5).at[0].set(late + moved)
        return at(paths, **shares, link_delay=delay)["tail"][0, 20]

    ahead, behind = (tail(side * 1e-4) for side in (-1, 1))
    top = at(paths, **shares, link_delay=jnp.zeros(5).at[0].set(late))["tail"][0].max()
    assert behind == 0.0
    assert 0.0 < ahead < 1e-6 * top  # quadratic: a corner would leave 1e-4 of it


def test_unknown_materials_change_the_powers_of_their_paths(paths):
    known, unknown = at(paths), at(paths, {"materials": "shared"})
    assert not np.allclose(unknown["permittivity"], known["permittivity"], atol=0.0)
    gain = np.asarray(field.path_gain(paths, unknown["permittivity"], unknown["conductivity"]))
    np.testing.assert_allclose(unknown["path_power"], np.abs(gain) ** 2, rtol=1e-6)
    assert not np.allclose(unknown["path_power"], known["path_power"], atol=0.0)


def test_the_level_saturates(paths):
    plain, sites = at(paths), at(paths, saturated_level=jnp.asarray(1e-20))
    power = plain["tap_power"].sum(axis=1)
    x = power / 1e-20
    np.testing.assert_allclose(sites["tap_power"].sum(axis=1), 1e-20 * x / (1 + x), rtol=1e-6)


def test_a_wave_on_a_tap_stays_there_and_noise_spreads_evenly():
    frequency = np.arange(-32.0, 32.0) * 7e6
    late = 5 / (64 * 7e6)
    wave = 3 * np.exp(-2j * np.pi * frequency * late)
    rng = np.random.default_rng(1)
    noise = (rng.normal(size=(1, 1000, 1, 1, 64)) + 1j * rng.normal(size=(1, 1000, 1, 1, 64))) * np.sqrt(
        0.5 * 4.0
    )
    quiet = delay_profile(measured(wave[None, None, None, None, :], frequency))
    expected = np.full(64, 1e-9 * 9 / 64)
    expected[7] = 9
    np.testing.assert_allclose(quiet["power"][0], expected, rtol=1e-6)
    assert np.argmin(np.abs(quiet["tap_delay"] - late)) == 7
    loud = delay_profile(measured(noise, frequency, noise_power=np.array([4.0])))
    error = loud["tap_noise"][0] / np.sqrt(1000)
    assert np.abs(loud["power"][0] - loud["tap_noise"][0]).max() < 5 * error


def test_uneven_subcarriers_and_foreign_powers_are_refused(paths):
    channel = np.ones((1, 1, 1, 1, 3), complex)
    with pytest.raises(InputError, match="common grid"):
        delay_profile(measured(channel, np.array([0.0, 1e6, 2.5e6])))
    with pytest.raises(InputError, match="common grid"):
        delay_profile(measured(channel[..., :1], np.array([0.0])))
    with pytest.raises(InputError, match=r"\(5, 49\)"):
        declare(ultra_wideband_profile, arguments(paths) | {"power": jnp.ones((4, 49))})
    with pytest.raises(InputError, match="tail_spread_db"):
        declare(ultra_wideband_profile, arguments(paths) | {"tail_spread_db": -3.0})


def arguments(paths):
    grid = {"subcarrier_frequency": jnp.asarray(FREQUENCY), "tap_delay": jnp.asarray(TAPS)}
    return {"paths": paths, **grid, "power": jnp.full((5, 49), 1e-12), "tap_noise": jnp.full(5, 1e-15)}


@pytest.mark.study
def test_the_contract_and_the_effects_that_powers_tell(paths):
    data = arguments(paths)
    check_model(ultra_wideband_profile, data)
    offered = catalogue(declare(ultra_wideband_profile, data).sites, data)
    families = {effect.family for effect in offered}
    assert {"receiver_displacement", "missing_object", "bandwidth_mismatch", "carrier_mismatch"} <= families
    assert not {"phase_error", "clock_drift", "amplifier_nonlinearity"} & families


def test_another_bandwidth_stretches_what_follows_the_first_path_alone(paths):
    """The time origin was ranged, by the time of flight: no spacing of subcarriers enters it."""
    data = arguments(paths)
    (effect,) = catalogue(declare(ultra_wideband_profile, data).sites, data, ["bandwidth_mismatch"])
    given = {effect.name: {"scale": jnp.asarray(0.2)}}
    with handlers.trace() as found, Rewriting(None, [effect], given, data), handlers.seed(rng_seed=0):
        ultra_wideband_profile(**data)
    mask, own = np.asarray(paths.mask), np.asarray(paths.delay)
    first = np.where(mask, own, np.inf).min(axis=1, keepdims=True)
    stretched = np.asarray(found["path_delay"]["value"])
    np.testing.assert_allclose(stretched[mask], (first + 1.2 * (own - first))[mask], rtol=1e-5)
    assert np.ptp(own[mask]) > 0
