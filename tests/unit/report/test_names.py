"""How a model of what is left is told: every way of varying a site as words."""

import pytest

from dtprob.report.names import allowance


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ("additive, common", "the mean vary by one amount for all"),
        ("additive, smooth in time", "the mean vary smoothly in time"),
        (
            "relative, ripple in time, 3 to 4 half waves",
            "the mean vary as a ripple in time, 3 to 4 half waves",
        ),
        ("additive, every 7 along slot", "the mean vary in a cycle of 7 along slot"),
        ("additive, by access_point", "the mean vary by access point"),
        ("additive, link", "the mean vary from link to link"),
        ("additive, link x beam_2", "the mean vary with every link and beam 2 together"),
        ("additive, snapshot_dim_1", "the mean vary from snapshot dim 1 to snapshot dim 1"),
        ("additive, hour 3 to 5", "the mean vary at hour 3 to 5"),
        (
            "spread, site tower, distance 23.7 to 37.6",
            "the spread of the mean vary at site tower, distance 23.7 to 37.6",
        ),
        (
            "additive, the 9 of 150 nearest to east 3 and north 4",
            "the mean vary at the 9 of 150 nearest to east 3 and north 4",
        ),
        ("additive, beyond 3 of path_loss", "the mean vary beyond 3 of path loss"),
        ("additive, east times north", "the mean vary with east times north"),
        ("additive, product of two columns", "the mean vary with the product of two columns"),
        ("additive, stretch of day by site", "the mean vary from stretch to stretch of day by site"),
        ("additive, block of link and slot", "the mean vary from block to block of link and slot"),
    ],
)
def test_a_way_of_varying_is_told(shape, said):
    remainder = {"terms": [{"site": "mean", "shape": shape}]}
    assert allowance(remainder) == f"it lets {said}"
