"""What a posterior foresees: the closed form, new places, scans, and what cannot be foreseen."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan

from dtprob.errors import InputError
from dtprob.inference import Posterior, fit, predictive

KEY = jax.random.key(4)
X = np.array([1.0, 2.0, 3.0])
Y = np.array([1.2, 1.9, 3.4])


def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 2.0))
    mean = numpyro.deterministic("mean", slope * x)
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


@pytest.fixture(scope="module")
def fitted():
    return fit(line, {"x": X, "y": Y}, engine="exact", key=KEY, draws=4000)


def test_mean_and_spread_are_those_of_the_closed_form(fitted):
    precision = X @ X / 0.25 + 0.25
    mean = X @ Y / 0.25 / precision
    for x in (X, np.array([5.0, 0.0])):  # with what was observed, and elsewhere
        data = {"x": x, "y": Y} if len(x) == len(Y) else {"x": x}
        drawn = predictive(KEY, fitted, line, data).predicted["y"]
        assert drawn.shape == (1, 4000, len(x))
        spread = np.sqrt(x**2 / precision + 0.25)
        np.testing.assert_allclose(drawn.mean(axis=(0, 1)), mean * x, atol=4 * spread.max() / 4000**0.5)
        np.testing.assert_allclose(drawn.std(axis=(0, 1)), spread, rtol=0.05)


def test_arviz_gets_what_it_looks_for_and_files_keep_it(fitted, tmp_path):
    import arviz as az

    made = predictive(KEY, fitted, line, {"x": X, "y": Y})
    tree = made.to_datatree()
    assert tree["posterior_predictive"]["y"].dims == ("chain", "draw", "row")
    assert tree["constant_data"]["x"].dims == ("row",)
    az.plot_ppc_dist(tree, backend="none")
    made.save(tmp_path / "p.nc")
    back = Posterior.load(tmp_path / "p.nc")
    np.testing.assert_array_equal(back.predicted["y"], made.predicted["y"])
    np.testing.assert_array_equal(back.constant["x"], X)
    again = predictive(KEY, fitted, line, {"x": X, "y": Y})
    np.testing.assert_array_equal(again.predicted["y"], made.predicted["y"])


def walk(steps, y=None):
    size = numpyro.sample("size", dist.LogNormal(0.0, 0.1))

    def step(before, seen):
        now = numpyro.sample("state", dist.Normal(before, size))
        numpyro.sample("y", dist.Normal(now, 0.01), obs=seen)
        return now, None

    scan(step, 0.0, y, length=steps)


def test_states_of_a_scan_are_those_of_the_posterior():
    y = np.cumsum(np.ones(6))
    posterior = fit(walk, {"steps": 6, "y": y}, engine="laplace", key=KEY, draws=50)
    drawn = predictive(KEY, posterior, walk, {"steps": 6, "y": y}).predicted["y"]
    assert np.abs(drawn - posterior.draws["state"]).max() < 0.06


def test_what_cannot_be_foreseen_is_refused(fitted):
    def sized(y=None):
        slope = numpyro.sample("slope", dist.Normal(0.0, 2.0))
        with numpyro.plate("row", y.shape[0]):
            numpyro.sample("y", dist.Normal(slope, 0.5), obs=y)

    def other(x, y=None):
        slope = numpyro.sample("slope", dist.Normal(jnp.zeros(2), 2.0).to_event(1))
        numpyro.sample("y", dist.Normal(slope.sum() * x, 0.5).to_event(1), obs=y)

    with pytest.raises(
        InputError, match=r"model sized: expected one that draws.*Size plates by other arguments"
    ):
        predictive(KEY, fitted, sized, {"y": Y})
    with pytest.raises(
        InputError, match=r"posterior of 'slope': expected a site of shape \(\), got one of shape \(2,\)"
    ):
        predictive(KEY, fitted, other, {"x": X})
    with pytest.raises(InputError, match=r"prediction: expected at most 2e.08 numbers"):
        predictive(KEY, fitted, line, {"x": np.zeros(100_000)})


def test_an_argument_may_be_called_as_its_plate_is(tmp_path):
    def model(row, y=None):
        slope = numpyro.sample("slope", dist.Normal(0.0, 2.0))
        with numpyro.plate("row", row.shape[0]):
            numpyro.sample("y", dist.Normal(slope * row, 0.5), obs=y)

    posterior = fit(model, {"row": X, "y": Y}, engine="laplace", key=KEY, draws=10)
    posterior.save(tmp_path / "p.nc")
    np.testing.assert_array_equal(Posterior.load(tmp_path / "p.nc").constant["row"], X)
