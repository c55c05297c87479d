"""The reader of tsch_tum on lines of its format, and on the measured logs."""

import numpy as np
import pytest

from dtprob.data.location import measured_data
from dtprob.data.tsch_tum import hops
from dtprob.errors import InputError

FIRST = "[2, 83, 172, 2, 0, 0, 66, 172, 2, 0, 0, 162, 0, 0, 2, 3, 26, 78" + ", 0" * 20 + "]\t0:00:00.036179\n"
SECOND = (
    "[2, 202, 172, 2, 0, 0, 172, 172, 2, 0, 0, 154, 0, 0, 3, 3, 13, 58, 2, 1, 14, 88"
    + ", 0" * 16
    + "]\t0:00:01.821632\n"
)


def test_a_log(tmp_path):
    (tmp_path / "a.log").write_text(FIRST + SECOND + SECOND)
    found = hops(tmp_path / "a.log")
    assert np.array_equal(found.packet, [0, 1, 1])
    assert np.array_equal(found.source, [2, 3, 3])
    assert np.array_equal(found.node, [2, 3, 2])
    assert np.array_equal(found.attempt, [0, 0, 2])
    assert np.array_equal(found.channel, [26, 13, 14])
    assert np.array_equal(found.generated, [175170, 175276, 175276])
    assert np.array_equal(found.received, [175187, 175306, 175306])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]\t0:00\n", r"a\.log, line 2: expected 38 bytes in brackets"),
        (FIRST.replace("83", "830"), "line 2: expected bytes from 0 to 255"),
        (
            FIRST.replace("2, 3, 26", "2, 7, 26"),
            "line 2: expected hops with 1 to 3 transmissions left, got 7",
        ),
    ],
)
def test_a_line_that_is_no_packet_is_named(tmp_path, text, message):
    (tmp_path / "a.log").write_text(SECOND + text)
    with pytest.raises(InputError, match=message):
        hops(tmp_path / "a.log")


@pytest.mark.measured
def test_the_measured_log():
    try:
        folder = measured_data("tsch_tum")
    except InputError as error:
        pytest.skip(str(error))
    found = hops(folder / "tdma_4-1-high_load.log.gz")
    assert len(np.unique(found.node)) == 12
    assert np.all(found.received >= found.generated)
    assert 5000 < found.packet.max() < 6481
