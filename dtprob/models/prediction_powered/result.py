"""What an estimate tells."""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from dtprob.models.prediction_powered.schemes import Scheme
from dtprob.models.prediction_powered.tuning import Lambda


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """Parameters with their uncertainty.

    Attributes:
        theta: the estimate, flat.
        covariance: of the estimate.
        degrees: degrees of freedom of each variance.
        low, high: ends of each parameter's interval.
        level: probability that an interval covers, if all assumptions hold.
        lam: lambda per parameter and context, before and after guard and clip, with its standard error.
        labels_only_variance: what the variances would be with lambda 0, that is without predictions.
        scheme: which of the six.
        n: labelled samples.
        n_unlabelled: unlabelled samples used.
        notes: sentences that a reader must know.
    """

    theta: Float[np.ndarray, " parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]
    degrees: Float[np.ndarray, " parameter"]
    low: Float[np.ndarray, " parameter"]
    high: Float[np.ndarray, " parameter"]
    level: float
    lam: Lambda
    labels_only_variance: Float[np.ndarray, " parameter"]
    scheme: Scheme
    n: int
    n_unlabelled: int
    notes: tuple[str, ...] = ()

    @property
    def standard_error(self) -> Float[np.ndarray, " parameter"]:
        """Standard error of each parameter."""
        return np.sqrt(np.diagonal(self.covariance))
