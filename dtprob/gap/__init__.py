"""Diagnosing the sim-to-real gap: where it lies, which effect causes it, how far that effect closes it.

`dtprob.diagnose` does it; `Settings` says with which error rates and how much effort.
"""

from dtprob.gap.settings import Settings

__all__ = ["Settings"]
