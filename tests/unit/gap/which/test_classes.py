"""Sets of effects that the data cannot rule out, from what each is worth."""

import numpy as np
import pytest

from dtprob.gap.which.classes import credible


def test_probabilities_are_those_of_the_evidence():
    worth = {("wall",): np.log(6.0), ("slope",): np.log(3.0), ("noise",): np.log(1.0)}
    classes, probability = credible(worth, ("wall",), 0.85)
    assert classes == (("wall",), ("slope",))
    assert probability == pytest.approx(0.6)
    assert credible(worth, ("wall",), 0.95)[0] == (("wall",), ("slope",), ("noise",))
    assert credible(worth, ("wall",), 0.5)[0] == (("wall",),)


def test_what_is_not_needed_makes_no_other_explanation():
    worth = {("wall",): np.log(5.0), ("slope", "wall"): np.log(4.0), ("noise", "slope", "wall"): np.log(1.0)}
    assert credible(worth, ("wall",), 0.9) == ((("wall",),), pytest.approx(1.0))
    beside = {**worth, ("slope",): np.log(5.0)}
    classes, probability = credible(beside, ("wall",), 0.9)
    assert classes == (("wall",), ("slope",))
    assert probability == pytest.approx(10 / 15)


def test_a_set_that_is_better_than_what_is_inside_it_stays():
    worth = {("wall",): np.log(2.0), ("slope", "wall"): np.log(8.0)}
    classes, probability = credible(worth, ("wall", "slope"), 0.9)
    assert classes == (("slope", "wall"), ("wall",))
    assert probability == pytest.approx(0.8)


def test_what_brings_hardly_more_is_no_other_explanation_either():
    """An offset that noise swamps is as likely there as not, and says nothing against the noise."""
    worth = {("noise",): 0.0, ("noise", "offset"): 0.1, ("offset",): -90.0}
    assert credible(worth, ("noise",), 0.9) == ((("noise",),), pytest.approx(1.0))
    more = credible({**worth, ("noise", "offset"): 1.2}, ("noise",), 0.9)[0]
    assert set(more) == {("noise",), ("noise", "offset")}


def test_the_accepted_set_is_never_counted_for_another():
    worth = {("wall",): 1.0, ("slope", "wall"): 1.0 - 1e-9}
    classes, probability = credible(worth, ("wall", "slope"), 0.9)
    assert set(map(frozenset, classes)) == {frozenset({"wall"}), frozenset({"slope", "wall"})}
    assert probability == pytest.approx(0.5)
