"""Effects of the user's own that change the model where they should do nothing."""

from __future__ import annotations

import numpy as np

from dtprob.effects.effect import Context
from dtprob.effects.library import FAMILIES
from dtprob.effects.rewriting import rewritten
from dtprob.errors import InputError
from dtprob.gap.model.problem import Problem

_ROUNDING = 1e-5
"""Share of the largest value of a site that single precision may lose."""


def check_nulls(problem: Problem) -> None:
    """Look at each mean effect whose family the library lacks: at its null, sites have to stay what they are.

    Raises:
        InputError: one changes a site there.
    """
    own = [e for e in problem.effects if e.kind == "mean" and e.family not in FAMILIES]
    if not own:
        return
    centre, spread = problem.prior_middle
    values = dict(problem.compiled.sites(centre + spread))
    context = Context(problem.data, values)
    for effect in own:
        for site in effect.rewrites:
            before = np.asarray(values[site])
            after = np.asarray(rewritten(effect, site, values[site], effect.null(), context))
            size, off = (np.abs(v[np.isfinite(v)]).max(initial=0.0) for v in (before, after - before))
            if off > _ROUNDING * size:
                raise InputError(
                    f"effect {effect.name}",
                    f"site {site!r} unchanged at its null, {_named(effect.null())}",
                    f"up to {off:.3g} away from values up to {size:.3g}",
                    "Make the rewrite the identity there, or give the parameter another null",
                )


def _named(values: dict[str, object]) -> str:
    return ", ".join(f"{name} = {np.asarray(value)}" for name, value in values.items())
