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
    kept = [str(key) for key, one in dataset.data_vars.items() if accepted or not _is_after(str(key), one)]
    return dataset[kept].where(np.abs(dataset[kept]) < np.inf)


def _is_after(name: str, values: xr.DataArray) -> bool:
    """Whether a variable is of the twin with the cause added; of a map, whose axis may be called "after ..." itself."""
    return name.startswith("after") or name == f"gap_after_{values.dims[0]}"
