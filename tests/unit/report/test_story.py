"""Words for names, sizes and verdicts."""

import pytest

from dtprob.effects import summaries
from dtprob.gap.vocabulary import READ_TWICE, UNSEEN
from dtprob.report import names, sizes
from dtprob.report.advice import ADVICE, advice, family
from dtprob.report.detectable import detectable_families
from dtprob.report.json_schema import Cause, Detectable
from dtprob.report.next_step import left_over, next_look, next_step
from dtprob.report.page import bar, ranked
from dtprob.report.story import tell


def _cause(*effects: str, alias: list[list[str]] | None = None) -> Cause:
    return {
        "effects": list(effects),
        "alias_class": alias or [list(effects)],
        "probability": 1.0,
        "size": {},
        "closed_fraction": None,
    }


def test_only_what_is_hardly_chance_is_located() -> None:
    sites: list[names.Site] = [{"site": s, "p_value": p, "share": 1.0} for s, p in (("a", 0.2), ("b", 0.01))]
    assert [site["site"] for site in names.significant(sites)] == ["b"]


def test_names_become_words() -> None:
    assert names.words("iq_imbalance") == "I/Q imbalance"
    assert names.words("object_displacement[building_2]") == "object displacement (building 2)"
    assert names.words("bias[rack[3]]") == "bias (rack[3])"
    assert names.together(["a_b", "c", "ack_loss"]) == "a b, c and ACK loss"
    assert names.listing([]) == ""
    assert names.site_words("arrival") == "directions of arrival"
    assert names.site_words("my_site") == "my site"
    assert names.term("channel_nmse_db") == "channel error (NMSE)"
    assert names.term("power_dbm_rmse") == names.term("power_rmse_db") == "power error (root mean square)"


def test_blocks_told_together_are_one_line() -> None:
    parts = [(3.0, 3.0), (7.0, 9.0), *((k, k) for k in (11.0, 13.0, 17.0, 19.0))]
    block: names.Coordinates = {"axes": {"row": (3, 19)}, "parts": parts, "p_value": 1e-5, "share": 0.4}
    assert names.block(block) == "row 3, 7\u00a0to\u00a09, 11, 13 and 2 more, together"
    assert names.block({"axes": {"row": (3, 4)}, "p_value": 1e-5, "share": 0.4}) == "row 3\u00a0to\u00a04"


def test_a_row_is_told_by_its_whole_number() -> None:
    block: names.Coordinates = {"axes": {"row": (1234567, 1234890)}, "p_value": 1e-5, "share": 0.4}
    assert names.block(block) == "row 1234567\u00a0to\u00a01234890"
    assert names.block({**block, "axes": {"angle": (-0.1234567, 2.0)}}) == "angle -0.123457\u00a0to\u00a02"


def test_aliases_leave_the_cause_out() -> None:
    assert names.aliases(_cause("a", "b", alias=[["b", "a"], ["c"]])) == [["c"]]


def test_user_terms_share_unit_and_decimals() -> None:
    assert names.user_terms("throughput", 0.845, 0.912) == ["0.845", "0.912"]
    assert names.user_terms("power_dbm_rmse", 4.04, 1.2) == ["4.0\u202fdB", "1.2\u202fdB"]
    assert names.user_terms("label_rmse", 0.5, None) == ["0.500"]
    assert names.user_terms("channel_nmse_db", -3.14, -17.8) == ["−3.1\u202fdB", "−17.8\u202fdB"]
    assert names.user_terms("delay_s", 1e-9, None) == ["1.00\u202fns"]
    assert names.user_terms("power_w", 1e-3, None) == ["0\u202fdBm"]
    assert names.user_terms("power_w_rmse", 0.308, 0.2) == ["0.31\u202fW", "0.20\u202fW"]
    assert names.user_terms("throughput_error", 0.127013, 0.1270131) == ["0.1270", "0.1270"]
    assert names.is_unchanged("throughput_error", 0.127, 0.1275)
    assert not names.is_unchanged("throughput_error", 0.236, 0.219)
    assert not names.is_unchanged("channel_nmse_db", -20.0, -20.2)


