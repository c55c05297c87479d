"""Engines by name, with errors that name the nearest."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import dtprob
from dtprob.errors import InputError
from dtprob.inference import ENGINES, AbstractEngine, Laplace, Point, fit, resolve
from dtprob.inference.build import build_target
from tests.unit.inference.examples import normal, normal_data, normal_posterior

KEY = jax.random.key(0)


def test_fit_by_name_and_by_engine():
    data = normal_data()
    by_name = dtprob.fit(normal, data, engine="laplace", key=KEY, draws=20)
    by_engine = dtprob.fit(normal, data, engine=Laplace(draws=20), key=KEY)
    np.testing.assert_array_equal(by_name.draws["level"], by_engine.draws["level"])
    assert by_name.provenance["engine"] == "laplace"
    assert by_name.provenance["settings"]["draws"] == 20
    assert by_name.provenance["key"] == ["threefry2x32", 0, 0]
    assert len(by_name.provenance["data_sha256"]) == 64
    assert abs(float(by_name.extra["mode.level"]) - normal_posterior(data)[0]) < 1e-6


def test_names_are_those_of_the_table():
    assert set(ENGINES) == {
        *("auto", "exact", "nuts", "blackjax_nuts", "hmc", "smc", "svi"),
        *("von_mises_em", "laplace", "ensemble", "point"),
    }
    for name in ENGINES:
        engine = resolve(name)
        assert isinstance(engine, AbstractEngine)
        assert engine.name == name


def test_settings_replace_those_of_an_engine():
    assert resolve(Laplace(draws=5), starts=2) == Laplace(draws=5, starts=2)
    assert resolve("point", objective="maximum_likelihood") == Point(objective="maximum_likelihood")


def test_unknown_names_get_the_nearest():
    with pytest.raises(InputError, match=r"'nutz'.*Did you mean 'nuts'"):
        resolve("nutz")
    with pytest.raises(InputError, match=r"settings of engine laplace.*Did you mean 'draws'"):
        resolve("laplace", draw=3)
    with pytest.raises(InputError, match="a name or an engine"):
        resolve(3)


def test_data_are_hashed_by_value():
    first, second, third = (
        dtprob.fit(normal, normal_data(seed), engine="point", key=KEY).provenance["data_sha256"]
        for seed in (0, 0, 1)
    )
    assert first == second != third


def test_a_model_that_reads_something_that_has_changed_is_another_one():
    class Reading:
        deviation = 1.0

        def __call__(self, y=None):
            level = numpyro.sample("level", dist.Normal(0.0, 10.0))
            with numpyro.plate("row", 50):
                numpyro.sample("y", dist.Normal(level, self.deviation), obs=y)

    model, data = Reading(), {"y": jnp.linspace(-0.1, 0.1, 50)}
    for deviation in (1.0, 0.01):
        model.deviation = deviation
        found = fit(model, data, engine="laplace", key=jax.random.key(0))
        assert float(np.std(found.draws["level"])) == pytest.approx(deviation / np.sqrt(50), rel=0.1)


def test_a_model_whose_scale_has_changed_is_another_one():
    class Scaled:
        weight = 1.0

        def __call__(self, y=None):
            level = numpyro.sample("level", dist.Normal(0.0, 10.0))
            with numpyro.handlers.scale(scale=self.weight), numpyro.plate("row", 50):
                numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    model, data = Scaled(), {"y": jnp.linspace(-0.1, 0.1, 50)}
    first, _ = build_target(model, data)
    assert build_target(model, data)[0] is first
    model.weight = 100.0
    assert build_target(model, data)[0] is not first


@pytest.mark.parametrize(
    ("engine", "setting", "value", "remedy"),
    [
        ("point", "objective", "max_likelihood", "Did you mean 'maximum_likelihood'"),
        ("point", "objective", "density", "choice"),
        ("svi", "guide", "full", "Did you mean 'full_rank'"),
        ("ensemble", "resample", "cluster", "Did you mean 'clusters'"),
        ("nuts", "chain_method", "vectorised", "Did you mean 'vectorized'"),
    ],
)
def test_a_setting_that_is_no_choice_is_refused(engine, setting, value, remedy):
    with pytest.raises(InputError, match=f"{setting} of engine {engine}.*{remedy}"):
        fit(normal, normal_data(), engine=engine, key=KEY, **{setting: value})


@pytest.mark.parametrize("value", [2.5, "100"])
def test_a_count_that_is_no_whole_number_is_refused(value):
    with pytest.raises(InputError, match=r"draws of engine nuts: expected a whole number, got '?\d+"):
        fit(normal, normal_data(), key=KEY, draws=value)


@pytest.mark.parametrize("engine", ["nuts", "blackjax_nuts"])
def test_chains_do_not_stand_where_the_density_is_nowhere_finite(engine):
    def model(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 10.0))
        with numpyro.plate("row", 3):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    with pytest.raises(InputError, match="expected a finite log density, got none at any start"):
        fit(model, {"y": jnp.array([2.9, jnp.inf, 2.0])}, engine=engine, key=jax.random.key(0))
