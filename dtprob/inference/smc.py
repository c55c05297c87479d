"""Sequential Monte Carlo from the prior to the posterior, with the evidence as a by-product.

BlackJAX's adaptive tempered SMC moves particles by Hamiltonian Monte Carlo; between two temperatures its
mass matrix is the particles' variance, and its step size follows the acceptance rate (Buchholz, Chopin and
Jacob, Adaptive tuning of Hamiltonian Monte Carlo within sequential Monte Carlo, 2021).

An angle is moved unwrapped, under its periodic density. A move of z + 2 pi K is that of z plus 2 pi K, so it
leaves the density on the circle invariant whatever K; after each temperature angles are wrapped again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from blackjax.mcmc import hmc
from blackjax.smc import adaptive_tempered, resampling
from blackjax.smc.tempered import TemperedSMCState
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar
from scipy.special import logsumexp

from dtprob.errors import InputError
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.circular import wrap
from dtprob.inference.engine import DEFAULT, AbstractEngine, Answer, RunOptions, check_counts, check_key
from dtprob.inference.iterate import Job, Steps, iterate
from dtprob.inference.modes import nowhere_finite
from dtprob.inference.posterior import Posterior
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model

_ACCEPTANCE = 0.8
_FIRST_STEP = 0.5
_JITTER = 0.5  # shortest step over longest: equal ones can fall into step with an orbit
_LOWEST = -1e30  # log likelihood where there is none, so that its zeroth power is one
_PER_COORDINATE, _RIDGE = (
    20,
    0.05,
)  # particles per coordinate that a covariance takes, and share of its diagonal
_BATCH = 250  # particles moved side by side


class Swarm(NamedTuple):
    """The particles of the run under way, and what is kept of those before.

    Attributes:
        particles: (particle, dimension).
        weights: normalised.
        temperature: the power of the likelihood, 0 to 1.
        step_size: of the Hamiltonian moves, in units of the particles' spread.
        log_evidence: of each run so far, nats, (run,).
        run: number of the run under way.
        stage: number of its next temperature.
        kept: the particles of the runs that are done, (run, particle, dimension).
        acceptance: their mean acceptance rate at the posterior, (run,).
    """

    particles: Float[Array, "particle dimension"]
    weights: Float[Array, " particle"]
    temperature: Scalar
    step_size: Scalar
    log_evidence: Float[Array, " run"]
    run: Int[Array, ""]
    stage: Int[Array, ""]
    kept: Float[Array, "run particle dimension"]
    acceptance: Float[Array, " run"]


@dataclass(frozen=True)
class SMC(AbstractEngine):
    """Adaptive tempered sequential Monte Carlo of BlackJAX, from the prior; estimates the log evidence.

    Serves posteriors with several modes, each of which keeps its share of the particles. The draws of
    independent runs are laid out as chains, so r-hat and effective sample sizes tell whether runs agree.

    The posterior's `extra` has `log_evidence` (of the mean of the runs' estimates), `log_evidence_of_runs` and
    `temperatures` (of the last run).

    Attributes:
        draws: particles of each run.
        chains: independent runs.
        target_ess: share of the particles that the next temperature keeps effective.
        moves: Hamiltonian moves of each particle at each temperature.
        leapfrog: steps of each move.
        max_temperatures: bound on the temperatures of a run.
    """

    name: ClassVar[str] = "smc"
    answer: ClassVar[Answer] = "exact"

    draws: int = 1000
    chains: int = 4
    target_ess: float = 0.5
    moves: int = 4
    leapfrog: int = 8
    max_temperatures: int = 200

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"draws": 2, "chains": 1, "moves": 1, "leapfrog": 1, "max_temperatures": 1})
        if not 0 < self.target_ess < 1:
            remedy = "Give a share, such as 0.5"
            raise InputError("target_ess of engine smc", "between 0 and 1", str(self.target_ess), remedy)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        check_key(key)
        target, inputs = build_target(model, data)
        job = Job(self, target, inputs, key, options)
        swarm, history = iterate(job, self._steps(target, inputs, key))
        runs, last = np.asarray(swarm.log_evidence), history["run"] == self.chains - 1
        acceptance = np.repeat(np.asarray(swarm.acceptance)[:, None], self.draws, axis=1)
        return assemble(
            target,
            inputs,
            np.asarray(swarm.kept),
            engine=self,
            key=key,
            options=options,
            stats={"acceptance_rate": acceptance},
            extra={
                "log_evidence": float(logsumexp(runs) - np.log(self.chains)),
                "log_evidence_of_runs": runs,
                "temperatures": history["temperature"][last],
            },
        )

    def _steps(self, target: Target, inputs: Inputs, key: PRNGKeyArray) -> Steps[Swarm]:
        """A step is a temperature; a run ends with moves at the posterior itself."""
        draw = target.compiled(_from_prior, self.draws)
        move = target.compiled(_temper, self.moves, self.leapfrog, self.target_ess)

        def key_of(run: Any, stage: Any) -> PRNGKeyArray:
            return jax.random.fold_in(jax.random.fold_in(key, run), stage)

        def fresh(run: Any) -> Float[Array, "particle dimension"]:
            particles, is_possible = draw(key_of(run, 0), inputs)
            if not is_possible:
                raise nowhere_finite(target)
            return particles

        def begin() -> Swarm:
            particles = fresh(0)
            nothing = jnp.zeros(self.chains, particles.dtype)
            kept = jnp.zeros((self.chains, *particles.shape), particles.dtype)
            zero = jnp.zeros((), int)
            swarm = Swarm(particles, nothing, zero, zero, nothing, zero, zero, kept, nothing)
            return _anew(swarm, particles)

        def step(_: int, before: Swarm) -> tuple[Swarm, dict[str, Any]]:
            if before.temperature < 1 and before.stage >= self.max_temperatures:
                expected = f"the posterior within {self.max_temperatures} temperatures"
                got = f"the likelihood to the power {float(before.temperature):.3g}"
                remedy = "Raise max_temperatures, or the number of particles"
                raise InputError(f"smc on model {target.declaration.name}", expected, got, remedy)
            moved, acceptance = move(before, key_of(before.run, before.stage + 1), inputs)
            row = {"run": before.run, "temperature": moved.temperature, "acceptance": acceptance}
            if before.temperature < 1:
                return moved, row
            moved = moved._replace(
                kept=moved.kept.at[before.run].set(moved.particles),
                acceptance=moved.acceptance.at[before.run].set(acceptance),
                run=before.run + 1,
            )
            return _anew(moved, fresh(moved.run)), row

        return Steps(
            begin,
            step,
            finished=lambda swarm: int(swarm.run) == self.chains,
            most=self.chains * (self.max_temperatures + 1),
            phase="temperatures",
            note=lambda swarm: (
                f"run {int(swarm.run)}, likelihood to the power {float(swarm.temperature):.3g}"
            ),
        )


def _from_prior(
    target: Target, count: int, key: PRNGKeyArray, inputs: Inputs
) -> tuple[Float[Array, "particle dimension"], Bool[Array, ""]]:
    """Draws from the prior, and whether the data are possible under any of them."""

    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        u = target.prior_draw(key, inputs)
        return u, jnp.isfinite(target.log_terms(u, inputs).likelihood)

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(count))
    particles, possible = jax.lax.map(one, keys, batch_size=_BATCH)
    return particles, jnp.any(possible)


def _anew(swarm: Swarm, particles: Float[Array, "particle dimension"]) -> Swarm:
    """The swarm with a new run begun at draws from the prior."""
    count, zero = particles.shape[0], jnp.zeros((), particles.dtype)
    return swarm._replace(
        particles=particles,
        weights=jnp.full(count, 1 / count, particles.dtype),
        temperature=zero,
        step_size=zero + _FIRST_STEP,
        stage=jnp.zeros((), int),
    )


def _temper(  # noqa: PLR0917
    target: Target,
    moves: int,
    leapfrog: int,
    target_ess: float,
    swarm: Swarm,
    key: PRNGKeyArray,
    inputs: Inputs,
) -> tuple[Swarm, Scalar]:
    """Resample, move at this temperature, weigh for the next; the swarm and its acceptance rate."""
    move_key, jitter_key = jax.random.split(key)

    def log_prior(u: Array) -> Array:
        terms = target.log_terms(u, inputs)
        return terms.prior + terms.jacobian

    def log_likelihood(u: Array) -> Array:
        return jnp.nan_to_num(target.log_terms(u, inputs).likelihood, nan=_LOWEST, neginf=_LOWEST)

    kernel: Callable[..., tuple[Any, Any]] = adaptive_tempered.build_kernel(
        log_prior,
        log_likelihood,
        hmc.build_kernel(),
        cast("Callable[..., Any]", hmc.init),
        resampling.systematic,
        target_ess,
        batch_size=_BATCH,
    )
    count, dimension = swarm.particles.shape
    length = swarm.step_size * dimension**-0.25
    jitter = jax.random.uniform(jitter_key, (count,), swarm.particles.dtype, minval=_JITTER)
    settings = {
        "step_size": length * jitter,
        "inverse_mass_matrix": _covariance(target, swarm)[None],
        "num_integration_steps": jnp.asarray([leapfrog]),
    }
    state = TemperedSMCState(swarm.particles, swarm.weights, swarm.temperature)
    after, info = kernel(move_key, state, moves, settings)
    acceptance = jnp.mean(info.update_info.acceptance_rate)
    angles = target.angles
    moved = swarm._replace(
        particles=after.particles.at[:, angles].set(wrap(after.particles[:, angles])),
        weights=after.weights,
        temperature=after.tempering_param,
        step_size=swarm.step_size * jnp.exp(acceptance - _ACCEPTANCE),
        log_evidence=swarm.log_evidence.at[swarm.run].add(info.log_likelihood_increment),
        stage=swarm.stage + 1,
    )
    return moved, acceptance


def _covariance(target: Target, swarm: Swarm) -> Float[Array, " dimension *columns"]:
    """Covariance of the weighted particles, angles as they stand about their mean direction.

    Its diagonal where there are too few particles for the whole. A draw from the prior that was rounded to the edge of
    its support stands at infinity; it counts as one at the prior's median, so that the others can move.
    """
    count, dimension = swarm.particles.shape
    weights = swarm.weights[:, None]
    particles = jnp.where(jnp.isfinite(swarm.particles), swarm.particles, 0.0)
    centre = jnp.sum(weights * particles, axis=0)
    direction = jnp.arctan2(*(jnp.sum(weights * f(particles), axis=0) for f in (jnp.sin, jnp.cos)))
    centre = jnp.where(target.circular, direction, centre)
    offset = particles - centre
    offset = jnp.where(target.circular, wrap(offset), offset)
    variance = jnp.sum(weights * offset**2, axis=0) + jnp.finfo(offset.dtype).eps
    if count < _PER_COORDINATE * dimension:
        return variance
    return (1 - _RIDGE) * (weights * offset).T @ offset + _RIDGE * jnp.diag(variance)
