"""The page of a diagnosis: complete, self-contained, accessible, and right in what it says."""

import itertools
import re
from html.parser import HTMLParser
from typing import Any

import matplotlib as mpl
import pytest
import xarray as xr

from dtprob.errors import InputError
from dtprob.report import render, to_json, validate

VOID = {"meta", "br", "hr", "img", "link", "input", "col"}
HEADLINES = {
    "NO_GAP": "Nothing found: the twin agrees with the data.",
    "LISTED": "The gap comes from one effect: timing offset.",
    "LISTED_WITH_REMAINDER": "Part of the gap comes from two effects: timing offset and I/Q imbalance, "
    "or what looks the same in these data. No known effect explains the rest.",
    "UNLISTED": "There is a gap, and none of the known effects explains it.",
    "UNDETERMINED": "There is a gap, but the data cannot tell device disconnected (3) from arrival rate "
    "shift (3).",
}
ACTIONS = {
    "NO_GAP": "Nothing to change in the twin.",
    "LISTED": "Estimate: delay 1.02 ns (90% interval 0.91 to 1.13 ns).",
    "LISTED_WITH_REMAINDER": "The twin will be closer but not right.",
    "UNLISTED": "Do not add a listed effect",
    "UNDETERMINED": "Do not change the twin yet. First: let device 3 transmit in 40 slots",
}


