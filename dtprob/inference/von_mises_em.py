"""Expectation maximisation with independent von Mises distributions over the angles of a model.

Source: Ruah, Simeone, Hoydis and Al-Hashimi, Calibrating wireless ray tracing for digital twinning using
local phase error estimates (arXiv 2312.12625), with the exact coordinate update in place of the paper's,
for any model of the class in `dtprob.inference.relaxation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e, i1e
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Scalar

from dtprob.errors import InputError, unknown_name
from dtprob.inference import von_mises
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.coupling import angle_sites
from dtprob.inference.engine import (
    DEFAULT,
    AbstractEngine,
    Answer,
    RunOptions,
    Serves,
    check_counts,
    check_initial,
    check_key,
)
from dtprob.inference.iterate import Job, Steps, iterate
from dtprob.inference.optimise import minimise
from dtprob.inference.phasors import is_gaussian, least_squares_start, reference_phases
from dtprob.inference.posterior import Posterior
from dtprob.inference.relaxation import (
    Layout,
    Quadratic,
    Resultants,
    expected_log_joint,
    find_layout,
    quadratic,
)
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model

_SWEEPS = 1000

type EStep = Literal["exact", "reference"]
_E_STEPS: Final[tuple[EStep, ...]] = ("exact", "reference")


class VonMises(NamedTuple):
    """Independent von Mises distributions of the angles.

    Attributes:
        direction: mu, rad, (group, colour).
        concentration: kappa, (group, colour).
    """

    direction: Float[Array, "group colour"]
    concentration: Float[Array, "group colour"]

    @property
    def resultants(self) -> Resultants:
        """The mean resultants, of length R(kappa) = I1(kappa) / I0(kappa)."""
        return Resultants(self.direction, i1e(self.concentration) / i0e(self.concentration))

    @property
    def entropy(self) -> Float[Array, "group colour"]:
        """Entropy of each, nats: log(2 pi I0(kappa)) - kappa R(kappa)."""
        kappa = self.concentration
        return jnp.log(2 * jnp.pi * i0e(kappa)) + kappa * (1 - i1e(kappa) / i0e(kappa))

    def sample(self, key: PRNGKeyArray, n: int) -> Float[Array, "draw group colour"]:
        """`n` draws."""
        return von_mises.sample(key, self.direction, self.concentration, n)


class Stage(NamedTuple):
    """Where the algorithm is.

    Attributes:
        angles: the distributions of the angles.
        rest: all coordinates; those of the angles are not used.
        free_energy: E[log q] - E[log p], nats.
    """

    angles: VonMises
    rest: Float[Array, " dimension"]
    free_energy: Scalar


class Settling(NamedTuple):
    """The state of a run.

    Attributes:
        stage: where it is.
        first: the free energy before the first iteration, nats.
        converged: whether an E-step from fresh starts brought nothing more.
    """

    stage: Stage
    first: Scalar
    converged: Bool[Array, ""]


@dataclass(frozen=True)
class VonMisesEM(AbstractEngine):
    """Independent von Mises distributions over the angles, the maximum a posteriori for everything else.

    The E-step updates one angle after the other, exactly; the M-step lowers the same free energy over the
    other latent sites (materials, noise power, concentrations), so the free energy never rises. The E-step
    has local optima, above all where paths are hard to tell apart: it starts from no error (all angles
    zero), from no knowledge (uniform angles), from directions spread over the circles and, where the data
    are Gaussian, from least squares; each group of coupled angles keeps the lowest. Once it has settled it
    starts the E-step afresh, until that brings nothing more.

    With `e_step = "reference"` the E-step is the paper's: directions by least squares, as if phasors were free
    numbers, and concentrations from each path's signal-to-noise ratio. It needs complex normal observations, may
    raise the free energy, and stops where it no longer lowers it. Where paths are resolved it is as good.

    The posterior's `extra` has `free_energy`, its history `free_energy_history`, `converged`, and for each
    circular site `direction.<site>` (rad) and `concentration.<site>`.

    Attributes:
        draws: how many draws of the angles; the other sites have the same value in each.
        max_iterations: bound on the E- and M-steps.
        tolerance: stop when an iteration lowers the free energy by less than this, nats.
        newton_steps: optimiser steps in an M-step.
        spread_starts: from how many spread directions the E-step starts.
        initial: constrained values that the sites without angles start from; by default the prior's median.
        e_step: "exact" coordinate updates, or that of the "reference".
    """

    name: ClassVar[str] = "von_mises_em"
    answer: ClassVar[Answer] = "approximation"
    serves: ClassVar[Serves] = "circular"

    draws: int = 1000
    max_iterations: int = 200
    tolerance: float = 1e-4
    newton_steps: int = 3
    spread_starts: int = 16
    initial: Mapping[str, Any] | None = None
    e_step: EStep = "exact"

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"draws": 1, "max_iterations": 1, "newton_steps": 1, "spread_starts": 0})
        check_initial(self.initial)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        layout_key, draw_key = jax.random.split(check_key(key))
        target, inputs = build_target(model, data)
        if not target.angles.size:
            expected = "a latent site with circular support"
            remedy = "Sample the phases from VonMises, or use another engine"
            raise InputError(f"von_mises_em on model {target.declaration.name}", expected, "none", remedy)
        self._check_e_step(target)
        layout = find_layout(target, inputs, layout_key)
        job = Job(self, target, inputs, key, options, free=("draws",))
        settling, history = iterate(job, self._steps(target, inputs, layout))
        stage = settling.stage
        angles = jax.vmap(layout.flat)(stage.angles.sample(draw_key, self.draws))
        positions = jnp.tile(stage.rest, (self.draws, 1)).at[:, target.angles].set(angles)
        energies = np.concatenate([[settling.first], history["free_energy"].ravel()])
        return assemble(
            target,
            inputs,
            positions[None],
            engine=self,
            key=key,
            options=options,
            extra=_facts(target, inputs, layout, stage)
            | {"free_energy_history": energies[np.isfinite(energies)], "converged": settling.converged},
        )

    def _check_e_step(self, target: Target) -> None:
        if self.e_step not in _E_STEPS:
            raise unknown_name("e_step of von_mises_em", self.e_step, _E_STEPS, "E-step")
        kinds = sorted({str(site.distribution) for site in target.declaration.observed.values()})
        if self.e_step == "reference" and kinds != ["ComplexNormal"]:
            remedy = "Use the exact E-step"
            raise InputError(
                "observations for the reference E-step", "ComplexNormal", ", ".join(kinds), remedy
            )

    def _steps(self, target: Target, inputs: Inputs, layout: Layout) -> Steps[Settling]:
        """An iteration is an M- and an E-step; once they have settled, also the E-step afresh."""

        def begin() -> Settling:
            values = target.latent_values(self.initial or {})
            rest = target.compiled(Target.prior_median)(inputs, values)
            nothing = jnp.zeros(layout.table.shape, rest.dtype)
            stage = self._restart(target, layout, VonMises(nothing, nothing), rest, inputs)
            return Settling(stage, stage.free_energy, jnp.zeros((), dtype=bool))

        def step(_: int, before: Settling) -> tuple[Settling, dict[str, Any]]:
            stage = self._refined(target, layout, before.stage, inputs)
            refined, again = stage.free_energy, jnp.full_like(stage.free_energy, jnp.nan)
            if before.stage.free_energy - refined >= self.tolerance:
                return before._replace(stage=stage), {"free_energy": jnp.stack([refined, again])}
            if self.e_step == "reference":  # nothing to start afresh from: it does not depend on where it is
                return Settling(before.stage, before.first, jnp.ones((), dtype=bool)), {
                    "free_energy": jnp.stack([refined, again])
                }
            stage = self._restart(target, layout, stage.angles, stage.rest, inputs)
            converged = refined - stage.free_energy < self.tolerance
            row = {"free_energy": jnp.stack([refined, stage.free_energy])}
            return Settling(stage, before.first, converged), row

        return Steps(
            begin,
            step,
            finished=lambda settling: bool(settling.converged),
            most=self.max_iterations,
            phase="iterations",
            note=lambda settling: f"free energy {float(settling.stage.free_energy):.6g} nats",
        )

    def _refined(self, target: Target, layout: Layout, stage: Stage, inputs: Inputs) -> Stage:
        """An M-step, and an E-step that continues."""
        rest = target.compiled(_m_step, self.newton_steps)(layout, stage, inputs)
        if self.e_step == "reference":
            return _reference(target, layout, rest, inputs)
        form = target.compiled(quadratic)(layout, rest, inputs)
        return _e_step(form, jax.tree.map(lambda leaf: leaf[None], stage.angles.resultants), rest)

    def _restart(
        self, target: Target, layout: Layout, angles: VonMises, rest: Array, inputs: Inputs
    ) -> Stage:
        """An E-step from where the angles are and from fresh starts."""
        if self.e_step == "reference":
            return _reference(target, layout, rest, inputs)
        zero = -inputs.location[target.angles][layout.table]
        fixed = jax.random.key(0)  # the same starts in every run
        spread = jax.random.uniform(
            fixed, (self.spread_starts, *zero.shape), zero.dtype, minval=-jnp.pi, maxval=jnp.pi
        )
        directions = jnp.concatenate([zero[None], spread])
        starts = [
            jax.tree.map(lambda leaf: leaf[None], angles.resultants),
            Resultants(directions, jnp.ones_like(directions)),
        ]
        if is_gaussian(target):
            found = target.compiled(least_squares_start)(layout, rest, inputs)
            starts.append(jax.tree.map(lambda leaf: leaf[None], found))
        form = target.compiled(quadratic)(layout, rest, inputs)
        return _e_step(form, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *starts), rest)


def _facts(target: Target, inputs: Inputs, layout: Layout, stage: Stage) -> dict[str, np.ndarray]:
    """The entries of a posterior's `extra` that describe the angles' distributions."""
    u = stage.rest.at[target.angles].set(layout.flat(stage.angles.direction))
    values = target.compiled(Target.constrain)(u, inputs)
    concentration = u.at[target.angles].set(layout.flat(stage.angles.concentration))
    facts: dict[str, Any] = {"free_energy": stage.free_energy}
    for name in angle_sites(target):
        place = target.coordinates[name]
        facts[f"direction.{name}"] = values[name]
        facts[f"concentration.{name}"] = concentration[place.start : place.stop].reshape(place.shape)
    return {name: np.asarray(value) for name, value in facts.items()}


def _reference(target: Target, layout: Layout, rest: Array, inputs: Inputs) -> Stage:
    """The E-step of the reference."""
    angles = VonMises(*target.compiled(reference_phases)(layout, rest, inputs))
    form = target.compiled(quadratic)(layout, rest, inputs)
    return Stage(angles, rest, jnp.sum(_group_free_energy(form, angles)) - form.constant)


def _m_step(target: Target, steps: int, layout: Layout, stage: Stage, inputs: Inputs) -> Array:
    """All coordinates, those of the other sites moved to a lower free energy."""
    others = np.flatnonzero(~target.circular)
    if not others.size:
        return stage.rest

    def objective(free: Array) -> Array:
        moved = stage.rest.at[others].set(free)
        return -expected_log_joint(target, layout, stage.angles.resultants, moved, inputs)

    return stage.rest.at[others].set(minimise(objective, stage.rest[others], steps).position)


@jax.jit
def _e_step(form: Quadratic, starts: Resultants, rest: Array) -> Stage:
    """The best of several starts (leading axis), chosen for each group of coupled angles."""
    found: VonMises = jax.vmap(lambda start: _settle(form, start))(starts)
    energies = jax.vmap(lambda q: _group_free_energy(form, q))(found)
    best = jnp.argmin(energies, axis=0)[None, :, None]
    kept = jax.tree.map(lambda leaf: jnp.take_along_axis(leaf, best, axis=0)[0], found)
    return Stage(kept, rest, jnp.sum(jnp.min(energies, axis=0)) - form.constant)


def _group_free_energy(form: Quadratic, angles: VonMises) -> Float[Array, " group"]:
    """Each group's part of E[log q] - E[log p]; the constant is left out, nats."""
    return -form.expectation(angles.resultants.vector) - jnp.sum(angles.entropy, axis=1)


