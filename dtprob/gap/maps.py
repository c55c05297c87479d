"""The arrays of gap.nc: where the gap lies, in the data's own coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from dtprob.gap.evidence import Evidence
from dtprob.gap.how_far.expected import expected_loss
from dtprob.gap.where.closed_share import ClosedShare
from dtprob.raytracing.paths import path_set_among

_PATHS = "path_gain"
"""The site that has an entry for each path."""
_COLUMNS = 6
"""Columns along which differences are kept, those that stand out most."""
_MOST_STEPS = 200_000
"""Steps of paths beyond which a scene is not drawn."""


def maps(evidence: Evidence, closed: Mapping[str, ClosedShare]) -> dict[str, xr.Dataset]:
    """Groups of gap.nc: excess along each axis, loss of each cluster, the screening, and paths where there are any.

    Args:
        evidence: of the diagnosis.
        closed: how what the causes close is spread along each axis.
    """
    where: dict[str, Any] = {f"gap_{axis}": (axis, values) for axis, values in evidence.before.axes.items()}
    after = {f"gap_after_{axis}": (axis, values) for axis, values in evidence.after.axes.items()}
    for axis, share in closed.items():
        where[f"closed_{axis}"] = (axis, share.found, {"nats": share.total})
        where[f"closed_expected_{axis}"] = (axis, share.expected)
    problem, name = evidence.problem, evidence.problem.cluster_name
    per = np.maximum(problem.n_observation_of_each, 1.0)
    least = _floor(evidence, per)
    clusters: dict[str, Any] = {
        "before": (name, -evidence.held_before.log_likelihood / per - least),
        "after": (name, -evidence.held_after.log_likelihood / per - least),
        "floor": (name, least),
    }
    for entry in problem.data.values():
        for position in ("rx_position", "tx_position"):
            if hasattr(entry, position) and len(getattr(entry, position)) == problem.n_cluster:
                clusters[position] = ((name, "direction"), np.asarray(getattr(entry, position)))
    first = evidence.steps[0].view.screening
    screening = xr.Dataset(
        {
            "z": ("effect", first.z),
            "p_value": ("effect", first.p_value),
            "adjusted_p_value": ("effect", first.adjusted),
            "log_bayes_factor": ("effect", first.log_bayes_factor),
            "correlation": (("effect", "other_effect"), first.correlation),
        },
        coords={"effect": list(first.names), "other_effect": list(first.names)},
    )
    group = "links" if name == "link" else "clusters"
    return {
        "where": xr.Dataset({**where, **after}),
        group: xr.Dataset(clusters),
        "screening": screening,
        **_differences(evidence),
        **_paths(evidence),
    }


def _floor(evidence: Evidence, count: np.ndarray) -> np.ndarray:
    """Nats per observation below which no cluster is expected to come (cluster,), all together at the floor of the whole.

    Noise that is known to be larger in one cluster is no gap there.

    Args:
        evidence: of the diagnosis.
        count: observations of each cluster (cluster,).
    """
    expected = expected_loss(evidence.last.problem, evidence.fitted.x)
    return expected / count - (evidence.floor.best + expected.sum()) / count.sum()


def _differences(evidence: Evidence) -> dict[str, xr.Dataset]:
    """Data less twin along each column, before and after, and its spread where the twin is right."""
    after = {(d.observed, d.axis, d.column): d for d in evidence.after.differences}
    looked_at = sum(len(d.place) for d in evidence.before.differences)
    content: dict[str, Any] = {}
    for i, before in enumerate(evidence.before.differences[:_COLUMNS]):
        group = f"group_{i}"
        said = {"observed": before.observed, "column": before.column, "unit": before.unit, "of": looked_at}
        content[f"place_{i}"] = (group, before.place, said)
        content[f"before_{i}"] = (group, before.mean, said)
        content[f"spread_{i}"] = (group, before.spread, said)
        then = after.get((before.observed, before.axis, before.column))
        if then is not None and np.array_equal(then.place, before.place):
            content[f"after_{i}"] = (group, then.mean, said)
    return {"differences": xr.Dataset(content)} if content else {}


def _paths(evidence: Evidence) -> dict[str, xr.Dataset]:
    """Each path of a traced scene with what it carries of the gap, and where it goes; nothing without a scene."""
    before, after = (at.entries.get(_PATHS) for at in (evidence.before, evidence.after))
    traced = path_set_among(evidence.problem.data)
    if traced is None or before is None or after is None or before.shape != traced.mask.shape:
        return {}
    if traced.interaction.size > _MOST_STEPS:
        return {}
    steps = ("link", "path", "step")
    content = {
        "before": (steps[:2], before),
        "after": (steps[:2], after),
        "mask": (steps[:2], np.asarray(traced.mask)),
        "interaction": (steps, np.asarray(traced.interaction)),
        "object": (steps, np.asarray(traced.object)),
        "vertex": ((*steps, "direction"), np.asarray(traced.vertex)),
        "rx_position": (("link", "direction"), np.asarray(traced.rx_position)),
        "tx_position": (("link", "direction"), np.asarray(traced.tx_position)),
        "object_name": (("object_index",), np.array(traced.object_names, str)),
    }
    return {"paths": xr.Dataset(content)}
