"""Screening: scores against closed forms, and false alarms over data sets without a gap."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats
from scipy.special import logsumexp

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import more, replicate
from dtprob.gap.fitting.plausible import SCALES
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.tails import family_wise, gamma_tail
from dtprob.gap.view import view
from dtprob.gap.where.locate import locate
from dtprob.gap.which.screen import screen
from dtprob.models.declaration import model
from tests.unit.gap.examples import SIGMA, bend, draw, inputs, jitter, line, pair, ripple, saturation, use

EFFECTS = (bend(), ripple(), ripple("ripple5", 5.0), pair(), saturation(), jitter())
FAST = Settings(replicates=200, site_replicates=99)


@pytest.fixture(scope="module")
def problem():
    return Problem(line, draw("line"), EFFECTS)


def fitted_to(problem, data):
    use(problem, data)
    return fitting.fit(problem, np.zeros(2), tolerance=1e-9)


def projection_of(x):
    """Whitened nuisance columns of the line, and what is left of any column after them."""
    columns = np.stack([np.ones(x.size), x.ravel()], axis=1) / SIGMA
    inverse = np.linalg.inv(columns.T @ columns + np.diag([2.0**-2, 3.0**-2]))
    return np.eye(x.size) - columns @ inverse @ columns.T


def look(problem, data, key=0, settings=FAST):
    fitted = fitted_to(problem, data)
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(key), settings)
    return fitted, projection, drawn, screen(problem, fitted, projection, drawn, settings)


def test_scores_are_those_of_neymans_test(problem):
    data = draw("line", shift=0.1 * inputs() ** 2)
    fitted, _, _, found = look(problem, data)
    x, y = np.asarray(data["x"]), np.asarray(data["y"])
    e = (y - fitted.x[0] - fitted.x[1] * x).ravel() / SIGMA
    left = projection_of(x)
    columns = {
        "bend": x**2,
        "ripple": np.sin(3 * x),
        "ripple5": np.sin(5 * x),
        "saturation": -np.abs(x),
    }
    for name, column in columns.items():
        w = column.ravel() / SIGMA
        z = (left @ w) @ e / np.sqrt(w @ left @ w)
        k = found.names.index(name)
        np.testing.assert_allclose(found.z[k], z, rtol=1e-6)
        p = stats.norm.sf(z) if name == "saturation" else 2 * stats.norm.sf(abs(z))
        np.testing.assert_allclose(found.p_value[k], p, rtol=1e-6)
        if name == "bend":  # prior N(0, 1): exact here, since all is Gaussian
            u, j = (left @ w) @ e, w @ left @ w
            np.testing.assert_allclose(found.step[name], [u / (j + 1)], rtol=1e-6)
            expected = logsumexp(0.5 * (SCALES**2 * u**2 / (SCALES**2 * j + 1) - np.log1p(SCALES**2 * j)))
            np.testing.assert_allclose(found.log_bayes_factor[k], expected - np.log(len(SCALES)), rtol=1e-6)
    k = found.names.index("pair")
    w = np.stack([x.ravel() ** 3 / 3, np.cos(2 * x.ravel())], axis=1) / SIGMA
    u, j = (left @ w).T @ e, w.T @ left @ w
    np.testing.assert_allclose(found.p_value[k], stats.chi2.sf(u @ np.linalg.solve(j, u), 2), rtol=1e-6)


def test_correlations_of_scores(problem):
    data = draw("line")
    found = look(problem, data)[3]
    x = np.asarray(data["x"]).ravel()
    left = projection_of(x)
    a, b = x**2, np.abs(x)
    expected = -(a @ left @ b) / np.sqrt(a @ left @ a * (b @ left @ b))
    i, k = found.names.index("bend"), found.names.index("saturation")
    np.testing.assert_allclose(found.correlation[i, k], expected, rtol=1e-6)


def test_a_variance_effect_follows_its_quadratic_form(problem):
    data = draw("line")
    settings = Settings(replicates=600, site_replicates=600)
    fitted, _, drawn, found = look(problem, data, settings=settings)
    x, y = np.asarray(data["x"]), np.asarray(data["y"])
    left = projection_of(x)
    member = np.kron(np.eye(len(x)), np.ones((x.shape[1], 1))) / SIGMA
    # Gradients are taken on rows that have been projected already.
    form = left @ member @ member.T @ left
    mean, variance = np.trace(form), 2 * np.trace(form @ form)
    energy = problem.programs.field_energy(
        {n: np.asarray(v) for n, v in problem.compiled.sites(fitted.x).items()},
        drawn.gradients,
        problem.effects,
    )["jitter"]
    energy = energy[:, 0]
    null = energy[1:]
    assert abs(null.mean() - mean) < 5 * np.sqrt(variance / len(null))
    assert abs(null.var() / variance - 1) < 0.35
    e = left @ ((y - fitted.x[0] - fitted.x[1] * x).ravel() / SIGMA)
    np.testing.assert_allclose(energy[0], ((member.T @ e) ** 2).sum(), rtol=1e-5)
    weights = np.linalg.eigvalsh(form)
    chance = np.random.default_rng(0).chisquare(1, (20_000, len(weights))) @ weights
    exact = (chance > energy[0]).mean()
    assert abs(found.p_value[found.names.index("jitter")] - exact) < 0.06


def test_gamma_tail_is_exact_and_goes_on_where_it_underflows():
    p, z = gamma_tail(np.array([7.0]), np.array([4.0]), np.array([8.0]))  # chi-square of 4
    np.testing.assert_allclose(p, stats.chi2.sf(7.0, 4), rtol=1e-9)
    np.testing.assert_allclose(z, stats.norm.isf(p), rtol=1e-9)
    values = np.geomspace(10, 1e5, 200)
    p, z = gamma_tail(values, np.full(200, 4.0), np.full(200, 8.0))
    assert np.all(np.isfinite(z))
    assert np.all(np.diff(z) > 0)
    np.testing.assert_allclose(z[-1], np.sqrt(2 * 0.5e5), rtol=0.01)
    assert gamma_tail(np.array([1.0]), np.array([0.0]), np.array([0.0]))[0] == 1.0


@pytest.mark.parametrize("m", [1, 20, 300])
def test_family_wise_matches_independent_tests(m):
    replicates = np.random.default_rng(m).uniform(size=(4000, m)).min(1)
    p = np.array([1e-4, 1e-3, 0.01]) / m
    np.testing.assert_allclose(family_wise(p, replicates), -np.expm1(m * np.log1p(-p)), rtol=0.15)


def test_family_wise_with_a_handful_of_replicates():
    assert 0.01 < family_wise(np.array([0.01]), np.random.default_rng(0).uniform(size=5))[0] < 0.05


def test_family_wise_sees_that_copies_are_one_test():
    replicates = np.random.default_rng(0).uniform(size=4000)
    np.testing.assert_allclose(family_wise(np.array([0.01]), replicates), 0.01, rtol=0.15)


def test_family_wise_sees_that_tests_are_more_far_out():
    """Tails that are heavier than their p-values say: P(min p <= t) = (100 t)^(1 / 1.4)."""
    replicates = np.random.default_rng(0).uniform(size=20_000) ** 1.4 / 100
    rare = np.array([0.005**1.4 / 100])
    assert family_wise(rare, replicates)[0] == pytest.approx(0.005, rel=0.2)
    assert family_wise(rare, replicates[:99])[0] < 0.004  # a few do not show it


def test_a_second_look_at_the_sites_is_of_new_replicates(problem):
    data = draw("line", seed=3)
    fitted, _, drawn, _ = look(problem, data)
    again = more(drawn, 5)
    assert again.at_sites == 5 * drawn.at_sites
    assert {n: len(g) for n, g in again.gradients.items()} == dict.fromkeys(
        drawn.gradients, 1 + again.at_sites
    )
    for name, gradient in again.gradients.items():
        np.testing.assert_array_equal(gradient[0], drawn.gradients[name][0])
        own = problem.compiled.site_gradient(fitted.x, again.rows[-1:])[name]
        np.testing.assert_allclose(gradient[-1], own[0], rtol=1e-6, atol=1e-12)
    alike = again.rows[1:, None] == drawn.rows[None, 1:]
    assert not alike.all(axis=(2, 3)).any()


@pytest.mark.study
def test_false_alarms_and_power_over_many_data_sets(problem):
    settings = Settings(replicates=60, site_replicates=60)
    n, level, strong = 100, 0.1, 5
    by_effects, by_sites, first = np.zeros(n), np.zeros(n), []
    for i in range(n + strong):
        data = draw("line", seed=100 + i, shift=0.25 * inputs() ** 2 * (i >= n))
        seen = view(problem, fitted_to(problem, data), jax.random.key(i), settings)
        if i < n:
            by_effects[i], by_sites[i] = seen.screening.adjusted.min(), seen.location.site_p_value
        else:
            first.append(seen.screening.names[int(seen.screening.p_value.argmin())])
            assert seen.screening.adjusted.min() < 0.01
    for p in (by_effects, by_sites):
        alarms = int((p <= level).sum())
        # An exact test would lie within; one that hardly ever speaks is no test.
        assert stats.binom.ppf(1e-3, n, level / 2) <= alarms <= stats.binom.ppf(0.999, n, level)
    assert first.count("bend") >= strong - 1


@pytest.fixture(scope="module")
def beside_a_field():
    """Scores and site tests of 100 data sets with a random level of each link, at fits that know of it."""
    problem = Problem(line, draw("line"), EFFECTS).with_live(["jitter"])
    settings = Settings(replicates=99, site_replicates=99)
    z, site = [], []
    for seed in range(100):
        level = 0.5 * SIGMA * np.random.default_rng(seed).normal(size=(12, 1))
        use(problem, draw("line", seed=1000 + seed, shift=level))
        fitted = fitting.fit(problem, problem.null(), ["jitter"], spread={"jitter": 0.5 * SIGMA})
        projection = project(problem, fitted)
        drawn = replicate(problem, fitted, projection, jax.random.key(seed), settings)
        found = screen(problem, fitted, projection, drawn, settings)
        z.append(found.z[[found.names.index(n) for n in ("bend", "ripple")]])
        site.append(locate(problem, fitted, projection, drawn, settings).site_p_value)
    return np.array(z), np.array(site)


@pytest.mark.study
def test_scores_beside_a_random_field_are_standard_normal(beside_a_field):
    """Mean and variance within a chance of 1 in 1,000, estimating the field's size apart."""
    z, _ = beside_a_field
    n = len(z)
    assert np.all(np.abs(z.mean(axis=0)) < 4 / np.sqrt(n))
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], n - 1) / (n - 1)
    assert np.all(z.var(axis=0, ddof=1) > 0.85 * low)
    assert np.all(z.var(axis=0, ddof=1) < 1.15 * high)


