"""The target: density, Jacobian, coordinates, data as arguments, and models that it refuses."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan
from scipy import integrate, stats

from dtprob.errors import InputError
from dtprob.inference.build import build_target
from dtprob.inference.fit import fit
from dtprob.inference.laplace import Laplace
from dtprob.inference.modes import starting_points
from dtprob.inference.target import Target
from tests.unit.inference.examples import at_the_cut, at_the_cut_data, normal, normal_data

KEY = jax.random.key(5)
Y = np.zeros(2)


def one_site(prior):
    def model(y=None):
        numpyro.sample("x", prior)
        with numpyro.plate("row", 2):
            numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)

    return model


SCALAR_PRIORS = {
    "normal": dist.Normal(2e-9, 1e-9),
    "positive": dist.HalfNormal(2.0),
    "lower bound": dist.Pareto(3.0, 2.5),
    "interval": dist.Uniform(-1.0, 4.0),
    "unit interval": dist.Beta(2.0, 3.0),
    "circular": dist.VonMises(1.0, 2.0),
}


@pytest.mark.parametrize("name", SCALAR_PRIORS)
def test_density_integrates_to_one(name):
    target, inputs = build_target(one_site(SCALAR_PRIORS[name]), {"y": Y})
    density = jax.jit(lambda u: jnp.exp(sum(target.log_terms(jnp.array([u]), inputs)[::2])))
    low, high = (-np.pi, np.pi) if name == "circular" else (-40, 40)
    total, _ = integrate.quad(density, low, high, limit=200, points=[0.0])
    assert total == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("prior", "value", "log_slope"),
    [
        (dist.LogNormal(0.3, 0.7), np.exp, lambda v: v),
        (
            dist.Uniform(1.0, 5.0),
            lambda v: 1 + 4 / (1 + np.exp(-v)),
            lambda v: np.log(4) - v - 2 * np.log1p(np.exp(-v)),
        ),
    ],
)
def test_density_agrees_with_the_closed_form(prior, value, log_slope):
    target, inputs = build_target(one_site(prior), {"y": Y})
    for u in (-1.3, 0.0, 0.8):
        v = float(inputs.location[0] + inputs.scale[0] * u)
        likelihood = 2 * stats.norm.logpdf(0.0)
        expected = prior.log_prob(value(v)) + log_slope(v) + np.log(inputs.scale[0]) + likelihood
        assert float(target.log_density(jnp.array([u]), inputs)) == pytest.approx(float(expected), rel=1e-12)


def test_simplex_jacobian_is_that_of_differences():
    prior = dist.Dirichlet(jnp.array([2.0, 3.0, 1.5]))
    target, inputs = build_target(one_site(prior), {"y": Y})
    u = jnp.array([0.4, -0.7])
    jacobian = jax.jacobian(lambda u: target.constrain(u, inputs)["x"][:2])(u)
    assert float(target.log_terms(u, inputs).jacobian) == pytest.approx(
        float(jnp.linalg.slogdet(jacobian)[1])
    )


def test_coordinates_are_in_units_of_the_prior():
    target, inputs = build_target(one_site(dist.Normal(3e-9, 1e-9)), {"y": Y})
    draws = target.prior_draws(KEY, inputs, {})
    assert abs(float(jnp.median(draws))) < 0.6
    assert 0.5 < float(draws.std()) < 2.0


def test_an_angle_has_no_edge():
    target, inputs = build_target(at_the_cut, at_the_cut_data())
    density = jax.jit(lambda z: target.log_density(jnp.array([z, 0.3]) - inputs.location, inputs))
    slope = jax.grad(density)
    for z in (np.pi, 1.0):
        assert float(density(z + 2 * np.pi)) == pytest.approx(float(density(z)), rel=1e-12)
    assert float(density(np.pi + 1e-9)) == pytest.approx(float(density(np.pi - 1e-9)), abs=1e-6)
    assert float(slope(np.pi + 1e-7)) == pytest.approx(float(slope(np.pi - 1e-7)), abs=1e-4)
    numeric = (density(np.pi + 1e-5) - density(np.pi - 1e-5)) / 2e-5
    assert float(slope(np.pi)) == pytest.approx(float(numeric), rel=1e-6)


def test_no_helper_site_leaks_and_angles_are_wrapped():
    target, inputs = build_target(at_the_cut, at_the_cut_data())
    values = target.constrain(jnp.array([40.0, -17.0]), inputs)
    assert set(values) == {"angle", "free"}
    assert all(-np.pi < float(v) <= np.pi for v in values.values())


def test_the_prior_predictive_still_works():
    build_target(at_the_cut, at_the_cut_data())
    trace = numpyro.handlers.trace(numpyro.handlers.seed(at_the_cut, KEY)).get_trace()
    assert trace["y"]["value"].shape == (15,)
    assert not trace["y"]["is_observed"]


def with_everything(x, y=None):
    top = numpyro.sample("top", dist.HalfNormal(2.0))
    part = numpyro.sample("part", dist.Uniform(0.0, top))
    numpyro.factor("penalty", -3.0 * part)
    mean = numpyro.deterministic("mean", part * x)
    with numpyro.plate("row", 3), numpyro.handlers.scale(scale=0.5):
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def test_factors_scales_deterministic_sites_and_supports_that_move():
    x, y = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.5, 0.2])
    target, inputs = build_target(with_everything, {"x": x, "y": y})
    u = jnp.array([0.3, -0.2])
    run = target.evaluate(u, inputs)
    part, top = float(run.values["part"]), float(run.values["top"])
    assert 0 < part < top
    np.testing.assert_allclose(run.values["mean"], part * x)
    pointwise = 0.5 * stats.norm.logpdf(y, part * x, 1.0)
    np.testing.assert_allclose(run.log_likelihood["y"], pointwise)
    assert float(run.terms.likelihood) == pytest.approx(pointwise.sum() - 3 * part)
    assert float(run.terms.prior) == pytest.approx(stats.halfnorm.logpdf(top, scale=2.0) - np.log(top))


def random_walk(y=None):
    def step(level, observed):
        level = numpyro.sample("level", dist.Normal(level, 0.5))
        numpyro.sample("y", dist.Normal(level, 1.0), obs=observed)
        return level, None

    scan(step, 0.0, y, length=4)


def test_sites_inside_a_scan():
    y = np.array([0.2, -0.1, 0.7, 1.0])
    target, inputs = build_target(random_walk, {"y": y})
    u = jnp.array([0.1, -0.4, 0.9, 0.3])
    run = target.evaluate(u, inputs)
    level = np.asarray(run.values["level"])
    np.testing.assert_allclose(level, inputs.location + inputs.scale * u)
    steps = np.diff(np.concatenate([[0.0], level]))
    assert float(run.terms.prior) == pytest.approx(stats.norm.logpdf(steps, 0, 0.5).sum())
    assert float(run.terms.likelihood) == pytest.approx(stats.norm.logpdf(y, level).sum())


def test_ravel_and_unravel_are_inverse():
    target, _ = build_target(with_everything, {"x": np.ones(3), "y": np.zeros(3)})
    vector = jnp.arange(2.0)
    np.testing.assert_array_equal(target.ravel(target.unravel(vector)), vector)


def test_initial_values_survive_the_coordinates():
    target, inputs = build_target(with_everything, {"x": np.ones(3), "y": np.zeros(3)})
    values = target.latent_values({"top": 3.0, "part": 1.0, "mean": np.zeros(3)})
    for u in (target.prior_draw(KEY, inputs, values), target.prior_median(inputs, values)):
        back = target.constrain(u, inputs)
        assert float(back["top"]) == pytest.approx(3.0)
        assert float(back["part"]) == pytest.approx(1.0)


def test_an_initial_value_on_the_edge_is_drawn_from_the_prior():
    target, inputs = build_target(with_everything, {"x": np.ones(3), "y": np.zeros(3)})
    u = target.prior_draw(KEY, inputs, target.latent_values({"top": 3.0, "part": 0.0}))
    assert np.all(np.isfinite(u))
    assert float(target.constrain(u, inputs)["top"]) == pytest.approx(3.0)


def test_initial_values_are_checked():
    target, _ = build_target(normal, normal_data())
    with pytest.raises(InputError, match="Did you mean 'level'"):
        target.latent_values({"leval": 1.0})
    with pytest.raises(InputError, match=r"expected shape \(\), got \(2,\)"):
        target.latent_values({"level": np.zeros(2)})


def counted():
    calls = []

    def model(x, y=None):
        calls.append(1)
        weight = numpyro.sample("weight", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", x.shape[0]):
            numpyro.sample("y", dist.Normal(weight * x, 1.0), obs=y)

    return model, calls


def test_one_compilation_for_each_shape():
    model, calls = counted()
    random = np.random.default_rng(0)
    fits = []
    for rows in (5, 5, 5, 6):
        data = {"x": random.normal(size=rows), "y": random.normal(size=rows)}
        fits.append(Laplace(draws=10)(KEY, model, data))
        fits[-1] = (len(calls), float(fits[-1].draws["weight"].mean()))
    traced, answers = zip(*fits, strict=True)
    runs = np.diff([0, *traced])  # one is a look whether what the model computes has changed
    assert runs[1] == runs[2] == 1
    assert runs[3] > 1
    assert len(set(answers)) == 4


def test_the_same_shapes_give_the_same_target():
    first, _ = build_target(normal, normal_data(0))
    second, _ = build_target(normal, normal_data(1))
    assert first is second
    assert first.compiled(Target.log_density) is second.compiled(Target.log_density)


def refused(kind):
    def model(y=None):
        if kind == "discrete":
            numpyro.sample("x", dist.Bernoulli(0.5))
        elif kind == "parameter":
            numpyro.param("x", 1.0)
            numpyro.sample("z", dist.Normal(0.0, 1.0))
        elif kind == "complex":
            from dtprob.models.complex_normal import ComplexNormal

            numpyro.sample("x", ComplexNormal(0j, 1.0))
        elif kind == "sphere":
            numpyro.sample("x", dist.ProjectedNormal(jnp.ones(2)))
        elif kind == "certain":
            numpyro.sample("x", dist.Delta(jnp.ones(2)).to_event(1))
        elif kind == "subsample":
            numpyro.sample("z", dist.Normal(0.0, 1.0))
            with numpyro.plate("part", 10, subsample_size=3):
                numpyro.factor("f", jnp.zeros(3))
        with numpyro.plate("row", 2):
            numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)

    return model


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("discrete", "the discrete latent site 'x'.*Sum it out"),
        ("parameter", "the parameter site 'x'.*numpyro.sample"),
        ("complex", "the complex latent site 'x'.*real and imaginary"),
        ("sphere", "the latent site 'x'.*config={'x': ProjectedNormalReparam()"),
        ("certain", r"the latent site 'x' .Delta.\. Write numpyro.deterministic"),
        ("subsample", "plate 'part' that takes 3 of 10.*full size"),
        ("nothing", "expected a latent site, got none"),
    ],
)
def test_what_cannot_work_is_refused_with_a_reason(kind, message):
    with pytest.raises(InputError, match=message):
        build_target(refused(kind), {"y": Y})


def test_single_precision():
    with jax.enable_x64(False):
        posterior = Laplace(draws=100)(KEY, normal, normal_data())
    assert posterior.draws["level"].dtype == np.float32
    assert bool(posterior.extra["converged"])


def test_more_starts_than_a_block_of_prior_draws_has():
    """Each is a start of its own, and those of few starts are the same as before."""
    target, inputs = build_target(normal, normal_data())
    find = functools.partial(
        starting_points, target, inputs, jax.random.key(1), objective="density", values={}
    )
    assert len(np.unique(find(starts=100))) == 100
    drawn = target.prior_draws(jax.random.key(1), inputs, {})
    density = np.asarray([target.log_density(u, inputs) for u in drawn])
    best = np.asarray(drawn)[np.argsort(-density)[:16]]
    np.testing.assert_allclose(find(starts=17)[1:], best, rtol=1e-5)


def test_a_site_with_obs_mask_is_refused():
    """NumPyro leaves the entries that were observed a latent twin whose density is one everywhere."""

    def split(seen, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", 3):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y, obs_mask=seen)

    with pytest.raises(InputError, match="observed site 'y': expected no obs_mask, got one"):
        build_target(split, {"seen": np.array([True, False, True]), "y": np.zeros(3)})


def with_holes(x, y=None, seen=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(slope * x, 1.0).mask(True if seen is None else seen), obs=y)


def test_data_that_are_no_numbers_are_named():
    x, holes = np.arange(5.0), np.where(np.arange(5) == 2, np.nan, 1.0)
    for data, text in (
        (
            {"x": x, "y": holes},
            r"data 'y': expected finite numbers, got NaN at index \[2\]\. Leave the reading out",
        ),
        ({"x": holes, "y": x}, "data 'x': expected finite numbers"),
    ):
        with pytest.raises(InputError, match=text):
            build_target(with_holes, data)


def test_what_a_model_masks_may_be_no_number():
    x, holes = np.arange(5.0), np.where(np.arange(5) == 2, np.nan, 1.0)
    found = Laplace(draws=10)(KEY, with_holes, {"x": x, "y": holes, "seen": np.isfinite(holes)})
    assert found.extra["mode.slope"] == pytest.approx(8.0 / 27.0)


def weighed(y):
    """A likelihood that is summed by hand over a hidden state."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    numpyro.factor("of_y", dist.Normal(mean, 1.0).log_prob(y).sum())


