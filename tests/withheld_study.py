"""Withheld cases made, diagnosed and scored by the commands, against bounds that a diagnosis of known rates keeps."""

import json
from collections.abc import Sequence
from pathlib import Path

from scipy import stats

from dtprob.cli import main

FAILURE = 1e-2
"""Chance that a bound is missed although its rate holds."""


def at_most(of: int, rate: float) -> int:
    """The most successes that are to be expected where each has at most this probability."""
    return int(stats.binom.isf(FAILURE, of, rate))


def at_least(of: int, rate: float) -> int:
    """The fewest where each has at least this probability."""
    return int(stats.binom.ppf(FAILURE, of, rate))


def studied(
    folder: Path, track: str, kinds: Sequence[str], *, seed: int
) -> dict[str, dict[str, tuple[int, int]]]:
    """One case of each kind in turn at lambda 100, diagnosed and scored.

    Returns:
        for each kind the counts of its rates, as (count, of).
    """
    study, answers = str(folder / track), str(folder / f"{track}_answers")
    words = ["--track", track, "--count", str(len(kinds)), "--seed", str(seed), "--lambdas", "100"]
    assert main(["withheld", "generate", *words, "--kinds", *kinds, "--out", study]) == 0
    assert main(["withheld", "run", f"{study}/cases", "--out", answers, "--workers", "1"]) == 0
    assert main(["withheld", "score", answers, "--key", f"{study}/key.json"]) == 0
    score = json.loads((folder / f"{track}_answers" / "score.json").read_text())
    assert len(score["cases"]) == len(kinds)
    assert score["missing"] == []
    return {
        stratum["kind"]: {name: (rate["count"], rate["of"]) for name, rate in stratum["rates"].items()}
        for stratum in score["strata"]
    }


def summed(found: Sequence[dict[str, dict[str, tuple[int, int]]]], kind: str, name: str) -> tuple[int, int]:
    """Count and number of a rate over several tracks."""
    counts = [one[kind][name] for one in found if kind in one]
    return sum(count for count, _ in counts), sum(of for _, of in counts)
