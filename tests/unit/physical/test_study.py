"""The loop over withheld cases, with a track whose campaigns are numbers."""

import json

import numpy as np
import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.physical.study import Order, Track


def track(most, drawn=None):
    """A track whose campaigns carry an effect of a lambda below `most`, drawn anew for each and put on a list."""

    def campaign(rng, _number, _families):
        strength = most * rng.random()
        if drawn is not None:
            drawn.append(strength)
        return strength

    def case(out, order, strength):
        if order.lambda_ > strength:
            raise InputError("withheld case", f"a fault of lambda {order.lambda_:g}", "none", "Ask for less")
        return order.record([{"name": "fault", "lambda": strength}], ())

    return Track(
        name="numbers",
        convention="",
        kinds=("listed",),
        usual=("listed",),
        families=("fault",),
        listed=("fault",),
        plan={},
        campaign=campaign,
        case=case,
    )


def test_a_campaign_that_cannot_carry_an_effect_is_replaced(tmp_path):
    drawn = []
    key = json.loads(track(2.0, drawn).generate(tmp_path, 40, 0, lambda_=1.0).read_text())
    assert len(key["cases"]) == 40
    assert min(drawn) < 1 <= min(case["effects"][0]["lambda"] for case in key["cases"])
    again = json.loads(track(2.0).generate(tmp_path / "again", 40, 0, lambda_=1.0).read_text())
    assert [c["effects"] for c in again["cases"]] == [c["effects"] for c in key["cases"]]


def test_a_folder_holds_one_study(tmp_path):
    track(2.0).generate(tmp_path, 3, 0, lambda_=1.0)
    made = track(2.0).generate(tmp_path, 5, 0, lambda_=1.0, resume=True)
    assert len(json.loads(made.read_text())["cases"]) == 5
    for seed, lambda_ in ((1, 1.0), (0, 0.5)):
        with pytest.raises(InputError, match="another study"):
            track(2.0).generate(tmp_path, 5, seed, lambda_=lambda_, resume=True)
    (tmp_path / "study.json").unlink()
    with pytest.raises(InputError, match="another study"):
        track(2.0).generate(tmp_path, 5, 0, lambda_=1.0, resume=True)


def test_a_case_does_not_tell_its_kind_by_what_it_leaves_out():
    """As often as for unlisted causes a family is left out, but none that the case holds."""
    found = []
    for index in range(2000):
        order = Order(index, 0, "listed", 1.0, ("a", "b", "c"), np.random.default_rng(0))
        found.append(order.left_out((), [{"name": "a[1]"}, None], order.families, 2 / 3))
    assert {family for one in found for family in one} == {"b", "c"}
    assert stats.binomtest(sum(map(len, found)), 2000, 2 / 3).pvalue > 1e-3
    unlisted = Order(0, 0, "unlisted", 1.0, ("a", "b"), np.random.default_rng(0))
    assert unlisted.left_out(("a",), [{"name": "a"}], ("a", "b"), 1.0) == ("a",)
    assert unlisted.left_out((), [{"name": "foreign"}], ("a", "b"), 1.0) == ()


@pytest.mark.parametrize("lambda_", [0.0, float("nan"), float("inf")])
def test_a_lambda_is_a_positive_number(lambda_, tmp_path):
    with pytest.raises(InputError, match="positive values of lambda"):
        track(2.0).generate(tmp_path, 1, 0, lambda_=lambda_)


def test_what_no_campaign_can_carry_is_refused(tmp_path):
    with pytest.raises(InputError, match="Ask for less"):
        track(1.0).generate(tmp_path, 1, 0, lambda_=1.0)
