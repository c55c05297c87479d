"""Withheld cases of labels beside predictions: a survey in which something may be wrong, and the key apart.

Each case is a folder with `case.toml` and `labels.csv`. How much right labels scatter, and where a drive led, differs from
survey to survey and is told to nobody.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dtprob.data.kinds import Labels
from dtprob.data.write import write
from dtprob.files import atomic_write
from dtprob.physical.fault_cases import KINDS, Choice, Families, choose, write_record
from dtprob.physical.gaussian import measure
from dtprob.physical.key import checked, write_key
from dtprob.physical.labels_faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.labels_survey import BLOCKS, ROWS, Survey, make_survey

SHARED: Final = 8
"""Cases of one survey's places and map."""
CONVENTION: Final = (
    "lambda is twice the divergence of the labels' law from the nearest law of the twin, whose standard deviation is"
    " fitted; exact for every size"
)


def generate_cases(
    out: Path,
    count: int,
    seed: int,
    kinds: Sequence[str] = KINDS,
    lambda_: float | Sequence[float] = (25.0, 100.0, 400.0),
    *,
    families: Sequence[str] = LISTED,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write withheld cases and their key.

    Case i is of kind `kinds[i % len(kinds)]`; its lambda is drawn from those given.

    Args:
        out: folder; cases go to `cases/NNNN`, `key.json` and `truth/NNNN.json` stay outside of `cases`.
        count: number of cases.
        seed: from which everything is drawn.
        kinds: "null" no fault, "listed" one fault, "unlisted" one whose family the case takes out of the library, or
            that never had an entry, "pair" and "triple" several that can be told apart.
        lambda_: information that each fault carries alone.
        families: which faults may occur.
        resume: keep the cases that are whole.
        progress: called with the number of cases done and `count`.

    Returns:
        The key's file.

    Raises:
        InputError: an unknown kind or family, or a lambda that no fault can reach.
    """
    lambdas = checked(kinds, lambda_, families, known_kinds=KINDS, known_families=FAMILIES)
    for index in range(count):
        if not (resume and (out / "truth" / f"{index:04d}.json").is_file()):
            survey = make_survey(np.random.default_rng([seed, index // SHARED, 0]))
            rng = np.random.default_rng([seed, index, 1])
            target, kind = lambdas[int(rng.integers(len(lambdas)))], kinds[index % len(kinds)]
            drawn = Families(lambda rng, family, survey=survey: draw(rng, family, survey), families, FOREIGN)
            choice = choose(rng, kind, survey.bench, target, drawn)
            _write(out, index, survey, choice, np.random.default_rng([seed, index, 2]))
            more = {"deviation": survey.deviation}
            write_record(out, f"{index:04d}", kind, target, choice=choice, more=more)
        if progress:
            progress(index + 1, count)
    plan = {"labels": BLOCKS * ROWS}
    return write_key(out, count, seed, track="labels", convention=CONVENTION, plan=plan)


def _write(out: Path, index: int, survey: Survey, choice: Choice, rng: np.random.Generator) -> None:
    """Measure and write one case."""
    law = survey.bench.law
    for one in choice.faults:
        law = one.fault.change(law, one.size)
    label = np.round(measure(rng, law).reshape(-1), 2)
    folder = out / "cases" / f"{index:04d}"
    folder.mkdir(parents=True, exist_ok=True)
    all_labelled = np.ones(len(label), bool)
    data = Labels(x=survey.x, y=label, labelled=all_labelled, prediction=survey.prediction)
    write(folder / "labels.csv", data)
    with atomic_write(folder / "case.toml") as temporary:
        temporary.write_text(_toml(choice.excluded, index), encoding="utf-8")


def _toml(excluded: Sequence[str], seed: int) -> str:
    left_out = f"exclude = {json.dumps(list(excluded))}\n" if excluded else ""
    return f"""[model]
name = "label_twin"

[data]
file = "labels.csv"

[effects]
use = "all"
{left_out}
[engine]
name = "laplace"

[seed]
value = {seed}
"""
