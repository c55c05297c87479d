"""Models on compressed data against the models on the whole channel, and the rival on powers against its loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from numpyro.infer.util import log_density

from dtprob import fit
from dtprob.errors import InputError
from dtprob.models.channel import phase_error_channel, ray_traced_channel
from dtprob.models.compressed_channel import (
    compress,
    compress_powers,
    compressed_channel,
    uniform_phase_channel,
)
from dtprob.raytracing.calibration import project
from dtprob.raytracing.field import frequency_response, path_gain, synthesize
from dtprob.testing import check_model
from dtprob.twin.likelihood import window_likelihoods
from tests import small_world

TONES = jnp.linspace(-40e6, 40e6, 5)
ARRAY = jnp.asarray([[0.0, 0.02, 0.01], [0.0, -0.02, -0.01], [0.0, 0.0, 0.03]])


@pytest.fixture(scope="module")
def paths():
    return small_world.trace()


@pytest.fixture(scope="module")
def channel(paths):
    random = np.random.default_rng(0)
    data = {"paths": paths, "subcarrier_frequency": TONES, "rx_array": ARRAY, "noise_power": 1e-9}
    data["snapshot_time"] = jnp.arange(2.0)
    drawn = handlers.trace(handlers.seed(phase_error_channel, int(random.integers(9)))).get_trace(**data)
    return drawn["channel"]["value"]


@pytest.fixture(scope="module")
def statistics(paths, channel):
    return project(paths, TONES, channel, rx_array=ARRAY)


def point(model, data, seed):
    """Values of the latent sites drawn from the prior."""
    trace = handlers.trace(handlers.seed(model, seed)).get_trace(**data)
    return {name: m["value"] for name, m in trace.items() if m["type"] == "sample" and not m["is_observed"]}


@pytest.mark.parametrize(
    ("whole", "phase"), [(ray_traced_channel, "coherent"), (phase_error_channel, "per_path")]
)
def test_densities_differ_by_a_constant_from_those_of_the_whole_channel(
    paths, channel, statistics, whole, phase
):
    full = {"paths": paths, "subcarrier_frequency": TONES, "rx_array": ARRAY, "noise_power": 1e-9}
    full |= {"channel": channel, "snapshot_time": jnp.arange(2.0)}
    short = {"paths": paths, "noise_power": 1e-9, "phase": phase, **compress(statistics)}
    differences = []
    for seed in range(4):
        values = point(whole, full, seed)
        differences.append(
            float(log_density(whole, (), full, values)[0])
            - float(log_density(compressed_channel, (), short, values)[0])
        )
    assert np.ptp(differences) < 1e-6 * abs(differences[0])


def test_the_rival_on_powers_has_the_loss_of_the_literature(paths, statistics):
    arguments = {"paths": paths, **compress_powers(statistics)}
    kept, found = statistics.power, []
    for seed in range(3):
        values = point(uniform_phase_channel, arguments, seed) | {"power_spread": jnp.asarray(0.1)}
        trace = handlers.trace(
            handlers.substitute(handlers.seed(uniform_phase_channel, 0), data=values)
        ).get_trace(**arguments)
        powers = trace["path_power"]["value"]
        loss = jnp.einsum("lp,lpq,lq->", powers, kept.normal, powers) - 2 * jnp.sum(powers * kept.right)
        fit = float(jnp.sum(trace["powers"]["fn"].log_prob(arguments["powers"])))
        found.append((float(loss), fit))
    loss, fit = np.asarray(found).T
    assert (fit[1] - fit[0]) / (loss[1] - loss[0]) == pytest.approx(
        (fit[2] - fit[0]) / (loss[2] - loss[0]), 1e-6
    )
    assert (fit[1] - fit[0]) / (loss[1] - loss[0]) < 0


@pytest.mark.study
@pytest.mark.parametrize("phase", ["per_path", "per_packet"])
def test_contract_on_channels(paths, statistics, phase):
    check_model(
        compressed_channel, {"paths": paths, "noise_power": 1e-9, "phase": phase, **compress(statistics)}
    )


@pytest.mark.study
def test_contract_on_powers(paths, statistics):
    check_model(uniform_phase_channel, {"paths": paths, **compress_powers(statistics)})


def test_arguments_of_another_path_set_are_named(paths, statistics):
    arguments = compress(statistics) | {"paths": paths.take([0])}
    with pytest.raises(InputError, match="path set"):
        handlers.seed(compressed_channel, 0)(**arguments)
    without = project(paths, TONES, jnp.zeros((paths.n_link, 1, 1, 1, 5)) + 0j, powers=False)
    with pytest.raises(InputError, match="powers=True"):
        compress_powers(without)
    assert jax.tree.leaves(without)


@pytest.mark.study
def test_members_of_an_ensemble_weigh_what_is_left_of_a_link_too(paths):
    """Noise that differs from link to link is as uncertain on compressed data as on the whole channel."""
    tones = jnp.linspace(-40e6, 40e6, 16)
    gain = path_gain(paths, paths.permittivity, paths.conductivity)
    clean = np.asarray(synthesize(gain, frequency_response(paths, tones)))
    random = np.random.default_rng(0)
    power = np.mean(np.abs(clean) ** 2) / 10 * np.exp(random.normal(size=(len(clean), 1, 1, 1, 1)))
    noise = np.sqrt(power / 2) * (random.normal(size=clean.shape) + 1j * random.normal(size=clean.shape))
    channel = jnp.asarray(clean + noise)
    ask = {"engine": "ensemble", "resample": "weights", "members": 48, "key": jax.random.key(0)}
    whole = {"paths": paths, "subcarrier_frequency": tones, "channel": channel, "materials": "shared"}
    short = {"paths": paths, "phase": "coherent", "materials": "shared"}
    short |= compress(project(paths, tones, channel, powers=False))
    spread = [
        np.log(fit(model, data, **ask).flat("noise_level")).std()
        for model, data in ((ray_traced_channel, whole), (compressed_channel, short))
    ]
    assert spread[1] == pytest.approx(spread[0], rel=0.05)


def test_noise_shows_in_the_likelihood_of_each_link(paths):
    """Ten times the noise in one link lowers its likelihood by as much as that of its whole channel, constants apart."""
    random = np.random.default_rng(0)
    full = {"paths": paths, "subcarrier_frequency": TONES, "rx_array": ARRAY, "noise_power": 1e-9}
    full |= {"snapshot_time": jnp.arange(2.0)}
    values = point(ray_traced_channel, full, 0)
    drawn = handlers.trace(handlers.substitute(handlers.seed(ray_traced_channel, 0), data=values)).get_trace(
        **full
    )
    quiet, draws = (
        drawn["channel"]["value"],
        {name: np.asarray(value)[None] for name, value in values.items()},
    )
    noise = np.sqrt(1e-8 / 2) * (
        random.normal(size=(2, *quiet.shape)) * np.array([1, 1j]).reshape(2, *[1] * 5)
    ).sum(0)
    told = []
    for channel in (quiet, np.asarray(quiet) + noise):
        whole = window_likelihoods(ray_traced_channel, {**full, "channel": jnp.asarray(channel)}, draws)
        short = {"paths": paths, "noise_power": 1e-9, "phase": "coherent"}
        short |= compress(project(paths, TONES, jnp.asarray(channel), rx_array=ARRAY))
        parts = window_likelihoods(compressed_channel, short, draws)
        told.append((whole["channel"][0], sum(part[0] for part in parts.values()), short["residual"]))
    (before, short_before, left), (after, short_after, more) = told
    free = np.asarray(short["size"] - np.sum(short["kept"], axis=1))[:, None]
    constants = ((free - 1) * np.log(np.asarray(more) / np.asarray(left))).sum(axis=1)
    np.testing.assert_allclose(short_after - short_before - constants, after - before, rtol=1e-6)


@pytest.mark.parametrize("model", [ray_traced_channel, phase_error_channel])
def test_choices_are_checked(paths, model):
    data = {"paths": paths, "subcarrier_frequency": TONES}
    with pytest.raises(InputError, match=r"materials: .*Did you mean 'per_object'"):
        handlers.seed(model, 0)(**data, materials="per_objects")
    if model is ray_traced_channel:
        with pytest.raises(InputError, match=r"phase: .*Did you mean 'coherent'"):
            handlers.seed(model, 0)(**data, phase="Coherent")
