"""The remainder at its site: against exact regression, calibrated in simulation, honest where nothing carries over."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.calibration import calibration
from dtprob.gap.how_far.remainder import (
    _has_to_be_positive,
    _held,
    _without,
    alone,
    model_remainder,
    shortlist,
)
from dtprob.gap.how_far.site_field import field_of
from dtprob.gap.model.problem import Problem
from dtprob.gap.where.along import curves
from dtprob.gap.where.families import Family, Pattern, deterministic, families
from dtprob.gap.where.quantities import quantity
from dtprob.gap.where.suspects import Suspect
from dtprob.gap.which.fields import common_spread
from tests.unit.gap.examples import MODELS, draw, inputs

SIGMA = 0.5
N_ROW = 240


def table(x, place, street, y=None):
    """A line over rows at places, in streets; the noise is known."""
    del place, street
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", slope * x)
        deviation = numpyro.deterministic("deviation", jnp.full(len(x), SIGMA))
        numpyro.sample("y", dist.Normal(mean, deviation), obs=y)


def raw(x, place, street, y=None):
    """The same with no named site."""
    del place, street
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(slope * x, SIGMA), obs=y)


def rows(seed, shift=0.0, loudness=1.0, streets=24):
    """Data of a line whose mean is shifted and whose noise is louder by functions of (place, street) or constants."""
    rng = np.random.default_rng(seed)
    x, place = rng.normal(size=N_ROW), rng.uniform(0, 1, N_ROW)
    street = rng.permutation(np.repeat(np.arange(streets), N_ROW // streets))
    noise = SIGMA * rng.normal(size=N_ROW)

    def at(value):
        return value(place, street) if callable(value) else value

    y = 1.3 * x + at(shift) + at(loudness) * noise
    return {"x": x, "place": place, "street": street, "y": y}


def suspect(problem, label, spread=1.0, *, site="mean", kind="additive", evidence=50.0):
    """The family of a label."""
    rows = {"location": (0,), "spread": (1,)}.get(kind)
    pattern = Pattern(label, (0,), next(c for c in curves(problem, "row", N_ROW) if c.label == label))
    return Suspect(site, rows, Family(kind, pattern, np.ones(())), spread, evidence, evidence, 0.0)


def prepared(data, model=table, cluster="street"):
    """The problem, its fit, the folds' fits and held-out results."""
    problem = Problem(model, data, [], cluster)
    fitted = fitting.fit(problem, np.zeros(1))
    assignment = closed.folds(problem.n_cluster, 4)
    parts = list(closed.fold_fits(problem, fitted, assignment))
    return problem, fitted, parts, closed.judged(problem, parts)


def modelled(data, labels, model=table, *, charged=0.0, **options):
    problem, fitted, parts, held = prepared(data, model)
    parts = [part._replace(charged=np.full(problem.n_cluster, charged)) for part in parts]
    suspects = [suspect(problem, label, **options) for label in labels]
    best = float(held.log_likelihood.sum()) + 1e-9
    view = SimpleNamespace(problem=problem, fitted=fitted, location=SimpleNamespace(suspects=tuple(suspects)))
    return held, model_remainder(view, parts, held, best, jax.random.key(1))


def wave(place, _):
    return 0.8 * np.sin(7.0 * place)


def levels(_, street):
    return 0.7 * np.random.default_rng(9).normal(size=street.max() + 1)[street]


def loud(_, street):
    return np.exp(0.8 * np.random.default_rng(9).normal(size=street.max() + 1))[street]


def test_the_spread_of_unit_weights_has_the_largest_evidence():
    rng = np.random.default_rng(0)
    information, truth = np.full(2000, 4.0), 0.6
    scores = information * truth * rng.normal(size=2000) + 2.0 * rng.normal(size=2000)
    spread, evidence = common_spread(scores, information)
    total = 4.0 + 16.0 * truth**2  # variance of a score
    exact = stats.norm(0, np.sqrt(total)).logpdf(scores).sum() - stats.norm(0, 2.0).logpdf(scores).sum()
    assert spread == pytest.approx(truth, rel=0.3)  # the grid's step is a quarter
    assert evidence == pytest.approx(exact, rel=0.05)
    assert common_spread(2.0 * rng.normal(size=2000), information)[1] < 3.0