def weighed_besides(y, z=None):
    weighed(y)
    if z is not None:
        numpyro.sample("z", dist.Normal(0.0, 1.0), obs=z)


@pytest.mark.parametrize("engine", ["nuts", "laplace", "exact"])
def test_a_factor_alone_may_hold_the_data(engine):
    y = jnp.array([0.5, 1.5, 2.5])
    with pytest.raises(InputError, match="expected an observed site, got none"):
        fit(weighed_besides, {"y": y}, engine=engine, key=KEY)
    posterior = fit(weighed, {"y": y}, engine=engine, key=KEY)
    variance = 1 / (3 + 0.25)
    assert posterior.draws["mean"].mean() == pytest.approx(variance * 4.5, abs=0.1)
    assert posterior.draws["mean"].std() == pytest.approx(variance**0.5, rel=0.1)


def test_a_model_without_observed_sites_is_not_resampled():
    with pytest.raises(
        InputError, match="ensemble on model weighed: expected a plate of independent clusters"
    ):
        fit(weighed, {"y": Y}, engine="ensemble", key=KEY)


@dataclasses.dataclass
class Survey:
    """What a user keeps together."""

    distance: np.ndarray
    unit: str


def test_data_may_be_objects_that_are_neither_arrays_nor_hashable():
    def model(survey, y=None):
        mean = numpyro.sample("mean", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", 2):
            numpyro.sample("y", dist.Normal(mean * survey.distance, 1.0), obs=y)

    survey = Survey(np.ones(2), "m")
    first, inputs = build_target(model, {"survey": survey, "y": Y})
    again, _ = build_target(model, {"survey": survey, "y": Y})
    assert first is again
    survey.distance = np.full(2, 3.0)
    changed, _ = build_target(model, {"survey": survey, "y": Y})
    u = jnp.ones(1)
    assert changed.log_density(u, inputs) == pytest.approx(density_of(3.0, inputs))


def density_of(distance, inputs):
    """The log density of one standard deviation of the prior there, in nats."""
    mean = float(inputs.location[0] + inputs.scale[0])
    terms = stats.norm.logpdf(mean), 2 * stats.norm.logpdf(mean * distance), np.log(float(inputs.scale[0]))
    return sum(terms)


def walks(y=None):
    """A scan within a scan."""

    def inner(before, seen):
        now = numpyro.sample("state", dist.Normal(before, 1.0))
        numpyro.sample("y", dist.Normal(now, 1.0), obs=seen)
        return now, None

    scan(lambda before, seen: (scan(inner, before, seen)[0], None), 0.0, y)


@pytest.mark.parametrize("shape", [(4, 3), (3, 4)])
def test_a_scan_within_a_scan_is_refused(shape):
    """With fewer inner steps than outer ones there was an answer, of a density that was broadcast."""
    with pytest.raises(
        InputError, match=r"site 'state': expected latent sites within one scan.*Scan once over all"
    ):
        fit(walks, {"y": jnp.ones(shape)}, engine="laplace", key=KEY)
