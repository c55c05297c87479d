"""Wrong twins of the measured apartment: what is spoilt in their files, and how answers are judged."""

import csv
import json
import re

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data.location import measured_data
from dtprob.data.uwb_apartment import read_links, read_radio
from dtprob.effects import FAMILIES
from dtprob.errors import InputError
from dtprob.raytracing.floorplan import read_floorplan
from dtprob.reproduce import apartment
from dtprob.reproduce.apartment import Answer, gaps, is_right
from dtprob.reproduce.apartment_twins import LINKS, TWINS, Twin, write_case
from dtprob.reproduce.progress import Progress

BY_NAME = {twin.name: twin for twin in TWINS}


def answer(before, after=None, link=(1, 2, 3), named="", inside=()):
    before = np.asarray(before, float)
    after = before if after is None else np.asarray(after, float)
    return Answer(np.asarray(link), before, after, "LISTED" if named else "UNLISTED", named, inside, 1.0)


def test_the_honest_twin_comes_first_and_answers_are_effects():
    assert TWINS[0].name == "honest"
    assert len(BY_NAME) == len(TWINS)
    assert {name.partition("[")[0] for twin in TWINS for name in twin.undone_by} <= set(FAMILIES)


def test_gaps_are_taken_on_links_that_both_twins_reach():
    found = {"honest": answer([1.0, 2, 3]), "wall_13": answer([4.0, 7], [1.0, 6], link=(3, 1))}
    extra, won = gaps(found, "wall_13")
    assert extra.tolist() == [6.0, 1.0]
    assert won.tolist() == [1.0, 3.0]


def test_an_answer_is_right_by_family_or_by_instance():
    assert is_right(BY_NAME["wall_13"], ["missing_object[0_0_to_1_0]"])
    assert not is_right(BY_NAME["wall_13"], ["missing_path[reflection]", ""])
    assert is_right(BY_NAME["swap_2_4"], ["carrier_mismatch", "swapped_transmitters[4_5]"])
    assert not is_right(BY_NAME["swap_2_4"], ["swapped_transmitters[5_6]"])
    assert not is_right(BY_NAME["plaster"], ["missing_path[reflection]"])


def test_the_figure_counts_what_is_right(monkeypatch):
    rng = np.random.default_rng(0)
    base = rng.normal(size=21)

    def diagnosed(twin, key, say):
        del key, say
        lost = 5.0 if twin.name in {"swap_2_4", "depth"} else 0.0
        named = "swapped_transmitters[4_5]" if twin.name == "swap_2_4" else ""
        before = base + lost
        return answer(before, before - 4.0 if named else None, LINKS, named, (named,) if named else ())

    monkeypatch.setattr(apartment, "answer", diagnosed)
    made = apartment.run(apartment.jax.random.key(0), 1, Progress())
    wrong = [twin.name for twin in TWINS[1:]]
    closed = dict(zip(wrong, made.panels[1].series[0].median, strict=True))
    assert np.isclose(closed["swap_2_4"], 0.8)
    assert closed["depth"] == 0.0
    assert np.isnan(closed["carrier"])
    able = sum(bool(twin.undone_by) for twin in TWINS)
    assert made.notes[-1] == (
        f"right first in 1 of {able}, inside the class in 1; of those whose extra gap is established right first in 1 of 2,"
        " inside the class in 1"
    )
    assert "extra gap 105.0 nats (105.0 to 105.0), 0.80 of it closed" in next(
        note for note in made.notes if "swap_2_4" in note
    )


@pytest.fixture(scope="module")
def measured():
    try:
        return measured_data("uwb_apartment")
    except InputError as error:
        pytest.skip(str(error))


def rows(folder):
    with (folder / "links.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.measured
@pytest.mark.parametrize("twin", TWINS, ids=lambda twin: twin.name)
def test_only_what_is_named_is_spoilt(measured, tmp_path, twin: Twin):
    case = load_case(write_case(twin, tmp_path))
    copy = case.data.file
    assert case.scene is not None
    assert all(getattr(case.scene, name) == value for name, value in twin.scene.items())
    moved = {
        int(old["anchor"])
        for old, new in zip(rows(measured), rows(copy), strict=True)
        if {k: v for k, v in old.items() if k[:7] != "anchor_"}
        == {k: v for k, v in new.items() if k[:7] != "anchor_"}
        and (old["anchor_x"], old["anchor_y"]) != (new["anchor_x"], new["anchor_y"])
    }
    assert moved == set(twin.anchor)
    plan, old = (json.loads((f / "floorplan.json").read_text()) for f in (copy, measured))
    gone = [n for n, wall in enumerate(old["walls_xyxy"]) if wall not in plan["walls_xyxy"]]
    assert gone == ([] if twin.wall is None else [twin.wall])
    radio, before = read_radio(copy), read_radio(measured)
    assert np.isclose(radio.bandwidth, twin.bandwidth * before.bandwidth)
    assert np.isclose(radio.tap * radio.bandwidth, before.tap * before.bandwidth)


@pytest.mark.measured
@pytest.mark.parametrize("twin", TWINS, ids=lambda twin: twin.name)
def test_every_twin_can_be_traced(measured, tmp_path, twin: Twin):
    """Ends are apart, no device stands in a wall or in furniture, places are counted as the answer says."""
    case = load_case(write_case(twin, tmp_path))
    links = [link for link in read_links(case.data.file) if link.number in LINKS]
    assert len(links) == len(LINKS)
    assert min(link.distance for link in links) > 0.5
    plan = read_floorplan(case.data.file / "floorplan.json")
    places = np.unique([link.anchor for link in links], axis=0)
    for x, y in [twin.anchor[number] for number in twin.anchor]:
        assert not any(_holds(piece.polygon, x, y) for piece in plan.furniture)
        first, step = plan.walls[:, :2], plan.walls[:, 2:] - plan.walls[:, :2]
        along = np.clip(np.sum(((x, y) - first) * step, axis=1) / np.sum(step**2, axis=1), 0, 1)
        assert np.hypot(*((x, y) - first - along[:, None] * step).T).min() > 0.06
    wrong = {int(np.flatnonzero(np.isclose(places, place).all(axis=1))[0]) for place in twin.anchor.values()}
    named = {n for name in twin.undone_by for n in map(int, re.findall(r"\d+", name.partition("[")[2]))}
    assert wrong == named


def _holds(polygon, x, y):
    """Whether a convex polygon holds a point."""
    step = np.roll(polygon, -1, axis=0) - polygon
    side = step[:, 0] * (y - polygon[:, 1]) - step[:, 1] * (x - polygon[:, 0])
    return bool(np.all(side > 0) or np.all(side < 0))
