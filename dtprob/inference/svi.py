"""Variational inference with von Mises factors for angles and a normal distribution for the rest.

The gradient of the evidence lower bound is taken along draws of the guide (von Mises: implicitly, see
`dtprob.inference.von_mises`) without the guide's own score, whose mean is zero: it then has no noise where
the guide is the posterior (Roeder, Wu and Duvenaud, Sticking the landing, 2017). Steps are Adam's. The rate
falls when the bound has stopped rising, and the mean of the last steps is the answer, not the last one
(Dhaka et al., Robust, accurate stochastic optimization for variational inference, 2020).

NumPyro's own loop carries its key from step to step and its sampler gives concentrations no gradient, so
this one works on the target itself; densities and normal draws are NumPyro's, the optimiser is optax's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

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
from dtprob.inference.guide import (
    Anchor,
    Family,
    Guide,
    anchor_at,
    draw,
    initial_guide,
    log_density,
    prior_anchor,
)
from dtprob.inference.iterate import Job, Steps, iterate
from dtprob.inference.modes import find_mode
from dtprob.inference.posterior import Posterior
from dtprob.inference.target import Inputs, Target
from dtprob.inference.weights import weight_facts
from dtprob.models.arguments import Model

_WINDOW = 100  # updates between two looks at the bound
_PATIENCE = 3  # windows without a rise after which the rate falls
_SHRINK = 0.25
_CLIP = 100.0  # nats per unit of a parameter
_LARGEST_FULL = 100
_TRIALS = 64
_EVALUATED = 32  # draws whose weights are evaluated at once


class Ascent(NamedTuple):
    """The state of a run.

    Attributes:
        anchor: where the guide is measured from.
        guide: the parameters after the last update.
        mean: their mean over the last window.
        optimiser: the state of Adam.
        recent: the bound of the latest windows at this rate, nats, oldest first.
        falls: how often the rate has fallen.
    """

    anchor: Anchor
    guide: Guide
    mean: Guide
    optimiser: Any
    recent: Float[Array, " window"]
    falls: Int[Array, ""]


@dataclass(frozen=True)
class SVI(AbstractEngine):
    """Stochastic variational inference: von Mises factors for angles, a normal for the rest.

    The posterior's `extra` has `elbo` (evidence lower bound, nats) with its `elbo_history`, `converged`
    (whether the bound stopped rising at every rate, and the density is finite at every draw), `pareto_k` (the
    tail index of the importance weights: above 0.7 the guide misses part of the posterior, and its draws are not
    to be trusted; minus infinity where all weights are equal, nan of fewer than 25 draws), `log_evidence` (from
    these weights) and `concentration.<site>` for each circular site. The statistic `log_weight` is log posterior
    less log guide, for weighing draws anew.

    Attributes:
        draws: how many draws of the guide.
        guide: "mean_field", "low_rank" or "full_rank" covariance of the coordinates that are not angles;
            "auto" is full up to 100 of them and low-rank above.
        rank: columns of a low-rank covariance.
        steps: bound on the updates.
        learning_rate: of Adam, in units of the density's curvature at the start.
        falls: how often the rate falls, to a quarter each time, before the run ends.
        particles: draws of the guide in each update.
        tolerance: a rise of the bound that is worth going on for, nats.
        starts: from how many points the mode is sought at which the guide starts.
        initial: constrained values to start from; sites without one start from the prior.
    """

    name: ClassVar[str] = "svi"
    answer: ClassVar[Answer] = "approximation"

    draws: int = 1000
    guide: Literal["auto", "mean_field", "low_rank", "full_rank"] = "auto"
    rank: int = 10
    steps: int = 20_000
    learning_rate: float = 0.05
    falls: int = 3
    particles: int = 8
    tolerance: float = 0.01
    starts: int = 4
    initial: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        least = ("draws", "rank", "steps", "falls", "particles", "starts")
        check_counts(self, dict.fromkeys(least, 1))
        check_choice(self, "guide", ("auto", *get_args(Family.__value__)))
        check_initial(self.initial)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        draw_key = jax.random.fold_in(check_key(key), 2)
        target, inputs = build_target(model, data)
        family = self._family(target)
        job = Job(self, target, inputs, key, options, free=("draws",))
        ascent, history = iterate(job, self._steps(target, family, inputs, key))
        keys = jax.vmap(jax.random.fold_in, (None, 0))(draw_key, jnp.arange(self.draws))
        weigh = target.compiled(_weighed, family)
        positions, weights = (np.asarray(x) for x in weigh(ascent.anchor, ascent.mean, keys, inputs))
        return assemble(
            target,
            inputs,
            positions[None],
            engine=self,
            key=key,
            options=options,
            stats={"log_weight": weights[None]},
            extra={
                "elbo": weights.mean(),
                "elbo_history": history["elbo"],
                "converged": bool(int(ascent.falls) >= self.falls and np.isfinite(weights).all()),
                **weight_facts(weights),
                **_concentrations(target, ascent),
            },
        )

    def _family(self, target: Target) -> Family:
        if not target.linear.size:
            return "mean_field"
        if self.guide != "auto":
            return self.guide
        return "full_rank" if target.linear.size <= _LARGEST_FULL else "low_rank"

    def _steps(self, target: Target, family: Family, inputs: Inputs, key: PRNGKeyArray) -> Steps[Ascent]:
        step_key = jax.random.fold_in(key, 1)

        def begin() -> Ascent:
            anchor = self._anchor(target, family, inputs, key)
            guide = initial_guide(target, family, self.rank)
            nothing = jnp.full(_PATIENCE + 1, -jnp.inf)
            falls = jnp.zeros((), dtype=int)
            return Ascent(anchor, guide, guide, _optimiser(1.0).init(guide), nothing, falls)

        def step(number: int, before: Ascent) -> tuple[Ascent, dict[str, Any]]:
            window = target.compiled(_window, family, self.particles)
            rate = self.learning_rate * _SHRINK ** before.falls.astype(float)
            moved, elbo, error = window(before, rate, jax.random.fold_in(step_key, number), inputs)
            recent = jnp.append(before.recent[1:], elbo)
            if elbo - recent[0] >= jnp.maximum(self.tolerance, error):
                return moved._replace(recent=recent), {"elbo": elbo}
            start_anew = jnp.full_like(recent, -jnp.inf).at[-1].set(elbo)
            return moved._replace(recent=start_anew, falls=before.falls + 1), {"elbo": elbo}

        return Steps(
            begin,
            step,
            finished=lambda ascent: int(ascent.falls) >= self.falls,
            most=-(-self.steps // _WINDOW),
            phase=f"x {_WINDOW} updates",
            note=lambda ascent: f"bound {float(ascent.recent[-1]):.6g} nats",
        )

    def _anchor(self, target: Target, family: Family, inputs: Inputs, key: PRNGKeyArray) -> Anchor:
        """The better one of the mode with its curvature and the prior."""
        search_key, trial_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 3)
        mode = find_mode(
            target,
            inputs,
            search_key,
            objective="density",
            initial=self.initial,
            starts=self.starts,
            max_steps=200,
        )
        at_mode = target.compiled(anchor_at, family)(mode.optimum.position, inputs)
        at_prior = prior_anchor(target, at_mode)
        bound = target.compiled(_bound, family, self.rank)
        keys = jax.random.split(trial_key, _TRIALS)
        heights = [bound(anchor, keys, inputs) for anchor in (at_mode, at_prior)]
        return at_prior if heights[1] > heights[0] else at_mode


def _optimiser(rate: Any) -> optax.GradientTransformation:
    return optax.chain(optax.zero_nans(), optax.clip(_CLIP), optax.scale_by_adam(), optax.scale(-rate))


def _particle_bound(  # noqa: PLR0917
    target: Target, family: Family, guide: Guide, anchor: Anchor, keys: PRNGKeyArray, inputs: Inputs
) -> Scalar:
    """The evidence lower bound over a few draws; its gradient is that along the draws."""

    def one(key: PRNGKeyArray) -> Array:
        u = draw(target, family, guide, anchor, key)
        own = log_density(target, family, jax.lax.stop_gradient(guide), anchor, u)
        return target.log_density(u, inputs) - own

    return jnp.mean(jax.vmap(one)(keys))


def _bound(  # noqa: PLR0917
    target: Target, family: Family, rank: int, anchor: Anchor, keys: PRNGKeyArray, inputs: Inputs
) -> Scalar:
    guide = initial_guide(target, family, rank)
    bound = _particle_bound(target, family, guide, anchor, keys, inputs)
    return jnp.where(jnp.isnan(bound), -jnp.inf, bound)


def _window(  # noqa: PLR0917
    target: Target,
    family: Family,
    particles: int,
    ascent: Ascent,
    rate: Scalar,
    key: PRNGKeyArray,
    inputs: Inputs,
) -> tuple[Ascent, Scalar, Scalar]:
    """A window of updates: the state after it, the mean of the bound over it and its standard error."""
    optimiser = _optimiser(rate)

    def loss(guide: Guide, number: Array) -> Array:
        keys = jax.random.split(jax.random.fold_in(key, number), particles)
        return -_particle_bound(target, family, guide, ascent.anchor, keys, inputs)

    def update(carry: tuple[Guide, Any, Guide], number: Array) -> tuple[tuple[Guide, Any, Guide], Array]:
        guide, state, total = carry
        value, slope = jax.value_and_grad(loss)(guide, number)
        change, state = optimiser.update(slope, state, guide)
        guide: Guide = jax.tree.map(jnp.add, guide, change)
        return (guide, state, jax.tree.map(jnp.add, total, guide)), -value

    nothing = jax.tree.map(jnp.zeros_like, ascent.guide)
    start = (ascent.guide, ascent.optimiser, nothing)
    (guide, state, total), bounds = jax.lax.scan(update, start, jnp.arange(_WINDOW))
    mean = jax.tree.map(lambda x: x / _WINDOW, total)
    moved = ascent._replace(guide=guide, mean=mean, optimiser=state)
    return moved, jnp.mean(bounds), jnp.std(bounds) / _WINDOW**0.5


def _weighed(  # noqa: PLR0917
    target: Target, family: Family, anchor: Anchor, guide: Guide, keys: PRNGKeyArray, inputs: Inputs
) -> tuple[Float[Array, "draw dimension"], Float[Array, " draw"]]:
    """Draws of the guide and their log weights."""

    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        u = draw(target, family, guide, anchor, key)
        return u, target.log_density(u, inputs) - log_density(target, family, guide, anchor, u)

    return jax.lax.map(one, keys, batch_size=_EVALUATED)


def _concentrations(target: Target, ascent: Ascent) -> dict[str, np.ndarray]:
    kappa = np.asarray(ascent.anchor.concentration * jnp.exp(ascent.mean.log_concentration))
    every = np.zeros(target.dimension)
    every[target.angles] = kappa
    return {
        f"concentration.{name}": every[place.start : place.stop].reshape(place.shape)
        for name, place in target.coordinates.items()
        if place.is_circular
    }
