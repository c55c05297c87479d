"""The six corrected losses, as one family.

Every scheme minimises

    true * mean l(X, Y) + unlabelled * mean l(X~, f(X~)) - predicted * mean l(X, f(X)),

and differs from the others in these three weights and in how the predictor f was trained. Sources:
Angelopoulos et al., Prediction-powered inference (2023); Angelopoulos, Duchi and Zrnic, PPI++ (2023); Zrnic
and Candes, Cross-prediction-powered inference (2024); Sifaou and Simeone, arXiv 2405.15415 (tuned CPPI).
"""

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, final

from jaxtyping import Float

from dtprob.errors import unknown_name
from dtprob.models.prediction_powered.arrays import Values, namespace

type Training = Literal["none", "all", "split", "cross"]


class Mix(NamedTuple):
    """The weights of the three terms; the last two may differ between contexts."""

    true: Float[Values, ""]
    unlabelled: Float[Values, " context"]
    predicted: Float[Values, " context"]


@final
@dataclass(frozen=True)
class Scheme:
    """One of the six.

    Attributes:
        name: its name in figures and reports.
        training: on which labelled samples the predictor is trained when dtprob trains it: "none" (no
            predictor), "all" of them, "split" (one half, the other half stays for inference), or "cross" (K
            predictors, each without one fold).
        pooled: labels and predictions are averaged as if they were alike, without a correction.
        lam: weight of the correction; None where it is tuned.
    """

    name: str
    training: Training
    pooled: bool = False
    lam: float | None = 1.0

    @property
    def is_tuned(self) -> bool:
        """Whether lambda comes from the data."""
        return self.lam is None

    def mix(
        self, n: Float[Values, ""], n_unlabelled: Float[Values, ""], lam: Float[Values, " context"]
    ) -> Mix:
        """The weights of the three terms.

        Args:
            n: labelled samples.
            n_unlabelled: unlabelled samples.
            lam: weight of the correction in each context; ignored by a pooled scheme.
        """
        xp = namespace(lam)
        if self.pooled:
            share = n_unlabelled / (n + n_unlabelled)
            return Mix(1 - share, xp.full_like(lam, share), xp.zeros_like(lam))
        return Mix(xp.ones_like(n), lam, lam)


SCHEMES: Final[dict[str, Scheme]] = {
    scheme.name: scheme
    for scheme in (
        Scheme("erm", "none", lam=0.0),
        Scheme("ss", "all", pooled=True),
        Scheme("ppi", "split"),
        Scheme("tuned_ppi", "split", lam=None),
        Scheme("cppi", "cross"),
        Scheme("tuned_cppi", "cross", lam=None),
    )
}
"""ERM, semi-supervised, PPI, tuned PPI, cross-PPI and tuned cross-PPI, by name."""


def named_scheme(name: str) -> Scheme:
    """A scheme from its name.

    Raises:
        InputError: no scheme has that name.
    """
    if name not in SCHEMES:
        raise unknown_name("scheme", name, SCHEMES, "scheme")
    return SCHEMES[name]