class Page(HTMLParser):
    """Checks nesting and collects what the tests look at."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_says_the_verdict_and_what_to_do(verdict: str, report: dict[str, Any], page: str) -> None:
    text = Page(page).text
    assert HEADLINES[verdict] in text
    assert ACTIONS[verdict] in text
    assert text.index(HEADLINES[verdict]) < text.index("Method and provenance")
    assert report["provenance"]["data_sha256"] in text


def test_several_effects_have_their_shares(examples: dict[str, Any]) -> None:
    report = examples["LISTED_WITH_REMAINDER"]()
    names = report["causes"][0]["effects"]
    assert "Only it" not in Page(render(report, None, title="x")).text
    report["causes"][0]["shares"] = [
        {"effect": name, "mean": mean, "low": mean - 0.1, "high": mean + 0.1, "own": mean - 0.05}
        for name, mean in zip(names, (0.7, 0.3), strict=True)
    ]
    text = Page(render(report, None, title="x")).text
    assert "Of what they close together, each closes" in text
    assert re.search(r"Timing offset 70% ?60 to 80% 65%", text)


def test_what_was_fitted_besides_is_compared_with_the_named_cause(examples: dict[str, Any]) -> None:
    report = examples["LISTED_WITH_REMAINDER"]()
    names = report["causes"][0]["effects"]
    assert "Why not another one" not in Page(render(report, None, title="x")).text
    report["tried"] = [
        {"effects": names, "gain_nats": 80.0, "behind_nats": 0.0},
        {"effects": ["doppler"], "gain_nats": 60.0, "behind_nats": 20.0},
        {"effects": [*names, "doppler"], "gain_nats": 81.0, "behind_nats": 3.0},
        {"effects": ["tilted_antenna"], "gain_nats": 80.0, "behind_nats": 0.0},
    ]
    report["causes"][0]["alias_class"] = [["tilted_antenna"]]
    text = Page(render(report, None, title="x")).text
    assert "Why not another one" in text
    assert re.search(r"Doppler 75% ?> 10⁶ times", text)
    assert re.search(r"and doppler 100% ?the rest brings too little", text)
    assert not re.search(r"Tilted antenna 100%", text)  # it is told as one that is just as possible


def test_summary_of_the_diagnosis_is_the_headline(examples: dict[str, Any]) -> None:
    report = {**examples["UNDETERMINED"](), "summary": "All is <well>."}
    page = render(report, None, title="x")
    assert "All is &lt;well&gt;." in page
    assert HEADLINES["UNDETERMINED"] not in Page(page).text


def test_refers_to_nothing_outside(page: str) -> None:
    assert not re.search(r"https?:|//[a-z]|@import|\bsrc\s*=|<script|<link|\bxmlns", page)
    assert all(match.startswith("#") for match in re.findall(r"url\(([^)]*)\)", page))
    for _, attributes in Page(page).elements:
        assert (attributes.get("href") or "#").startswith("#")
        assert not any(name.startswith("on") for name in attributes)


def test_ids_are_unique_and_links_lead_somewhere(page: str) -> None:
    elements = Page(page).elements
    ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    targets = {a[name] for _, a in elements for name in ("aria-labelledby",) if name in a}
    targets |= {(a["href"] or "#").removeprefix("#") for _, a in elements if "href" in a}
    targets |= set(re.findall(r"url\(#([^)]*)\)", page))
    assert targets <= set(ids)


def test_every_figure_is_described(page: str) -> None:
    parsed = Page(page)
    figures = parsed.all("svg")
    assert len(figures) == len(parsed.all("figure")) == len(parsed.all("figcaption")) > 0
    for figure in figures:
        assert figure["role"] == "img"
        assert len(figure["aria-label"] or "") > 20


def test_structure_for_screen_readers(page: str) -> None:
    parsed = Page(page)
    assert parsed.all("html") == [{"lang": "en"}]
    assert len(parsed.all("h1")) == len(parsed.all("main")) == len(parsed.all("title")) == 1
    assert all("scope" in heading for heading in parsed.all("th"))
    levels = [int(tag[1]) for tag, _ in parsed.elements if re.fullmatch(r"h[1-6]", tag)]
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))


def test_maps_and_links_are_drawn_before_and_after(gap: xr.DataTree, examples: dict[str, Any]) -> None:
    listed = examples["LISTED"]()
    labels = [figure["aria-label"] or "" for figure in Page(render(listed, gap, title="x")).all("svg")]
    assert sum(label.startswith("Plan view") for label in labels) == 2
    assert sum(label.startswith("Gap over") for label in labels) == 2
    assert labels[0].startswith("Gap over subcarrier")
    without = [figure["aria-label"] or "" for figure in Page(render(listed, None, title="x")).all("svg")]
    assert not any(label.startswith(("Plan view", "Gap over")) for label in without)


def test_absent_parts_leave_a_page(examples: dict[str, Any]) -> None:
    for make in examples.values():
        report = make()
        for name in ("screening", "fit"):
            report.pop(name, None)
        report |= {"detectable": [], "next_measurement": None, "provenance": {}}
        report["gap"] |= {"floor": None, "in_user_terms": {}}
        report["unlisted"] = {"p_value": None, "sites": []}
        report["where"] = {"sites": [], "coordinates": []}
        for cause in report["causes"]:
            cause |= {"closed_fraction": None, "size": {}}
        page = Page(render(report, xr.DataTree.from_dict({"/where": xr.Dataset()}), title="x"))
        assert "Written by dtprob. " in " ".join(page.words)


def test_long_tables_are_folded_but_complete(examples: dict[str, Any]) -> None:
    report = examples["LISTED"]()
    page = Page(render(report, None, title="x"))
    assert len(page.all("details")) == 2
    for candidate in report["screening"][:8]:
        assert f"building {candidate['effect'][-2]}" in page.text


def test_warnings_are_said_with_the_verdict(examples: dict[str, Any]) -> None:
    text = Page(render(examples["LISTED_WITH_REMAINDER"](), None, title="x")).text
    verdict = text[: text.index("Which effect causes it")]
    assert "the fit of the twin did not converge" in verdict
    assert "larger than this effect plausibly has" in verdict
    assert "Treat this verdict with care" not in Page(render(examples["LISTED"](), None, title="x")).text


def test_copies_are_said_with_the_verdict(examples: dict[str, Any]) -> None:
    """They make gaps of their own."""
    report = examples["UNLISTED"]()
    report["fit"]["warnings"] = [
        "9 of 90 values of y are others again: was a log read twice? Leave copies out"
    ]
    text = Page(render(report, None, title="x")).text
    assert "9 of 90 values of y are others again" in text[: text.index("Where it lies")]


def test_same_input_gives_the_same_page(report: dict[str, Any], gap: xr.DataTree, page: str) -> None:
    settings = dict(mpl.rcParams)
    assert render(report, gap, title="Street canyon") == page
    assert dict(mpl.rcParams) == settings


def test_values_that_are_not_finite_are_left_out(examples: dict[str, Any], gap: xr.DataTree) -> None:
    links, where = gap["links"].to_dataset(), gap["where"].to_dataset()
    links["before"][:3] = float("nan")
    where["gap_rx_antenna"][0] = float("inf")
    where["gap_subcarrier"][:] = float("nan")
    broken = xr.DataTree.from_dict({"/links": links, "/where": where})
    labels = [
        svg["aria-label"] or "" for svg in Page(render(examples["LISTED"](), broken, title="x")).all("svg")
    ]
    assert any("147 links" in label for label in labels)
    assert any(
        label.startswith("Gap over receive antenna: before, the highest excess is 6.20") for label in labels
    )
    assert not any("nan" in label or "subcarrier" in label for label in labels)


def test_without_an_accepted_cause_nothing_is_shown_as_after(
    examples: dict[str, Any], gap: xr.DataTree
) -> None:
    labels = [
        svg["aria-label"] or "" for svg in Page(render(examples["UNLISTED"](), gap, title="x")).all("svg")
    ]
    assert sum(label.startswith("Plan view") for label in labels) == 1
    assert not any("after" in label for label in labels)


def test_a_small_remainder_is_not_called_chance(examples: dict[str, Any]) -> None:
    report = examples["LISTED"]()
    assert "What is left is no more than chance." in Page(render(report, None, title="x")).text
    report["unlisted"] = {"p_value": 1e-9, "sites": ["path_gain"]}
    text = Page(render(report, None, title="x")).text
    assert "no more than chance" not in text
    assert "What is left is not chance, but small beside the cause." in text


def test_unconfirmed_signs_are_not_called_a_gap(examples: dict[str, Any]) -> None:
    report = examples["UNDETERMINED"]()
    report["causes"] = [{**report["causes"][0], "alias_class": [["device_disconnected[3]"]]}]
    report["next_measurement"] = None
    text = Page(render(report, None, title="x")).text
    assert "There are signs of device disconnected (3), but the data do not confirm them." in text
    assert "The gap is real" not in text


def _with_candidates(report: dict[str, Any], judged: int, absorbed: int) -> str:
    """The words of its page with so many candidates that could be judged, and so many that could not."""
    rows = report["screening"]
    clear = [row for row in rows if not row["absorbed_by"]]
    dull = next(row for row in rows if row["absorbed_by"])
    page = render({**report, "screening": [*clear[:judged], *[dull] * absorbed]}, None, title="x")
    return " ".join(" ".join(Page(page).words).split())


def test_candidates_that_could_not_be_judged_are_not_called_tried(examples: dict[str, Any]) -> None:
    quiet, unknown = examples["NO_GAP"](), examples["UNLISTED"]()
    assert "Of 3 candidates none explains" in _with_candidates(quiet, 3, 2)
    assert "The one candidate that could be judged explains" in _with_candidates(quiet, 1, 2)
    assert "No candidate could be judged." in _with_candidates(quiet, 0, 2)
    assert "3 candidates were tried" in _with_candidates(unknown, 3, 2)
    assert "One candidate was tried; with it" in _with_candidates(unknown, 1, 0)
    assert "One effect was screened before" in _with_candidates(unknown, 1, 0)
    assert "No candidate could be judged." in _with_candidates(unknown, 0, 1)


def test_one_group_is_told_as_one(examples: dict[str, Any]) -> None:
    report = examples["NO_GAP"]()
    report["fit"] |= {"n_clusters": 1, "n_observations": 1000}
    assert "1\u202f000 observations in 1 independent group." in render(report, None, title="x")


def test_text_of_users_is_escaped(examples: dict[str, Any]) -> None:
    report = examples["LISTED"]()
    report["causes"][0]["physics"] = "<script>alert(1)</script>"
    report["causes"][0]["effects"] = ["my_effect[<b>]"]
    page = render(report, None, title="a <i> & b")
    assert "<script" not in page
    assert "<i> &" not in page
    assert "<b>" not in page


def test_examples_keep_to_the_schema(report: dict[str, Any]) -> None:
    assert validate(report)["verdict"] == report["verdict"]
    assert to_json(report).endswith("}\n")


def test_wrong_report_is_refused(report: dict[str, Any]) -> None:
    report["gap"]["before"] = float("nan")
    with pytest.raises(InputError, match=r"report\.gap\.before: expected a finite number, got nan"):
        render(report, None, title="x")


def test_a_spread_is_called_a_spread(examples: dict[str, Any]) -> None:
    report = examples["UNLISTED"]()
    report["where"]["sites"] = [
        {"site": "noiseless_channel", "p_value": 1e-9, "share": 0.9, "family": "additive, link"},
        {"site": "channel", "p_value": 1e-9, "share": 0.9, "family": "spread, by link", "moment": "spread"},
    ]
    report["unlisted"] |= {"sites": ["channel"], "located": report["where"]["sites"][1:]}
    text = Page(render(report, None, title="x")).text
    assert "lies in the spread of the measured channel" in text
    assert "Spread of the measured channel" in text
    assert "Channel as a whole" in text
    assert "Look for what could change the spread of the measured channel there." in text


def test_the_remainder_is_told_with_its_calibration(examples: dict[str, Any]) -> None:
    report = examples["UNLISTED"]()
    text = Page(render(report, None, title="x")).text
    assert "What is left, modelled where it shows" not in text
    report["remainder"] = {
        "terms": [
            {"site": "arrival", "shape": shape, "weights": 4, "per_cluster": own, "evidence": 9.0}
            for shape, own in [
                ("additive, smooth in time", False),
                ("relative, link", True),
                ("additive, by run", True),
                ("relative, every 7 along slot", False),
            ]
        ],
        "closed_fraction": {"mean": 0.81, "low": 0.7, "high": 0.9},
        "gain_nats": 30.0,
        "before": {"coverage": 0.71, "error_ratio": 1.6},
        "after": {"coverage": 0.9, "error_ratio": 1.01},
    }
    page = Page(render(report, None, title="x"))
    assert "this closes 81% of what is wrong (90% interval 70 to 90%)" in page.text
    assert "vary smoothly in time" in page.text
    assert "vary from link to link" in page.text
    assert "vary by run" in page.text
    assert "vary in a cycle of 7 along slot" in page.text
    assert "becomes wider instead of moving" in page.text
    assert re.search(r"inside their 90% interval 71% 90% 90%", page.text)
    assert any("Share of what is left" in (svg["aria-label"] or "") for svg in page.all("svg"))
    report["remainder"]["before"]["coverage"] = report["remainder"]["after"]["coverage"] = None
    counts = Page(render(report, None, title="x")).text
    assert "inside their 90% interval" not in counts
    assert re.search(r"Actual error over predicted error 1\.6\d* 1\.01 1", counts)
    report["remainder"]["before"]["error_ratio"] = report["remainder"]["after"]["error_ratio"] = None
    outcomes = Page(render(report, None, title="x")).text
    assert "What is left, modelled where it shows" in outcomes
    assert "as uncertain as they say" not in outcomes


def test_what_came_near_to_a_gap_is_where_it_lies(examples: dict[str, Any]) -> None:
    report = examples["NO_GAP"]()
    assert "agree with the twin everywhere" in Page(render(report, None, title="x")).text
    report["where"]["sites"] = [
        {"site": "predicted_label", "p_value": 0.0064, "share": 1.0, "whereabouts": "along x[0]"}
    ]
    text = Page(render(report, None, title="x")).text
    assert "agree with the twin everywhere" not in text
    assert "predicted labels (along x[0]) came nearest to a gap (p = 0.0064)" in text


def test_which_gap_is_closed_is_said(page: str) -> None:
    assert "avoidable error that the twin's own quantities and the candidates can see" in Page(page).text


def test_sizes_are_told_as_they_are_meant(examples: dict[str, Any]) -> None:
    report = examples["UNDETERMINED"]()
    meaning = {"words": "slots in which its radio is off", "told_as": "share"}
    size = {"mean": 0.478, "low": 0.315, "high": 0.647, "unit": "1", "meaning": meaning}
    report["causes"][0] |= {"size": {"sleep": size}, "strata": {"estimate": [0.4, 0.5]}}
    text = Page(render(report, None, title="x")).text
    assert re.search(r"Slots in which its radio is off 38% ?27 to 48%", text)
    assert "without another part of the data: 33 and 39%" in text