def test_estimates_of_strata_share_the_unit_of_the_size() -> None:
    shown = sizes.apart("delay_s", {"mean": 1e-9, "low": 0.9e-9, "high": 1.1e-9}, [0.98e-9, 1.03e-9])
    assert shown == "0.98 and 1.03\u202fns"


def test_detectable_sizes_of_a_family_are_its_worst() -> None:
    entries: list[Detectable] = [
        {"effect": "shift[a]", "size": 0.02, "unit": "m"},
        {"effect": "shift[b]", "size": 0.05, "unit": "m"},
        {"effect": "other", "size": 0.1},
    ]
    first, second = detectable_families(entries)
    assert (first.name, first.size, first.count) == ("shift", "5.0\u202fcm", 2)
    assert first.sizes == "2.0\u202fcm to 5.0\u202fcm"
    assert (second.name, second.size, second.sizes, second.count) == ("other", "0.10", "0.10", 1)
    beyond: list[Detectable] = [
        {"effect": "turn[a]", "size": 14.0, "parameter": "rotation", "unit": "rad"},
        {"effect": "missing[a]", "size": 0.5, "parameter": "fraction"},
        {"effect": "missing[b]", "size": 1.5, "parameter": "fraction"},
    ]
    assert [entry.sizes for entry in detectable_families(beyond)] == ["not at all", "0.50 to not at all"]
    (ratio,) = detectable_families([{"effect": "noise", "size": 0.03, "parameter": "log_ratio"}])
    assert (ratio.parameter, ratio.size) == ("factor of ratio", "1.030")


def test_sizes_drop_the_unit_of_their_key() -> None:
    interval = {"mean": 0.1, "low": 0.05, "high": 0.15}
    label, shown = sizes.size_reading("array_calibration[rx_1].log_gain_Np", {**interval, "unit": "Np"})
    assert label == "array calibration (rx 1): gain"
    assert (shown.mean, shown.unit) == ("0.87", "dB")
    assert sizes.size_reading("velocity_x_m_per_s", {**interval, "unit": "m/s"})[0] == "velocity x"
    assert sizes.size_reading("scale_rad_per_s0.5", {**interval, "unit": "rad/s^0.5"})[0] == "scale"
    assert sizes.size_reading("delay_s", interval)[0] == "delay"
    assert sizes.size_reading("gps.metres_1", {**interval, "unit": "1"})[0] == "gps: metres 1"


def test_a_logarithm_is_told_as_a_factor() -> None:
    size: names.Size = {"mean": 0.7, "low": 0.6, "high": 0.8, "unit": "1"}
    label, shown = sizes.size_reading("label_noise[x0_low].log_ratio", size)
    assert (label, shown.mean, shown.low, shown.high) == (
        "label noise (x0 low): ratio",
        "2.01",
        "1.82",
        "2.23",
    )
    assert sizes.apart("log_ratio", size, [0.6, 0.8]) == "1.82 and 2.23"


def test_code_names_in_sentences_become_words() -> None:
    codes = ["path_delay", "arrival", "shift_all", "shift_all[wall_2]", "my_shift_all"]
    said = names.spoken(
        "It is shift_all[wall_2] or shift_all at path_delay on arrival (my_shift_all).", codes
    )
    assert said == "It is shift all (wall 2) or shift all at path delays on arrival (my shift all)."
    assert names.spoken("plain", []) == "plain"


def test_next_step_is_made_from_a_design() -> None:
    plan = {"split": [["a"], ["b"]], "design": {"link": 17}, "gain_nats": 0.25, "repeats": 12}
    report: names.Any = {"next_measurement": plan}
    assert next_step(report) == "Measure link 17 again 12 times: there the explanations differ most."
    report = {"next_measurement": "Do it."}
    assert next_step(report) == "Do it."


