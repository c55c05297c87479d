"""Which candidates are refitted: the best by score, of those that move the mean, and of each scan, in turn."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.gap.settings import Settings
from dtprob.gap.which import trials
from dtprob.gap.which.scan import Found

NAMES = ("near", "far", "swap", "wall", "tilt", "drift")


def effect(name):
    return Effect(
        name, {"mean": lambda value, p, _: value + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
    )


def chosen(scores, scans, count, absorbed=(), *, noise=(), promise=1000.0, alarms=()):
    screening = SimpleNamespace(
        names=NAMES,
        absorbed_by=["gain" if name in absorbed else None for name in NAMES],
        adjusted=np.array([1e-4 if name in alarms else 1.0 for name in NAMES]),
        locates=[name not in noise for name in NAMES],
        log_bayes_factor=np.array([scores.get(name, -1.0) for name in NAMES]),
    )
    problem = SimpleNamespace(effects=[effect(name) for name in NAMES])
    seen = cast("Any", SimpleNamespace(screening=screening, problem=problem, promise=promise))
    found = [{n: Found(gain, np.zeros(0), np.zeros(1)) for n, gain in scan.items()} for scan in scans]
    return trials._chosen(seen, found, Settings(candidates=count), None)


def test_each_scan_has_its_turn_however_much_another_gains():
    scans = [{"wall": 50.0, "tilt": 40.0, "drift": 30.0}, {"swap": 20.0, "tilt": 10.0}]
    assert chosen({"near": 90.0, "far": 80.0}, scans, 4) == ["near", "wall", "far", "swap"]
    assert chosen({"near": 90.0}, scans, 6) == ["near", "wall", "swap", "tilt", "drift"]


def test_the_best_of_each_scan_is_refitted_in_any_case():
    scans = [{"wall": 50.0, "tilt": 40.0}, {"tilt": 10.0, "swap": 9.0}, {"drift": 5.0, "tilt": 4.0}]
    assert chosen({"near": 90.0, "far": 80.0}, scans, 2) == ["near", "wall", "tilt", "drift"]


def test_what_looks_like_noise_leaves_room_for_what_moves_the_mean():
    scores = {"near": 90.0, "far": 80.0, "swap": 70.0, "tilt": 8.0, "drift": 6.0}
    noise = ("near", "far", "swap")
    assert chosen(scores, [{"wall": 50.0}, {}], 5, noise=noise) == ["near", "tilt", "wall", "far", "drift"]
    later = chosen(scores, [], 5, noise=noise)  # scans are for the first step
    assert later == ["near", "tilt", "far", "drift", "swap"]


def test_a_small_gap_is_judged_by_scores_alone():
    scores = {"near": 90.0, "far": 80.0, "swap": 70.0, "tilt": 8.0, "drift": 6.0}
    found = chosen(scores, [], 5, noise=("near", "far", "swap"), promise=90.0)
    assert found == ["near", "far", "swap", "tilt", "drift"]


def test_what_a_smaller_gap_hides_is_looked_for_with_clusters_own_unknowns_found_anew(monkeypatch):
    """An exchange of two anchors 263 nats better, of which neither its score nor the gap's promise of 79 told."""
    far = {"swap": 263.0, "drift": 2.0}
    assert chosen({"near": 24.0, "far": 10.0}, [{}, {}, far, {}], 2, promise=79.0) == ["near", "swap"]
    found = {"swap": Found(263.0, np.zeros(0), np.ones(1))}
    for name in ("scan", "scan_each"):
        monkeypatch.setattr(trials, name, lambda *_: pytest.fail("for large gaps only"))
    monkeypatch.setattr(trials, "centre", lambda _problem, x: x)
    monkeypatch.setattr(trials, "scan_anew", lambda *_: found)
    place = SimpleNamespace(x=np.zeros(0))
    seen = SimpleNamespace(problem=None, fitted=place, screening=SimpleNamespace(names=NAMES), promise=79.0)
    assert trials._scans(cast("Any", seen)) == [{}, found, found, {}]


@pytest.mark.parametrize(("promise", "looks"), [(79.0, True), (20.0, False)])
def test_far_looks_begin_at_a_gap_of_thirty_nats(monkeypatch, promise, looks):
    class LookError(Exception):
        """Before any refit."""

    def stop(*_):
        raise LookError

    monkeypatch.setattr(trials, "_scans", stop)
    monkeypatch.setattr(trials, "_chosen", lambda *_: pytest.fail("no look") if looks else stop())
    seen = SimpleNamespace(promise=promise, fitted=SimpleNamespace(effects=()), screening=None)
    told = []
    with pytest.raises(LookError):
        trials.tried(cast("Any", seen), Settings(), told.append)
    assert bool(told) is looks


def test_what_gains_nothing_or_is_absorbed_is_not_refitted():
    scans = [{"wall": 2.0, "tilt": np.inf}, {}]
    assert chosen({"near": 90.0, "far": 1.0}, scans, 6, absorbed=("tilt",)) == ["near"]
    assert chosen({}, [], 6) == []


def test_what_rings_the_alarm_is_refitted_though_nuisances_absorb_nearly_all_of_it():
    """Another one, which nothing calls for, was named in its place."""
    scores = {"near": 9.0, "tilt": 4.0}
    assert chosen(scores, [], 6, absorbed=("near",), promise=20.0) == ["tilt"]
    assert chosen(scores, [], 6, absorbed=("near",), promise=20.0, alarms=("near",)) == ["near", "tilt"]


def test_what_gains_at_its_whole_size_at_the_fit_is_not_absorbed():
    fit, anew, centre = {"wall": 90.0}, {"tilt": 50.0, "swap": 2.0}, {"drift": 90.0}
    absorbed = ("wall", "tilt", "swap", "drift")
    assert chosen({"near": 90.0}, [fit, anew, centre], 6, absorbed) == ["near", "tilt"]
    assert chosen({"near": 90.0}, [fit, anew, centre], 6) == ["near", "wall", "tilt", "drift"]


def fit_of(worth, *effects):
    x = np.array([float(NAMES.index(effects[-1]) + 1)] * len(NAMES))
    return SimpleNamespace(effects=effects, log_evidence=worth, x=x)


def test_what_was_as_good_as_an_effect_is_its_rival_when_that_is_looked_at_again():
    """`far` fell short by 1 nat, `tilt` by 9, `swap` stands beside already, `near` was as good beside another choice."""
    layout = SimpleNamespace(of=lambda one: np.array([NAMES.index(one.name)]))
    problem = cast("Any", SimpleNamespace(layout=layout))
    worth = {"wall": 50.0, "far": 49.0, "tilt": 41.0, "swap": 50.0}
    first = trials.Trials(problem, {n: cast("Any", fit_of(w, "drift", n)) for n, w in worth.items()})
    other = trials.Trials(problem, {"near": cast("Any", fit_of(50.0, "near"))})
    seen = cast(
        "Any",
        SimpleNamespace(
            problem=SimpleNamespace(effects=[effect(name) for name in NAMES]), fitted=fit_of(0.0, "swap")
        ),
    )
    found = trials.as_good("wall", [first, other], seen)
    assert list(found) == ["far"]
    assert found["far"].parameters == [2.0]
    assert found["far"].gain == -1.0
    np.testing.assert_array_equal(found["far"].x, seen.fitted.x)
