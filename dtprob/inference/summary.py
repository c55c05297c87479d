"""A table of a posterior: one row for each entry of each site, angles summarised as angles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dtprob.errors import InputError, unknown_name
from dtprob.inference.circular import arc_interval, mean_direction, resultant_length
from dtprob.inference.posterior import Posterior

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = ("kind", "mean", "sd", "low", "high", "resultant_length", "ess", "rhat")
_FEWEST = 4  # draws that an effective sample size can be told from


def summary(
    posterior: Posterior, sites: Sequence[str] | None = None, probability: float = 0.9
) -> pd.DataFrame:
    """Summarise a posterior.

    Columns: `kind` ("linear" or "circular"), `mean` (for an angle the mean direction, rad), `sd` (for an
    angle the circular standard deviation sqrt(-2 log of the resultant length)), `low` and `high` (ends of
    the central interval; for an angle of the shortest arc, counter-clockwise from low to high),
    `resultant_length` (angles only), `ess` (bulk effective sample size) and `rhat` (rank-normalised; for an
    angle the worse of its cosine's and sine's, which a chain stuck on one side of +-pi cannot hide from
    both). An entry without a finite draw, such as the log-probability of what cannot happen, has no row.

    Args:
        posterior: the posterior.
        sites: which; by default the latent ones.
        probability: of the intervals.

    Raises:
        InputError: no such site, or a probability outside of (0, 1).
    """
    if not 0 < probability < 1:
        expected, remedy = "a probability between 0 and 1", "Give 0.9 for 90% intervals"
        raise InputError("probability of a summary", expected, f"{probability:g}", remedy)
    import pandas as pd  # noqa: PLC0415  (takes half a second)

    chosen = list(sites if sites is not None else posterior.latent or posterior.draws)
    for name in chosen:
        if name not in posterior.draws:
            raise unknown_name("summary", name, posterior.draws, "site")
    rows = [row for name in chosen for row in _rows(posterior, name, probability)]
    table = pd.DataFrame([values for _, values in rows], columns=list(_COLUMNS))
    table.index = pd.Index([label for label, _ in rows], name="site")
    return table


def _rows(posterior: Posterior, name: str, probability: float) -> Iterable[tuple[str, list[object]]]:
    values = posterior.draws[name]
    parts = (
        ((f"{name}.real", np.real(values)), (f"{name}.imag", np.imag(values)))
        if np.iscomplexobj(values)
        else ((name, values),)
    )
    for label, part in parts:
        for index in np.ndindex(part.shape[2:]):
            place = f"[{','.join(map(str, index))}]" if index else ""
            entry = part[(slice(None), slice(None), *index)]
            if not np.isfinite(entry).any():
                continue
            row = _circular if name in posterior.circular else _linear
            yield f"{label}{place}", row(entry, probability)


def _linear(entry: np.ndarray, probability: float) -> list[object]:
    low, high = np.quantile(entry, [0.5 - probability / 2, 0.5 + probability / 2])
    with np.errstate(invalid="ignore"):  # of draws that are not finite
        mean, spread = entry.mean(), entry.std()
    return ["linear", mean, spread, low, high, np.nan, *_quality([entry])]


def _circular(entry: np.ndarray, probability: float) -> list[object]:
    flat = entry.ravel()
    length = float(resultant_length(flat))
    spread = np.sqrt(-2 * np.log(min(max(length, 1e-300), 1.0)))
    low, high = arc_interval(flat, probability)
    quality = _quality([np.cos(entry), np.sin(entry)])
    return ["circular", mean_direction(flat), spread, low, high, length, *quality]


def _quality(parts: Sequence[np.ndarray]) -> tuple[float, float]:
    """The smallest effective sample size and the largest r-hat; nan where they cannot be told."""
    from arviz_stats.base import array_stats  # noqa: PLC0415  (takes a second)

    if parts[0].shape[1] < _FEWEST or all(np.ptp(part) == 0 for part in parts):
        return np.nan, np.nan
    stats = cast("Any", array_stats)
    ess = min(float(stats.ess(part, chain_axis=0, draw_axis=1)) for part in parts)
    if parts[0].shape[0] == 1:
        return ess, np.nan
    return ess, max(float(stats.rhat(part, chain_axis=0, draw_axis=1)) for part in parts)
