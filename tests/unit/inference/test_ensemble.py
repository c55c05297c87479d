"""Ensembles: exact for linear Gaussian models, by every scheme what its definition says, of any base engine."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.inference import Ensemble
from dtprob.inference.build import build_target
from dtprob.inference.ensemble import _places
from dtprob.inference.resample import chosen_scheme
from dtprob.workflow.summary import summarise
from tests.unit.inference.examples import (
    at_the_cut,
    at_the_cut_data,
    logistic,
    logistic_data,
    normal,
    normal_data,
)

KEY = jax.random.key(8)
X = np.random.default_rng(0).normal(size=(9, 2))


def linear(x, y=None):
    with numpyro.plate("column", 2):
        weight = numpyro.sample("weight", dist.Normal(jnp.asarray([0.5, -1.0]), jnp.asarray([1.0, 2.0])))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(x @ weight, 0.8), obs=y)


def linear_data():
    return {"x": X, "y": X @ [1.0, 0.5] + np.random.default_rng(1).normal(0, 0.8, 9)}


def linear_posterior(data, x=X):
    precision = np.diag([1.0, 0.25]) + x.T @ x / 0.64
    covariance = np.linalg.inv(precision)
    return covariance @ (np.asarray([0.5, -0.25]) + x.T @ data["y"] / 0.64), covariance


def test_randomised_map_of_a_linear_gaussian_model_is_the_posterior():
    """Whitened by the closed form, members are independent standard normals: chi-square and Kolmogorov-Smirnov."""
    data, members = linear_data(), 600
    posterior = Ensemble(members=members)(KEY, linear, data)
    assert str(posterior.extra["resampled_by"]) == "noise"
    mean, covariance = linear_posterior(data)
    white = np.linalg.solve(np.linalg.cholesky(covariance), (posterior.flat("weight") - mean).T).ravel()
    assert stats.kstest(white, "norm").pvalue > 1e-3
    low, high = stats.chi2.interval(1 - 1e-3, white.size)
    assert low < np.sum(white**2) < high
    assert abs(np.corrcoef(white.reshape(2, -1))[0, 1]) < 4 / members**0.5
    assert not posterior.sample_stats["diverging"].any()
    few = Ensemble(members=40)(KEY, linear, data)
    np.testing.assert_array_equal(few.draws["weight"], posterior.draws["weight"][:, :40])


def test_without_any_perturbation_all_members_are_the_mode():
    data = linear_data()
    posterior = Ensemble(members=3, resample="none", perturb_prior=False)(KEY, linear, data)
    np.testing.assert_allclose(
        posterior.flat("weight"), np.tile(linear_posterior(data)[0], (3, 1)), atol=1e-6
    )


def test_a_bootstrap_member_is_the_mode_of_its_weighted_data():
    """Resampled clusters: every member solves the normal equations of some integer weights that sum to the rows."""
    data = {"noise": 1.5, "y": np.asarray([0.0] * 11 + [12.0])}
    posterior = Ensemble(members=300, resample="clusters", perturb_prior=False)(KEY, normal, data)
    precision = 1 / 9 + 12 / 1.5**2
    count = (posterior.flat("level") * precision - 1 / 9) * 1.5**2 / 12.0  # times the last row is drawn
    np.testing.assert_allclose(count, np.round(count), atol=1e-6)
    observed = np.bincount(np.round(count).astype(int), minlength=4)[:4]
    expected = 300 * stats.binom.pmf(np.arange(4), 12, 1 / 12)
    assert np.all(np.abs(observed - expected) < 4 * np.sqrt(expected))


def test_weights_leave_the_reported_likelihood_alone():
    data = normal_data()
    posterior = Ensemble(members=5, resample="weights")(KEY, normal, data)
    expected = stats.norm.logpdf(data["y"], posterior.draws["level"][..., None], data["noise"])
    np.testing.assert_allclose(posterior.log_likelihood["y"], expected)


@pytest.mark.study
def test_angles_and_discrete_data():
    posterior = Ensemble(members=64)(KEY, at_the_cut, at_the_cut_data())
    eta = 3.0 * np.exp(1j * at_the_cut_data()["y"]).sum() + 0.05
    error = np.angle(np.exp(1j * (posterior.draws["angle"] - np.angle(eta)))).mean()
    assert abs(error) < 0.1
    with pytest.raises(InputError, match=r"observed sites that are normal.*'y' \(Bernoulli"):
        Ensemble(resample="noise")(KEY, logistic, logistic_data())


def test_an_angle_whose_prior_lies_across_the_cut_has_the_spread_of_its_prior():
    """Without data members are draws of the prior, here within .2 rad or so of pi."""

    def untold(y=None):
        numpyro.sample("angle", dist.VonMises(jnp.pi, 25.0))
        numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)

    posterior = Ensemble(members=64, resample="none")(KEY, untold, {"y": jnp.zeros(())})
    error = np.angle(np.exp(1j * (posterior.draws["angle"] - np.pi)))
    assert np.std(error) == pytest.approx(25**-0.5, rel=0.3)


LAWS = {
    "LogNormal": lambda level: dist.LogNormal(level, 1.0),
    "FoldedDistribution": lambda level: dist.FoldedDistribution(dist.Normal(level, 1.0)),
    "TruncatedNormal": lambda level: dist.TruncatedNormal(level, 1.0, low=0.0),
}


@pytest.mark.parametrize("name", LAWS)
def test_no_noise_is_added_to_data_that_only_have_a_normal_base(name):
    """With noise they would leave their support, where there is no density."""

    def positive(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", 12):
            numpyro.sample("y", LAWS[name](level), obs=y)

    target, _ = build_target(positive, {"y": jnp.linspace(0.05, 2.0, 12)})
    assert chosen_scheme(target, "auto", point=True) == "weights"
    with pytest.raises(InputError, match="observed sites that are normal"):
        chosen_scheme(target, "noise", point=True)


def test_any_engine_can_be_the_base():
    """Bagging: the members' mean spreads by about as much as the data tell, on top of each one's own spread."""
    data = linear_data()
    settings = {"draws": 50}
    posterior = Ensemble(members=40, base="laplace", settings=settings)(KEY, linear, data)
    assert posterior.draws["weight"].shape == (1, 2000, 2)
    mean, covariance = linear_posterior(data)
    draws = posterior.flat("weight")
    within = np.mean([np.cov(block.T) for block in draws.reshape(40, 50, 2)], axis=0)
    assert np.all(np.diag(within) > 0.6 * np.diag(covariance))
    assert np.all(np.diag(np.cov(draws.T)) > np.diag(within))
    assert np.all(np.abs(draws.mean(0) - mean) < 4 * np.sqrt(2 * np.diag(covariance) / 40))
    with pytest.raises(InputError, match="base of engine ensemble"):
        Ensemble(base="ensemble")(KEY, linear, data)


def test_a_draw_on_the_edge_of_its_support_stays_there():
    """An engine's draw was rounded to the edge, where its coordinate is infinite; it is not the prior's median."""

    def edged(y=None):
        share = numpyro.sample("share", dist.Uniform(2.0, 3.0))
        scale = numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
        numpyro.sample("y", dist.Normal(share, scale), obs=y)

    target, inputs = build_target(edged, {"y": jnp.zeros(())})
    values = {"share": jnp.asarray([2.0, 3.0, 2.3]), "scale": jnp.asarray([1.0, 0.0, 2.0])}
    positions = _places(target, values, inputs)
    assert np.isfinite(positions).all()
    back = [target.constrain(u, inputs) for u in positions]
    for name, value in values.items():
        np.testing.assert_allclose([one[name] for one in back], value, rtol=1e-6, atol=1e-6)


def test_what_lies_outside_of_the_resampled_plate_is_refused():
    """It would count as data without any noise, and the draws would be too narrow."""

    def beside(y=None, z=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", 4):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)
        numpyro.sample("z", dist.Normal(level, 1.0), obs=z)

    data = {"y": jnp.zeros(4), "z": jnp.zeros(())}
    with pytest.raises(InputError, match="every observed site in the plate 'row', got 'z' outside"):
        Ensemble(resample="weights")(KEY, beside, data)


def test_settings_of_another_base_are_refused():
    with pytest.raises(InputError, match="none with base point"):
        Ensemble(members=4, settings={"objective": "maximum_likelihood"})
    with pytest.raises(InputError, match="a value for each site by name"):
        Ensemble(members=4, initial="zzz")


@pytest.mark.parametrize("is_known", [True, False])
def test_noise_added_to_data_of_unknown_noise_is_told(is_known):
    """Whose variance doubles: the noise comes out larger by the root of two."""

    def model(y=None):
        mean = numpyro.sample("mean", dist.Normal(0.0, 5.0))
        noise = 2.0 if is_known else numpyro.sample("noise", dist.HalfNormal(5.0))
        with numpyro.plate("row", 100):
            numpyro.sample("y", dist.Normal(mean, noise), obs=y)

    y = 2 * np.random.default_rng(0).normal(size=100)
    found = Ensemble(members=64)(jax.random.key(0), model, {"y": y})
    assert bool(found.extra["noise_unknown"]) != is_known
    warned = [text for text in summarise(found)["warnings"] if "whose noise is unknown" in text]
    assert bool(warned) != is_known
    if not is_known:
        assert found.draws["noise"].mean() == pytest.approx(2**0.5 * y.std(), rel=0.1)