def test_a_design_of_several_places_is_measured_at_each() -> None:
    report: names.Any = {"next_measurement": {"design": {"sample": [173, 347]}, "repeats": 12}}
    said = "Measure samples 173 and 347 again 12 times each: there the explanations differ most."
    assert next_step(report) == said
    report = {"next_measurement": {"design": {"sample": [173]}, "repeats": 1}}
    assert next_step(report) == "Measure sample 173 again: there the explanations differ most."


def test_a_cause_that_changes_nothing_for_the_user_is_called_small() -> None:
    small = _report(channel_nmse_db=[-20.01, -20.05])
    assert "hardly changes the channel error (NMSE)" in tell(small).meaning
    for terms in (
        {"channel_nmse_db": [-20.0, -21.0]},
        {"load_error": [0.2, 0.1], "delay_error": [0.2, 0.2]},
        {},
    ):
        assert "hardly" not in tell(_report(**terms)).meaning


def test_what_cannot_be_judged_is_said_where_nothing_is_found() -> None:
    report = {**_report(), "verdict": "NO_GAP", "causes": []}
    assert "2 known effects were tried" in tell(report).meaning
    assert "C could not be judged" in tell(report).meaning


def test_that_no_effects_were_given_is_said() -> None:
    nothing: names.Any = {**_report(), "causes": [], "screening": []}
    assert "No effects were given" in tell({**nothing, "verdict": "NO_GAP"}).meaning
    told = tell({**_unlisted(), "screening": []})
    assert "no effects were given" in told.headline
    assert "listed" not in told.meaning + told.action


def _unlisted(*left: names.Site) -> names.Any:
    found = {"p_value": 1e-9, "sites": [site["site"] for site in left], "located": list(left)}
    nothing: names.Site = {
        "site": "delay",
        "p_value": 0.9,
        "share": None,
        "family": "spread, common",
        "moment": "spread",
    }
    where = {"sites": [*left, nothing], "coordinates": []}
    return {**_report(), "verdict": "UNLISTED", "causes": [], "unlisted": found, "where": where}


def test_what_is_left_is_told_as_it_is_wrong() -> None:
    moment = "dependence on rss"
    left: names.Site = {"site": "delay", "p_value": 1e-9, "share": None, "family": f"{moment}, common"}
    report = _unlisted({**left, "moment": moment})
    assert "lies in the dependence of the delay on RSS" in tell(report).meaning
    assert "cause the dependence of the delay on RSS, or declare errors that are so" in tell(report).action
    assert next_look(report).endswith("Look for what could cause the dependence of the delay on RSS.")


@pytest.mark.parametrize(
    ("kind", "hint"),
    [("skewness", "err to one side"), ("dispersion", "a schedule"), ("tails", "farther off")],
)
def test_what_makes_a_law_wrong_is_hinted_at(kind: str, hint: str) -> None:
    report = _unlisted(
        {"site": "delay", "p_value": 1e-9, "share": None, "family": f"{kind}, common", "moment": kind}
    )
    assert f"the {kind} of the delay" in tell(report).headline + tell(report).meaning
    assert f"change the {kind} of the delay (" in next_look(report)
    assert hint in next_look(report)


def test_a_value_that_is_wrong_calls_for_physics() -> None:
    values: names.Site = {"site": "range", "p_value": 1e-9, "share": 0.5, "family": "additive, common"}
    spread: names.Site = {
        "site": "y",
        "p_value": 1e-3,
        "share": None,
        "family": "spread, by wall",
        "moment": "spread",
    }
    assert "Look for physics" in tell(_unlisted(values, spread)).action
    assert (
        "change the range and change the spread of the readings" not in tell(_unlisted(values, spread)).action
    )
    assert "change the spread of the readings, or declare" in tell(_unlisted(spread)).action


