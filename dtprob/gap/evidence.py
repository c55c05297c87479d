"""Everything that a verdict is drawn from."""

from __future__ import annotations

from dataclasses import dataclass

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.how_far.closed import ClosedFraction, Floor, HeldOut
from dtprob.gap.how_far.remainder import Remainder
from dtprob.gap.how_far.shares import Share
from dtprob.gap.model.problem import Problem
from dtprob.gap.view import View
from dtprob.gap.where.locate import Location
from dtprob.gap.which.search import Step
from dtprob.gap.which.trials import Start


@dataclass(frozen=True)
class Evidence:
    """The base fit, the steps of the search and the held-out losses before and after the accepted effects.

    `notes` says what is wrong with the base fit itself; `rivals` are where the search ended on its other ways; `asked_for`
    are effects that the scores still call for where no more of them were looked for.
    """

    problem: Problem
    base: Fit
    steps: tuple[Step, ...]
    held_before: HeldOut
    held_after: HeldOut
    floor: Floor
    fraction: ClosedFraction | None
    shares: tuple[Share, ...]
    notes: tuple[str, ...] = ()
    remainder: Remainder | None = None
    rivals: tuple[Start, ...] = ()
    asked_for: tuple[str, ...] = ()

    @property
    def before(self) -> Location:
        """Maps at the base fit."""
        return self.steps[0].view.location

    @property
    def last(self) -> View:
        """The view with all accepted effects."""
        return self.steps[-1].view

    @property
    def after(self) -> Location:
        """Maps at the last fit."""
        return self.last.location

    @property
    def fitted(self) -> Fit:
        """The fit with all accepted effects."""
        return self.last.fitted

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names of the accepted effects."""
        return self.fitted.effects

    @property
    def explanations(self) -> dict[tuple[str, ...], Start]:
        """Sets of effects, fitted, each with its problem.

        Those that differ from the accepted one in one effect at most, and the rivals, which may have several effects in
        place of one.
        """
        found = {frozenset(self.accepted): Start(self.last.problem, self.fitted)}
        for step in self.steps:
            rest = step.view.fitted.effects
            if step.accepted is None or {*rest, step.accepted} != set(self.accepted):
                continue
            for name, fitted in step.trials.fits.items():
                found.setdefault(frozenset(fitted.effects), step.trials.at(name))
        for rival in self.rivals:
            found.setdefault(frozenset(rival.fitted.effects), rival)
        return {one.fitted.effects: one for one in found.values()} if self.accepted else {}

    @property
    def tried(self) -> dict[tuple[str, ...], Start]:
        """The explanations, and each single effect that was fitted before any was named."""
        found = self.explanations
        seen = {frozenset(names) for names in found}
        first = self.steps[0]
        if not found or first.view.fitted.effects:
            return found
        singles = {fitted.effects: name for name, fitted in first.trials.fits.items()}
        return found | {
            names: first.trials.at(name) for names, name in singles.items() if frozenset(names) not in seen
        }
