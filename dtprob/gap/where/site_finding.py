"""What is found at a model's sites, and in which order: one that is wrong makes others look so."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from dtprob.gap.tails import LOG_SMALLEST, told_apart

SURE: Final = 0.005
"""Probability below which a site is surely wrong."""
_END: Final = math.exp(LOG_SMALLEST + 14)
"""Probability near which p-values, adjusted for many tests, end."""
_FAR_READINGS: Final = 1e-9
"""Probability of the tails from which far readings are what is wrong, and ripples of a spread follow them."""
_LIKE_NOISE: Final = 20.0
"""Times the residuals' energy up to which a squared score over its variance is as noise makes it, in the best of many."""
_MOMENTS: Final = frozenset(
    ("spread", "shape", "skewness", "tails", "dispersion", "circularity", "dependence", "repeats")
)
"""First words of kinds of what may be wrong with an observation whose values are right."""


@dataclass(frozen=True)
class SiteFinding:
    """Evidence that a site's values are wrong.

    Attributes:
        site: its name.
        kind: what is added ("additive", "relative", "conjugate", ...) or wrong ("spread", "dependence along link", ...).
        pattern: how that varies, in words.
        p_value: family-wise over all sites and families.
        gain: nats that moving the site along its steepest direction would gain, nuisances refitted to first order; None
            where nothing that a model computes would move it.
        last: whether it may be the shadow of another: a wrong mean spreads too, and far strays look like wrong means.
        spreads: whether moving the site moves nothing but spreads of observations.
        beyond_noise: nats of the gain beyond those that noise of the residuals' energy would bring by chance.
        score: squared score of its values over the variance, on average over the entries of the family that has most.
        place: in words, of the one entry that brings most of what is wrong; None where several do.
        whereabouts: the pattern, where it says where or along what something is wrong.
        is_ripple: whether it varies in ripples, which find any reading that is far off.
        is_of_each: whether it varies from reading to reading, which finds them, too.
        is_held: of far readings, whether sites were tested with these held, so that what is wrong there is not they.
    """

    site: str
    kind: str
    pattern: str
    p_value: float
    gain: float | None
    last: bool = False
    spreads: bool = False
    beyond_noise: float = 0.0
    score: float = math.inf
    place: str | None = None
    whereabouts: str | None = None
    is_ripple: bool = False
    is_of_each: bool = False
    is_held: bool = False

    @property
    def family(self) -> str:
        """What is added and how it varies, in words."""
        return f"{self.kind}, {self.pattern}"

    @property
    def moment(self) -> str | None:
        """What of an observation is wrong: its spread, or what lies beyond; None where values are."""
        return self.kind if self.kind.split(" ")[0] in _MOMENTS else None

    @property
    def is_of_values(self) -> bool:
        """Whether values are wrong, and not how observations spread about them, by whatever name."""
        return self.moment is None and not self.spreads

    @property
    def is_dependence(self) -> bool:
        """Whether readings depend on each other."""
        return self.kind.startswith("dependence")

    @property
    def is_of_far(self) -> bool:
        """Whether it is of readings that lie far out, to both sides or to one."""
        return self.moment in ("tails", "skewness")

    @property
    def strays(self) -> bool:
        """Whether far readings are surely what is wrong."""
        return self.is_of_far and self.p_value <= _FAR_READINGS

    @property
    def is_placed(self) -> bool:
        """Whether it is of a site, or of how an observation spreads, which differ from place to place."""
        return self.moment in (None, "spread", "shape")

    @property
    def is_inline(self) -> bool:
        """Whether it is of readings themselves, which no site stands for one by one; a site that shows it says more."""
        return self.kind == "location"

    @property
    def can_be_modelled(self) -> bool:
        """Whether a model of the remainder may say something: not of what nothing moves, nor of ripples that follow it."""
        return self.gain is not None and (self.is_of_values or not (self.last and self.is_ripple))

    @property
    def repeats(self) -> bool:
        """Whether readings are exactly alike, which no wrong value or spread makes them."""
        return self.moment == "repeats"


