"""A single value: the maximum a posteriori, or the maximum likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax

from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.engine import (
    DEFAULT,
    AbstractEngine,
    Answer,
    RunOptions,
    check_choice,
    check_counts,
    check_initial,
    check_key,
)
from dtprob.inference.modes import find_mode
from dtprob.inference.posterior import Posterior
from dtprob.models.arguments import Model


@dataclass(frozen=True)
class Point(AbstractEngine):
    """The value that maximises prior times likelihood, or the likelihood alone; one draw.

    The maximum is over the constrained values, so it does not depend on the coordinates: the mode of a
    Dirichlet is the textbook's. The posterior's `extra` has `objective` (the log of what is maximised),
    `converged`, `promise` (nats that another step would gain) and `agreeing` (share of the starts that
    ended there).

    Attributes:
        objective: "map" or "maximum_likelihood".
        starts: from how many points the maximum is sought.
        initial: constrained values to start from; sites without one start from the prior.
        max_steps: bound on the steps of each search.
    """

    name: ClassVar[str] = "point"
    answer: ClassVar[Answer] = "point"

    objective: Literal["map", "maximum_likelihood"] = "map"
    starts: int = 4
    initial: Mapping[str, Any] | None = None
    max_steps: int = 200

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"starts": 1, "max_steps": 1})
        check_choice(self, "objective", ("map", "maximum_likelihood"))
        check_initial(self.initial)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        target, inputs = build_target(model, data)
        mode = find_mode(
            target,
            inputs,
            check_key(key),
            objective=self.objective,
            initial=self.initial,
            starts=self.starts,
            max_steps=self.max_steps,
        )
        return assemble(
            target,
            inputs,
            mode.optimum.position[None, None],
            engine=self,
            key=key,
            options=options,
            extra={"objective": -mode.optimum.value, **mode.facts()},
        )
