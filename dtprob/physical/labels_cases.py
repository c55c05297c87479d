"""Withheld cases of labels beside predictions: a survey in which something may be wrong, and the key apart.

Each case is a folder with `case.toml` and `labels.csv`. How much right labels scatter, and where a drive led, differs from
survey to survey and is told to nobody.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from dtprob.data.kinds import Labels
from dtprob.data.write import write
from dtprob.physical.fault_cases import KINDS, Families, Setup, Study, generate, left_out, write_text
from dtprob.physical.gaussian import Vector
from dtprob.physical.key import checked, write_key
from dtprob.physical.labels_faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.labels_survey import BLOCKS, ROWS, Survey, make_survey

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

    def make(rng: np.random.Generator, _: int) -> Setup:
        survey = make_survey(rng)
        drawn = Families(lambda rng, family: draw(rng, family, survey), families, FOREIGN)
        return Setup(survey.bench, drawn, partial(_write, survey), {"deviation": survey.deviation})

    generate(out, Study(count, seed, kinds, lambdas), make, resume=resume, progress=progress)
    plan = {"labels": BLOCKS * ROWS}
    return write_key(out, count, seed, track="labels", convention=CONVENTION, plan=plan)


def _write(survey: Survey, folder: Path, measured: Vector, excluded: Sequence[str], seed: int) -> None:
    """Write one case."""
    label = np.round(measured.reshape(-1), 2)
    all_labelled = np.ones(len(label), bool)
    folder.mkdir(parents=True, exist_ok=True)
    data = Labels(x=survey.x, y=label, labelled=all_labelled, prediction=survey.prediction)
    write(folder / "labels.csv", data)
    write_text(folder / "case.toml", _toml(excluded, seed))


def _toml(excluded: Sequence[str], seed: int) -> str:
    return f"""[model]
name = "label_twin"

[data]
file = "labels.csv"

[effects]
use = "all"
{left_out(excluded)}
[engine]
name = "laplace"

[seed]
value = {seed}
"""