def most_gained(found: Iterable[SiteFinding]) -> float:
    """Nats that moving the best of these sites would gain; zero where there is none."""
    return max((one.gain for one in found if one.gain is not None), default=0.0)


def most_left(found: Iterable[SiteFinding]) -> float:
    """Nats that are left at the worst of these sites at least.

    Of a moment, a spread or what goes together, about -log p at least, as a likelihood ratio of it would have: of a spread
    that is far too small the first order tells a fraction. Not where it may be the shadow of another site.
    """
    sites = tuple(found)
    moments = (one for one in sites if not (one.is_of_values or one.last))
    told = (-math.log(max(one.p_value, 1e-300)) for one in moments)
    return max(most_gained(sites), max(told, default=0.0))


def likely_left(found: Iterable[SiteFinding]) -> float:
    """Nats that are left where no site is surely wrong: the gain at one, for the share of doubt that its p-value leaves.

    That something is wrong is 1 / (-e p log p) times as likely as the p-value says at most (Sellke, Bayarri and Berger,
    Am. Stat. 55 (2001) 62): above 1 / e nothing speaks for it.
    """
    told = ((one.p_value, one.gain) for one in found if one.gain is not None)
    likely = ((1 + math.e * p * math.log(p)) * gain for p, gain in told if 0 < p < math.exp(-1))
    return max(likely, default=0.0)


def shadows_last(findings: Sequence[SiteFinding], energy: float) -> list[SiteFinding]:
    """Where values are surely wrong moments come last, or the values if a moment is more than twice as surely wrong.

    Not if that moment gains less: a level that is far off makes squares larger than all noise, and explains them better.

    Ripples of a spread, and what varies from reading to reading, come last where tails or skewness are what is wrong: they
    find any reading that is far off.

    Far readings that sites were tested without come last where one of these is surely wrong: where many readings are off at
    one place, they lie far out among all.

    Readings themselves come last where a site stands for some of them, unless they are more than twice as surely wrong.

    Where p-values end values come last if their scores are no larger than noise of such an energy (of the residuals, over
    its expectation) makes them.
    """
    strays = any(f.strays for f in findings)
    by_strays = [strays and ((f.is_ripple and not f.is_of_values) or f.is_of_each) for f in findings]
    at_places = (f.p_value for f, by in zip(findings, by_strays, strict=True) if f.is_placed and not by)
    is_at_a_place = min(at_places, default=1.0) <= SURE
    steady = [f for f in findings if f.is_of_values and not (strays and f.is_of_each)]
    of_values = min((f.p_value for f in steady), default=1.0)
    explained = max((f.beyond_noise for f in steady), default=0.0)
    others = (f for f in findings if not (f.is_of_values or f.is_held))
    moments = (f for f in others if (f.gain is None or f.gain > explained))
    of_moments = min((f.p_value for f in moments), default=1.0)
    score = max((f.score for f in steady), default=0.0)
    by_noise = of_moments < of_values**2 or (of_moments < _END and score < _LIKE_NOISE * energy)
    of_sites = min((f.p_value for f in steady if not f.is_inline), default=1.0)
    return [
        replace(
            f,
            last=(of_values <= SURE and f.is_of_values == by_noise and not f.repeats)
            or by
            or (f.is_held and is_at_a_place)
            or (f.is_inline and of_sites <= SURE and f.p_value >= of_sites**2),
        )
        for f, by in zip(findings, by_strays, strict=True)
    ]


def rank(found: SiteFinding) -> tuple[bool, bool, float, float]:
    """The surest first, then the largest gain; sites that rounding alone parts, one acting through another, are equal.

    What is read again and again comes before all others: it makes values and spreads look wrong, and not they it.
    """
    return not found.repeats, found.last, told_apart(found.p_value), -told_apart(found.gain or 0.0)