@pytest.mark.study
def test_sites_beside_a_random_field_raise_no_alarm(beside_a_field):
    _, p = beside_a_field
    assert np.sum(p <= 0.05) <= stats.binom.ppf(0.999, len(p), 0.07)


ENTRIES, WAITS = {"cause": 5, "shift": 20, "batch": 200, "server": 40}, 400


@model(axes={"log_wait": ("row",)}, cluster="server")
def waits(server, cause, shift, batch, load, *, wait=None):
    """Exponential waits, whose energies at the sites are skew."""
    level = numpyro.sample("level", dist.Normal(0.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    log_wait = numpyro.deterministic("log_wait", level + slope * load)
    with numpyro.plate("row", WAITS):
        numpyro.sample("wait", dist.Exponential(jnp.exp(-log_wait)), obs=wait)


def levels_of(column):
    """A level of its own for each value of a column."""
    return Effect(
        f"levels[{column}]",
        {"log_wait": lambda value, p, context: value + p["scale"] * p[FIELD][context[column]]},
        (Parameter("scale", dist.HalfNormal(0.5)),),
        kind="variance",
        field_shape=lambda value, context: (ENTRIES[column],),
    )


@pytest.mark.study
def test_more_replicates_decide_where_energies_are_skew():
    """A first look at 19 replicates rings in 15% of right twins; with 20 times more ones in less than 8%."""
    rng, load = np.random.default_rng(0), np.linspace(0.0, 1.0, WAITS)
    columns = {"server": np.repeat(np.arange(40), 10), "batch": np.arange(WAITS) % 200}
    columns |= {name: rng.integers(0, ENTRIES[name], WAITS) for name in ("cause", "shift")}
    data = {n: jnp.asarray(column) for n, column in {**columns, "load": load, "wait": np.ones(WAITS)}.items()}
    problem = Problem(waits, data, [levels_of(name) for name in ENTRIES], "server")
    rings = dict.fromkeys((1, 20), 0)
    for number in range(200):
        data["wait"] = jnp.asarray(rng.exponential(np.exp(0.5 + 0.4 * load)))
        fitted = fitting.fit(use(problem, data), np.zeros(2))
        for times in rings:
            settings = Settings(replicates=50, site_replicates=19, site_times=times)
            seen = view(problem, fitted, jax.random.key(number), settings, located=False)
            rings[times] += seen.screening.shows_gap(settings)
    assert rings[1] >= stats.binom.ppf(0.01, 200, 0.1)
    assert rings[20] <= stats.binom.ppf(0.99, 200, 0.04)
