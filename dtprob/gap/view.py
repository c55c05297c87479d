"""A fit seen from all sides: what it leaves, which candidates it calls for, where."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import Projection, project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.locate import NOWHERE, Location, locate
from dtprob.gap.where.site_finding import most_gained
from dtprob.gap.which.places import place
from dtprob.gap.which.screen import Screening, screen


@dataclass(frozen=True)
class View:
    """A fit, the scores of all candidates there, and the maps of the gap that it leaves."""

    problem: Problem
    fitted: fitting.Fit
    projection: Projection
    screening: Screening
    location: Location

    @property
    def promise(self) -> float:
        """Nats that the best candidate or site could still bring, to first order."""
        return max(
            float(self.screening.log_bayes_factor.max(initial=0.0)),
            most_gained(self.location.sites),
        )

    def alarmed(self, settings: Settings) -> bool:
        """Whether the effects' scores or the site tests show a gap at the level."""
        return self.screening.shows_gap(settings) or self.location.site_p_value <= settings.level / 2


def view(
    problem: Problem, fitted: fitting.Fit, key: jax.Array, settings: Settings, *, located: bool = True
) -> View:
    """Screen all candidates and map the gap at a fit, on one bootstrap; without maps if not `located`."""
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, key, settings)
    problem, placed = place(problem, fitted, drawn)
    screening = screen(problem, fitted, projection, drawn, settings, placed=placed)
    location = NOWHERE
    if located:
        shown = not fitted.effects and screening.shows_gap(settings)
        location = locate(problem, fitted, projection, drawn, settings, shown=shown)
    return View(problem, fitted, projection, screening, location)
