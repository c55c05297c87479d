"""Designs as data of a model: predictions of rival fits in closed form, and a rival split after a diagnosis."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.model.problem import Problem
from dtprob.gap.next_measurement.design import Design, Prediction, expected_evidence, joined, rank, recommend
from dtprob.gap.next_measurement.design_data import cheapest, designs_of, everything
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace

SIGMA = 0.3
FAST = Settings(replicates=100, site_replicates=39, candidates=2, polished=1)


def line(x, y=None):
    """A line with known noise."""
    level = numpyro.sample("a", dist.Normal(0.0, 2.0))
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", level + slope * x)
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def bend(power):
    """A term |x|^power."""
    return Effect(
        f"bend_{power}",
        {"mean": lambda v, p, c: v + p["c"] * jnp.abs(c["x"]) ** power},
        (Parameter("c", dist.Normal(0.0, 2.0)),),
        requires=("x",),
    )


EFFECTS = (bend(2), bend(3))


def data(x, truth, seed):
    noise = np.random.default_rng(seed).standard_normal(len(x))
    return {"x": jnp.asarray(x), "y": jnp.asarray(0.5 + x + 1.5 * np.abs(x) ** truth + SIGMA * noise)}


def test_predictions_are_those_of_a_linear_model():
    x, new = np.linspace(1, 2, 24), np.array([-3.0, 0.0, 3.0])
    plain = Problem(line, data(x, 2, 0), EFFECTS)
    problem = plain.with_live([effect.name for effect in EFFECTS])
    fits = [fitting.fit(problem, problem.null(), [effect.name]) for effect in EFFECTS]
    there = Problem(line, data(new, 2, 1), EFFECTS).with_live([effect.name for effect in EFFECTS])
    designs = designs_of(there, problem, fits, "new")
    assert [design.where for design in designs] == [{"design": "new", "row": k} for k in range(3)]
    for row, at in enumerate(new):
        means = []
        for rival, fitted in enumerate(fits):
            power = 2 + rival
            matrix = np.column_stack([np.ones_like(x), x, np.abs(x) ** power]) / SIGMA
            precision = matrix.T @ matrix + np.diag([1 / 4, 1 / 9, 1 / 4])
            np.testing.assert_allclose(fitted.covariance, np.linalg.inv(precision), rtol=1e-4)
            coefficients = np.linalg.solve(precision, matrix.T @ np.asarray(problem.data["y"]) / SIGMA)
            terms = np.array([1.0, at, np.abs(at) ** power])
            means.append(terms @ coefficients / SIGMA)
            found = designs[row].predictions[rival]
            np.testing.assert_allclose(found.tangents[0], terms / SIGMA, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(found.tangents[1], 0.0, atol=1e-9)
        first, second = designs[row].predictions
        assert second.mean[0] - first.mean[0] == pytest.approx(means[1] - means[0], rel=1e-3)
    assert rank(designs)[0].where["row"] in {0, 2}


def streets(x, street, y=None):
    """The line over rows of streets."""
    del street
    line(x, y)


@pytest.mark.parametrize(
    ("ids", "called"), [([207, 105, 311], [207, 105, 311]), ([207, 105, 311, 311], [105, 207, 311])]
)
def test_a_cluster_is_called_by_its_entry_however_often_that_is_there(ids, called):
    def rows(ids):
        x = np.linspace(1, 2, len(ids))
        return {**data(x, 2, 0), "street": jnp.asarray(ids)}

    names = [effect.name for effect in EFFECTS]
    here, there = (
        Problem(streets, rows(k), EFFECTS, "street").with_live(names)
        for k in (np.repeat([11, 12, 13, 14], 5), ids)
    )
    fits = [fitting.fit(here, here.null(), [name]) for name in names]
    assert [one.where["street"] for one in designs_of(there, here, fits, "elsewhere")] == called


def hierarchy(x, y=None):
    """A line on links whose levels are their own."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", x.shape[0], dim=-2):
        level = numpyro.sample("a", dist.Normal(0.0, 1.0))
        with numpyro.plate("sample", x.shape[1], dim=-1):
            mean = numpyro.deterministic("mean", level + slope * x)
            numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def test_a_new_links_own_level_is_known_by_its_prior_only():
    x = np.random.default_rng(0).normal(size=(8, 6))
    rng = np.random.default_rng(1)
    y = rng.normal(size=(8, 1)) + x + 0.5 * np.abs(x) ** 2 + SIGMA * rng.normal(size=x.shape)
    problem = Problem(hierarchy, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, EFFECTS).with_live(
        [effect.name for effect in EFFECTS]
    )
    fits = [fitting.fit(problem, problem.null(), [effect.name]) for effect in EFFECTS]
    first, second = designs_of(problem, problem, fits, "again")[2].predictions
    law = np.eye(6) + np.ones((6, 6)) / SIGMA**2
    located = first.tangents[np.abs(first.tangents[:, 0]) > 1e-9][:, 0]
    expected = x[2] / SIGMA
    assert located @ located == pytest.approx(expected @ np.linalg.solve(law, expected), rel=1e-6)
    slopes = [(f.x[problem.layout["b"].index[0, 0]], f.x[f.global_index][-1]) for f in fits]
    (b, c), (other, d) = slopes
    apart = ((b - other) * x[2] + c * np.abs(x[2]) ** 2 - d * np.abs(x[2]) ** 3) / SIGMA
    between = second.mean - first.mean
    assert between @ between == pytest.approx(apart @ np.linalg.solve(law, apart), rel=1e-6)


