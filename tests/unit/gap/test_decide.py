"""The verdict that follows from what was accepted, what it closes and what is left."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from dtprob.gap.decide import decide
from dtprob.gap.evidence import Evidence
from dtprob.gap.how_far.closed import ClosedFraction
from dtprob.gap.settings import Settings
from dtprob.gap.where.site_finding import SiteFinding
from dtprob.gap.which.screen import Screening
from dtprob.gap.which.trials import Start, Trials, best, credit


def evidence(kind, p_after, asked_for=(), left="additive", *, locates=True):
    """What `decide` looks at: one accepted effect of a kind, and the sites' p-value beside it."""
    scores = SimpleNamespace(locating=frozenset({"a"} if locates else ()))
    view = SimpleNamespace(alarmed=lambda settings: True, screening=SimpleNamespace(scores=scores))
    return SimpleNamespace(
        problem=SimpleNamespace(effects=[SimpleNamespace(name="a", kind=kind)]),
        accepted=("a",),
        steps=[SimpleNamespace(view=view)],
        before=SimpleNamespace(site_p_value=1e-9),
        after=SimpleNamespace(site_p_value=p_after, sites=(SiteFinding("y", left, "common", p_after, 9.0),)),
        asked_for=asked_for,
        remainder=None,
    )


def cause(closed, probability=0.99, plausible=True):
    fraction = None if closed is None else ClosedFraction(closed, closed - 0.1, min(closed + 0.1, 1.0))
    return SimpleNamespace(explained=fraction, probability=probability, plausible=plausible)


@pytest.mark.parametrize(
    ("kind", "closed", "p_after", "verdict"),
    [
        ("mean", 0.99, 0.5, "LISTED"),
        ("mean", 0.85, 1e-6, "LISTED_WITH_REMAINDER"),
        ("mean", 0.4, 1e-6, "UNLISTED"),
        ("mean", 0.99, 1e-6, "LISTED"),
        ("mean", None, 1e-6, "UNLISTED"),
        ("mean", None, 0.5, "UNDETERMINED"),
        ("variance", 0.85, 0.5, "LISTED"),
        ("variance", 0.95, 1e-6, "LISTED_WITH_REMAINDER"),
        ("variance", 0.99, 1e-6, "LISTED_WITH_REMAINDER"),
        ("variance", 0.99, 0.5, "LISTED"),
        ("variance", 0.85, 1e-6, "UNLISTED"),
    ],
)
def test_verdicts(kind, closed, p_after, verdict):
    assert decide(evidence(kind, p_after), (cause(closed),), Settings()) == verdict


@pytest.mark.parametrize(
    ("left", "locates", "closed", "verdict"),
    [
        ("spread", True, 0.37, "LISTED_WITH_REMAINDER"),
        ("tails", True, 0.37, "LISTED_WITH_REMAINDER"),
        ("spread", True, 0.25, "UNLISTED"),
        ("spread", False, 0.37, "UNLISTED"),
        ("relative", True, 0.37, "UNLISTED"),
    ],
)
def test_what_moves_expectations_imitates_no_spread(left, locates, closed, verdict):
    """A shift of one group beside a spread of another: both are there, and the shift is named for its share."""
    found = evidence("mean", 1e-6, left=left, locates=locates)
    assert decide(found, (cause(closed),), Settings()) == verdict


def test_a_noise_beside_what_moves_expectations_does_not_take_its_name_away():
    """A saturation that also squeezes the noise: the saturation is named beside a noise that stands for the squeezing."""
    found = evidence("mean", 1e-6, left="spread")
    found.accepted = ("a", "noise")
    assert decide(found, (cause(0.73),), Settings()) == "LISTED_WITH_REMAINDER"


@pytest.mark.parametrize(
    ("closed", "p_after", "verdict"),
    [(0.8, 1e-6, "UNLISTED"), (0.8, 0.5, "UNDETERMINED"), (0.99, 1e-6, "UNDETERMINED")],
)
def test_equally_good_sets_that_leave_something_are_imitations(closed, p_after, verdict):
    assert decide(evidence("mean", p_after), (cause(closed, 0.6),), Settings()) == verdict


@pytest.mark.parametrize(
    ("kind", "p_after", "verdict"),
    [
        ("variance", 1e-6, "UNLISTED"),
        ("variance", 0.5, "LISTED"),
        ("mean", 1e-6, "LISTED"),
    ],
)
def test_a_random_field_too_large_for_what_it_is_that_leaves_something_is_an_imitation(
    kind, p_after, verdict
):
    assert decide(evidence(kind, p_after), (cause(0.99, plausible=False),), Settings()) == verdict


@pytest.mark.parametrize(("closed", "verdict"), [(0.7, "LISTED_WITH_REMAINDER"), (0.99, "LISTED")])
def test_what_was_not_looked_for_any_more_is_left(closed, verdict):
    found = evidence("mean", 0.5, asked_for=("b",))
    assert decide(found, (cause(closed),), Settings()) == verdict


def test_no_cause_is_unlisted_where_a_site_is_wrong():
    assert decide(evidence("mean", 1e-6), (), Settings()) == "UNLISTED"


def seen(problem, fitted, adjusted):
    """What `best` looks at: a fit, and the smallest family-wise p-value of the scores there."""
    screening = SimpleNamespace(pays_for=lambda name, most, settings: adjusted <= settings.level / 2)
    return SimpleNamespace(problem=problem, fitted=fitted, screening=screening)


