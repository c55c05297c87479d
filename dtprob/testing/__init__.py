"""The contracts as checks that anyone can run on a model, an engine or an effect of their own.

Each check returns nothing, or raises a `ContractError` that says what is broken and how to mend it:

    from dtprob.testing import check_model
    check_model(my_model, {"x": x, "y": y})
"""

from dtprob.testing.contract import ContractError
from dtprob.testing.effects import check_effect
from dtprob.testing.engines import check_engine
from dtprob.testing.models import check_model

__all__ = ["ContractError", "check_effect", "check_engine", "check_model"]
