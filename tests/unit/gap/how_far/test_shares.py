"""Shapley's shares of a closed gap, against games of known value and against a line with two effects."""

from itertools import combinations

import jax
import numpy as np
import pytest
from scipy import stats

from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.shares import shapley, shares
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace
from tests.unit.gap.examples import SIGMA, bend, draw, inputs, line, ripple, saturation


def subsets(names):
    return [frozenset(c) for n in range(len(names) + 1) for c in combinations(names, n)]


def test_in_an_additive_game_everyone_has_his_own():
    worth = {"a": np.array([1.0, 2.0]), "b": np.array([0.5, 0.0]), "c": np.array([3.0, -1.0])}
    value = {s: sum((worth[n] for n in s), np.zeros(2)) for s in subsets("abc")}
    for name, found in shapley("abc", value).items():
        np.testing.assert_allclose(found, worth[name], atol=1e-12)


def test_gloves():
    """A pair of gloves is worth 1; a and b have a left one each, c the right one: 1/6, 1/6, 2/3."""
    value = {s: np.array([float("c" in s and len(s) > 1)]) for s in subsets("abc")}
    found = shapley("abc", value)
    np.testing.assert_allclose([found[n][0] for n in "abc"], [1 / 6, 1 / 6, 2 / 3], atol=1e-12)


def shared(effects, shift):
    data = draw("line", shift=shift)
    problem = Problem(line, data, effects).with_live([e.name for e in effects])
    base = fitting.fit(problem, problem.null())
    full = fitting.fit(problem, base.x, [e.name for e in effects])
    assignment = closed.folds(12, 4)
    held = closed.cross_fit(problem, base, assignment), closed.cross_fit(problem, full, assignment)
    return data, assignment, shares(problem, full, held, assignment, jax.random.key(2))


def least_squares_gain(data, assignment, columns):
    """Held-out nats of each subset of columns over none, by ridge regressions with the priors' precisions."""
    x, y = np.asarray(data["x"]), np.asarray(data["y"])
    result = {}
    for chosen in subsets(columns):
        a = np.stack([np.ones_like(x), x, *(columns[n](x) for n in sorted(chosen))], axis=-1)
        prior = np.diag([2.0**-2, 3.0**-2, *[1.0] * len(chosen)])
        total = 0.0
        for fold in np.unique(assignment):
            inside, out = a[assignment != fold], a[assignment == fold]
            flat = inside.reshape(-1, a.shape[-1])
            moment = flat.T @ y[assignment != fold].ravel() / SIGMA**2
            mean = np.linalg.solve(flat.T @ flat / SIGMA**2 + prior, moment)
            total += stats.norm(0, SIGMA).logpdf(y[assignment == fold] - out @ mean).sum()
        result[chosen] = total
    return result


def test_shares_agree_with_regressions_and_add_up():
    x = inputs()
    data, assignment, found = shared([bend(), ripple()], 0.6 * x**2 + 0.8 * np.sin(3 * x))
    columns = {"bend": lambda x: x**2, "ripple": lambda x: np.sin(3 * x)}
    value = least_squares_gain(data, assignment, columns)
    both, none = value[frozenset(columns)], value[frozenset()]
    exact = shapley(list(columns), {s: np.array([v]) for s, v in value.items()})
    assert {share.effect for share in found} == set(columns)
    assert sum(share.mean for share in found) == pytest.approx(1.0)
    for share in found:
        assert share.mean == pytest.approx(float(exact[share.effect][0]) / (both - none), abs=2e-3)
        left_out = value[frozenset(columns) - {share.effect}]
        assert share.own == pytest.approx((both - left_out) / (both - none), abs=2e-3)
        assert share.low < share.mean < share.high


def test_what_two_effects_can_both_explain_is_nobodys_own():
    """A bend and a saturation are both even: where only one is there, the other would do in part."""
    _, _, found = shared([bend(), saturation()], -0.7 * np.abs(inputs()) + 0.2 * inputs() ** 2)
    assert sum(share.mean for share in found) == pytest.approx(1.0)
    assert sum(share.own for share in found) < 0.9


def test_one_effect_needs_no_shares():
    assert shared([bend()], 0.6 * inputs() ** 2)[2] == ()


@pytest.mark.parametrize("offered", [[bend(), ripple()], [ripple(), bend()]])
def test_what_closes_most_is_named_first(offered):
    x = inputs()
    data = draw("line", shift=0.4 * x**2 + 1.5 * np.sin(3 * x))
    settings = Settings(replicates=40, site_replicates=20)
    found = diagnose(line, data, offered, engine=Laplace(), key=jax.random.key(0), settings=settings)
    shares = {share.effect: share.mean for share in found.causes[0].shares}
    assert shares["ripple"] > shares["bend"] > 0
    assert found.causes[0].effects == ("ripple", "bend")
    assert "ripple and bend" in found.summary
