"""What a fit maximises: the scores of a system against gradients, and those that are made anew beside kept curvatures."""

from dataclasses import replace

import numpy as np
import pytest

from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.density import rescored, system_at, value_of
from dtprob.gap.model.problem import Problem
from tests.unit.gap.examples import MODELS, bend, draw, jitter

NAMES = ("line", "hierarchy", "spread", "logistic", "counts", "labels", "tone")


def live(name, effects=()):
    """A model's problem with effects free, a point off its mode, and another one beside it."""
    made = {"bend": bend(), "jitter": jitter()}
    problem = Problem(MODELS[name][0], draw(name), [made[e] for e in effects] or [bend()]).with_live(effects)
    rng = np.random.default_rng(3)
    x = problem.null() + 0.1 * rng.normal(size=problem.dimension)
    return problem, x, x + 0.05 * rng.normal(size=problem.dimension)


@pytest.mark.parametrize("name", NAMES)
def test_scores_are_the_slope_of_the_log_posterior(name):
    problem, x, _ = live(name)
    active = activate(problem)
    system = system_at(problem, active, x)
    steps = 1e-5 * np.eye(problem.dimension)
    slope = np.array(
        [(value_of(problem, active, x + s) - value_of(problem, active, x - s)) / 2e-5 for s in steps]
    )
    scale = np.abs(slope).max()
    np.testing.assert_allclose(system.gradient, slope[active.global_index], atol=1e-6 * scale)
    np.testing.assert_allclose(system.local_gradient, slope[active.local_index], atol=1e-6 * scale)


@pytest.mark.parametrize(
    ("name", "effects"),
    [*((name, ()) for name in NAMES), ("line", ("bend", "jitter")), ("hierarchy", ("jitter",))],
)
def test_scores_made_anew_are_those_of_a_new_system(name, effects):
    problem, x, beside = live(name, effects)
    weights = np.arange(problem.n_cluster) % 3.0 / 2
    active = activate(problem, effects, weights)
    moved = replace(active, spread={k: 2 * sd for k, sd in active.spread.items()})
    before, there = system_at(problem, active, x), system_at(problem, moved, beside)
    found = rescored(problem, moved, beside, before)
    np.testing.assert_allclose(found.gradient, there.gradient, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found.local_gradient, there.local_gradient, rtol=1e-7, atol=1e-7)


def test_a_field_whose_spread_changes_takes_its_priors_curvature_along():
    problem, x, _ = live("line", ("jitter",))
    active = activate(problem, ("jitter",))
    wide = replace(active, spread={"jitter": 7 * active.spread["jitter"]})
    kept = rescored(problem, wide, x, system_at(problem, active, x))
    anew = system_at(problem, wide, x)
    np.testing.assert_allclose(kept.curvature, anew.curvature, rtol=1e-9)
    np.testing.assert_allclose(kept.local, anew.local, rtol=1e-9)