def flags(flag, z, y=None):
    """Links whose levels are their own."""
    with numpyro.plate("link", len(flag), dim=-2):
        level = numpyro.sample("a", dist.Normal(0.0, 1.0))
        with numpyro.plate("sample", 6, dim=-1):
            mean = numpyro.deterministic("mean", level + jnp.zeros((len(flag), 6)))
            numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def by(name):
    return Effect(
        f"by_{name}",
        {"mean": lambda v, p, c: v + p["c"] * c[name][:, None]},
        (Parameter("c", dist.Normal(0.0, 2.0)),),
        requires=(name,),
    )


def test_levels_that_rivals_fitted_otherwise_do_not_make_a_repeat_useless():
    rng, z = np.random.default_rng(0), np.linspace(-1, 1, 24)
    flag = (z > 0.2).astype(float)
    y = rng.normal(size=(24, 1)) + 3 * flag[:, None] + SIGMA * rng.normal(size=(24, 6))
    columns, effects = {"flag": flag, "z": z}, (by("flag"), by("z"))
    problem = Problem(flags, {**columns, "y": jnp.asarray(y)}, effects).with_live(["by_flag", "by_z"])
    fits = [fitting.fit(problem, problem.null(), [effect.name]) for effect in effects]
    (a,), (b,) = (fitted.x[fitted.global_index] for fitted in fits)
    designs = designs_of(problem, problem, fits, "again")
    for link in (0, 12, 23):
        first, second = designs[link].predictions
        expected = np.abs(b * z[link] - a * flag[link]) / np.sqrt(1.0 + SIGMA**2 / 6)
        assert np.linalg.norm(second.mean - first.mean) == pytest.approx(expected, rel=1e-6)


def slope_alone(x, y=None):
    """A line through the origin on links."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", slope * x)
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


LEVELS = Effect(
    "levels",
    {"mean": lambda v, p, c: v + p["s"] * p[FIELD]},
    (Parameter("s", dist.HalfNormal(1.0)),),
    kind="variance",
    field_shape=lambda v, _: (v.shape[0], 1),
)


def divergence(truth, rival):
    """Of two normal laws, mean and covariance of each."""
    (m, s), (other, v) = truth, rival
    inverse, d = np.linalg.inv(v), m - other
    logs = np.linalg.slogdet(v)[1] - np.linalg.slogdet(s)[1]
    return 0.5 * (np.trace(inverse @ s) - len(d) + d @ inverse @ d + logs)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_random_field_is_part_of_what_its_rival_predicts_whichever_comes_first(order):
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20, 6))
    y = x + 0.6 * rng.normal(size=(20, 1)) + 0.2 * x**2 + SIGMA * rng.normal(size=x.shape)
    effects = (bend(2), LEVELS)
    problem = Problem(slope_alone, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, effects)
    problem = problem.with_live([effect.name for effect in effects])
    fits = [fitting.fit(problem, problem.null(), [effect.name]) for effect in effects]
    designs = designs_of(problem, problem, [fits[k] for k in order], "again")

    def laws(links):
        """Of a bend's rows and of those that have levels, at some links."""
        flat = x[links].reshape(-1)
        columns = np.column_stack([flat, flat**2]), flat[:, None]
        noise = SIGMA**2 * np.eye(len(flat))
        level = fits[1].spread["levels"] ** 2 * np.kron(np.eye(len(links)), np.ones((6, 6)))
        return [
            (m @ f.x[f.global_index], noise + m @ f.covariance @ m.T + more)
            for m, f, more in zip(columns, fits, (0.0, level), strict=True)
        ]

    for links in ([0], [5], [0, 5]):
        found = joined([designs[link] for link in links]).predictions
        expected = laws(links)
        for truth, rival in ((0, 1), (1, 0)):
            nats = expected_evidence(found[order.index(truth)], found[order.index(rival)])
            assert nats == pytest.approx(divergence(expected[truth], expected[rival]), rel=1e-5)


