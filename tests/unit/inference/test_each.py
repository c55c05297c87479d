"""Many data sets at once: each has the posterior that it would have alone."""

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import Posterior, RunOptions, fit, fit_each, summary
from tests.unit.inference.examples import at_the_cut, at_the_cut_data, normal, normal_data, normal_posterior

KEY = jax.random.key(41)
COUNT = 40


def stacked():
    sets = [normal_data(seed) for seed in range(COUNT)]
    return sets, {**sets[0], "y": np.stack([one["y"] for one in sets])}


SHORT = {
    "nuts": {"warmup": 0, "draws": 4, "chains": 2},
    "blackjax_nuts": {"warmup": 0, "draws": 4, "chains": 2},
    "hmc": {"warmup": 0, "draws": 4, "chains": 2},
    "laplace": {"draws": 20, "starts": 2},
}


@pytest.mark.study
@pytest.mark.parametrize("engine", ["nuts", "laplace", "blackjax_nuts", "hmc"])
def test_the_same_draws_as_alone_but_for_rounding(engine):
    """Before rounding has been amplified: chains without adaptation, a few draws."""
    sets, data = stacked()
    short = {"engine": engine, **SHORT[engine]}
    together = fit_each(normal, data, ["y"], key=KEY, **short)
    for number in (0, COUNT - 1):
        alone = fit(normal, sets[number], key=jax.random.fold_in(KEY, number), **short)
        for name, values in alone.draws.items():
            np.testing.assert_allclose(together.draws[name][:, :, number], values, rtol=1e-5)
        for name, values in alone.log_likelihood.items():
            np.testing.assert_allclose(together.log_likelihood[name][:, :, number], values, rtol=1e-5)
        if engine == "laplace":
            np.testing.assert_allclose(together.extra["log_evidence"][number], alone.extra["log_evidence"])
            assert together.extra["converged"].shape == (COUNT,)
        np.testing.assert_array_equal(together.observed["y"][number], alone.observed["y"])


@pytest.mark.study
@pytest.mark.parametrize("engine", ["nuts", "hmc"])
def test_each_has_its_own_posterior(engine, tmp_path):
    """Means against the closed form: 40 z-scores, all below 4.5 (failure rate 3e-4); and the layout, kept on disk."""
    sets, data = stacked()
    settings = {"engine": engine, "warmup": 150, "draws": 300, "chains": 2}
    posterior = fit_each(normal, data, ["y"], axis="place", key=KEY, **settings)
    assert posterior.draws["level"].shape == (2, 300, COUNT)
    assert posterior.log_likelihood["y"].shape == (2, 300, COUNT, len(sets[0]["y"]))
    assert posterior.sample_stats["lp"].shape == posterior.sample_stats["diverging"].shape == (2, 300, COUNT)
    table = summary(posterior)
    for number, one in enumerate(sets):
        mean, spread, _ = normal_posterior(one)
        row = table.loc[f"level[{number}]"]
        assert abs(row["mean"] - mean) < 4.5 * spread / row["ess"] ** 0.5
        assert row["sd"] == pytest.approx(spread, rel=0.25)
    tree = posterior.to_datatree()
    assert tree["posterior"]["level"].dims == tree["sample_stats"]["lp"].dims == ("chain", "draw", "place")
    posterior.save(tmp_path / "posterior.nc")
    loaded = Posterior.load(tmp_path / "posterior.nc")
    np.testing.assert_array_equal(loaded.draws["level"], posterior.draws["level"])


@pytest.mark.study
def test_angles_are_centred_for_each_by_itself():
    data = at_the_cut_data()
    turned = np.asarray([0.0, 1.0, np.pi])
    y = np.angle(np.exp(1j * (data["y"] + turned[:, None])))
    settings = {"engine": "nuts", "warmup": 200, "draws": 300, "chains": 2}
    posterior = fit_each(at_the_cut, {**data, "y": y}, ["y"], key=KEY, **settings)
    assert summary(posterior)["rhat"].max() < 1.05
    direction = np.angle(np.exp(1j * posterior.draws["angle"]).mean((0, 1)))
    error = np.angle(np.exp(1j * (direction - direction[0] - turned)))
    assert np.abs(error).max() < 0.1


def test_what_it_refuses(tmp_path):
    _, data = stacked()
    attempts = {
        "laplace, hmc, nuts or blackjax_nuts, got smc": {"engine": "smc"},
        "no early stop": {"engine": "nuts", "enough_ess": 100},
        "no checkpoint": {"options": RunOptions(checkpoint=tmp_path / "run.h5")},
        "chains of engine nuts": {"engine": "nuts", "chains": 0},
        "draws of engine laplace": {"draws": 0},
    }
    for text, settings in attempts.items():
        with pytest.raises(InputError, match=text):
            fit_each(normal, data, ["y"], key=KEY, **settings)
    with pytest.raises(InputError, match="'z'"):
        fit_each(normal, data, ["z"], key=KEY)
    with pytest.raises(InputError, match="one common length, 1 or more, got a scalar"):
        fit_each(normal, data, ["noise"], key=KEY)


def test_data_that_the_model_cannot_take_are_refused_wherever_they_are():
    """As by `fit`: NumPyro gives a density all the same, and JAX takes the last entry."""

    def counted(group, y=None):
        with numpyro.plate("group", 2):
            level = numpyro.sample("level", dist.LogNormal(0.0, 1.0))
        with numpyro.plate("row", 3):
            numpyro.sample("y", dist.Gamma(2.0, level[group]), obs=y)

    y, group = np.ones((4, 3)), np.tile([0, 1, 1], (4, 1))
    bad, beyond = y.copy(), group.copy()
    bad[2, 1], beyond[3, 0] = -1.0, 2
    with pytest.raises(InputError, match=r"observed site 'y': expected values that Gamma.*-1\. at \[2, 1\]"):
        fit_each(counted, {"group": group, "y": bad}, ["group", "y"], key=KEY)
    with pytest.raises(InputError, match="data set 3 'group': expected indices from 0 to 1"):
        fit_each(counted, {"group": beyond, "y": y}, ["group", "y"], key=KEY)