def _settle(form: Quadratic, start: Resultants) -> VonMises:
    """The E-step: exact updates of one colour of angles after the other, until they stay."""

    def update(colour: Array, angles: tuple[Array, Array]) -> tuple[Array, Array]:
        mean, eta = angles
        own = form.linear[:, colour] + jnp.einsum("gdij,gdj->gi", form.coupling[:, colour], mean)
        found = VonMises(jnp.arctan2(own[:, 1], own[:, 0]), jnp.linalg.norm(own, axis=1))
        return mean.at[:, colour].set(found.resultants.vector), eta.at[:, colour].set(own)

    def sweep(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        mean, eta, _, sweeps = carry
        moved, eta = jax.lax.fori_loop(0, mean.shape[1], update, (mean, eta))
        return moved, eta, jnp.max(jnp.abs(moved - mean)), sweeps + 1

    def moving(carry: tuple[Array, Array, Array, Array]) -> Array:
        return (carry[2] > jnp.finfo(carry[0].dtype).eps ** 0.5) & (carry[3] < _SWEEPS)

    infinite = jnp.asarray(jnp.inf, form.linear.dtype)
    first = (start.vector, jnp.zeros_like(form.linear), infinite, jnp.zeros((), dtype=int))
    eta = jax.lax.while_loop(moving, sweep, first)[1]
    return VonMises(jnp.arctan2(eta[..., 1], eta[..., 0]), jnp.linalg.norm(eta, axis=-1))
