"""The result of a diagnosis: what report.json and gap.nc hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from dtprob.effects.effect import Meaning
from dtprob.gap.how_far.closed import ClosedFraction
from dtprob.gap.how_far.shares import Share
from dtprob.gap.vocabulary import Verdict
from dtprob.inference.storage import renamed, without_slashes


@dataclass(frozen=True)
class Size:
    """Posterior of one scalar of an effect's parameter: mean and 90% interval in `unit`, and how that is told to people."""

    name: str
    mean: float
    low: float
    high: float
    unit: str
    meaning: Meaning | None = None


@dataclass(frozen=True)
class Cause:
    """A set of effects that explains the gap, with the sets that the data cannot tell from it.

    Attributes:
        effects: names, what closes most first.
        alias_class: equally good sets, this one first.
        probability: among the sets that were refitted.
        size: posterior of each scalar parameter.
        closed_fraction: on held-out clusters; None where not established.
        explained: the same if the entries of random fields were known: having to estimate them is nothing against a cause.
        parameters: how many were estimated, with the entries of random fields that clusters share.
        shares: how much of that each effect closes, where there are several.
        physics: one line.
        strata: the first size's estimate in the fit without each fold.
        plausible: whether the size lies within what the effect's prior calls plausible.
    """

    effects: tuple[str, ...]
    alias_class: tuple[tuple[str, ...], ...]
    probability: float
    size: tuple[Size, ...]
    closed_fraction: ClosedFraction | None
    explained: ClosedFraction | None
    parameters: float
    shares: tuple[Share, ...]
    physics: str
    strata: tuple[float, ...]
    plausible: bool


@dataclass(frozen=True)
class Diagnosis:
    """Verdict, causes, where, how far.

    `sections` holds the remaining parts of the report, each as plain numbers and text; `maps` the arrays of gap.nc.
    """

    verdict: Verdict
    summary: str
    causes: tuple[Cause, ...]
    sections: Mapping[str, Any]
    maps: Mapping[str, xr.Dataset]

    def __repr__(self) -> str:
        """Verdict and summary."""
        return f"Diagnosis({self.verdict}: {self.summary})"

    def to_report(self) -> dict[str, Any]:
        """The content of report.json."""
        report = {
            "verdict": self.verdict,
            "summary": self.summary,
            "causes": [_cause(cause) for cause in self.causes],
            **self.sections,
        }
        return plain(report)

    def to_datatree(self) -> xr.DataTree:
        """The content of gap.nc: groups where, differences, links or clusters, screening, paths.

        A slash in a name, as of plates within `numpyro.handlers.scope`, is a dot there.
        """
        names = without_slashes(self.maps.values())
        return xr.DataTree.from_dict({f"/{name}": renamed(each, names) for name, each in self.maps.items()})


def _cause(cause: Cause) -> dict[str, Any]:
    closed = cause.closed_fraction
    return {
        "effects": list(cause.effects),
        "alias_class": [list(names) for names in cause.alias_class],
        "probability": cause.probability,
        "size": {size.name: _size(size) for size in cause.size},
        "closed_fraction": None
        if closed is None
        else {"mean": closed.mean, "low": closed.low, "high": closed.high},
        "parameters": cause.parameters,
        "shares": [asdict(share) for share in cause.shares],
        "physics": cause.physics,
        "strata": {"estimate": list(cause.strata)},
        "plausible": cause.plausible,
    }


def _size(size: Size) -> dict[str, Any]:
    return {"mean": size.mean, "low": size.low, "high": size.high, "unit": size.unit, **meant(size.meaning)}


def meant(meaning: Meaning | None) -> dict[str, Any]:
    """How a size is told, as an entry of report.json beside it; none where it has no meaning of its own."""
    return {} if meaning is None else {"meaning": asdict(meaning)}


def plain(value: Any) -> Any:
    """Numbers, text, lists and dicts only; what is not finite becomes null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
