"""How often the sites are looked at again, and with how many replicates."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from dtprob.gap.settings import Settings
from dtprob.gap.where.locate import _further_looks


def looks(first, affordable, *, shown=False, discrete=False, **settings):
    drawn = SimpleNamespace(at_sites=first, most=lambda times: min(times, affordable))
    return list(_further_looks(cast("Any", drawn), Settings(**settings), shown=shown, discrete=discrete))


def test_a_second_look_is_of_four_hundred_and_a_third_of_all():
    (second, open_at_first), (third, open_at_second) = looks(99, 1000)
    assert (second, third) == (5, 20)
    assert open_at_first == (1e-9, 0.5)
    assert open_at_second == pytest.approx((5e-5, 0.05))


def test_where_a_gap_is_shown_the_first_look_mostly_suffices():
    (_, (low, _)), _ = looks(99, 1000, shown=True)
    assert low == 1e-6


def test_outcomes_are_looked_at_again_however_surely_wrong_they_seem():
    (_, (low, high)), (_, third) = looks(99, 1000, shown=True, discrete=True)
    assert (low, high) == (0.0, 0.1)
    assert third == pytest.approx((5e-9, 0.05))


@pytest.mark.parametrize(
    ("first", "affordable", "settings", "expected"),
    [
        (19, 1000, {}, [20]),  # few at first: all at once
        (99, 3, {}, [3]),  # large sites
        (99, 1, {}, []),
        (99, 1000, {"site_times": 1}, []),
        (500, 1000, {}, [20]),  # enough at first
    ],
)
def test_no_look_is_taken_twice(first, affordable, settings, expected):
    assert [times for times, _ in looks(first, affordable, **settings)] == expected


def test_the_third_look_follows_the_level():
    assert looks(99, 1000, level=0.1)[1][1] == pytest.approx((5e-4, 0.5))
