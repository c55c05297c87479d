"""Options of the measured apartment that cannot be, on packets made up for it."""

import numpy as np
import pytest

from dtprob.data import uwb_apartment
from dtprob.errors import InputError


@pytest.fixture
def two_links(monkeypatch):
    taps = np.random.default_rng(0).normal(size=(3, 16)) + 0j
    place = np.zeros(2)
    links = tuple(
        uwb_apartment.Link(n, place, place + 1, "LOS", 1.4, 1e-9, taps, np.zeros(3)) for n in (4, 9)
    )
    monkeypatch.setattr(uwb_apartment, "read_links", lambda _: links)
    monkeypatch.setattr(uwb_apartment, "read_radio", lambda _: uwb_apartment.Radio(4e9, 5e8, 1e-9))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"links": 4}, "links: expected a list of numbers among 4, 9, got 4"),
        ({"links": [4, 5]}, r"numbers among 4, 9, got \[5\]"),
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