def test_a_site_that_is_wrong_in_two_ways_is_told_as_it_is_most_surely() -> None:
    two = [
        {"site": "y", "p_value": p, "share": None, "family": f, "moment": f}
        for p, f in ((1e-9, "tails"), (1e-3, "spread"))
    ]
    report = {**_unlisted(), "unlisted": {"p_value": 1e-9, "sites": ["y"], "located": two}}
    assert [names.located_words(site) for site in left_over(report)] == ["tails of the readings"]
    bare = {**report, "unlisted": {"p_value": 1e-9, "sites": ["y"]}}
    assert [names.located_words(site) for site in left_over(bare)] == ["readings"]


def test_the_place_that_stands_out_is_told_in_words() -> None:
    site = {"site": "mean", "p_value": 1e-9, "share": 0.9, "family": "additive, by access_point"}
    assert not names.place_words(site)
    assert names.place_words({**site, "place": "access_point 11"}) == " (most of it at access point 11)"


@pytest.mark.parametrize(
    ("whereabouts", "told"),
    [
        ("slot 408 to 435", " (slot 408 to 435)"),
        ("along day by access_point", " (along day by access point)"),
        ("over snr and load", " (over SNR and load)"),
        ("x[2] 2, x[0] -39.7 to -18.8", " (x[2] 2, x[0] -39.7 to -18.8)"),
        (None, ""),
    ],
)
def test_it_is_told_where_or_along_what_a_site_is_wrong(whereabouts: str | None, told: str) -> None:
    """Which slots, devices and columns they are is what helps; what does not say so is left out."""
    site = {"site": "mean", "p_value": 1e-9, "share": 0.9, "family": "additive, ..."}
    site |= {} if whereabouts is None else {"whereabouts": whereabouts}
    assert names.whereabouts(site) == told
    most = " (most of it at row 9)" if not told else f"{told[:-1]}, most of it at row 9)"
    assert names.whereabouts({**site, "place": "row 9"}) == most
    report = {**_unlisted(), "unlisted": {"p_value": 1e-9, "sites": ["mean"], "located": [site]}}
    assert f"lies in the {names.located_words(site)}{told}" in tell(report).meaning


def test_a_sentence_that_begins_with_a_code_name_begins_with_a_capital() -> None:
    said = "There is a gap, and none of the known effects explains it. iq_imbalance and stale_map[a] imitate part of it."
    report = {**_report(), "verdict": "UNLISTED", "summary": said}
    report["causes"][0]["effects"] = ["iq_imbalance", "stale_map[a]"]
    assert tell(report).headline.endswith(" explains it. I/Q imbalance and stale map (a) imitate part of it.")
    report["causes"][0]["effects"], report["summary"] = ["stale_map"], "There is one. stale_map imitates it."
    assert tell(report).headline == "There is one. Stale map imitates it."


def test_values_that_are_read_too_often_call_for_what_makes_them() -> None:
    site = {
        "site": "y",
        "p_value": 1e-9,
        "share": None,
        "family": "repeats, each",
        "moment": "repeats",
        "place": "the value -92, read 18 times",
    }
    report = {**_unlisted(), "unlisted": {"p_value": 1e-9, "sites": ["y"], "located": [site]}}
    story = tell(report)
    assert "lies in the repeats of the readings (most of it at the value -92, read 18 times)" in story.meaning
    assert (
        "cause the repeats of the readings (a receiver at its limit, a sensor that is stuck" in story.action
    )


def _report(**terms: list[float]) -> names.Any:
    row = {"sites": ["y"], "z": 1.0, "p_value": 0.5, "adjusted_p_value": 1.0}
    absorbed = {"effect": "c", "absorbed_by": "gain", **row}
    return {
        "verdict": "LISTED",
        "causes": [_cause("a")],
        "where": {"sites": [], "coordinates": []},
        "gap": {"in_user_terms": terms},
        "unlisted": {"p_value": 0.5, "sites": []},
        "detectable": [],
        "screening": [{"effect": "a", **row}, {"effect": "b", **row}, absorbed],
        "next_measurement": None,
    }


