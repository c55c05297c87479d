"""Calibrate the materials of a traced scene from measured channels, as a loop compiled once.

This is the algorithm of Ruah, Simeone, Hoydis and Al-Hashimi (arXiv 2312.12625) with its rivals, on statistics of the
measurement that are computed once: no iteration sees an antenna or a subcarrier. It finds one value per parameter;
`dtprob.inference` finds posteriors.
"""

from dtprob.raytracing.calibration.calibrate import (
    Calibration,
    calibrate,
    calibrate_runs,
)
from dtprob.raytracing.calibration.groups import object_groups
from dtprob.raytracing.calibration.settings import SCHEMES, Scheme, Settings
from dtprob.raytracing.calibration.statistics import Statistics, project

__all__ = [
    "SCHEMES",
    "Calibration",
    "Scheme",
    "Settings",
    "Statistics",
    "calibrate",
    "calibrate_runs",
    "object_groups",
    "project",
]