def test_a_field_along_a_curve_is_exact_normal_regression():
    """Evidence and held-out mean of the refit with a field, against the same Gaussian process in closed form."""
    problem = Problem(table, rows(1, wave), [], "street")
    one = suspect(problem, "along place", 0.3)
    wider = problem.with_fields([field_of(problem, "r[0]", one, positive=False)])
    kept = np.ones(problem.n_cluster)
    kept[:6] = 0.0
    found = fitting.fit(wider, wider.null(), ["r[0]"], weights=kept)
    data, curve = problem.data, 0.3 * one.family.pattern.curves.values.T
    seen = data["street"] >= 6
    spread = found.spread["r[0]"]

    def covariance(s):
        return 9.0 * np.outer(data["x"], data["x"]) + s**2 * curve @ curve.T + SIGMA**2 * np.eye(N_ROW)

    def evidence(s):
        part = covariance(s)[np.ix_(seen, seen)]
        return stats.multivariate_normal(np.zeros(seen.sum()), part).logpdf(data["y"][seen])

    around = [evidence(spread * f) for f in (0.9, 1.0, 1.1)]
    assert found.log_evidence == pytest.approx(around[1], abs=0.01)
    assert around[1] > max(around[0], around[2])
    whole = covariance(spread) - SIGMA**2 * np.eye(N_ROW)
    mean = whole[:, seen] @ np.linalg.solve(covariance(spread)[np.ix_(seen, seen)], data["y"][seen])
    predicted = np.asarray(wider.compiled.sites(found.x)["mean"])
    np.testing.assert_allclose(predicted, mean, atol=0.01)


def log(window, y=None):
    """A load in windows of eight slots, on two devices; each window has a number."""
    del window
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    with numpyro.plate("window", 21, dim=-3), numpyro.plate("slot", 8, dim=-2), numpyro.plate("device", 2):
        load = numpyro.deterministic("load", jnp.broadcast_to(level, (21, 8, 2)))
        numpyro.sample("y", dist.Normal(load, 1.0), obs=y)


def moved_as_its_families_do(problem, site, over, rng):
    """Labels of all families of a site, each of whose fields moves the site as the family's weights do."""
    seen, value = [], site.value
    for family, scores in families(partial(curves, problem), over, site):
        effect = field_of(problem, "r[0]", Suspect("load", None, family, 0.5, 9.0, 9.0, 0.0), positive=False)
        weights = rng.normal(size=effect.shape_of_field(jnp.asarray(value), {}))
        moved = effect.rewrites["load"](value, {"scale": 2.0, FIELD: weights}, {}) - value
        assert weights.size == scores.shape[1]
        wanted = family.pattern.perturbation(weights.reshape(-1), value.shape, 1)[..., 0] * family.factor
        np.testing.assert_allclose(moved, np.broadcast_to(wanted, value.shape), atol=1e-12)
        seen.append(family.pattern.label)
    return seen