@pytest.mark.parametrize(
    ("name", "most", "paid"),
    [("a", 0.1, True), ("b", 0.1, False), ("b", 17.0, False), ("b", 19.0, True), ("c", 100.0, True)],
)
def test_an_alarm_pays_for_the_effect_that_rang_it_and_for_what_gains_as_much(name, most, paid):
    """The score of one candidate tells of 18 nats: one that brings one nat did not ring that alarm."""
    screening = SimpleNamespace(
        names=("a", "b", "c"), adjusted=np.array([1e-7, 0.9, 0.3]), z=np.array([6.0, 1.0, 1.0])
    )
    assert Screening.pays_for(cast("Any", screening), name, most, Settings()) == paid


@pytest.mark.parametrize(
    ("so_far", "adjusted", "gain", "taken"),
    [
        (0.0, 0.004, 0.5, True),
        (0.0, 0.004, -0.5, False),
        (0.0, 0.02, 6.5, False),
        (0.0, 0.02, 6.7, True),  # log 40 + 3 = 6.69
        (200.0, 0.004, 5.0, False),
        (200.0, 0.004, 7.0, True),
    ],
)
def test_the_choice_among_all_is_paid_by_the_level_or_by_the_evidence(so_far, adjusted, gain, taken):
    effects = [SimpleNamespace(name=str(i), kind="mean") for i in range(40)]
    base = SimpleNamespace(effects=(), log_evidence=-1000.0)
    fitted = SimpleNamespace(effects=("1",), log_evidence=-1000.0 + so_far)
    trials = {"0": SimpleNamespace(effects=("1", "0"), log_evidence=fitted.log_evidence + gain)}
    view = seen(SimpleNamespace(effects=effects), fitted, adjusted)
    assert best(view, base, trials, Settings()) == ("0" if taken else None)


@pytest.mark.parametrize(
    ("gained", "chosen"),
    [((20.0, 22.0), "plain"), ((20.0, 24.0), "field"), ((300.0, 308.0), "plain"), ((300.0, 312.0), "field")],
)
def test_a_random_field_has_to_be_better_by_a_margin(gained, chosen):
    effects = [SimpleNamespace(name="plain", kind="mean"), SimpleNamespace(name="field", kind="variance")]
    problem, base = SimpleNamespace(effects=effects), SimpleNamespace(effects=(), log_evidence=-1000.0)
    trials = {
        effect.name: SimpleNamespace(effects=(effect.name,), log_evidence=-1000.0 + gain)
        for effect, gain in zip(effects, gained, strict=True)
    }
    assert best(seen(problem, base, 0.5), base, trials, Settings()) == chosen
    assert credit(problem, trials["plain"], base) == trials["plain"].log_evidence


def test_there_are_more_pairs_than_single_effects():
    effects = [SimpleNamespace(name=str(i), kind="mean") for i in range(41)]
    problem, base = SimpleNamespace(effects=effects), SimpleNamespace(effects=(), log_evidence=0.0)
    names = tuple(effect.name for effect in effects)
    one, two, all_of_them = (
        credit(problem, SimpleNamespace(effects=names[:size], log_evidence=7.0), base) for size in (1, 2, 41)
    )
    assert one == 7.0
    assert two == pytest.approx(7.0 - np.log(20.0))  # 41 * 40 / 2 pairs, 41 single effects
    assert all_of_them == 7.0


def test_several_effects_in_place_of_one_are_an_explanation():
    def fitted(*names):
        return SimpleNamespace(effects=names, within=lambda problem: problem)

    field, pair, neighbour = fitted("field"), fitted("one", "two"), fitted("three")
    trials = Trials("tried", {"field": field, "three": neighbour})
    first = SimpleNamespace(view=SimpleNamespace(fitted=fitted()), trials=trials, accepted="field")
    end = SimpleNamespace(
        view=SimpleNamespace(fitted=field, problem="end"),
        trials=Trials("end", {}),
        accepted=None,
    )
    given = {"held_before": None, "held_after": None, "floor": None, "fraction": None, "shares": ()}
    found = Evidence(
        problem=None, base=None, steps=(first, end), **given, rivals=(Start("beside", pair),)
    ).explanations
    assert set(found) == {("field",), ("three",), ("one", "two")}
    assert found["one", "two"].problem == "beside"


@pytest.mark.parametrize(
    ("left", "locates", "beside", "verdict"),
    [
        ("additive", False, 40.0, "UNLISTED"),
        ("additive", False, 60.0, "LISTED"),
        ("additive", True, 40.0, "LISTED"),
        ("spread", False, 40.0, "LISTED"),
    ],
)
def test_noise_that_hides_a_law_is_no_cause(left, locates, beside, verdict):
    """Of 100 nats it keeps less than half beside a model of what it leaves, however much of the gap it closes."""
    given = evidence("mean", 1e-9, left=left, locates=locates)
    given.remainder = SimpleNamespace(beside=beside)
    given.fitted, given.base = SimpleNamespace(log_evidence=-50.0), SimpleNamespace(log_evidence=-150.0)
    assert decide(given, (cause(0.995),), Settings()) == verdict


@pytest.mark.parametrize(
    ("kind", "left", "p_after", "verdict"),
    [
        ("variance", "additive", 1e-9, "UNLISTED"),
        ("variance", "dependence along subcarrier", 1e-9, "UNLISTED"),
        ("variance", "additive", 1e-4, "LISTED_WITH_REMAINDER"),
        ("variance", "tails", 1e-9, "LISTED_WITH_REMAINDER"),
        ("mean", "additive", 1e-9, "LISTED"),
    ],
)
def test_a_noise_of_each_cluster_whose_readings_hang_together_is_none(kind, left, p_after, verdict):
    """A receiver that stands elsewhere seems to be a noisy one, in whose residuals neighbours are alike."""
    given = evidence(kind, p_after, left=left, locates=False)
    assert decide(given, (cause(0.97),), Settings()) == verdict
