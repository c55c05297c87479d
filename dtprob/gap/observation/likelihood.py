"""What a diagnosis has to know of a family of distributions of observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
from jax.typing import ArrayLike

from dtprob.gap.observation.residuals import Parameters

type Rows = Callable[[Parameters, Any], jax.Array]
type Move = Callable[[Parameters, jax.Array], Parameters]


class About(NamedTuple):
    """Rows at given parameters; what depends on these alone is computed once, before any loop over values or changes.

    Attributes:
        residual: values -> rows (component, *shape of the value).
        shift: a change of each parameter -> what it adds to the rows.
    """

    residual: Callable[[Any], jax.Array]
    shift: Callable[[Parameters], jax.Array]


@dataclass(frozen=True)
class Likelihood:
    """One family of distributions.

    Attributes:
        make: the NumPyro distribution from its parameters.
        parameters: names of the parameters, each an attribute of the distribution.
        residual: (parameters, values) -> rows (component, *shape of the value).
        shift: (parameters, a change of each) -> what it adds to the rows.
        about: parameters -> both, where something is computed from the parameters alone.
        located: how many of the rows, the first ones, stand for a location or probability; None for all.
        relocate: (parameters, step) -> parameters whose first row is shifted by the step; None where that is not possible.
        respread: the same for the first row that is no location.
        respread_about: the same by about the step, where the exact unit is slow to tell.
        log_scale: of families whose first rows are normal, the logarithm of the scale for a unit step of that row.
        probability: (parameters, rows) -> probability of a smaller value than theirs, of families of numbers that are not
            normal; see `dtprob.gap.observation.probabilities`.
        is_outcome: whether one of a few outcomes is seen.
        is_complex: whether the first two rows are the real and the imaginary part of one.
        trailing: axes that a parameter has beyond those of the value.
        mean: expected value, where it is neither the location nor the distribution's own.
        log_prob: log density of each entry given those before it, where the entries of the last axis are one vector.
        density: log density of each value, where NumPyro's has no gradient at an end of what parameters may be.
        impossible: which values cannot be although their density is finite.
    """

    make: Callable[..., Any]
    parameters: tuple[str, ...]
    residual: Rows
    shift: Rows
    located: int | None = None
    relocate: Move | None = None
    respread: Move | None = None
    respread_about: Move | None = None
    log_scale: float | None = None
    probability: Callable[[Parameters, jax.Array], ArrayLike] | None = None
    is_outcome: bool = False
    is_complex: bool = False
    trailing: Mapping[str, int] = field(default_factory=dict)
    mean: Callable[[Parameters], jax.Array] | None = None
    log_prob: Rows | None = None
    density: Rows | None = None
    impossible: Rows | None = None
    about: Callable[[Parameters], About] | None = None