def test_a_field_moves_its_site_as_its_family_does():
    rng = np.random.default_rng(0)
    problem = Problem(log, {"window": np.arange(21) // 3, "y": rng.normal(size=(21, 8, 2))}, [], "window")
    value = rng.normal(size=(21, 8, 2))
    site = deterministic("load", ("window", "slot", "device"), value, rng.normal(size=(1, 21, 8, 2)))
    over = quantity("delay", site.axes, rng.normal(size=value.shape))
    seen = moved_as_its_families_do(problem, site, [(over, tuple(over.curves()))], rng)
    assert {"every 7 along window and slot", "along delay"} <= set(seen)


def daily(place, y=None):
    """A load on nine devices, day by day; each day has a place."""
    del place
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    with numpyro.plate("day", 12, dim=-2), numpyro.plate("device", 9):
        load = numpyro.deterministic("load", jnp.broadcast_to(level, (12, 9)))
        numpyro.sample("y", dist.Normal(load, 1.0), obs=y)


def test_stretches_and_columns_of_each_device_move_their_site_too():
    """Windows overlap, so that a position belongs to several weights."""
    rng = np.random.default_rng(1)
    value = rng.normal(size=(12, 9))
    problem = Problem(daily, {"place": rng.normal(size=12), "y": value}, [], "day")
    site = deterministic("load", ("day", "device"), value, rng.normal(size=(1, 12, 9)))
    seen = moved_as_its_families_do(problem, site, [], rng)
    assert {"stretch of device x day", "along place x device"} <= set(seen)


def test_what_all_clusters_share_carries_over():
    held, found = modelled(rows(2, wave), ["along place"])
    assert [(t.site, t.per_cluster) for t in found.terms] == [("mean", False)]
    assert found.closed.low > 0.75
    assert found.closed.mean <= found.closed.high <= 1.0
    assert (found.held.log_likelihood - held.log_likelihood).sum() > 50
    assert found.before.error_ratio > 1.2
    assert found.before.coverage < 0.85
    assert 0.85 < found.after.coverage < 0.95
    assert found.after.error_ratio == pytest.approx(1.0, abs=0.12)


def test_a_cause_is_charged_for_its_choice_beside_a_model_of_the_rest_too():
    """Else what the choice among its family costs would be credited to the model of the rest."""
    free, charged = (modelled(rows(2, wave), ["along place"], charged=nats)[1] for nats in (0.0, 0.5))
    np.testing.assert_allclose(charged.held.log_likelihood, free.held.log_likelihood - 0.5, atol=1e-9)


@pytest.mark.parametrize(
    ("shift", "loudness", "options"),
    [
        (levels, 1.0, {}),
        pytest.param(
            0.0, loud, {"site": "deviation", "kind": "relative", "spread": 0.5}, marks=pytest.mark.study
        ),
    ],
)
def test_what_is_each_clusters_own_widens_the_prediction(shift, loudness, options):
    """Coverage of three data sets, 720 rows in 72 streets; a street's rows share their level or loudness."""
    coverage = []
    for seed in range(3, 6):
        held, found = modelled(rows(seed, shift, loudness), ["by street"], **options)
        assert [t.per_cluster for t in found.terms] == [True]
        assert (found.held.log_likelihood - held.log_likelihood).sum() > 5
        assert found.before.error_ratio > found.after.error_ratio
        coverage.append(found.after.coverage)
    assert 0.85 < np.mean(coverage) < 0.95


def test_a_spread_that_no_site_names_is_modelled_too():
    data = rows(3, 0.0, loud)
    _, named = modelled(data, ["by street"], site="deviation", kind="relative", spread=SIGMA)
    _, unnamed = modelled(data, ["by street"], raw, site="y", kind="spread")
    assert unnamed.closed.mean == pytest.approx(named.closed.mean, abs=0.05)


def test_what_one_cluster_alone_has_cannot_be_predicted():
    held, found = modelled(rows(4, lambda place, street: 1.5 * (street == 3)), ["along place", "by street"])
    if found is not None:
        assert (found.held.log_likelihood - held.log_likelihood).sum() < 0.5 * 10 * 0.5 * (1.5 / SIGMA) ** 2
        assert found.after.coverage > 0.85


def test_what_is_chance_is_not_modelled():
    assert modelled(rows(5), ["along place", "by street"])[1] is None
    problem = prepared(rows(5))[0]
    assert shortlist(problem, [suspect(problem, "along place", evidence=1.0)]) == ()


@pytest.mark.parametrize(
    ("gains", "kept"), [((3.0, 5.0), 1), ((3.0, -50.0), 0), ((-1.0, 2.0), 1), ((-1.0, -2.0), 0)]
)
def test_what_predicts_no_better_is_left_out_of_the_model(gains, kept, monkeypatch):
    """Each further term costs what it adds to the evidence, and has to predict clusters that were left out."""
    fits = [SimpleNamespace(name=i) for i in range(2)]
    folds = [SimpleNamespace(held=np.arange(4) == i, charged=0.0) for i in range(2)]
    monkeypatch.setattr(closed, "fold_fits", lambda wider, full, assignment: [Refitted(full)] * 2)
    monkeypatch.setattr(
        closed,
        "judged",
        lambda wider, parts: SimpleNamespace(log_likelihood=np.array([gains[parts[0].full.name]])),
    )
    found = _held(None, fits, folds, SimpleNamespace(log_likelihood=np.zeros(1)))
    assert found[0].name == kept
    assert found[2].log_likelihood[0] == gains[kept]


class Refitted(NamedTuple):
    full: SimpleNamespace
    charged: float = 1.0


def test_what_each_reading_does_by_itself_is_always_tried():
    """Heavy tails look like an amount of its own for each reading, of which other evidence makes little."""
    problem = prepared(rows(5))[0]
    labels = [c.label for c in curves(problem, "row", N_ROW) if c.extent[0] <= 16][:8]
    some = [
        replace(suspect(problem, label, evidence=10.0), steady=10.0 - i) for i, label in enumerate(labels)
    ]
    each = replace(suspect(problem, labels[0], evidence=900.0), steady=0.0)
    each = replace(each, family=Family("spread", Pattern("row", (0,)), np.ones(())), site="y", rows=(1,))
    found = shortlist(problem, [*some, each])
    assert len(found) == 6
    assert [s.steady for s in found] == [10.0, 0.0, 9.0, 8.0, 7.0, 6.0]
    last = shortlist(problem, [*some, replace(each, site="mean", rows=None)])
    assert [s.steady for s in last] == [10.0, 9.0, 8.0, 7.0, 6.0, 0.0]


def test_one_thing_under_two_names_is_tried_once():
    problem = prepared(rows(5))[0]
    pair = [
        suspect(problem, "along place", site=site, kind=kind, evidence=evidence)
        for site, kind, evidence in [
            ("y", "spread", 20.0),
            ("deviation", "relative", 20.0),
            ("mean", "additive", 15.0),
        ]
    ]
    assert [s.site for s in shortlist(problem, pair)] == ["deviation", "mean"]


def test_families_are_tried_site_by_site():
    """Rows far out look like noise that varies in many ways, whatever moves them: these are not all that is tried."""
    problem = prepared(rows(5))[0]
    known = [c.label for c in curves(problem, "row", N_ROW) if c.extent[0] <= 16]
    labels = [label for label in known if label != "along place"][:5]
    loud = [suspect(problem, label, site="deviation", kind="relative", evidence=90.0) for label in labels]
    moved = suspect(problem, "along place", site="mean", kind="additive", evidence=30.0)
    found = shortlist(problem, [*loud, moved])
    assert [s.site for s in found[:3]] == ["deviation", "mean", "deviation"]


def test_a_family_that_stands_alone_pays_for_having_been_picked():
    problem, fitted, _, _ = prepared(rows(1, wave))
    place, street = (
        suspect(problem, "along place", evidence=60.0),
        suspect(problem, "by street", evidence=50.0),
    )

    def found(*suspects, least=0.0):
        location = SimpleNamespace(suspects=suspects)
        view = SimpleNamespace(problem=problem, fitted=fitted, location=location)
        return [one.fitted.log_evidence for one in alone(view, fitted.log_evidence + least)]

    (free,) = found(place)
    assert found(street, least=-np.inf) == []  # of which each cluster has its own
    assert found(place, street, least=-np.inf) == pytest.approx([free], abs=1e-6)
    gained = free - fitted.log_evidence
    place = replace(place, evidence=gained)
    assert found(place, least=gained - 6.0) == pytest.approx([free], abs=1e-6)
    assert found(replace(place, price=7.0), least=gained - 6.0) == []
    assert found(place, least=gained + 1.0) == []
    assert found() == []
    unpromising = replace(place, evidence=0.4 * gained)
    assert found(unpromising, least=gained - 6.0) == []


def test_what_stands_alone_counts_the_weights_that_the_data_determine():
    problem, fitted, _, _ = prepared(rows(1, wave))
    place = suspect(problem, "along place", evidence=60.0)
    view = SimpleNamespace(problem=problem, fitted=fitted, location=SimpleNamespace(suspects=[place]))
    (one,) = alone(view, fitted.log_evidence)
    size = place.family.pattern.curves.values.shape[0]
    assert 1.0 < one.weights <= size


def test_predictions_of_a_right_model_are_calibrated():
    problem, _, parts, _ = prepared(rows(6))
    found = calibration(problem, parts)
    assert found.coverage == pytest.approx(0.9, abs=3.5 * np.sqrt(0.09 / N_ROW))
    assert found.error_ratio == pytest.approx(1.0, abs=3.5 / np.sqrt(2 * N_ROW))


def holed(x, seen, y=None):
    """A line with known noise, of which some readings are masked."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        numpyro.sample("y", dist.Normal(slope * x, SIGMA).mask(seen), obs=y)


def test_masked_readings_are_no_hits():
    """The noise is twice what the model says, which four readings in five are not there to tell."""
    rng = np.random.default_rng(0)
    x, seen = rng.normal(size=(40, 30)), rng.random((40, 30)) < 0.2
    y = 2 * x + 2 * SIGMA * rng.normal(size=x.shape)
    problem = Problem(holed, {"x": jnp.asarray(x), "seen": jnp.asarray(seen), "y": jnp.asarray(y)}, ())
    fitted = fitting.fit(problem, problem.null())
    found = calibration(problem, list(closed.fold_fits(problem, fitted, closed.folds(40, 4))))
    scaled = ((y - fitted.x[0] * x) / SIGMA)[seen]
    assert problem.observed.count == seen.sum()
    np.testing.assert_allclose(problem.n_observation_of_each, seen.sum(1))
    assert found.coverage == pytest.approx(np.mean(np.abs(scaled) < 1.645), abs=0.02)
    assert found.error_ratio == pytest.approx(np.sqrt(np.mean(scaled**2)), rel=0.02)


@pytest.mark.parametrize("name", ["counts", "logistic", "labels"])
def test_errors_of_outcomes_are_not_judged(name):
    """A level of each link's own: counts vary more with it, outcomes by p (1 - p) as before."""
    x = inputs(0, 40)
    level = np.random.default_rng(9).normal(size=(40, 1))
    shift = level[..., None] * np.array([1.0, 0.0, 0.0]) if name == "labels" else level
    problem = Problem(MODELS[name][0], draw(name, 1, shift, x), [])
    fitted = fitting.fit(problem, problem.null())
    found = calibration(problem, list(closed.fold_fits(problem, fitted, closed.folds(40, 2))))
    assert found.coverage is None
    if name == "counts":
        assert found.error_ratio > 2
    else:
        assert found.error_ratio is None


def own_levels(y=None):
    with numpyro.plate("link", y.shape[0], dim=-2):
        level = numpyro.sample("level", dist.Normal(0.0, 0.7))
        with numpyro.plate("sample", y.shape[1], dim=-1):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


@pytest.mark.parametrize("readings", [1, 2, 4])
def test_a_right_model_with_levels_of_its_own_is_calibrated(readings):
    """A level that its prior knows leaves more of a reading than one that is refitted without it."""
    rng = np.random.default_rng(readings)
    y = 0.7 * rng.normal(size=(400, 1)) + rng.normal(size=(400, readings))
    problem = Problem(own_levels, {"y": jnp.asarray(y)}, ())
    fitted = fitting.fit(problem, problem.null())
    found = calibration(problem, list(closed.fold_fits(problem, fitted, closed.folds(400, 2))))
    assert found.coverage == pytest.approx(0.9, abs=3.5 * np.sqrt(0.09 / 400))
    assert found.error_ratio == pytest.approx(1.0, abs=3.5 / np.sqrt(2 * 400))


def of_rates(x, place=None, street=None, y=None):
    del place, street
    rate = numpyro.deterministic("rate", jnp.exp(numpyro.sample("b", dist.Normal(0.0, 1.0)) * x))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Poisson(rate), obs=y)


def of_levels(shift=0.0):
    """A line over x from 40 up, whose levels happen to be positive."""
    data = rows(1, shift)
    up = 40.0 + np.abs(data["x"])
    return {**data, "x": up, "y": data["y"] + 1.3 * (up - data["x"])}


def test_only_what_cannot_be_negative_has_to_be_positive():
    problem, fitted, *_ = prepared(of_levels())
    assert not _has_to_be_positive(problem, fitted.x, "mean")
    assert _has_to_be_positive(problem, fitted.x, "deviation")
    counts = {**rows(1), "y": np.arange(N_ROW) % 7}
    assert _has_to_be_positive(Problem(of_rates, counts, [], "street"), np.ones(1), "rate")


def test_a_law_as_large_as_the_levels_that_it_is_added_to():
    """Steps of 40 from levels about 52: as factors of these they would be anything."""
    data = of_levels(lambda place, _: 40.0 - 80.0 * place)
    held, found = modelled(data, ["along place"], spread=20.0)
    assert found is not None
    assert found.after.coverage == pytest.approx(0.9, abs=0.08)
    assert found.held.log_likelihood.sum() > 0.02 * held.log_likelihood.sum()  # both are negative


@pytest.mark.parametrize("offset", [0.0, 2.0])
def test_what_a_cause_brings_beside_a_model_of_the_remainder(offset):
    """Against fits of both and of the remainder alone: nothing where it is not there, however far the fit has it."""
    cause = Effect(
        "half",
        {"mean": lambda value, p, data: value + p["offset"] * (data["place"] > 0.5)},
        (Parameter("offset", dist.Normal(0.0, 1.0)),),
    )
    problem = Problem(table, rows(1, lambda place, _: offset * (place > 0.5)), [cause], "street").with_live(
        ["half"]
    )
    one = suspect(problem, "along x", 0.1)
    wider = problem.with_fields([field_of(problem, "r[0]", one, positive=False)])
    both = fitting.fit(wider, wider.null(), ["half", "r[0]"], spread={"r[0]": 1.0})
    rest = fitting.fit(wider, wider.null(), ["r[0]"], spread={"r[0]": 1.0})
    assert _without(wider, both, ("half",)) == pytest.approx(rest.log_evidence, abs=0.1)
    if offset:
        far = replace(both, x=np.where(both.x == 0, both.x, 3 * both.x))
        assert both.log_evidence - rest.log_evidence > 50.0
        assert _without(wider, far, ("half",)) == pytest.approx(rest.log_evidence, abs=0.1)
