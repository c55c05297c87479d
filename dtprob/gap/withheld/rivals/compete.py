"""All rivals on one case."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import jax

from dtprob.gap.fitting.integrated import based
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.discrepancy import gaussian_process
from dtprob.gap.withheld.rivals.lasso import lasso
from dtprob.gap.withheld.rivals.look import Look, look
from dtprob.gap.withheld.rivals.stepwise import BIC, LOO, forward
from dtprob.gap.withheld.rivals.unadjusted import unadjusted

RIVALS: Final[Mapping[str, Callable[[Look, jax.Array, Settings], Claim]]] = {
    "forward_loo": lambda seen, key, settings: forward(seen, LOO, key, settings),
    "forward_bic": lambda seen, key, settings: forward(seen, BIC, key, settings),
    "lasso": lambda seen, *_: lasso(seen),
    "gaussian_process": lambda seen, *_: gaussian_process(seen),
    "unadjusted": lambda seen, *_: unadjusted(seen),
}
"""Each rival by its name: (base fit, key, settings) -> answer."""


def compete(problem: Problem, key: jax.Array, settings: Settings) -> dict[str, dict[str, Any]]:
    """What each rival says, in the form of report.json, with the seconds of CPU that it took.

    The base fit and its scores are made once; their time counts for every rival.

    Args:
        problem: the model and candidates on their data.
        key: for starting points and replicates.
        settings: the same as those of the diagnosis with which they are compared.
    """
    keys, began = jax.random.split(key, 3), time.process_time()
    start = based(problem, keys[0])
    seen = look(start.problem, start.fitted, keys[1], settings)
    common, answers = time.process_time() - began, {}
    for name, rival in RIVALS.items():
        began = time.process_time()
        report = rival(seen, keys[2], settings).to_report(settings.level)
        answers[name] = {**report, "seconds": common + time.process_time() - began}
    return answers
