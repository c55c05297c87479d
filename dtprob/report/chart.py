"""One figure of a page, and what it is drawn from."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from markupsafe import Markup

from dtprob.report.json_schema import Report


@dataclass(frozen=True)
class Chart:
    """One figure of the page."""

    svg: Markup
    caption: str


def group(gap: xr.DataTree | None, name: str, report: Report) -> xr.Dataset:
    """A group of gap.nc, infinite values as missing; nothing "after" without an accepted cause."""
    if gap is None or name not in gap.children:
        return xr.Dataset()
    dataset = gap[name].to_dataset()
    accepted = report["gap"]["after"] is not None
    kept = [key for key in map(str, dataset.data_vars) if accepted or "after" not in key.split("_")]
    return dataset[kept].where(np.abs(dataset[kept]) < np.inf)