def test_effects_whose_opposite_the_data_ask_for_are_named() -> None:
    """Beside a cause only where they are asked for more: what looks like the cause is asked for, too."""
    report = _report()
    below = {**report["screening"][1], "effect": "dry_step", "opposite": True}
    for z, said in ((-5.9, True), (-0.5, False)):
        rows = [report["screening"][0], {**below, "z": z}]
        assert (
            "even more for the opposite of dry step:" in tell({**report, "screening": rows}).meaning
        ) == said
        other = {**report, "verdict": "UNLISTED", "causes": [], "screening": rows}
        assert "ask for the opposite of dry step: look whether its size" in tell(other).action


def test_a_size_that_only_its_prior_forbids_is_said() -> None:
    report = {**_report(), "verdict": "UNLISTED", "causes": []}
    near, far = report["screening"][:2]
    for z, said in ((9.3, True), (0.5, False)):  # only of what the data ask for most
        rows = [near, {**far, "effect": "body", "z": z, "beyond": 6.2}]
        action = tell({**report, "screening": rows}).action
        assert ("ask for body, but 6 times the size that its prior calls usual" in action) == said


@pytest.mark.parametrize("verdict", ["NO_GAP", "LISTED", "LISTED_WITH_REMAINDER", "UNLISTED", "UNDETERMINED"])
def test_what_cannot_be_judged_is_said_with_its_reason_whatever_the_verdict(verdict: str) -> None:
    report = {**_report(), "verdict": verdict}
    dull = report["screening"][2]
    idle = [{**dull, "effect": effect, "absorbed_by": UNSEEN} for effect in ("worn_cable", "e", "f", "g")]
    meaning = tell({**report, "screening": [*report["screening"], *idle[:1]]}).meaning
    assert meaning.startswith("2 known effects were tried") == (verdict == "NO_GAP")
    taken_up = (
        f"{names.capital(names.words(dull['effect']))} could not be judged, because fitted parameters of"
    )
    assert taken_up in meaning
    assert "Worn cable could not be judged, because nothing that was observed depends on it." in meaning
    meaning = tell({**report, "screening": [*report["screening"], *idle]}).meaning
    assert (
        "4 listed effects could not be judged, because nothing that was observed depends on them." in meaning
    )
    assert "could not be judged" not in tell({**report, "screening": report["screening"][:2]}).meaning


def test_a_cause_that_was_named_is_not_said_to_be_unjudged() -> None:
    report = _report()
    (effect,) = report["causes"][0]["effects"]
    rows = [{**row, "absorbed_by": "level"} for row in report["screening"] if row["effect"] == effect]
    assert rows
    assert "could not be judged" not in tell({**report, "screening": rows}).meaning


def test_what_is_called_for_beside_the_cause_is_no_chance() -> None:
    assert "What is left is no more than chance." in tell(_report()).meaning
    more = {**_report(), "unlisted": {"p_value": 0.5, "sites": [], "called_for": ["slow_drift"]}}
    assert "The data call for one more effect, slow drift, which is small" in tell(more).meaning
    doubtful = {**_report(), "unlisted": {"p_value": 0.02, "sites": [], "called_for": []}}
    assert "What is left may be more than chance" in tell(doubtful).meaning


