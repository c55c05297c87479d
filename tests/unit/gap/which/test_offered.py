"""Effects that nothing observed shows at the usual place are looked for at others, at a price."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import view
from dtprob.gap.vocabulary import UNSEEN
from dtprob.gap.which.places import place
from dtprob.gap.which.search import search
from tests.unit.gap.examples import bump, draw, inputs, line, ripple, use

FAST = replace(Settings(), replicates=99)
USUAL, TRUE = 4.0, 0.8
"""Edges: nothing is observed beyond the usual one."""


def beyond(prior, usual=USUAL, size=None):
    """A slope beyond some edge."""

    def rewrite(value, p, context):
        return value + p["slope"] * jnp.maximum(context["x"] - p["edge"], 0.0)

    edge = Parameter("edge", prior, null=usual, is_place=True)
    return Effect("beyond", {"mean": rewrite}, (Parameter("slope", size or dist.HalfNormal(2.0)), edge))


def fitted_on(effects, slope=0.0, seed=1):
    data = draw("line", seed=seed, shift=slope * np.maximum(inputs() - TRUE, 0.0))
    problem = Problem(line, data, effects)
    return problem, fitting.fit(problem, problem.null())


def placed(problem, base, seed=0):
    return place(problem, base, replicate(problem, base, project(problem, base), jax.random.key(seed), FAST))


@pytest.mark.parametrize(
    "prior",
    [dist.Normal(USUAL, 1.5), dist.LogNormal(np.log(3.0), 0.7), dist.Gamma(4.0, 1.0)],
    ids=["normal", "quantiles", "draws"],
)
def test_an_effect_that_its_usual_place_does_not_show_is_found_and_its_prior_stands(prior):
    assert inputs().max() < USUAL
    problem, base = fitted_on([beyond(prior), ripple()], slope=2.0)
    found = search(problem, base, jax.random.key(0), FAST, lambda _: None)
    first, end = found.steps[0].view.screening, found.steps[-1].end
    k = first.names.index("beyond")
    assert first.absorbed_by[k] is None
    assert first.adjusted[k] < 1e-3
    assert end.fitted.effects == ("beyond",)
    slope, edge = (float(end.fitted.x[end.problem.layout[f"beyond.{p}"].offset]) for p in ("slope", "edge"))
    assert abs(slope - 2.0) < 1.2
    assert abs(edge - TRUE) < 0.5
    kept = next(e for e in end.problem.effects if e.name == "beyond").parameters[1]
    assert kept.prior is prior
    assert not kept.tried


def test_places_are_tried_only_where_the_usual_ones_tell_nothing():
    seen, named = beyond(dist.Normal(0.5, 1.5), usual=0.5), bump()
    problem, base = fitted_on([seen, named], slope=2.0)
    moved, found = placed(problem, base)
    assert set(found) == {"bump"}
    assert next(e for e in moved.effects if e.name == "beyond") is seen


@pytest.mark.parametrize(
    ("effect", "slope"),
    [
        (beyond(dist.Normal(USUAL, 0.1)), 2.0),
        (
            replace(
                beyond(dist.Normal(USUAL, 1.5)),
                parameters=(
                    Parameter("slope", dist.HalfNormal(2.0)),
                    Parameter("edge", dist.Normal(USUAL, 1.5), null=USUAL),
                ),
            ),
            0.0,
        ),
    ],
    ids=["its prior reaches nothing", "an edge that is called a size"],
)
def test_what_is_seen_nowhere_is_told_as_unseen(effect, slope):
    problem, base = fitted_on([effect], slope=slope)
    seen = view(problem, base, jax.random.key(0), FAST, located=False)
    assert seen.screening.absorbed_by == (UNSEEN,)
    assert seen.screening.log_bayes_factor[0] <= 0.0


def test_what_has_been_found_pays_for_its_place_in_later_looks_too():
    problem, base = fitted_on([beyond(dist.Normal(USUAL, 1.5))], slope=2.0)
    moved, first = placed(problem, base)
    _, again = placed(moved, base)
    assert first["beyond"].price > np.log(1.5)
    assert again["beyond"].price == pytest.approx(first["beyond"].price)


@pytest.mark.study
def test_the_choice_of_a_place_is_paid_for():
    """Of 200 right twins, none too many below each level by an exact binomial bound at 1e-3."""
    effect = beyond(dist.Normal(USUAL, 1.5), size=dist.Normal(0.0, 2.0))
    problem, _ = fitted_on([effect])
    values = []
    for seed in range(1, 201):
        problem = use(problem, draw("line", seed=seed))
        base = fitting.fit(problem, problem.null())
        values.append(placed(problem, base, seed)[1]["beyond"].p_value)
    for level in (0.01, 0.05, 0.2):
        assert (np.array(values) < level).sum() <= stats.binom.isf(1e-3, len(values), level)
