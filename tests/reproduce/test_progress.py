"""Parts of a long figure: kept, and the time that they took with them."""

import time

import numpy as np

from dtprob.reproduce.progress import Progress


def test_a_resumed_run_has_the_parts_and_the_time_of_the_interrupted_one(tmp_path):
    folder = tmp_path / "parts"
    first = Progress(folder=folder)
    assert first.spent() == 0.0

    def slow():
        time.sleep(0.05)
        return {"value": np.arange(3)}

    for name in ("one", "two"):
        first.part(name, slow)
    resumed = Progress(folder=folder)
    kept = resumed.part("one", lambda: {"value": np.zeros(0)})
    assert list(kept) == ["value"]
    assert kept["value"].tolist() == [0, 1, 2]
    assert 0.1 <= resumed.spent() < 60.0
    resumed.done()
    assert Progress(folder=folder).spent() == Progress().spent() == 0.0
