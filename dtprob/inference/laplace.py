"""Laplace's method: a Gaussian at the mode of the unconstrained density.

Source: Tierney and Kadane, Accurate approximations for posterior moments and marginal densities (1986).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.errors import InputError
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.engine import (
    DEFAULT,
    AbstractEngine,
    Answer,
    RunOptions,
    check_counts,
    check_initial,
    check_key,
)
from dtprob.inference.modes import find_mode, objective_value
from dtprob.inference.optimise import curvature, gradient_and_hessian
from dtprob.inference.posterior import Posterior
from dtprob.inference.target import Inputs, Target
from dtprob.inference.weights import tail_index
from dtprob.models.arguments import Model
from dtprob.models.supported import differentiated_forwards

COUNTS = {"draws": 1, "starts": 1, "max_steps": 1}
"""The least that the settings can be."""
LARGEST = 3000
"""Coordinates that a dense precision is kept for."""


class Gaussian(NamedTuple):
    """The approximation.

    Attributes:
        mode: unconstrained coordinates of the mode, (dimension,).
        precision: negative Hessian of the log density there, made positive definite.
        factor: a square root of the covariance.
        log_density: log density at the mode.
        log_evidence: log of the integral of the Gaussian approximation.
        replaced: directions whose curvature was not positive and was replaced by its absolute value.
    """

    mode: Float[Array, " dimension"]
    precision: Float[Array, "dimension dimension"]
    factor: Float[Array, "dimension dimension"]
    log_density: Float[Array, ""]
    log_evidence: Float[Array, ""]
    replaced: Array


@dataclass(frozen=True)
class Laplace(AbstractEngine):
    """Gaussian approximation at the mode, in unconstrained coordinates; angles are wrapped after drawing.

    The posterior's `extra` has `log_evidence`, `log_density` and `mode` (unconstrained), `mode.<site>` for
    each latent site, `precision`, `converged`, `promise` (nats that another step would gain), `agreeing`
    (share of the starts that ended there), `replaced` (directions in which the density does not fall
    off; when it is not zero, the draws and the evidence are not to be trusted) and `pareto_k` (of the draws' importance
    weights: above .7 the posterior is another one, such as one with a funnel, or with angles that are spread widely).

    Attributes:
        draws: how many draws.
        starts: from how many points the mode is sought.
        initial: constrained values to start from; sites without one start from the prior.
        max_steps: bound on the steps of each search.
    """

    name: ClassVar[str] = "laplace"
    answer: ClassVar[Answer] = "approximation"

    draws: int = 1000
    starts: int = 4
    initial: Mapping[str, Any] | None = None
    max_steps: int = 200

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, COUNTS)
        check_initial(self.initial)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        search_key, draw_key = jax.random.split(check_key(key))
        target, inputs = build_target(model, data)
        if target.dimension > LARGEST:
            remedy = "Use another engine, such as nuts, or point"
            raise InputError("laplace", f"at most {LARGEST} coordinates", str(target.dimension), remedy)
        mode = find_mode(
            target,
            inputs,
            search_key,
            objective="density",
            initial=self.initial,
            starts=self.starts,
            max_steps=self.max_steps,
        )
        with differentiated_forwards():
            gaussian: Gaussian = target.compiled(approximate)(mode.optimum.position, inputs)
        noise = jax.random.normal(draw_key, (self.draws, target.dimension))
        positions = gaussian.mode + noise @ gaussian.factor.T
        posterior = assemble(
            target,
            inputs,
            positions[None],
            engine=self,
            key=key,
            options=options,
            extra=gaussian_facts(target, inputs, gaussian) | mode.facts(),
        )
        heights = posterior.sample_stats["lp"][0] + 0.5 * np.sum(np.asarray(noise) ** 2, axis=1)
        return replace(posterior, extra={**posterior.extra, "pareto_k": np.asarray(tail_index(heights))})


def gaussian_facts(target: Target, inputs: Inputs, gaussian: Gaussian) -> dict[str, np.ndarray]:
    """The entries of a posterior's `extra` that describe a Gaussian approximation."""
    values = target.compiled(Target.constrain)(gaussian.mode, inputs)
    facts = gaussian._asdict()
    del facts["factor"]
    modes = {f"mode.{name}": values[name] for name in target.coordinates}
    return {name: np.asarray(value) for name, value in (facts | modes).items()}


def approximate(target: Target, mode: Float[Array, " dimension"], inputs: Inputs) -> Gaussian:
    """The Gaussian with the density's height and curvature at a mode.

    Args:
        target: the target.
        mode: its coordinates.
        inputs: the target's arrays.
    """

    def function(u: Array) -> Array:
        return objective_value(target, "density", u, inputs)

    values, vectors = curvature(gradient_and_hessian(function, mode)[1])
    floor = jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), initial=0.0)
    positive = jnp.maximum(jnp.abs(values), floor)
    log_density = -function(mode)
    return Gaussian(
        mode=mode,
        precision=(vectors * positive) @ vectors.T,
        factor=vectors / jnp.sqrt(positive),
        log_density=log_density,
        log_evidence=log_density + 0.5 * jnp.sum(jnp.log(2 * jnp.pi / positive)),
        replaced=jnp.sum(values <= floor),
    )
