"""Gauss-Newton fits against closed forms: mode, covariance, evidence, marginal likelihood, elimination."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize, stats
from scipy.special import logsumexp

from dtprob.effects import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.density import system_at
from dtprob.gap.fitting.marginal import marginal
from dtprob.gap.fitting.newton import positive
from dtprob.gap.fitting.plausible import SCALES
from dtprob.gap.model.problem import Problem
from tests.unit.gap.examples import (
    MODELS,
    SIGMA,
    bend,
    counts,
    draw,
    hierarchy,
    jitter,
    labels,
    line,
    logistic,
    saturation,
    seconds,
    spread,
    tone,
)


def design(x, *columns):
    """Regression matrix (observation, column)."""
    return np.stack([np.broadcast_to(c, x.shape).ravel() for c in columns], axis=1)


def conjugate(matrix, y, prior_sd, covariance):
    """Mean, covariance and log evidence of a Gaussian linear model, zero prior means."""
    precision = matrix.T @ np.linalg.solve(covariance, matrix) + np.diag(np.asarray(prior_sd) ** -2.0)
    mean = np.linalg.solve(precision, matrix.T @ np.linalg.solve(covariance, y))
    marginal = covariance + matrix @ np.diag(np.asarray(prior_sd) ** 2.0) @ matrix.T
    return mean, np.linalg.inv(precision), stats.multivariate_normal(np.zeros(len(y)), marginal).logpdf(y)


def arrays(data):
    return np.asarray(data["x"]), np.asarray(data["y"])


def test_gaussian_posterior_and_evidence_are_exact():
    data = draw("line")
    x, y = arrays(data)
    mean, covariance, evidence = conjugate(design(x, 1.0, x), y.ravel(), [2, 3], SIGMA**2 * np.eye(y.size))
    fitted = fitting.fit(Problem(line, data, [bend()]), np.zeros(2), tolerance=1e-10)
    assert fitted.converged
    np.testing.assert_allclose(fitted.x, mean, rtol=1e-6)
    np.testing.assert_allclose(fitted.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(fitted.log_evidence, evidence, rtol=1e-9)


def test_an_effects_parameter_joins_the_fit():
    data = draw("line", shift=0.4)
    x, y = arrays(data)
    matrix, noise = design(x, 1.0, x, x**2), SIGMA**2 * np.eye(y.size)
    mean, covariance, _ = conjugate(matrix, y.ravel(), [2, 3, 1], noise)
    evidence = logsumexp([conjugate(matrix, y.ravel(), [2, 3, s], noise)[2] for s in SCALES]) - np.log(
        len(SCALES)
    )
    problem = Problem(line, data, [bend()]).with_live(["bend"])
    fitted = fitting.fit(problem, problem.null(), ["bend"], tolerance=1e-10)
    np.testing.assert_allclose(fitted.x, mean, rtol=1e-6)
    np.testing.assert_allclose(fitted.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(fitted.log_evidence, evidence, rtol=1e-9)


def test_an_effect_that_is_not_free_stays_at_its_null():
    data = draw("line")
    problem = Problem(line, data, [bend()])
    live = problem.with_live(["bend"])
    plain = fitting.fit(problem, problem.null(), tolerance=1e-10)
    fitted = fitting.fit(live, live.null(), tolerance=1e-10)
    assert fitted.x[live.layout["bend.c"].offset] == 0.0
    np.testing.assert_allclose(fitted.log_evidence, plain.log_evidence, rtol=1e-10)


def test_units_do_not_matter():
    data = draw("seconds")
    x, y = arrays(data)
    unit = design(x, x, 1.0)  # in nanoseconds
    mean, covariance, evidence = conjugate(unit, y.ravel(), [1, 2], SIGMA**2 * np.eye(y.size))
    fitted = fitting.fit(Problem(seconds, data, [bend()]), np.zeros(2), tolerance=1e-10)
    size = np.array([1e-9, 1.0])
    np.testing.assert_allclose(fitted.x, size * mean, rtol=1e-6)
    np.testing.assert_allclose(fitted.covariance, np.outer(size, size) * covariance, rtol=1e-7)
    # Evidence does not depend on the unit of a coordinate.
    np.testing.assert_allclose(fitted.log_evidence, evidence, rtol=1e-8)


def _hierarchy_oracle(data):
    x, y = arrays(data)
    link = np.repeat(np.arange(len(x)), x.shape[1])
    same = (link[:, None] == link[None]).astype(float)
    return conjugate(design(x, x), y.ravel(), [3], SIGMA**2 * np.eye(y.size) + same)


@pytest.fixture(scope="module")
def local():
    data = draw("hierarchy")
    problem = Problem(hierarchy, data, [bend(), jitter()])
    return data, problem, fitting.fit(problem, problem.null(), tolerance=1e-12)


def test_local_coordinates_are_eliminated_exactly(local):
    data, problem, fitted = local
    mean, covariance, evidence = _hierarchy_oracle(data)
    slope = problem.layout["b"].offset
    np.testing.assert_allclose(fitted.x[slope], mean[0], rtol=1e-7)
    np.testing.assert_allclose(fitted.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(fitted.log_evidence, evidence, rtol=1e-9)
    x, y = arrays(data)
    offset = (y - mean[0] * x).sum(1) / SIGMA**2 / (x.shape[1] / SIGMA**2 + 1)
    np.testing.assert_allclose(fitted.x[problem.layout["offset"].index[:, 0]], offset, rtol=1e-6)


def test_marginal_likelihood_of_each_cluster_is_exact(local):
    data, problem, fitted = local
    x, y = arrays(data)
    covariance = SIGMA**2 * np.eye(x.shape[1]) + 1.0
    slope = fitted.x[problem.layout["b"].offset]
    expected = [stats.multivariate_normal(slope * a, covariance).logpdf(b) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(marginal(problem, fitted), expected, rtol=1e-6)


def test_marginal_does_not_need_the_clusters_coordinates(local):
    _, problem, fitted = local
    x = fitted.x.copy()
    x[problem.layout["offset"].index] = 5.0
    far = fitting.Fit(**{**fitted.__dict__, "x": x})
    np.testing.assert_allclose(marginal(problem, far), marginal(problem, fitted), atol=2e-3)


def test_marginal_integrates_the_field_of_a_variance_effect():
    data = draw("line", shift=0.8 * np.random.default_rng(8).normal(size=(12, 1)))
    problem = Problem(line, data, [jitter()]).with_live(["jitter"])
    fitted = fitting.fit(problem, problem.null(), ["jitter"], tolerance=1e-9, steps=200)
    x, y = arrays(data)
    sd = fitted.spread["jitter"]
    assert 0.4 < sd < 1.4
    a, b = fitted.x[problem.layout["a"].offset], fitted.x[problem.layout["b"].offset]
    covariance = SIGMA**2 * np.eye(x.shape[1]) + sd**2
    expected = [stats.multivariate_normal(a + b * u, covariance).logpdf(v) for u, v in zip(x, y, strict=True)]
    np.testing.assert_allclose(marginal(problem, fitted), expected, rtol=1e-6)


def test_spread_is_the_maximum_of_the_marginal_likelihood():
    data = draw("line", shift=0.8 * np.random.default_rng(8).normal(size=(12, 1)))
    problem = Problem(line, data, [jitter()]).with_live(["jitter"])
    fitted = fitting.fit(problem, problem.null(), ["jitter"], tolerance=1e-9, steps=300)
    x, y = arrays(data)
    link = np.repeat(np.arange(len(x)), x.shape[1])
    same = (link[:, None] == link[None]).astype(float)

    def loss(sd):
        return -conjugate(design(x, 1.0, x), y.ravel(), [2, 3], SIGMA**2 * np.eye(y.size) + sd**2 * same)[2]

    best = optimize.minimize_scalar(loss, bounds=(0.01, 3.0), method="bounded")
    # The EM step leaves out the uncertainty of the level, which all links share.
    np.testing.assert_allclose(fitted.spread["jitter"], best.x, rtol=0.08)
    np.testing.assert_allclose(fitted.log_evidence, -loss(fitted.spread["jitter"]), rtol=1e-6)


def test_clusters_without_weight_leave_the_fit():
    data = draw("line")
    x, y = arrays(data)
    weights = (np.arange(len(x)) % 3 > 0).astype(float)
    used = weights > 0
    mean, covariance, evidence = conjugate(
        design(x[used], 1.0, x[used]), y[used].ravel(), [2, 3], SIGMA**2 * np.eye(y[used].size)
    )
    problem = Problem(line, data, [bend()])
    fitted = fitting.fit(problem, np.zeros(2), weights=weights, tolerance=1e-10)
    np.testing.assert_allclose(fitted.x, mean, rtol=1e-6)
    np.testing.assert_allclose(fitted.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(fitted.log_evidence, evidence, rtol=1e-9)


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("logistic", logistic),
        ("counts", counts),
        ("labels", labels),
        ("spread", spread),
    ],
)
def test_modes_of_other_families_are_stationary(name, model):
    problem = Problem(model, draw(name), [bend()])
    fitted = fitting.fit(problem, problem.null(), tolerance=1e-10)

    def density(v):
        likelihood, prior, local = problem.compiled.terms(v, problem.compiled.arrays)
        return likelihood.sum() + prior + local.sum()

    slope, curvature = jax.grad(density)(jnp.asarray(fitted.x)), -jax.hessian(density)(jnp.asarray(fitted.x))
    assert fitted.converged
    assert float(slope @ jnp.linalg.solve(curvature, slope)) < 1e-6
    np.testing.assert_allclose(fitted.log_posterior, density(fitted.x), rtol=1e-10)
    ratio = np.diag(fitted.covariance) / np.diag(np.linalg.inv(curvature))
    assert np.all(np.abs(ratio - 1) < (0.35 if name == "spread" else 1e-6 if name != "spread" else 0))


def test_turned_phases_are_found_in_every_link():
    data = draw("tone")
    problem = Problem(tone, data, [bend()])
    fitted = fit_base(problem, jax.random.key(0))
    x, y = arrays(data)
    phase = fitted.x[problem.layout["phase"].index[:, 0]]
    best = np.angle((y * np.exp(-0.7j * x)).sum(1))
    assert np.abs(np.angle(np.exp(1j * (phase - best)))).max() < 0.02
    assert abs(np.exp(fitted.x[problem.layout["gain"].offset]) - MODELS["tone"][1]["gain"]) < 0.15


@pytest.fixture(scope="module")
def at_the_edge():
    """A fit whose one-sided effect would like to be negative, and the fit without it."""
    data = draw("line", shift=0.6 * np.abs(np.asarray(draw("line")["x"])))
    problem = Problem(line, data, [saturation()]).with_live(["saturation"])
    x = problem.null()
    x[problem.layout["saturation.c"].offset] = 0.3
    return (
        problem,
        fitting.fit(problem, x, ["saturation"]),
        fitting.fit(problem, problem.null(), tolerance=1e-9),
    )


def test_one_sided_parameters_stay_on_their_side(at_the_edge):
    problem, fitted, plain = at_the_edge
    assert fitted.x[problem.layout["saturation.c"].offset] == 0.0
    np.testing.assert_allclose(fitted.x[:2], plain.x[:2], atol=0.05)


def test_the_others_reach_their_mode_beside_an_edge(at_the_edge):
    _, fitted, plain = at_the_edge
    np.testing.assert_allclose(fitted.x[:2], plain.x[:2], atol=0.01)


def test_positive_does_not_depend_on_units():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3, 4, 4))
    matrix, size = a @ np.swapaxes(a, 1, 2), np.array([1e-9, 1.0, 1e6, 3.0])
    scaled = matrix * size[:, None] * size
    np.testing.assert_allclose(positive(scaled), scaled, rtol=1e-6, atol=0)
    wrong = np.diag([2.0, -3.0])
    assert np.linalg.eigvalsh(positive(wrong)).min() > 0


def test_a_start_whose_curvature_overflows_leads_nowhere():
    def level(x, y=None):
        error = numpyro.sample("error", dist.LogNormal(jnp.log(3.0), 0.7))
        mean = numpyro.deterministic("mean", x)
        with numpyro.plate("row", len(x)):
            numpyro.sample("y", dist.Normal(mean, error), obs=y)

    shift = Effect(
        "shift", {"mean": lambda v, p, c: v + p["size"]}, (Parameter("size", dist.Normal(0.0, 1.0)),)
    )
    with jax.enable_x64(False):  # in double precision it takes a far larger error
        x = jnp.linspace(0, 1, 50)
        problem = Problem(level, {"x": x, "y": x + 0.1}, [shift])
        assert fitting.fit(problem, np.array([84.4])).log_posterior == -np.inf
        assert np.isfinite(fit_base(problem, jax.random.key(0)).log_posterior)


@pytest.mark.parametrize("own", [1e-300, 1e-60, 1e-35])
def test_positive_can_be_inverted_where_a_coordinate_bends_only_with_others(own):
    matrix = np.array(
        [[own, 3.0, 1.0, 2.0], [3.0, 2.0, 0.5, 1.0], [1.0, 0.5, 1.0, 1.0], [2.0, 1.0, 1.0, 3.0]]
    )
    assert np.all(np.isfinite(np.linalg.inv(positive(matrix))))


def test_unknowns_that_go_together_arrive_however_far_they_have_to_go():
    """Steps end ten standard deviations of a prior away; cut coordinate by coordinate they led downhill, as if arrived."""

    def far(x, y=None):
        level, slope = numpyro.sample("a", dist.Normal(0.0, 1.0)), numpyro.sample("b", dist.Normal(0.0, 2.0))
        mean = numpyro.deterministic("mean", level + slope * x)
        with numpyro.plate("row", len(x)):
            numpyro.sample("y", dist.Normal(mean, 0.05), obs=y)

    rng = np.random.default_rng(0)
    x = rng.uniform(0.7, 1.3, 400)
    y = 100 - 85 * x + 0.05 * rng.normal(size=400)
    found = fitting.fit(Problem(far, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, [], "row"), np.zeros(2))
    design = np.stack([np.ones(400), x], axis=1)
    precision = design.T @ design / 0.05**2 + np.diag([1.0, 0.25])
    np.testing.assert_allclose(found.x, np.linalg.solve(precision, design.T @ y / 0.05**2), atol=1e-3)
    assert found.converged


def test_the_farthest_step_knows_the_base_model_alone():
    """What is known of the prior may come from a problem with larger live effects."""
    sizes = Parameter("one", dist.Normal(0.0, 1.0)), Parameter("two", dist.Normal(0.0, 1.0))
    wide = Effect("wide", {"mean": lambda value, p, _: value + p["one"] + p["two"] * value}, sizes)
    start = Problem(line, draw("line"), [wide, bend()]).with_live(["wide"])
    fitting.fit(start, start.null(), ("wide",))
    other = start.with_live([bend().name])
    assert fitting.fit(other, other.null(), (bend().name,)).converged


def amplified(u, y=None, z=None):
    """An amplitude behind a loss, which is measured apart."""
    loss = numpyro.sample("loss", dist.Normal(0.0, 3.0))
    amplitude = numpyro.sample("amplitude", dist.Normal(0.0, 50.0))
    with numpyro.plate("link", u.shape[0]):
        numpyro.sample("z", dist.Normal(numpyro.deterministic("known", loss + 0.0 * u), 0.1), obs=z)
        received = numpyro.deterministic("received", amplitude * jnp.exp(-loss) * u)
        numpyro.sample("y", dist.Normal(received, 0.05), obs=y)


@pytest.mark.parametrize(("loss", "amplitude"), [(4.0, 0.5), (6.0, 27.0)])
def test_kept_curvatures_do_not_end_a_fit_where_others_have_fallen(loss, amplitude):
    """The loss arrives in one step as promised, while the amplitude's curvature falls by a factor of thousands."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=100)
    y = amplitude * np.exp(-loss) * u + 0.05 * rng.normal(size=100)
    z = loss + 0.1 * rng.normal(size=100)
    data = {"u": jnp.asarray(u), "y": jnp.asarray(y), "z": jnp.asarray(z)}
    fitted = fitting.fit(Problem(amplified, data, []), np.zeros(2))
    expected = [np.mean(z), np.exp(np.mean(z)) * (u @ y) / (u @ u)]
    assert fitted.converged
    np.testing.assert_allclose(fitted.x, expected, rtol=0.02)


def test_a_fit_with_kept_curvatures_makes_fewer_systems_and_ends_where_it_would(monkeypatch):
    problem, made = Problem(spread, draw("spread"), []), []
    monkeypatch.setattr(fitting, "system_at", lambda *a: made.append(1) or system_at(*a))
    start = problem.null() + 1.0
    kept = fitting.fit(problem, start, tolerance=1e-8)
    count = len(made)
    monkeypatch.setattr(fitting, "_AS_PROMISED", (2.0, 1.0))
    anew = fitting.fit(problem, start, tolerance=1e-8)
    assert count < len(made) - count
    np.testing.assert_allclose(kept.x, anew.x, rtol=1e-5)
    np.testing.assert_allclose(kept.log_evidence, anew.log_evidence, rtol=1e-8)
