"""Candidate effects: transforms of a model's named sites that do nothing at their null value.

`catalogue` offers those that a model and its data allow; `Effect` and `Parameter` declare one's own;
`with_effects` extends a model by effects.
"""

from dtprob.effects.distributions import ComplexStudentT, replace_base
from dtprob.effects.effect import Context, Effect, Meaning, Parameter
from dtprob.effects.library import FAMILIES, catalogue, summaries
from dtprob.effects.rewriting import Rewriting, with_effects

__all__ = [
    "FAMILIES",
    "ComplexStudentT",
    "Context",
    "Effect",
    "Meaning",
    "Parameter",
    "Rewriting",
    "catalogue",
    "replace_base",
    "summaries",
    "with_effects",
]
