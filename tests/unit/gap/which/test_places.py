"""Effects that may act anywhere: the best place is found, and paid for."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.fitting.refit import refit
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.tails import family_wise
from dtprob.gap.view import view
from dtprob.gap.which.confirm import confirm
from dtprob.gap.which.directions import surroundings
from dtprob.gap.which.places import place
from dtprob.gap.which.screen import screen
from dtprob.gap.which.search import search
from dtprob.gap.which.trials import tried
from dtprob.inference.laplace import Laplace
from tests.unit.gap.examples import PLACES, WIDTH, bump, draw, gusty, inputs, line, raised, ripple, use

FAST = replace(Settings(), replicates=99)


@pytest.fixture(scope="module")
def problem():
    return Problem(line, draw("line"), [bump(), ripple()])


@pytest.fixture(scope="module")
def looked(problem):
    """Shift of the mean and seed -> problem, base fit, projection and replicates on these data."""

    def look(shift=0.0, seed=1, of=problem, settings=FAST):
        data = draw("line", seed=seed, shift=shift)
        other = Problem(line, data, of.effects)
        base = fitting.fit(other, np.zeros(other.dimension))
        projection = project(other, base)
        return other, base, projection, replicate(other, base, projection, jax.random.key(seed), settings)

    return look


def test_scores_at_places_are_derivatives_in_the_size(looked):
    problem, base, _, drawn = looked()
    points = np.array([[0.0, -0.7], [0.0, 1.1]])
    around = surroundings(problem, base.x).grown()
    told = problem.programs.place_scores("bump", around, drawn.gradients, points)
    x, gradients = np.asarray(inputs()), np.asarray(drawn.gradients["mean"])
    by_hand = [(gradients * raised(x, at, 1.0)).sum(axis=(1, 2)) for at in points[:, 1]]
    np.testing.assert_allclose(told, by_hand, rtol=1e-4, atol=1e-4 * np.abs(by_hand).max())


@pytest.mark.parametrize(("at", "size"), [(-0.93, 2.5), (0.41, -2.5)])
def test_the_best_place_is_found_between_those_that_are_tried(looked, at, size):
    shift = raised(inputs(), at, size)
    problem, base, projection, drawn = looked(shift)
    placed, found = place(problem, base, drawn)
    moved = next(e for e in placed.effects if e.name == "bump").parameters[1]
    assert abs(moved.null - at) < 0.5 * WIDTH
    fine = np.arange(-1.5, 1.5, (PLACES[1] - PLACES[0]) / 9)
    points = np.stack([np.zeros_like(fine), fine], axis=1)
    around = surroundings(problem, base.x).grown()
    scores = problem.programs.place_scores("bump", around, drawn.gradients, points)
    largest = np.abs(scores[:, 0] / scores[:, 1:].std(axis=1)).argmax()
    assert abs(moved.null - fine[largest]) < 1.1 * (fine[1] - fine[0])
    assert float(moved.prior.mean) == moved.null
    assert found["bump"].p_value < 1e-4
    assert 1 < np.exp(found["bump"].price) < 9 * len(PLACES)
    seen = screen(placed, base, projection, drawn, Settings(), placed=found)
    assert seen.adjusted[seen.names.index("bump")] < 1e-3
    live = placed.with_live(["bump"])
    step = seen.step["bump"]
    x = live.translate(base.x, placed)
    x[live.layout["bump.c"].offset] = step[0]
    fitted = fitting.fit(live, x, ["bump"])
    assert abs(fitted.x[live.layout["bump.at"].offset] - at) < 0.2 * WIDTH
    assert fitted.log_evidence > base.log_evidence + 10


def test_an_effect_of_one_side_is_looked_for_on_that_side(looked):
    sided = Problem(line, draw("line"), [bump(dist.HalfNormal(2.0))])
    many = replace(
        FAST, replicates=400, site_replicates=400
    )  # a hundred tell a p-value of .03 to a factor of 5
    below, base, _, drawn = looked(-raised(inputs(), 0.4, 1.5), of=sided, settings=many)
    assert place(below, base, drawn)[1]["bump"].p_value > 0.01
    above, base, _, drawn = looked(raised(inputs(), 0.4, 1.5), of=sided)
    assert place(above, base, drawn)[1]["bump"].p_value < 1e-4


def test_energies_at_places_are_those_of_the_field_there(looked):
    problem, base, _, drawn = looked(of=Problem(line, draw("line"), [gusty()]))
    around = surroundings(problem, base.x).grown()
    told = problem.programs.place_scores(
        "gusty", around, drawn.gradients, np.array([[0.0, -0.7], [0.0, 1.1]])
    )
    for at, energies in zip((-0.7, 1.1), told, strict=True):
        size, place_of = gusty().parameters
        there = replace(gusty(), parameters=(size, replace(place_of, null=at)))
        expected = problem.programs.field_energy(around, drawn.gradients, [there])["gusty"][:, 0]
        np.testing.assert_allclose(energies, expected, rtol=1e-4)


def test_a_random_field_is_found_and_fitted_at_its_place(looked):
    """Heights of each link around one x: the place, their spread and both in the confirmed sizes."""
    heights = 1.5 * np.random.default_rng(5).normal(size=(len(inputs()), 1))
    problem, base, _, drawn = looked(
        heights * raised(inputs(), 0.4, 1.0), of=Problem(line, draw("line"), [gusty(), ripple()])
    )
    found = place(problem, base, drawn)[1]
    assert found["gusty"].p_value < 1e-4
    seen = view(problem, base, jax.random.key(2), FAST)
    assert seen.screening.names[int(seen.screening.log_bayes_factor.argmax())] == "gusty"
    trials = tried(seen, FAST, lambda _: None)
    fitted, end = trials.fits["gusty"], trials.problem
    at = end.layout["gusty.at"].offset
    assert abs(fitted.x[at] - 0.4) < 0.2 * WIDTH
    assert abs(fitted.spread["gusty"] - heights.std()) < 4 * heights.std() / np.sqrt(2 * len(heights))
    assert fitted.log_evidence > base.log_evidence + 10
    effect = next(e for e in end.effects if e.name == "gusty")
    sizes = {s.name: s for s in confirm(end, fitted, [effect], jax.random.key(0), Laplace())[0]}
    assert set(sizes) == {"height", "at"}
    assert sizes["height"].low < heights.std() < sizes["height"].high
    assert sizes["at"].low < fitted.x[at] < sizes["at"].high


def test_a_random_field_is_fitted_from_where_it_was_found_last(looked):
    """Tried at -1.7 before, found at 0.4 since."""
    heights = 1.5 * np.random.default_rng(5).normal(size=(len(inputs()), 1))
    shift = heights * raised(inputs(), 0.4, 1.0)
    height, at = gusty().parameters
    found = replace(gusty(), parameters=(height, replace(at, null=0.4)))
    problem, base, _, _ = looked(shift, of=Problem(line, draw("line"), [found]))
    live = problem.with_live(["gusty"])
    x = live.translate(base.x, problem)
    position = live.layout["gusty.at"].offset
    x[position] = -1.7
    fitted = refit(live, replace(base, x=x), found, [])
    assert abs(fitted.x[position] - 0.4) < 0.2 * WIDTH


def test_a_random_field_pays_for_its_place(looked):
    problem, base, projection, drawn = looked(of=Problem(line, draw("line"), [gusty()]))
    placed, found = place(problem, base, drawn)
    seen, free = (screen(placed, base, projection, drawn, Settings(), placed=f) for f in (found, {}))
    np.testing.assert_allclose(seen.p_value, found["gusty"].p_value)
    expected = family_wise(seen.p_value, found["gusty"].replicate_p)
    np.testing.assert_allclose(seen.adjusted, expected)
    np.testing.assert_allclose(free.log_bayes_factor - seen.log_bayes_factor, found["gusty"].price, rtol=1e-9)


@pytest.mark.study
def test_a_random_field_with_a_place_imitates_nothing(looked):
    """Where it was found the search does not start again without it."""
    heights = 1.5 * np.random.default_rng(5).normal(size=(len(inputs()), 1))
    of = Problem(line, draw("line"), [gusty(), ripple()])
    problem, base, _, _ = looked(heights * raised(inputs(), 0.4, 1.0), of=of)
    said = []
    found = search(problem, base, jax.random.key(3), FAST, said.append)
    assert found.steps[-1].end.fitted.effects == ("gusty",)
    assert not any("imitated" in line for line in said)


@pytest.mark.study
def test_a_random_field_is_not_found_where_there_is_none(looked):
    """The smallest of 40 p-values at the best place is no smaller than chance lets it be, one time in a thousand."""
    of = Problem(line, draw("line"), [gusty()])
    values = []
    for seed in range(1, 41):
        problem, base, _, drawn = looked(seed=seed, of=of)
        values.append(place(problem, base, drawn)[1]["gusty"].p_value)
    assert (np.array(values) < 0.05).sum() <= stats.binom.isf(1e-3, len(values), 0.05)


def test_an_effect_that_is_fitted_stays_where_it_is(looked):
    problem, base, _, drawn = looked(raised(inputs(), 0.4, 1.5))
    same, found = place(problem, replace(base, effects=("bump",)), drawn)
    assert same is problem
    assert not found


def test_a_live_effect_that_moves_is_fitted_from_its_new_place(looked):
    """Another effect is live after it, at a size that no fit may lose."""
    shift = raised(inputs(), 0.4, 2.5) + 0.5 * np.sin(3 * inputs())
    problem, base, _, _ = looked(shift)
    live = problem.with_live(["bump", "ripple"])
    x = live.translate(base.x, problem)
    x[live.layout["bump.at"].offset] = -1.7  # where it was tried before
    beside = fitting.fit(live, x, ["ripple"])
    seen = view(live, beside, jax.random.key(0), FAST)
    assert seen.problem.compiled is live.compiled
    assert [e.name for e in seen.problem.live] == ["bump", "ripple"]
    null = next(e for e in seen.problem.live if e.name == "bump").parameters[1].null
    assert abs(null - 0.4) < 0.5 * WIDTH
    found = tried(seen, FAST, lambda _: None)
    fitted, size = found.fits["bump"], found.problem.layout["ripple.c"].offset
    assert abs(fitted.x[found.problem.layout["bump.at"].offset] - 0.4) < 0.3 * WIDTH
    assert abs(fitted.x[size] - 0.5) < 0.3
    fresh = Problem(line, live.data, seen.problem.effects).with_live(["bump", "ripple"])
    again = fitting.fit(fresh, fitted.x, fitted.effects)
    np.testing.assert_allclose(again.log_evidence, fitted.log_evidence, atol=1e-3)


def test_what_is_not_there_has_a_negative_score(looked):
    sided = Problem(line, draw("line"), [bump(dist.HalfNormal(2.0))])
    problem, base, projection, drawn = looked(of=sided)
    placed, found = place(problem, base, drawn)
    seen = screen(placed, base, projection, drawn, Settings(), placed=found)
    z = seen.z[seen.names.index("bump")]
    np.testing.assert_allclose(stats.norm.sf(z), found["bump"].p_value, rtol=1e-6)
    np.testing.assert_allclose(seen.p_value[seen.names.index("bump")], found["bump"].p_value)
    replicate_p = found["bump"].replicate_p
    expected = family_wise(seen.p_value, replicate_p)  # there is no other effect
    np.testing.assert_allclose(seen.adjusted, expected)
    assert (replicate_p < 0.1).sum() <= stats.binom.isf(1e-3, len(replicate_p), 0.1)
    alone = replace(seen.scores, price=np.zeros(1))
    np.testing.assert_allclose(
        alone.log_bayes_factor - seen.scores.log_bayes_factor, found["bump"].price, rtol=1e-9
    )


DAYS = np.repeat(np.arange(8.0), 40)


def steps_on(true, size, seed=0):
    """Readings on eight days, a step since any of them being looked for: problem, base fit, projection, replicates."""

    def level(day, y=None):
        mean_level = numpyro.sample("level", dist.Normal(0.0, 10.0))
        with numpyro.plate("row", len(day)):
            mean = numpyro.deterministic("mean", mean_level + 0.0 * day)
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)

    since = Effect(
        "since",
        {"mean": lambda value, p, context: value + p["db"] * (context["day"] >= p["day"])},
        (
            Parameter("db", dist.Normal(0.0, 2.0)),
            Parameter(
                "day", dist.Normal(4.0, 2.0), null=4.0, is_place=True, tried=tuple(np.arange(1.0, 8.0))
            ),
        ),
    )
    y = size * (true <= DAYS) + np.random.default_rng(seed).normal(size=len(DAYS))
    problem = Problem(level, {"day": jnp.asarray(DAYS), "y": jnp.asarray(y)}, [since])
    base = fitting.fit(problem, problem.null())
    projection = project(problem, base)
    return problem, base, projection, replicate(problem, base, projection, jax.random.key(seed), FAST)


def test_what_would_be_noticed_is_told_of_a_typical_place():
    """A step on the last day needs 1.5 times the size of one in the middle; data may lead to either."""
    told = []
    for true in (4.0, 7.0):
        problem, base, projection, drawn = steps_on(true, 2.0)
        moved, found = place(problem, base, drawn)
        assert moved.effects[0].parameters[1].null == pytest.approx(true, abs=1.0)
        (one,) = screen(moved, base, projection, drawn, Settings(), placed=found).detectable
        told.append(one.size / np.sqrt(_needed(found["since"].price)))
    share = np.arange(1, 8) / 8
    expected = 1 / np.sqrt(len(DAYS) * np.median(share * (1 - share)))
    np.testing.assert_allclose(told, expected, rtol=0.2)  # 99 replicates tell a deviation to 7%


def _needed(price):
    """Information times the square of a size that is noticed nine times in ten."""
    return (stats.norm.isf(Settings().level / 4 / np.exp(price)) + stats.norm.ppf(0.9)) ** 2


def test_finer_looks_that_find_nothing_new_cost_nothing():
    """There are seven steps, each of which is tried."""
    problem, base, _, drawn = steps_on(4.0, 0.0)
    assert 1 < np.exp(place(problem, base, drawn)[1]["since"].price) <= 7


@pytest.mark.study
def test_the_best_of_many_places_is_as_rare_as_its_p_value_says():
    """Of 200 right twins, none too many below each level and none too few, by exact binomial bounds at 1e-3."""
    at = Parameter("at", dist.Normal(0.0, 1.2), is_place=True, tried=tuple(np.linspace(-2.0, 2.0, 61)))
    close = replace(bump(), parameters=(bump().parameters[0], at))
    problem, values = Problem(line, draw("line"), [close]), []
    for seed in range(1, 201):
        problem = use(problem, draw("line", seed=seed))
        base = fitting.fit(problem, problem.null())
        drawn = replicate(problem, base, project(problem, base), jax.random.key(seed), FAST)
        values.append(place(problem, base, drawn)[1]["bump"].p_value)
    for level in (0.01, 0.05, 0.2):
        assert (np.array(values) < level).sum() <= stats.binom.isf(1e-3, len(values), level)
    assert (np.array(values) < 0.2).sum() >= stats.binom.ppf(1e-3, len(values), 0.2)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (lambda tried: (Parameter("c", dist.Normal(), tried=tried),), "is_place=True"),
        (lambda tried: (Parameter("at", dist.HalfNormal(), is_place=True, tried=tried),), "normal prior"),
        (
            lambda tried: (
                Parameter("c", dist.Normal().expand([2]).to_event(1)),
                Parameter("at", dist.Normal(), is_place=True, tried=tried),
            ),
            "one size",
        ),
        (
            lambda tried: (
                Parameter("c", dist.Normal()),
                Parameter("d", dist.Normal()),
                Parameter("at", dist.Normal(), is_place=True, tried=tried),
            ),
            "one size",
        ),
    ],
)
def test_what_cannot_be_looked_for_is_refused(parameters, message):
    with pytest.raises(InputError, match=message):
        Effect("odd", {"mean": lambda value, p, _: value + p["c"]}, parameters((0.0, 1.0)))


@pytest.mark.parametrize(("sites", "tried"), [(("mean", "other"), (0.0, 1.0)), (("mean",), ())])
def test_a_random_field_acts_at_one_site_where_it_is_looked_for(sites, tried):
    at = Parameter("at", dist.Normal(), is_place=True, tried=tried)
    with pytest.raises(InputError, match="tried values of each place and then one site"):
        Effect(
            "odd",
            dict.fromkeys(sites, lambda value, p, _: value + p["field"]),
            (Parameter("c", dist.HalfNormal()), at),
            kind="variance",
        )


def test_a_place_of_several_entries_stands_beside_one_that_is_tried():
    effect = Effect(
        "step",
        {
            "mean": lambda value, p, context: (
                value
                + p["db"]
                * jax.nn.sigmoid((context["x"] - p["edge"]) / (0.2 + 0.01 * jnp.sum(p["width"] ** 2)))
            )
        },
        (
            Parameter("db", dist.HalfNormal(2.0)),
            Parameter("width", dist.Normal(0.0, 1.0).expand([2]).to_event(1), is_place=True),
            Parameter("edge", dist.Normal(0.0, 1.0), is_place=True, tried=(-0.5, 0.0, 0.5)),
        ),
    )

    def steps(x, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 10.0))
        with numpyro.plate("row", len(x)):
            mean = numpyro.deterministic("mean", level + 0.0 * x)
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)

    x = np.linspace(-1, 1, 200)
    y = 1.5 * (x > 0.5) + np.random.default_rng(0).normal(size=200)
    problem = Problem(steps, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, [effect])
    base = fitting.fit(problem, problem.null())
    seen = view(problem, base, jax.random.key(0), Settings(replicates=100, site_replicates=19), located=False)
    edge = next(e for e in seen.problem.effects if e.name == "step").parameters[2]
    assert edge.null == pytest.approx(0.5, abs=0.3)
