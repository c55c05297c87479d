"""Options of the measured apartment that cannot be, on packets made up for it."""

import numpy as np
import pytest

from dtprob.data import uwb_apartment
from dtprob.errors import InputError


@pytest.fixture
def two_links(monkeypatch):
    taps = {n: np.random.default_rng(n).normal(size=(3, 16)) + 0j for n in (4, 9)}
    place = np.zeros(2)
    links = tuple(
        uwb_apartment.Link(n, place, place + 1, "LOS", 1.4, 1e-9, taps[n], np.zeros(3)) for n in (4, 9)
    )
    monkeypatch.setattr(uwb_apartment, "read_links", lambda _: links)
    monkeypatch.setattr(uwb_apartment, "read_radio", lambda _: uwb_apartment.Radio(4e9, 5e8, 1e-9))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"links": 4}, "links: expected a list of numbers among 4, 9, got 4"),
        ({"links": [4, 5]}, r"numbers among 4, 9, got \[5\]"),
        ({"links": [4, 4]}, r"expected different numbers, got \[4, 4\]"),
        ({"links": []}, "links: expected a list"),
        ({"averages": 2.5}, "averages: expected 2 or more, got 2.5"),
        ({"averages": 4}, "averages: expected at most 3, the packets of link 4, got 4"),
    ],
)
def test_options_that_cannot_be_are_named(two_links, options, message):
    with pytest.raises(InputError, match=message):
        uwb_apartment.channels(**options)


def test_one_packet_may_be_an_average(two_links):
    assert uwb_apartment.channels(links=[9], averages=3).channel.shape[:2] == (1, 3)


def test_links_come_in_the_order_that_was_asked_for(two_links):
    both, back = (uwb_apartment.channels(links=links, averages=3).channel for links in ([4, 9], [9, 4]))
    np.testing.assert_array_equal(back, both[::-1])
