"""The multi-access system: devices with buffers that share a channel with multi-packet reception."""

from dtprob.models.multi_access.clusters import Clusters
from dtprob.models.multi_access.model import multi_access
from dtprob.models.multi_access.records import priors, records, window_counts
from dtprob.models.multi_access.transition import Kernel, Noise, Slot, State, kernel

__all__ = [
    "Clusters",
    "Kernel",
    "Noise",
    "Slot",
    "State",
    "kernel",
    "multi_access",
    "priors",
    "records",
    "window_counts",
]
