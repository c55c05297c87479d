"""From a CASE file to everything that a command needs."""

from dtprob.workflow.models import MODELS
from dtprob.workflow.prepare import Prepared, prepare

__all__ = ["MODELS", "Prepared", "prepare"]
