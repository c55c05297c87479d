"""The declared generative models, and what they share.

`model` says what a model's author knows beyond the function, `declare` runs a model once and tells its sites.
"""

from dtprob.models.declaration import Declaration, Measure, declare, model

__all__ = ["Declaration", "Measure", "declare", "model"]
