"""Withheld cases of labels beside predictions: a survey in which something may be wrong, and the key apart.

Each case is a folder with `case.toml` and `labels.csv`. How much right labels scatter, and where a drive led, differs from
survey to survey and is told to nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from dtprob.data.kinds import Labels
from dtprob.data.write import write
from dtprob.files import write_text
from dtprob.physical.fault_cases import KINDS, Families, Setup, make_case
from dtprob.physical.gaussian import Vector
from dtprob.physical.labels_faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.labels_survey import BLOCKS, ROWS, Survey, make_survey
from dtprob.physical.study import Track, case_end

CONVENTION: Final = (
    "lambda is twice the divergence of the labels' law from the nearest law of the twin, whose standard deviation is"
    " fitted; exact for every size, but of a saturated receiver only the mean and the covariance of what it shows count"
)
_MODEL: Final = """[model]
name = "label_twin"

[data]
file = "labels.csv"

"""


def _campaign(rng: np.random.Generator, _: int, families: Sequence[str]) -> Setup:
    survey = make_survey(rng)
    drawn = Families(lambda rng, family: draw(rng, family, survey), families, FOREIGN)
    return Setup(
        survey.bench,
        drawn,
        partial(_write, survey),
        ("sample",),
        ("sample",),
        {"deviation": survey.deviation},
    )


def _write(survey: Survey, folder: Path, measured: Vector, excluded: Sequence[str], seed: int) -> None:
    """Write one case."""
    label = np.round(measured.reshape(-1), 2)
    all_labelled = np.ones(len(label), bool)
    folder.mkdir(parents=True, exist_ok=True)
    data = Labels(x=survey.x, y=label, labelled=all_labelled, prediction=survey.prediction)
    write(folder / "labels.csv", data)
    write_text(folder / "case.toml", _MODEL + case_end(excluded, seed))


TRACK: Final = Track(
    name="labels",
    convention=CONVENTION,
    kinds=KINDS,
    usual=KINDS,
    families=FAMILIES,
    listed=LISTED,
    plan={"labels": BLOCKS * ROWS},
    campaign=_campaign,
    case=make_case,
)