def test_next_step_says_what_is_saved_and_what_does_not_help() -> None:
    plan = {"design": {"design": "roof_sites", "link": 3}, "repeats": 1, "resolves": True, "cost": 1.0}
    report: names.Any = {"next_measurement": {**plan, "cost_of_all_again": 12.0}}
    said = next_step(report)
    assert said is not None
    assert said.startswith("Measure link 3 of the design roof sites: there the explanations differ most.")
    assert said.endswith("Everything again would cost 12 times as much.")
    alone = {"next_measurement": {**plan, "split": [["slow_drift"], []]}}
    assert str(next_step(alone)) == "Measure link 3 of the design roof sites: there it would show most."
    report = {"next_measurement": {**plan, "cost_of_all_again": None}}
    assert str(next_step(report)).endswith("Measuring everything again would not decide.")
    assert "verything" not in str(
        next_step({"next_measurement": plan})
    )  # too much to hold: nothing is known of it
    report = {"next_measurement": {**plan, "cost_of_all_again": 1.4}}
    assert str(next_step(report)).endswith("there the explanations differ most.")
    whole = {"design": {"link": [0, 1, 2]}, "repeats": 2, "resolves": True, "cost": 6.0, "everything": True}
    report = {"next_measurement": {**whole, "cost_of_all_again": 6.0}}
    assert next_step(report) == "Measure everything again 2 times: no few places decide for less."
    report = {"next_measurement": {**plan, "resolves": False, "cost_of_all_again": None}}
    assert str(next_step(report)).startswith("No measurement that is known of tells the explanations apart")


def test_advice_reads_as_an_imperative() -> None:
    assert family("blockage[wall_3]") == "blockage"
    assert advice("blockage[wall_3]") == ADVICE["blockage"]
    assert "new_effect" not in ADVICE
    assert set(ADVICE) == set(summaries())
    assert advice("new_effect[2]") == "add new effect (2), with its estimated size, to the twin"
    for text in ADVICE.values():
        assert text[0].islower()
        assert not text.endswith(".")


def test_a_bar_shows_zero_and_the_whole_interval() -> None:
    for low, mean, high in ((1.0, 2.0, 3.0), (-3.0, -2.0, -1.0), (-1.0, 0.5, 2.0), (0.0, 0.0, 0.0)):
        place = bar({"low": low, "mean": mean, "high": high})
        assert 0 <= place.low <= place.mean <= place.high <= 100
        assert 0 <= place.zero <= 100


def test_candidates_are_ranked_and_untested_ones_come_last() -> None:
    def row(effect: str, z: float | None, p: float | None) -> names.Any:
        return {"effect": effect, "sites": [], "z": z, "p_value": p, "adjusted_p_value": p}

    rows = [
        row("none", None, None),
        row("weak", 1.0, 1.0),
        row("strong", -9.0, 1e-9),
        row("medium", 2.0, 1.0),
    ]
    rows.append({**row("absorbed", -6.1, 1.0), "absorbed_by": "gain"})
    ranks = [candidate["effect"] for candidate in ranked(rows)]
    assert ranks == ["strong", "medium", "weak", "none", "absorbed"]


def test_a_gap_that_a_tolerance_calls_none_is_told() -> None:
    report = {**_report(power_rmse_db=[2.62, 2.48]), "verdict": "NO_GAP"}
    assert tell(report).label == "No gap found"
    report["gap"]["tolerated"] = True
    story = tell(report)
    assert story.label == "No gap that matters"
    assert "power error (root mean square) 2.6\u202fdB." in story.meaning
    assert "What closes most of it: a." in story.meaning


def test_effects_that_were_not_looked_for_any_more_are_told() -> None:
    report = {**_report(), "verdict": "LISTED_WITH_REMAINDER"}
    assert tell(report).label == "Causes found, perhaps not all"
    report["unlisted"]["sites"] = ["y"]
    assert tell(report).label == "Cause found, but something is left"


def test_shares_below_nothing_are_told_as_they_are() -> None:
    assert names.shares({"low": -0.2, "high": 0.4}) == "\u221220 to 40%"
    assert names.shares({"low": -1.5, "high": -0.46}) == "\u2212150 to \u221246%"


@pytest.mark.parametrize(
    ("judged", "said"),
    [
        (
            2,
            "2 known effects were tried; none of them is needed to explain these data, and nothing else was left over.",
        ),
        (
            1,
            "1 known effect was tried; it is not needed to explain these data, and nothing else was left over.",
        ),
        (0, "No known effect could be tried; nothing was left over."),
    ],
)
def test_how_many_effects_were_tried_is_a_sentence(judged: int, said: str) -> None:
    rows = _report()["screening"]
    report = {**_report(), "verdict": "NO_GAP", "causes": [], "screening": [*rows[:judged], rows[2]]}
    meaning = tell(report).meaning
    assert meaning.startswith(said)
    assert "C could not be judged, because fitted parameters" in meaning


