"""Rivals of the diagnosis: against closed forms, and where each is known to be right or wrong."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.compete import RIVALS
from dtprob.gap.withheld.rivals.criteria import bic, loo
from dtprob.gap.withheld.rivals.discrepancy import VARIANCES, evidences, inputs
from dtprob.gap.withheld.rivals.lasso import extended_bic, lasso, path
from dtprob.gap.withheld.rivals.look import chance, look
from dtprob.gap.withheld.rivals.stepwise import LOO
from tests.unit.gap.examples import SIGMA, bend, draw, hierarchy, jitter, line, ripple
from tests.unit.gap.examples import inputs as regressors

SETTINGS = Settings(candidates=2, max_effects=2)
HIDDEN = 0.25
"""Part of the hidden effect that is no multiple of the slope."""


def ordinary(effect: str, shape):
    """An effect that adds c times a function of x to the mean."""

    def rewrite(value, p, context):
        return value + p["c"] * shape(context["x"])

    return Effect(effect, {"mean": rewrite}, (Parameter("c", dist.Normal(0.0, 20.0)),))


def hidden():
    """An effect most of which the slope imitates."""
    return ordinary("hidden", lambda x: x + HIDDEN * jnp.cos(5 * x))


def shadow():
    """Much like what is left of the hidden one, and like nothing that the model fits."""
    return ordinary("shadow", lambda x: jnp.cos(5 * x) + jnp.sin(9 * x))


def wave():
    """A wave that no candidate looks like."""
    return ordinary("wave", lambda x: jnp.sign(x) * jnp.sqrt(jnp.abs(x)))


def seen(data, effects):
    problem = Problem(line, data, effects)
    return look(problem, fitting.fit(problem, np.zeros(2)), jax.random.key(0), SETTINGS)


def normal_log_density(y, mean, covariance):
    return stats.multivariate_normal(mean, covariance).logpdf(y)


def conditional(covariance, y, mine):
    """Log density of some entries given the others, zero means."""
    rest = ~mine
    gain = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[np.ix_(rest, mine)]).T
    left = covariance[np.ix_(mine, mine)] - gain @ covariance[np.ix_(rest, mine)]
    return normal_log_density(y[mine], gain @ y[rest], left)


@pytest.mark.parametrize("name", ["line", "hierarchy"])
def test_leave_one_out_is_exact_for_normal_models(name):
    """With nuisances shared by all clusters and with some of each cluster's own."""
    data = draw(name)
    x, y = np.asarray(data["x"]), np.asarray(data["y"]).ravel()
    cluster = np.repeat(np.arange(len(x)), x.shape[1])
    if name == "line":
        covariance, model, size = 4 + 9 * np.outer(x, x), line, 2
    else:
        covariance, model, size = (cluster[:, None] == cluster) + 9.0 * np.outer(x, x), hierarchy, 1 + len(x)
    covariance = covariance + SIGMA**2 * np.eye(y.size)
    problem = Problem(model, data, [bend()])
    found = loo(problem, fitting.fit(problem, np.zeros(size), tolerance=1e-10))
    expected = [conditional(covariance, y, cluster == c) for c in range(len(x))]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_bic_is_the_likelihood_at_the_effect_with_nuisances_integrated_out():
    data = draw("line", shift=0.3)
    x, y = np.asarray(data["x"]).ravel(), np.asarray(data["y"]).ravel()
    problem = Problem(line, data, [bend(), ripple()]).with_live(["bend"])
    fitted = fitting.fit(problem, np.zeros(3), ["bend"], tolerance=1e-10)
    size = fitted.x[problem.layout["bend.c"].index[0, 0]]
    covariance = 4 + 9 * np.outer(x, x) + SIGMA**2 * np.eye(y.size)
    expected = normal_log_density(y - size * x**2, np.zeros(y.size), covariance) - 0.5 * np.log(y.size)
    assert bic(problem, fitted).sum() == pytest.approx(expected, rel=1e-8)


def test_bic_of_a_random_field_integrates_it_out():
    data = draw("line")
    x, y = np.asarray(data["x"]).ravel(), np.asarray(data["y"]).ravel()
    y = y + np.repeat(np.random.default_rng(3).normal(size=len(data["x"])), data["x"].shape[1])
    data = {"x": data["x"], "y": jnp.asarray(y.reshape(data["x"].shape))}
    problem = Problem(line, data, [jitter()]).with_live(["jitter"])
    fitted = fitting.fit(problem, problem.null(), ["jitter"], tolerance=1e-10)
    own = np.repeat(np.arange(len(data["x"])), data["x"].shape[1])
    covariance = 4 + 9 * np.outer(x, x) + SIGMA**2 * np.eye(y.size)
    covariance = covariance + fitted.spread["jitter"] ** 2 * (own[:, None] == own)
    expected = normal_log_density(y, np.zeros(y.size), covariance) - 0.5 * np.log(y.size)
    assert bic(problem, fitted).sum() == pytest.approx(expected, rel=1e-6)


def test_leave_one_out_chooses_what_is_clearly_better_only():
    assert LOO.better(np.full(50, 0.2))
    assert not LOO.better(np.full(50, 0.05))  # 2.5 nats
    assert not LOO.better(np.array([30.0, *np.zeros(49)]))  # one cluster's doing


