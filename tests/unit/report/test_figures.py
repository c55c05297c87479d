"""Figures: they draw what they are given, keep to their width and leave no trace in global settings."""

import functools
import re
from xml.etree import ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from dtprob.report.axis_figures import coordinate_map, share_map, usual_limit
from dtprob.report.figures import (
    WIDTH,
    IntervalRow,
    classes_for,
    gap_track,
    interval_plot,
    plan_view,
)
from dtprob.report.palette import DARK, LIGHT, contrast
from dtprob.report.svg import inline_svg


@functools.cache
def _figures() -> dict[str, Figure]:
    random = np.random.default_rng(0)
    position = random.uniform(0, 50, (30, 3))
    value = random.normal(size=30)
    classes = classes_for(value)
    rows = [IntervalRow("first", 1.0, 0.5, 1.5), IntervalRow("second, longer", -1.0, -2.0, 0.0)]
    return {
        "interval": interval_plot(rows, label="size (m)", null=0.0),
        "gap": gap_track(1.2, 0.1, (0.02, 0.08), unit="nats"),
        "gap without floor": gap_track(-350.2, -360.1, None, unit="nats"),
        "shares": share_map(np.arange(3), value[:3], value[1:4], np.ones(3), label="link"),
        "map": coordinate_map(np.arange(30), value, 0.1 * value, label="antenna", threshold=usual_limit(30)),
        "names": coordinate_map(["a", "b", "c"], [1.0, 2.0, 900.0], label="object", threshold=usual_limit(3)),
        "plan": plan_view(position, position[:2], value, classes=classes, label="excess (nats)"),
        "one link": plan_view(position[:1], position[:1], value[:1], classes=classes, label="excess (nats)"),
    }


def test_figures_are_of_one_width_and_leave_settings_alone() -> None:
    settings = dict(mpl.rcParams)
    for figure in _figures().values():
        assert figure.get_figwidth() == WIDTH
        inline_svg(figure, "a figure")
    assert dict(mpl.rcParams) == settings


@pytest.mark.parametrize("name", sorted(_figures()))
def test_svg_is_inline_and_follows_the_theme(name: str) -> None:
    svg = inline_svg(_figures()[name], 'says "a < b"')
    assert svg.startswith("<svg ")
    assert 'aria-label="says &quot;a &lt; b&quot;"' in svg
    assert not re.search(r"xmlns|http|<style|font-family|<metadata", svg)
    assert set(re.findall(r"#[0-9a-f]{6}\b", svg)) <= {"#000000", "#ffffff"}
    assert "var(--ink)" in svg
    assert set(re.findall(r'(?:href="|url\()#([^")]+)', svg)) == set(re.findall(r' id="([^"]+)"', svg))


def test_svg_is_the_same_every_time_and_apart_from_others() -> None:
    first, again = (inline_svg(_figures.__wrapped__()["map"], "a") for _ in range(2))
    other = inline_svg(_figures()["map"], "b")
    assert first == again
    assert not set(re.findall(r' id="([^"]+)"', first)) & set(re.findall(r' id="([^"]+)"', other))


def test_text_stays_text() -> None:
    svg = inline_svg(_figures()["interval"], "a")
    assert "second, longer</text>" in svg
    assert "size (m)</text>" in svg


def test_interval_plot_shows_its_numbers() -> None:
    axes = _figures()["interval"].axes[0]
    drawn = [line.get_xdata() for line in axes.lines]
    assert any(np.array_equal(x, [0.5, 1.5]) for x in drawn)
    assert any(np.array_equal(x, [-2.0, 0.0]) for x in drawn)


def test_a_long_name_takes_more_lines_and_no_room_from_its_interval() -> None:
    """Three effects with their instances; such a name shrank the axes to a quarter."""
    names = [
        "receiver displacement (receiver 11), material mismatch (all concrete 50mm) and timing offset",
        "b",
    ]
    long, short = (
        interval_plot([IntervalRow(name, 1.0, 0.0, 2.0)] * 2, label="closed (%)") for name in names
    )
    svg, _ = inline_svg(long, "a"), inline_svg(short, "a")
    assert long.axes[0].get_position().width == pytest.approx(short.axes[0].get_position().width)
    assert long.get_figheight() > short.get_figheight()
    assert "timing offset</text>" in svg


def test_a_name_in_any_script_makes_no_noise() -> None:
    """The page has fonts of its own: that matplotlib's lacks a sign is no news."""
    svg = inline_svg(coordinate_map([0.0, 1.0], [0.0, 1.0], label="距離\x0b", threshold=1.0), "距離\x0b")
    assert "距離" in svg
    assert ET.fromstring(svg).tag == "svg"  # noqa: S314  (of our own)


def test_gap_track_bars_start_at_the_lower_end_of_the_floor() -> None:
    axes = _figures()["gap"].axes[0]
    before, after = axes.patches
    assert (before.get_x(), before.get_x() + before.get_width()) == pytest.approx((0.02, 1.2))
    assert after.get_x() + after.get_width() == pytest.approx(0.1)
    assert axes.lines[-1].get_xdata() == pytest.approx((0.02, 0.08))
    assert not _figures()["gap without floor"].axes[0].patches


def test_classes_cover_the_values() -> None:
    values = np.array([-0.3, 0.0, 0.2, 1.1, 2.4, 90.0] + [1.0] * 300)
    classes = classes_for(values)
    assert np.all(np.diff(classes.edges) > 0)
    assert len(classes.colours) == len(classes.edges) - 1
    assert classes(values).min() == 0
    assert classes([1e9]) == len(classes.colours) - 1
    assert np.all(np.diff(classes(np.linspace(-1, 5, 50))) >= 0)
    assert len(classes_for(np.zeros(4)).colours) >= 1


@pytest.mark.parametrize("others", [np.random.default_rng(0).normal(size=100), np.zeros(100)])
def test_one_bad_link_of_a_hundred_has_a_class_of_its_own(others: np.ndarray) -> None:
    """It looked like the worst of those that fit, since the classes ended there."""
    classes = classes_for(np.append(others, 60.0))
    rank = classes(np.append(others, 60.0))
    assert np.max(rank[:-1]) < rank[-1]
    assert classes.edges[1] - classes.edges[0] > 1e-3


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_text_has_contrast(theme: dict[str, str]) -> None:
    for name in ("ink", "muted", "accent", "good", "found", "partly", "unknown", "before", "after"):
        assert contrast(theme[name], theme["paper"]) >= 4.5, name
        assert contrast(theme[name], theme["panel"]) >= 4.5, name
    assert set(LIGHT) == set(DARK)


def test_contrast_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)