@pytest.mark.parametrize(
    ("resolves", "all_again", "more_decides"), [(True, 9.0, True), (True, None, False), (False, None, False)]
)
def test_more_data_are_not_said_to_decide_where_the_plan_says_that_they_do_not(
    resolves: bool, all_again: float | None, more_decides: bool
) -> None:
    plan = {
        "design": {"link": 3},
        "repeats": 2,
        "resolves": resolves,
        "cost": 2.0,
        "cost_of_all_again": all_again,
    }
    cause = {**_report()["causes"][0], "alias_class": []}
    report = {**_report(), "verdict": "UNDETERMINED", "causes": [cause], "next_measurement": plan}
    told = tell(report)
    assert ("more data of the same kind would decide" in told.meaning) == more_decides
    assert "First: no measurement" not in told.action
    assert ("First: measure link 3" in told.action) == resolves
    assert ("No measurement that is known of" in told.action) == (not resolves)


@pytest.mark.parametrize(
    ("others", "told"),
    [
        ([["mutual_coupling"]], "cannot tell clipping from mutual coupling."),
        (
            [["mutual_coupling"], ["phase_noise"]],
            "cannot tell apart clipping, mutual coupling and phase noise.",
        ),
    ],
)
def test_what_cannot_be_told_apart_is_listed(others: list[list[str]], told: str) -> None:
    cause = {**_report()["causes"][0], "effects": ["clipping"], "alias_class": others}
    report = {**_report(), "verdict": "UNDETERMINED", "causes": [cause], "next_measurement": None}
    assert tell(report).headline == f"There is a gap, but the data {told}"


def test_what_came_near_to_a_gap_is_said_with_its_place() -> None:
    site = {"site": "predicted_label", "p_value": 0.0064, "share": 1.0, "whereabouts": "along x[0]"}
    report = {**_report(), "verdict": "NO_GAP", "causes": []}
    for p, near in ((0.0064, True), (0.2, False)):
        story = tell({**report, "where": {"sites": [{**site, "p_value": p}], "coordinates": []}})
        assert (
            "left in the predicted labels (along x[0]) may be more than chance (p = 0.0064)" in story.meaning
        ) == near
        assert ("nothing else was left over" in story.meaning) != near
        assert ("More data of the same kind" in story.action) == near
        bare = {**report, "screening": [], "where": {"sites": [{**site, "p_value": p}], "coordinates": []}}
        assert ("by no more than chance" in tell(bare).meaning) != near


@pytest.mark.parametrize(
    ("adjusted", "absorbed", "near"), [(0.03, None, True), (0.3, None, False), (0.03, "gain", False)]
)
def test_which_effect_came_near_to_being_a_cause_is_said(adjusted, absorbed, near) -> None:
    row = {
        "effect": "phase_noise",
        "sites": ["phase"],
        "z": 3.6,
        "p_value": 3e-4,
        "adjusted_p_value": adjusted,
    }
    other = {**row, "effect": "clipping", "adjusted_p_value": 0.9}
    report = {**_report(), "verdict": "NO_GAP", "causes": [], "where": {"sites": [], "coordinates": []}}
    story = tell({**report, "screening": [other, {**row, "absorbed_by": absorbed}]})
    assert ("call most for phase noise, which may be chance (p = 0.03" in story.meaning) == near
    assert ("would tell whether phase noise is there." in story.action) == near


NOISE = {
    "effect": "heavy_tailed_noise",
    "sites": ["channel"],
    "z": 121.5,
    "p_value": 0.0,
    "adjusted_p_value": 0.0,
}
VALUES: names.Site = {"site": "path_gain", "p_value": 1e-9, "share": None, "family": "relative, link x path"}