@pytest.mark.study
def test_a_diagnosis_recommends_what_splits_its_class():
    x = np.linspace(0.3, 2.0, 40)
    wide = np.linspace(-3, 3, 7)
    options = {"key": jax.random.key(0), "engine": Laplace(draws=100), "settings": FAST}
    before = data(x, 2, 0)
    found = diagnose(line, before, EFFECTS, designs={"wide": data(wide, 2, 9)}, **options)
    assert found.verdict == "UNDETERMINED"
    plan = found.sections["next_measurement"]
    places = diagnose(
        line, before, EFFECTS, designs={"wide": {"x": list(wide)}}, **options
    )  # not measured yet
    assert places.sections["next_measurement"]["ranking"] == plan["ranking"]
    assert plan["resolves"]
    assert plan["design"]["design"] == "wide"
    costs = [one["cost"] for one in plan["ranking"] if one["resolves"]]
    assert costs == sorted(costs)
    assert plan["cost_of_all_again"] is None or plan["cost"] <= plan["cost_of_all_again"] / 5
    new = data(np.repeat(wide[np.atleast_1d(plan["design"]["row"])], plan["repeats"]), 2, 4)
    both = {name: jnp.concatenate([before[name], new[name]]) for name in before}
    after = diagnose(line, both, EFFECTS, **options)
    assert after.verdict == "LISTED"
    assert after.causes[0].effects == ("bend_2",)


@pytest.mark.study
def test_signs_of_an_effect_that_the_data_do_not_confirm_are_decided_against_the_twin_as_it_is():
    """Of a parabola the ends and the middle tell most; measured as often as it is said they confirm it."""
    x = np.linspace(0.3, 2.0, 40)

    def curve(x, seed):
        noise = np.random.default_rng(seed).standard_normal(len(x))
        return {"x": jnp.asarray(x), "y": jnp.asarray(0.5 + x + 0.4 * x**2 + SIGMA * noise)}

    options = {"key": jax.random.key(0), "engine": Laplace(draws=100), "settings": FAST}
    before = curve(x, 0)
    found = diagnose(line, before, EFFECTS[:1], **options)
    assert (found.verdict, found.causes[0].effects) == ("UNDETERMINED", ("bend_2",))
    plan = found.sections["next_measurement"]
    assert plan["split"] == [["bend_2"], []]
    assert plan["design"]["row"] == [0, 19, 39]
    assert plan["resolves"]
    new = curve(np.repeat(x[plan["design"]["row"]], plan["repeats"]), 4)
    both = {name: jnp.concatenate([before[name], new[name]]) for name in before}
    assert diagnose(line, both, EFFECTS[:1], **options).verdict == "LISTED"


def test_everything_again_is_a_plan_where_no_few_places_cost_less():
    """Unknown levels of 40 sites hide the same difference at each: a few sites never tell, all do at once."""
    levels = np.eye(40)

    def at(site, mean):
        return Prediction(np.array([mean]), levels[[site]], levels)

    gap = np.sqrt(1.525)
    again = [Design({"site": k}, 1.0, (at(k, 0.0), at(k, gap))) for k in range(40)]
    whole = everything(again)
    assert whole.cost == 40.0
    assert cheapest(again, whole) is whole
    few = recommend(again)
    assert few.cost > whole.cost
    assert cheapest(again, None) == few
    none = np.zeros((1, 0)), np.zeros((0, 0))
    plain = [
        Design({"site": k}, 1.0, tuple(Prediction(np.array([m]), *none) for m in (0.0, 3.0)))
        for k in range(4)
    ]
    assert cheapest(plain, everything(plain)).cost == 1.0


def many(x, group, y=None):
    """A level for each group."""
    level = numpyro.sample("a", dist.Normal(0.0, 2.0).expand([x.shape[0] // 4]))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", level[group])
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def test_designs_of_other_parameters_are_refused():
    def rows(n):
        return {"x": jnp.ones(n), "group": jnp.zeros(n, int), "y": jnp.ones(n)}

    names = [effect.name for effect in EFFECTS]
    here, there = (Problem(many, rows(n), EFFECTS).with_live(names) for n in (16, 8))
    fits = [fitting.fit(here, here.null(), [name]) for name in names]
    with pytest.raises(InputError, match="the 5 shared parameters of the fit, got 3"):
        designs_of(there, here, fits, "fewer")
