"""Choosing an engine by the model's structure, with the reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.build import build_target
from dtprob.inference.engine import DEFAULT, AbstractEngine, Answer, RunOptions, check_counts, check_key
from dtprob.inference.exact import Exact, conjugate, has_tables
from dtprob.inference.gaussian import gaussian_posterior
from dtprob.inference.nuts import NUTS
from dtprob.inference.posterior import Posterior
from dtprob.inference.relaxation import find_layout
from dtprob.inference.svi import SVI
from dtprob.inference.target import Inputs, Target
from dtprob.inference.von_mises_em import VonMisesEM
from dtprob.models.arguments import Model

MOST_COORDINATES = 500
"""Coordinates up to which the No-U-Turn sampler is chosen."""
MOST_WORK = 1e13
"""Floating-point operations of a whole run up to which it is chosen: about an hour on two cores."""
_GRADIENTS = 256_000  # of a run of 4 chains of 2000 steps of 32 leapfrogs


class Choice(NamedTuple):
    """An engine, and why."""

    engine: AbstractEngine
    reason: str


@dataclass(frozen=True)
class Auto(AbstractEngine):
    """The engine that suits the model's structure, and the reason for it in the posterior's provenance.

    Exact where the posterior has a closed form; the No-U-Turn sampler where that is affordable; von Mises EM
    for many angles of the class it serves exactly; variational inference otherwise. The provenance has the
    name of the `chosen` engine and the `reason`.

    Attributes:
        draws: of the chosen engine; by chain where it has several.
    """

    name: ClassVar[str] = "auto"
    answer: ClassVar[Answer] = "approximation"

    draws: int = 1000

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"draws": 1})

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        check_key(key)
        engine, reason = choose(model, data, draws=self.draws)
        posterior = engine(key, model, data, options=options)
        chosen = {"chosen_by": self.name, "chosen": engine.name, "reason": reason}
        return dataclasses.replace(posterior, provenance={**posterior.provenance, **chosen})


def choose(model: Model, data: Mapping[str, Any], *, draws: int = 1000) -> Choice:
    """The engine for a model on data; the same one in every run.

    Args:
        model: a NumPyro model.
        data: its arguments by name.
        draws: how many draws the engine is to give.

    Raises:
        InputError: see `build_target`.
    """
    target, inputs = build_target(model, data)
    key = jax.random.key(0)
    closed = _closed_form(target, inputs, key)
    if closed:
        return Choice(Exact(draws=draws), f"{closed}, so the posterior is known in closed form")
    size, angles, work = target.dimension, target.angles.size, _work(target, inputs)
    what = f"{size} unknowns" + (f", {angles} of them angles" if angles else "")
    if size <= MOST_COORDINATES and work <= MOST_WORK:
        reason = f"{what}, about {work:.0e} operations: few enough to draw from the posterior itself"
        return Choice(NUTS(draws=draws), reason)
    many = f"more than {MOST_COORDINATES}" if size > MOST_COORDINATES else f"about {work:.0e} operations"
    too_much = f"{what}, {many}: too many for a Markov chain"
    if 2 * angles > size and _is_relaxable(target, inputs, key):
        reason = f"{too_much}; the log density is affine in each angle's cosine and sine"
        return Choice(VonMisesEM(draws=draws), reason)
    return Choice(SVI(draws=draws), f"{too_much}, so a distribution is fitted to the posterior")


def _closed_form(target: Target, inputs: Inputs, key: PRNGKeyArray) -> str | None:
    """What makes the posterior known, if anything does."""
    try:
        if has_tables(target):
            conjugate(target, inputs, key)
            return "all unknowns are Dirichlet tables under counts"
        gaussian_posterior(target, inputs, key)
    except InputError:
        return None
    return "the log density is quadratic"


def _is_relaxable(target: Target, inputs: Inputs, key: PRNGKeyArray) -> bool:
    try:
        find_layout(target, inputs, key)
    except InputError:
        return False
    return True


def _work(target: Target, inputs: Inputs) -> float:
    """Floating-point operations of a usual run of the No-U-Turn sampler, from the program of its gradient."""
    slope: Any = target.compiled(_slope)
    cost = slope.lower(jnp.zeros(target.dimension), inputs).cost_analysis()
    return _GRADIENTS * float(cost.get("flops", 0.0))


def _slope(target: Target, u: Float[Array, " dimension"], inputs: Inputs) -> Float[Array, " dimension"]:
    return jax.grad(lambda v: target.log_density(v, inputs))(u)