def _reflecting() -> names.Any:
    rows = [{**NOISE, "beyond": 11.9, "spreads": True}]
    rows += [{**NOISE, "effect": name, "z": 18.0} for name in ("path_gain_error", "extra_path[anywhere]")]
    cause = _cause("path_gain_error", "extra_path[anywhere]")
    size = {"mean": 38.1, "low": 37.6, "high": 38.6, "unit": "m"}
    there = {"x": size, "y": {**size, "mean": 13.1, "low": 12.6, "high": 13.6}}
    cause["size"] = {f"extra_path[anywhere].{axis}_m": one for axis, one in there.items()}
    return {**_unlisted(VALUES), "screening": rows, "causes": [cause]}


def test_noise_leads_nobody_where_values_are_wrong() -> None:
    """It resembles whatever is wrong; what moves the values, and where, is what to look at."""
    report = _reflecting()
    action = tell(report).action
    assert "heavy tailed noise" not in action
    assert action.startswith("Look first at what came closest")
    assert "extra path (anywhere), at x 38.1\u202fm and y 13.1\u202fm. " in action
    report["causes"] = [_cause("heavy_tailed_noise")]
    assert "closest, though it does not explain all: path gain error. " in tell(report).action
    spread: names.Site = {"site": "noise_power", "p_value": 1e-9, "share": None, "spreads": True}
    hidden = {**report, **{key: _unlisted(spread)[key] for key in ("unlisted", "where")}}
    assert "Look first" not in tell(hidden).action
    assert "could change the noise level, or declare errors that are so" in tell(hidden).action
    assert "ask for heavy tailed noise, but 12 times" in tell(hidden).action


def test_copies_are_left_out_before_anything_else() -> None:
    """They make gaps of their own, which no physics explains."""
    report = _unlisted(VALUES)
    report["fit"] = {
        "nuisances": [],
        "converged": True,
        "warnings": [f"90 of 630 values are others again: {READ_TWICE}"],
    }
    assert tell(report).action.startswith("Leave out the copies")
    assert "Should a gap remain, do not add a listed effect" in tell(report).action
    assert next_look(report).startswith("Leave out the copies")
    quiet = {**report, "verdict": "NO_GAP"}
    assert tell(quiet).action.endswith("of their own.")
    report["fit"]["warnings"] = ["something else"]
    assert "copies" not in tell(report).action + next_look(report)


def test_an_element_is_dead_or_out_of_calibration() -> None:
    size: names.Any = {"low": 0.9, "high": 1.1, "unit": "1"}
    phase = {"phase_rad": {"mean": 0.2, "low": -0.5, "high": 0.9, "unit": "rad"}}
    for lacks, dead in ((0.995, True), (0.4, False)):
        cause = _cause("array_calibration[rx_2]")
        cause["size"] = {"fraction": {**size, "mean": lacks}, **phase}
        action = tell({**_report(), "causes": [cause]}).action
        assert ("dead or its cable is off" in action) == dead
        assert ("Calibrate the element" in action) != dead
        assert ("phase" in action.partition("Estimate")[2]) != dead
    assert advice("array_calibration[rx]").startswith("apply the estimated gain and phase to each antenna")


def test_a_radio_that_sleeps_is_to_be_checked() -> None:
    assert advice("duty_cycle[device_1]").startswith("check whether the device's radio is off")
    assert "in the twin" in advice("duty_cycle[device_1]")


def test_axes_in_the_summary_are_words() -> None:
    report = {
        **_unlisted(VALUES),
        "summary": "It shows at path_gain, and in the data most at rx_antenna 1 to 2.",
    }
    report["where"]["coordinates"] = [{"axes": {"rx_antenna": (1, 2)}, "p_value": 1e-9, "share": 0.2}]
    assert tell(report).headline == "It shows at path gains, and in the data most at receive antenna 1 to 2."
