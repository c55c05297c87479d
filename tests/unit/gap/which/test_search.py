"""From which pair a search starts once more."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dtprob.gap.settings import Settings
from dtprob.gap.which import search
from dtprob.gap.which.pairs import Pair
from dtprob.gap.which.search import _promising
from dtprob.gap.which.trials import Trials

TILT_AND_NOISE, TILT_AND_SHIFT = Pair(("noise", "tilt"), 900.0), Pair(("shift", "tilt"), 880.0)


def way(effects, *, leaves, pairs=(TILT_AND_NOISE, TILT_AND_SHIFT)):
    """A way of one step that ended with these effects; noise alone moves no mean."""
    scores = SimpleNamespace(
        pairs=lambda: pairs,
        locating=frozenset({"shift", "tilt", "gain"}),
        log_bayes_factor=np.array([700.0, 500.0]),
    )
    view = SimpleNamespace(
        problem=SimpleNamespace(effects=("shift", "tilt", "gain", "noise")),
        fitted=SimpleNamespace(effects=effects),
        screening=SimpleNamespace(scores=scores),
        alarmed=lambda _: leaves,
    )
    return [SimpleNamespace(view=view)]


def test_noise_is_no_start_where_what_moves_the_mean_leaves_nothing():
    assert _promising([way(("gain",), leaves=False)], 800.0, Settings()) == ("shift", "tilt")
    only_noise = way(("gain",), leaves=False, pairs=(TILT_AND_NOISE,))
    assert _promising([only_noise], 800.0, Settings()) is None


@pytest.mark.parametrize(("effects", "leaves"), [(("gain",), True), (("noise",), False)])
def test_noise_is_a_start_where_something_is_left_or_noise_was_needed(effects, leaves):
    assert _promising([way(effects, leaves=leaves)], 800.0, Settings()) == ("noise", "tilt")


@pytest.mark.parametrize(("effects", "reached"), [(("noise", "tilt"), 800.0), (("gain",), 1500.0), ((), 0.0)])
def test_no_pair_that_was_reached_or_promises_less_or_where_nothing_was_found(effects, reached):
    assert _promising([way(effects, leaves=True)], reached, Settings()) is None


def test_no_pair_where_one_effect_is_all_that_is_looked_for():
    assert _promising([way(("gain",), leaves=True)], 800.0, Settings(max_effects=1)) is None


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
