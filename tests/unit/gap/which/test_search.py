"""Steps of a search: where they end, which are taken over, when earlier choices are looked at again."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dtprob.gap.settings import Settings
from dtprob.gap.which import search
from dtprob.gap.which.trials import Trials


def test_a_search_that_goes_in_a_circle_ends_where_most_credit_is(monkeypatch):
    """Adding b gives up a, adding a gives up b: without an end where it has been, this never stops."""
    evidence = {(): 0.0, ("a",): 5.0, ("b",): 9.0}

    def fitted(*effects):
        return SimpleNamespace(
            effects=effects, log_evidence=evidence[effects], within=lambda problem: problem
        )

    problem = SimpleNamespace(effects=[SimpleNamespace(name=n, kind="mean") for n in "abc"])

    def looked(problem, fitted, *_, **__):
        return SimpleNamespace(problem=problem, fitted=fitted, promise=50.0, alarmed=lambda _: True)

    def tried(seen, *_, **__):
        new = {(): "a", ("a",): "b", ("b",): "a"}[seen.fitted.effects]
        return Trials(problem, {new: fitted(new)})

    monkeypatch.setattr(search, "_looked", looked)
    monkeypatch.setattr(search, "tried", tried)
    monkeypatch.setattr(search, "remembered", lambda *_: {})
    monkeypatch.setattr(search, "best", lambda seen, base, trials, settings: next(iter(trials)))
    monkeypatch.setattr(search, "without", lambda *_: None)
    monkeypatch.setattr(search, "_revised", lambda *_, **__: [])
    steps = search._forward(problem, fitted(), jax.random.key(0), Settings(), lambda _: None)
    assert [step.view.fitted.effects for step in steps] == [(), ("a",), ("b",), ("b",)]
    assert steps[-1].accepted is None


@pytest.mark.parametrize(("promise", "goal", "is_hopeless"), [(50.0, 600.0, False), (20.0, 600.0, True)])
def test_a_way_that_cannot_reach_what_another_one_has_is_left(promise, goal, is_hopeless):
    """100 nats and three steps of up to six times the promise; the banned field promises all."""
    problem = SimpleNamespace(
        effects=[
            SimpleNamespace(name=n, kind="variance" if n == "field" else "mean") for n in ("a", "b", "field")
        ]
    )
    fits = {
        names: SimpleNamespace(effects=names, log_evidence=evidence)
        for names, evidence in (((), 0.0), (("a",), 100.0))
    }
    screening = SimpleNamespace(names=("b", "field"), log_bayes_factor=np.array([promise, 900.0]))
    settings = Settings(max_effects=4)

    def hopeless(effects, goal):
        seen = SimpleNamespace(problem=problem, fitted=fits[effects], screening=screening)
        return search._is_hopeless(seen, fits[()], goal, settings, "field")

    assert hopeless(("a",), goal) == is_hopeless
    assert not hopeless((), 1e6)
    assert not hopeless(("a",), -np.inf)


def fitted_as(effects, evidence):
    return SimpleNamespace(effects=effects, log_evidence=evidence)


@pytest.mark.parametrize(
    ("effects", "evidence", "is_taken"), [((), 10.3, True), ((), 50.0, False), (("b",), 10.0, False)]
)
def test_a_step_is_taken_over_from_the_same_fit_alone(effects, evidence, is_taken):
    problem = SimpleNamespace()
    fits = {name: fitted_as((name,), 20.0) for name in ("a", "field")}
    view = SimpleNamespace(fitted=fitted_as((), 10.0), problem=problem)
    step = search.Step(view, Trials(problem, fits), "field")
    found = search._without_trial(step, fitted_as(effects, evidence), "field")
    if is_taken:
        assert (set(found.trials.fits), found.accepted, found.view) == ({"a"}, None, view)
    else:
        assert found is None
    alone = search.Step(view, Trials(problem, {"field": fits["field"]}), "field")
    assert search._without_trial(alone, fitted_as((), 10.0), "field") is None


@pytest.mark.parametrize(("goal", "is_revised"), [(-np.inf, True), (11.0, True), (30.0, False)])
def test_choices_are_looked_at_again_near_a_goal_alone(monkeypatch, goal, is_revised):
    """Nine nats are within a quarter of eleven, and not of thirty."""
    problem = SimpleNamespace(effects=[SimpleNamespace(name=n, kind="mean") for n in "ab"])
    first = SimpleNamespace(effects=(), log_evidence=0.0, within=lambda problem: problem)
    second = SimpleNamespace(effects=("a",), log_evidence=9.0, within=lambda problem: problem)
    revised = []

    def looked(problem, fitted, *_, **__):
        return SimpleNamespace(
            problem=problem, fitted=fitted, promise=50.0, alarmed=lambda _: not fitted.effects
        )

    monkeypatch.setattr(search, "_looked", looked)
    monkeypatch.setattr(search, "_is_hopeless", lambda *_: False)
    monkeypatch.setattr(search, "tried", lambda *_, **__: Trials(problem, {"a": second}))
    monkeypatch.setattr(search, "best", lambda *_: "a")
    monkeypatch.setattr(search, "without", lambda *_: None)
    monkeypatch.setattr(search, "_revised", lambda *_, **__: revised.append(1) or [])
    search._forward(problem, first, jax.random.key(0), Settings(), lambda _: None, goal=goal)
    assert bool(revised) == is_revised


def test_a_step_that_was_begun_costs_no_look_and_no_refits(monkeypatch):
    problem = SimpleNamespace(effects=[SimpleNamespace(name="a", kind="mean")])
    first = SimpleNamespace(effects=(), log_evidence=0.0, within=lambda problem: problem)
    second = SimpleNamespace(effects=("a",), log_evidence=9.0, within=lambda problem: problem)
    looks = []

    def looked(problem, fitted, *_, **__):
        looks.append(fitted.effects)
        return SimpleNamespace(problem=problem, fitted=fitted, promise=50.0, alarmed=lambda _: False)

    view = SimpleNamespace(problem=problem, fitted=first, promise=50.0, alarmed=lambda _: True)
    begun = search.Step(view, Trials(problem, {"a": second}), None)
    monkeypatch.setattr(search, "_looked", looked)
    monkeypatch.setattr(search, "tried", lambda *_, **__: pytest.fail("refitted anew"))
    monkeypatch.setattr(search, "without", lambda *_: pytest.fail("looked for a better fit anew"))
    monkeypatch.setattr(search, "best", lambda *_: "a")
    monkeypatch.setattr(search, "_revised", lambda *_, **__: [])
    steps = search._forward(problem, first, jax.random.key(0), Settings(), lambda _: None, begun=begun)
    assert looks == [("a",)]
    assert steps[-1].view.fitted is second


@pytest.mark.parametrize(
    ("gains", "first"),
    [
        ({("a", "b"): 10.0, ("a",): 9.5}, ("a",)),
        ({("a", "b"): 12.0, ("a",): 9.5}, ("a", "b")),
        ({("a", "b"): 10.0, ("c",): 9.5}, ("a", "b")),
        ({("a", "b"): 10.0, (): 9.5}, ("a", "b")),
    ],
)
def test_of_two_ways_the_one_without_an_idle_effect_stands(gains, first):
    """What is worth most stands, unless one of its effects brings hardly anything."""
    problem = SimpleNamespace(effects=[SimpleNamespace(name=n, kind="mean") for n in "abc"])
    base = SimpleNamespace(effects=(), log_evidence=0.0)
    ways = [
        [SimpleNamespace(view=SimpleNamespace(fitted=SimpleNamespace(effects=e, log_evidence=g)))]
        for e, g in gains.items()
    ]
    for order in (ways, ways[::-1]):
        found = search._ranked(problem, order, base)
        assert found[0][-1].view.fitted.effects == first
        assert sorted(map(id, found)) == sorted(map(id, ways))


def test_an_earlier_choice_is_looked_at_again_beside_what_was_as_good(monkeypatch):
    """Beside a, b and c were alike; once a is given up, b is looked at again, and c with it."""
    problem = SimpleNamespace(effects=[SimpleNamespace(name=n, kind="mean") for n in "abc"])

    def fitted(*effects):
        return SimpleNamespace(effects=effects, log_evidence=9.0, within=lambda problem: problem)

    def view(one):
        return SimpleNamespace(problem=problem, fitted=one)

    step = search.Step(view(fitted("a")), Trials(problem, {"b": fitted("a", "b")}), "b")
    asked = []

    def as_good(name, before, seen):
        asked.append((name, len(before)))
        return {"c": None}

    def tried(seen, settings, say, known, *, banned, earlier):
        assert list(earlier) == ["c"]
        return Trials(problem, {"b": fitted("b")})

    def without(problem, fit, name):
        return SimpleNamespace(problem=problem, fitted=fitted(*(e for e in fit.effects if e != name)))

    monkeypatch.setattr(search, "as_good", as_good)
    monkeypatch.setattr(search, "tried", tried)
    monkeypatch.setattr(search, "refitted_without", without)
    monkeypatch.setattr(search, "_looked", lambda problem, fitted, *_, **__: view(fitted))
    monkeypatch.setattr(search, "best", lambda seen, *_: None if seen.fitted.effects else "b")
    keys = jax.random.key(0), Settings(), lambda _: None
    found = list(search._revised((step,), fitted(), *keys, banned=None))
    assert [(one.view.fitted.effects, one.accepted) for one in found] == [(("b",), None), ((), "b")]
    assert asked == [("a", 1), ("b", 2)]
