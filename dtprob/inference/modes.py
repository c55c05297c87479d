"""The mode of a target, found from several starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.errors import InputError
from dtprob.inference.optimise import Optimum, best, minimise
from dtprob.inference.target import PRIOR_DRAWS, Inputs, Target
from dtprob.models.supported import differentiated_forwards

type Objective = Literal["density", "map", "maximum_likelihood"]

_CANDIDATES = 4
_SAME_NATS = 1e-3


class Mode(NamedTuple):
    """The best optimum over the starts.

    Attributes:
        optimum: where it is and whether the search arrived.
        agreeing: share of the starts that ended within a thousandth of a nat of it.
    """

    optimum: Optimum
    agreeing: Scalar

    def facts(self) -> dict[str, Array]:
        """The entries of a posterior's `extra` that say how the search went."""
        found = self.optimum
        return {"converged": found.converged, "promise": found.promise, "agreeing": self.agreeing}


def objective_value(
    target: Target, objective: Objective, u: Float[Array, " dimension"], inputs: Inputs
) -> Scalar:
    """The negative log density that a mode minimises.

    Args:
        target: the target.
        objective: "density" for the density over the unconstrained coordinates (what Laplace's method needs),
            "map" for prior times likelihood over the constrained values, "maximum_likelihood" without the
            prior.
        u: the point.
        inputs: the target's arrays.
    """
    terms = target.log_terms(u, inputs)
    if objective == "density":
        return -sum(terms, start=jnp.zeros(()))
    return -terms.likelihood if objective == "maximum_likelihood" else -(terms.prior + terms.likelihood)


def find_mode(
    target: Target,
    inputs: Inputs,
    key: PRNGKeyArray,
    *,
    objective: Objective,
    initial: Mapping[str, Any] | None,
    starts: int,
    max_steps: int,
) -> Mode:
    """The lowest of the local minima reached from several starts.

    The first start is the prior's median, the others the best of four times as many prior draws; sites with
    an initial value start there, and where every site has one there is a single start.

    Args:
        target: the target.
        inputs: its arrays.
        key: typed JAX key, for the starts.
        objective: see `objective_value`.
        initial: constrained values of some sites.
        starts: how many.
        max_steps: bound on the steps of each.

    Raises:
        InputError: the density is not finite at any start, or has derivatives backwards only.
    """
    values = target.latent_values(initial or {})
    count = 1 if len(values) == len(target.coordinates) else starts
    points = starting_points(target, inputs, key, objective=objective, values=values, starts=count)
    with differentiated_forwards():
        mode: Mode = target.compiled(search, objective, max_steps)(points, inputs)
    if not bool(jnp.isfinite(mode.optimum.value)):
        raise nowhere_finite(target)
    return mode


def nowhere_finite(target: Target) -> InputError:
    """The error of a model whose density is not finite where a search or a chain begins."""
    what = f"model {target.declaration.name}"
    remedy = "Give initial values, or check that the data are finite and within the model's supports"
    return InputError(what, "a finite log density", "none at any start", remedy)


def search(
    target: Target,
    objective: Objective,
    max_steps: int,
    points: Float[Array, "start dimension"],
    inputs: Inputs,
) -> Mode:
    """The lowest of the minima reached from these points, as a pure function; see `find_mode`."""

    def function(u: Array) -> Array:
        return objective_value(target, objective, u, inputs)

    optima = jax.vmap(lambda point: minimise(function, point, max_steps))(points)
    lowest = best(optima)
    return Mode(lowest, jnp.mean(optima.value <= lowest.value + _SAME_NATS, dtype=lowest.value.dtype))


def starting_points(
    target: Target,
    inputs: Inputs,
    key: PRNGKeyArray,
    *,
    objective: Objective,
    values: Mapping[str, Array],
    starts: int,
) -> Float[Array, "start dimension"]:
    """Where to start: the prior's median, then the best of four times as many prior draws.

    Args:
        target: the target.
        inputs: its arrays.
        key: typed JAX key.
        objective: what "best" means.
        values: constrained values of the sites that are given.
        starts: how many.
    """
    if starts == 1:
        return target.once(_median)(inputs, values)
    drawn = _candidates(target, inputs, key, values, _CANDIDATES * (starts - 1))
    return target.once(_chosen, objective, starts)(drawn, inputs, values)


def _candidates(
    target: Target, inputs: Inputs, key: PRNGKeyArray, values: Mapping[str, Array], least: int
) -> Float[Array, "draw dimension"]:
    """Prior draws, this many or more, in blocks of one compiled size."""
    draw = target.once(Target.prior_draws)
    keys = [key, *(jax.random.fold_in(key, block) for block in range(1, -(-least // PRIOR_DRAWS)))]
    return jnp.concatenate([draw(own, inputs, values) for own in keys])


def _median(target: Target, inputs: Inputs, values: Mapping[str, Array]) -> Float[Array, "1 dimension"]:
    return target.prior_median(inputs, values)[None]


def _chosen(  # noqa: PLR0917
    target: Target,
    objective: Objective,
    starts: int,
    drawn: Float[Array, "draw dimension"],
    inputs: Inputs,
    values: Mapping[str, Array],
) -> Float[Array, "start dimension"]:
    """The prior's median, and the best of some prior draws."""
    points = drawn[: _CANDIDATES * (starts - 1)]
    heights = jax.lax.map(lambda u: objective_value(target, objective, u, inputs), points)
    order = jnp.argsort(jnp.where(jnp.isfinite(heights), heights, jnp.inf))
    return jnp.concatenate([_median(target, inputs, values), points[order[: starts - 1]]])
