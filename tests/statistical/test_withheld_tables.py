"""58 withheld cases of labels and of users' own models; see `tests.withheld_study` for what the bounds mean."""

import pytest

from tests.withheld_study import at_least, at_most, studied, summed

CASES = {
    "labels": [*["null"] * 25, *["listed"] * 7, *["unlisted"] * 4],
    "custom": [*["null"] * 14, *["listed"] * 5, *["unlisted"] * 3],
}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    return [studied(folder, track, kinds, seed=20) for track, kinds in CASES.items()]


def test_false_alarms(found):
    count, of = summed(found, "null", "alarm")
    assert of == 39
    assert count <= at_most(of, 0.01)


@pytest.mark.parametrize(
    ("kind", "name", "rate"),
    [
        ("listed", "right effect first", 0.85),
        ("listed", "truth in the class", 0.9),
        ("listed", "right site first", 0.75),
        ("unlisted", "right site first", 0.6),
    ],
)
def test_what_is_found(kind, name, rate, found):
    count, of = summed(found, kind, name)
    assert of == {"listed": 12, "unlisted": 7}[kind]
    assert count >= at_least(of, rate)


@pytest.mark.parametrize("kind", ["listed", "unlisted"])
def test_nothing_of_this_size_is_missed(kind, found):
    count, of = summed(found, kind, "missed")
    assert count <= at_most(of, 0.01)