def test_orthogonal_features_are_shrunk_by_the_penalty():
    score = np.array([3.0, -2.0, 1.0, -0.5])
    knots = list(path(score, np.eye(4), np.zeros(4, bool)))
    for b, penalty in zip(knots, [3.0, 2.0, 1.0, 0.5, 0.0], strict=True):
        np.testing.assert_allclose(b, np.sign(score) * np.maximum(abs(score) - penalty, 0), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_every_knot_of_a_path_is_optimal(seed):
    """The conditions of Karush, Kuhn and Tucker, with some coefficients that may not be negative."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(30, 12)) + 1.5 * rng.normal(size=(30, 1))
    matrix /= np.linalg.norm(matrix, axis=0)
    response, positive = 3 * rng.normal(size=30), np.arange(12) % 3 == 0
    for b in path(matrix.T @ response, matrix.T @ matrix, positive):
        c = matrix.T @ (response - matrix @ b)
        penalty = np.where(positive, c, abs(c)).max()
        on = b != 0
        np.testing.assert_allclose(c[on], penalty * np.sign(b[on]), atol=1e-8)
        assert np.all(b[positive] >= 0)


def test_extended_bic_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    matrix, response = rng.normal(size=(30, 5)), rng.normal(size=30)
    kept = np.array([True, False, True, False, False])
    found = extended_bic(kept, matrix.T @ response, matrix.T @ matrix, 30)
    left = response - matrix[:, kept] @ np.linalg.lstsq(matrix[:, kept], response, rcond=None)[0]
    expected = left @ left - response @ response + 2 * np.log(30) + 2 * np.log(10)  # 10 pairs of five
    assert found == pytest.approx(expected)


def test_nothing_joins_a_path_that_may_not():
    knots = list(path(np.array([-1.0, -2.0]), np.eye(2), np.ones(2, bool)))
    assert len(knots) == 1
    assert not knots[0].any()


def test_evidence_of_a_process_is_the_ratio_of_normal_densities():
    rng = np.random.default_rng(0)
    features, residual = rng.normal(size=(20, 6)), 2 * rng.normal(size=20)
    found = evidences(features.T @ features, (features.T @ residual)[None])[0]
    zero, one = np.zeros(20), np.eye(20)
    expected = [
        normal_log_density(residual, zero, one + v * features @ features.T)
        - normal_log_density(residual, zero, one)
        for v in VARIANCES
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_inputs_of_a_process():
    """Places along the axes and the regressor, but neither what was observed nor what does not vary."""
    x = regressors()
    data = {"x": jnp.asarray(x), "y": jnp.asarray(x + 1), "constant": jnp.ones(len(x)), "power": 3.0}
    site = SimpleNamespace(shape=x.shape)
    declared = SimpleNamespace(sites={"y": site})
    observed = SimpleNamespace(values={"y": data["y"]})
    found = inputs(SimpleNamespace(declaration=declared, observed=observed, data=data), "y")
    assert found.shape == (*x.shape, 3)
    np.testing.assert_allclose(found.std(axis=(0, 1)), 1.0)
    assert np.corrcoef(found[..., 2].ravel(), x.ravel())[0, 1] == pytest.approx(1.0)


def test_chance_is_a_rank():
    assert chance(np.array([5.0, *np.arange(4), 5.0])) == pytest.approx(2 / 6)
    assert chance(np.array([9.0, *np.zeros(99)])) == 0.01


def test_nothing_is_named_without_an_alarm():
    claim = Claim(0.02, ("bend",), ("bend", "ripple"))
    assert claim.to_report(0.01)["verdict"] == "NO_GAP"
    assert claim.to_report(0.01)["causes"] == []
    alarm = claim.to_report(0.05)
    assert (alarm["verdict"], alarm["causes"][0]["effects"]) == ("LISTED", ["bend"])
    assert Claim(0.0, (), ("bend",)).to_report(0.01)["verdict"] == "UNDETERMINED"
    assert Claim(0.0, ("bend",), ("bend",), unlisted=True).to_report(0.01)["verdict"] == "UNLISTED"


@pytest.fixture(scope="module")
def masked():
    """An effect that the slope mostly absorbs, beside one that looks like the rest of it and is not absorbed."""
    x = regressors(n_link=40)
    shift = 6.0 * (x + HIDDEN * np.cos(5 * x))
    return seen(draw("line", shift=shift, x=x), [hidden(), shadow(), ripple()])


@pytest.mark.parametrize(
    ("rival", "named"),
    [("unadjusted", ("shadow",)), ("forward_bic", ("hidden",)), ("forward_loo", ("hidden",))],
)
def test_unadjusted_scores_are_fooled_by_what_a_nuisance_absorbs(masked, rival, named):
    claim = RIVALS[rival](masked, jax.random.key(1), SETTINGS)
    assert claim.p_value == 0.01
    assert claim.effects == named


def test_the_lasso_names_a_single_strong_effect_first():
    data = draw("line", shift=0.4 * np.asarray(regressors(n_link=40)) ** 2, x=regressors(n_link=40))
    claim = lasso(seen(data, [bend(), ripple(), jitter()]))
    assert claim.p_value == 0.01
    assert claim.effects == ("bend",)


def test_a_process_knows_when_none_of_the_candidates_is_like_it():
    x = regressors(n_link=40)
    foreign = draw("line", shift=1.5 * np.sign(x) * np.sqrt(np.abs(x)), x=x)
    claims = {}
    for candidate in (wave(), bend()):
        view = seen(foreign, [candidate, ripple("ripple", 20.0)])
        claims[candidate.name] = RIVALS["gaussian_process"](view, jax.random.key(0), SETTINGS)
    assert {claim.p_value for claim in claims.values()} == {0.01}
    assert not claims["wave"].unlisted
    assert claims["wave"].effects == ("wave",)
    assert claims["bend"].unlisted


def test_sound_data_alarm_nobody():
    view = seen(draw("line", seed=5), [bend(), ripple(), jitter()])
    for rival in RIVALS.values():
        assert rival(view, jax.random.key(0), SETTINGS).p_value > 0.01
