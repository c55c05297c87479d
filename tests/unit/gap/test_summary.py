"""The verdict in one sentence."""

from types import SimpleNamespace

import pytest

from dtprob.effects import Meaning
from dtprob.gap.compose import spreads_only, summary
from dtprob.gap.diagnosis import Cause, Diagnosis, Size
from dtprob.gap.how_far.closed import ClosedFraction
from dtprob.gap.located import site_shares, unlisted
from dtprob.gap.where.coordinates import CoordinateFinding
from dtprob.gap.where.locate import Location
from dtprob.gap.where.site_finding import SiteFinding


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ([("a",), ("b",)], "There is a gap, but the data cannot tell a or b apart."),
        ([("a", "b"), ("c",)], "There is a gap, but the data cannot tell a and b or c apart."),
        (
            [("a", "b"), ("c", "a")],
            "The gap comes from a together with b or c, and the data cannot tell which.",
        ),
        ([("a",), ("a", "b")], "The gap comes from a, perhaps together with b: the data cannot tell."),
        ([("a",)], "There are signs of a, but held-out data do not confirm that it closes a gap."),
    ],
)
def test_what_explanations_share_is_said_first(sets, said):
    cause = SimpleNamespace(effects=sets[0], alias_class=sets, closed_fraction=None)
    assert summary("UNDETERMINED", (cause,), SimpleNamespace()) == said


def test_effects_that_were_not_looked_for_any_more_are_said():
    cause = SimpleNamespace(effects=("a",), alias_class=(("a",),), closed_fraction=None)
    evidence = SimpleNamespace(asked_for=("b",), accepted=("a",))
    assert summary("LISTED_WITH_REMAINDER", (cause,), evidence) == (
        "Most of the gap comes from a; only one effect was looked for, and b may explain some of what is left."
    )


@pytest.mark.parametrize(
    ("effects", "said"), [(("a",), "a, which closes"), (("a", "b"), "a and b, which close")]
)
def test_what_is_named_closes_a_share(effects, said):
    closed = SimpleNamespace(mean=0.9, low=0.8, high=0.95)
    cause = SimpleNamespace(effects=effects, alias_class=(effects,), closed_fraction=closed)
    assert summary("LISTED", (cause,), SimpleNamespace()) == (
        f"The gap comes from {said} 90% of the gap (80 to 95%)."
    )


def test_a_gap_within_the_tolerance_is_a_gap():
    assert summary("NO_GAP", (), SimpleNamespace(), tolerated=True).startswith("A gap was found")
    assert summary("NO_GAP", (), SimpleNamespace()).startswith("No gap was found")


@pytest.mark.parametrize(("effects", "said"), [(("a",), "a imitates"), (("a", "b"), "a and b imitate")])
def test_what_imitates_part_of_an_unknown_cause_is_said(effects, said):
    cause = SimpleNamespace(
        effects=effects, alias_class=(effects,), closed_fraction=ClosedFraction(0.4, 0.2, 0.6)
    )
    nowhere = Location((), (), {}, 1e-9)
    evidence = SimpleNamespace(before=nowhere, after=nowhere, problem=SimpleNamespace(effects=("a", "b")))
    assert summary("UNLISTED", (cause,), evidence).endswith(f" {said} part of it.")
    cause.closed_fraction = None  # not established that it closes anything
    assert "part of it" not in summary("UNLISTED", (cause,), evidence)


def test_shares_are_of_a_gap_and_of_what_can_be_moved():
    found = [
        SiteFinding("delay", "additive", "common", 1e-9, 30.0),
        SiteFinding("power", "additive", "common", 0.01, 2.0),
        SiteFinding("y", "spread", "common", 0.2, 100.0),
        SiteFinding("y", "dependence along link", "common", 0.3, None),
    ]
    assert site_shares(found, 40.0, {"power": 0.9}) == [0.75, 0.9, 1.0, None]
    assert site_shares(found, 1e-3, {"power": 0.9}) == [None] * 4


def test_what_is_left_names_each_site_once_and_each_way_that_it_is_wrong():
    found = (
        SiteFinding("y", "dependence along link", "common", 1e-9, None),
        SiteFinding("y", "spread", "common", 1e-3, 3.0),
        SiteFinding("power", "additive", "common", 0.3, 1.0),
    )
    left = unlisted(Location(found, (), {}, 1e-9), 0.005)
    assert left["p_value"] == 1e-9
    assert left["sites"] == ["y"]
    assert [site["family"] for site in left["located"]] == ["dependence along link, common", "spread, common"]


def test_it_is_said_where_a_site_is_wrong():
    sites = (
        SiteFinding(
            "mean", "additive", "slot 408 to 435", 1e-9, 9.0, place="slot 410", whereabouts="slot 408 to 435"
        ),
        SiteFinding("y", "spread", "ripple in day, 9 to 16 half waves", 1e-9, None),
    )
    blocks = (CoordinateFinding("rx_antenna", 1, 2, 1e-22, 40.0), CoordinateFinding("link", 6, 6, 1e-17, 9.0))
    here = Location(sites, blocks, {}, 1e-9)
    evidence = SimpleNamespace(before=here, after=here, problem=SimpleNamespace(effects=()))
    assert summary("UNLISTED", (), evidence).endswith(
        " It shows at mean (slot 408 to 435), the spread of y; most of it at slot 410."
    )
    bare = (SiteFinding("rx_response", "conjugate", "stretch of link x rx_antenna", 1e-9, 9.0),)
    for found, said in ((blocks, ", and in the data most at rx_antenna 1 to 2."), ((), "rx_response.")):
        here = Location(bare, found, {}, 1e-9)
        evidence = SimpleNamespace(before=here, after=here, problem=SimpleNamespace(effects=()))
        assert summary("UNLISTED", (), evidence).endswith(said)


def test_sites_that_only_spread_say_so():
    found = [
        SiteFinding(name, "relative", "link", 1e-9, 9.0, spreads=name == "noise")
        for name in ("noise", "gain")
    ]
    left = unlisted(Location(tuple(found), (), {}, 1e-9), 0.005)
    assert [site.get("spreads", False) for site in left["located"]] == [True, False]


def test_what_a_size_means_is_in_the_report():
    meaning = Meaning("slots in which its radio is off", "share")
    size = Size("sleep", 0.478, 0.3, 0.6, "1", meaning)
    cause = Cause(("a",), (("a",),), 1.0, (size,), None, None, 1.0, (), "", (), plausible=True)
    told = Diagnosis("LISTED", "", (cause,), {}, {}).to_report()["causes"][0]["size"]["sleep"]
    assert told["meaning"] == {"words": meaning.words, "told_as": "share"}


def test_noise_spreads_and_fields_where_their_sites_do():
    noise = SiteFinding("noise_power", "relative", "common", 0.2, 1.0, spreads=True)
    gain = SiteFinding("path_gain", "relative", "common", 0.2, 1.0)
    observed = SimpleNamespace(declaration=SimpleNamespace(observed={"channel": None}))
    evidence = SimpleNamespace(before=Location((noise, gain), (), {}, 0.2), problem=observed)
    for kind, site, locates, only in (
        ("mean", "path_gain", True, False),
        ("mean", "channel", False, True),
        ("variance", "noise_power", False, True),
        ("variance", "path_gain", False, False),
    ):
        effect = SimpleNamespace(kind=kind, sites=(site,))
        assert spreads_only(effect, evidence, locates=locates) == only
