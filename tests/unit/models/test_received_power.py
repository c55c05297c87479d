"""Received powers: moments against simulated phases, recovery of the unknowns, and a diagnosis without phases."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from scipy.special import polygamma

from dtprob.case import load_case
from dtprob.data import PowerData
from dtprob.effects import catalogue
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace, fit
from dtprob.models.declaration import declare
from dtprob.models.received_power import link_power, received_power
from dtprob.raytracing import storage
from dtprob.raytracing.field import path_gain
from dtprob.workflow.prepare import prepare
from tests import small_world

DEMO = Path(__file__).parents[3] / "dtprob" / "data" / "demo"
SHAPE = (1, 1)


@pytest.fixture(scope="module")
def street():
    return storage.load(DEMO / "paths.nc")


def gains_of(paths):
    return np.asarray(path_gain(paths, paths.permittivity, paths.conductivity))


def drawn(paths, gains, *, looks=8, level=1e-3, spread=0.1, seed=0):
    """Powers as a receiver reports them: path phases drawn anew in each of `looks` places, averaged."""
    rng = np.random.default_rng(seed)
    phases = np.exp(2j * np.pi * rng.random((looks, *gains.shape)))
    power = np.mean(np.abs(np.sum(phases * gains, axis=-1)) ** 2, axis=0)
    return level * power[:, None, None] * np.exp(spread * rng.normal(size=(paths.n_link, *SHAPE)))


def test_moments_are_those_of_random_phases():
    paths = small_world.trace()
    values = {"level_offset": 0.0, "looks": 1.0, "measurement_spread": 0.1}
    with handlers.seed(rng_seed=0), handlers.substitute(data=values):
        trace = handlers.trace(received_power).get_trace(paths, materials="known")
    gain = gains_of(paths)
    rng = np.random.default_rng(0)
    power = np.abs((np.exp(2j * np.pi * rng.random((200_000, *gain.shape))) * gain).sum(-1)) ** 2
    mean, variance = power.mean(0), power.var(0)
    np.testing.assert_allclose(
        trace["mean_power"]["value"], mean, rtol=5 * np.max(variance**0.5 / mean) / 447
    )
    expected = np.sqrt(polygamma(1, mean**2 / variance))
    np.testing.assert_allclose(trace["fading_deviation"]["value"], expected, rtol=0.03)


@pytest.mark.study
def test_level_and_spread_are_recovered(street):
    power = jnp.asarray(drawn(street, gains_of(street), looks=1000, spread=0.3))
    data = {"paths": street, "power": power, "materials": "known"}
    posterior = fit(received_power, data, engine="laplace", key=jax.random.key(0), draws=400)
    for name, truth in {"level_offset": np.log(1e-3), "measurement_spread": 0.3}.items():
        draws = np.asarray(posterior.draws[name]).reshape(-1)
        assert abs(draws.mean() - truth) < 4 * draws.std()
        assert draws.std() < 0.3 * abs(truth)


def test_effects_that_need_phases_are_not_offered(street):
    data = {"paths": street, "power": jnp.ones((street.n_link, *SHAPE))}
    offered = {e.family for e in catalogue(declare(received_power, data).sites, data)}
    assert {"missing_path", "blockage", "shadowing", "material_mismatch", "antenna_pattern"} <= offered
    assert not {"timing_offset", "phase_error", "iq_imbalance", "diffuse_scattering"} & offered


@pytest.mark.study
def test_a_class_of_paths_that_is_weaker_is_named(street):
    """The line of sight lost 80% of its amplitude behind something that the scene lacks."""
    gains = gains_of(street)
    direct = np.asarray(jnp.all(street.interaction == 0, axis=-1) & street.mask)
    assert direct.any(axis=1).sum() > 10
    power = jnp.asarray(drawn(street, np.where(direct, 0.2 * gains, gains), looks=64))
    data = {"paths": street, "power": power, "materials": "known"}
    names = ["missing_path", "rough_surface", "path_loss_exponent", "shadowing"]
    effects = catalogue(declare(received_power, data).sites, data, use=names)
    settings = Settings(replicates=200, site_replicates=39, candidates=3, max_effects=1)
    found = diagnose(
        received_power, data, effects, key=jax.random.key(0), engine=Laplace(draws=200), settings=settings
    )
    assert found.causes[0].effects == ("missing_path[line_of_sight]",)
    assert abs(found.causes[0].size[0].mean - 0.8) < 0.1
    before, after = found.sections["gap"]["in_user_terms"]["power_rmse_db"]
    assert before > 2 * after > 0


def test_powers_in_a_case(tmp_path, street):
    names = {name: np.asarray(getattr(street, name)) for name in ("rx_position", "tx_position")}
    power = drawn(street, gains_of(street)) * np.array([[1.0, 1.1], [0.9, 0.8]])
    np.savez(tmp_path / "power.npz", power_db=10 * np.log10(power) + 30, power_reference=1e-3, **names)
    storage.save(street, tmp_path / "paths.nc")
    text = (
        '[model]\nname = "received_power"\n[data]\nfile = "power.npz"\nphase = "{}"\n'
        '[scene]\nfile = "paths.nc"\nfrequency = 6e9\n[effects]\nuse = "all"\n[engine]\nname = "laplace"\n'
    )
    (tmp_path / "case.toml").write_text(text.format("none"))
    job = prepare(load_case(tmp_path / "case.toml"), need="diagnosis")
    np.testing.assert_allclose(job.data["power"], power.mean((1, 2), keepdims=True), rtol=1e-9)
    assert len(job.effects) > 20
    (tmp_path / "case.toml").write_text(text.format("coherent"))
    with pytest.raises(InputError, match="expected none, since powers have no phase, got coherent"):
        prepare(load_case(tmp_path / "case.toml"), need="diagnosis")


def test_wrong_powers(street):
    with pytest.raises(InputError, match="power: expected shape"):
        declare(received_power, {"paths": street, "power": jnp.ones((3, 1, 1))})
    here = np.zeros((2, 3))
    with pytest.raises(InputError, match=r"expected positive powers, got 0 at \[1, 0, 0\]"):
        link_power(PowerData(power=np.array([[[1.0]], [[0.0]]]), rx_position=here, tx_position=here))
