"""Ensembles: one estimate for each of many data sets like the one observed.

With point estimates this is randomised maximum a posteriori. A member maximises the posterior density of data
with noise added anew (or re-weighted), under the prior shifted by the difference of two draws from it over
sqrt(2): for a Gaussian prior, by a draw of its own covariance. With a linear model and Gaussian noise each
member then is an independent, exact draw from the posterior (Bardsley, Solonen, Haario and Laine,
Randomize-then-optimize, 2014; Oliver, He and Reynolds, Conditioning permeability fields to pressure data,
1996). Elsewhere it is an approximation. With an engine that draws, it is the bagged posterior (Huggins and
Miller, Robust and reproducible model selection using bagged posteriors, 2019).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.circular import wrap
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
from dtprob.inference.iterate import Job, Steps, iterate
from dtprob.inference.modes import find_mode
from dtprob.inference.optimise import minimise
from dtprob.inference.posterior import Posterior
from dtprob.inference.resample import (
    WEIGHTS,
    Scheme,
    Weighted,
    chosen_scheme,
    cluster_axis,
    cluster_weights,
    is_noise_unknown,
    with_noise,
)
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Data, Model

_BLOCK = 32  # members optimised side by side


class Members(NamedTuple):
    """The state of a run: the point estimates so far.

    Attributes:
        fitted: the estimate on the data themselves, from which each member starts.
        positions: of each member.
        converged: whether its search arrived.
        done: how many there are.
    """

    fitted: Float[Array, " dimension"]
    positions: Float[Array, "member dimension"]
    converged: Bool[Array, " member"]
    done: Array


class Bags(NamedTuple):
    """The state of a run that bags another engine, whose draws its steps record.

    Attributes:
        fitted: the estimate on the data themselves, empty where no noise is drawn about it.
        done: how many members there are.
    """

    fitted: Float[Array, " dimension"]
    done: Array


@dataclass(frozen=True)
class Ensemble(AbstractEngine):
    """One estimate for each of many data sets resampled from the one observed: randomised MAP, or bagging.

    With the base engine "point" a member is the mode of the density over the unconstrained coordinates, and
    a draw of the posterior; the statistic `diverging` marks those whose search did not arrive. With another
    base engine all draws of all members are the posterior's, one member after the other in a single chain. The posterior's
    `extra` says `noise_unknown` where noise was added to data whose noise is a latent site: it comes out too large.

    Attributes:
        members: how many data sets.
        base: name of the engine that each is given to.
        settings: that engine's settings, where it is not "point".
        resample: "noise" adds noise drawn from the fitted model to normal data; "weights" gives each of the
            model's clusters a random weight, "clusters" draws them with replacement; "none" leaves data
            alone; "auto" is noise for points from normal data, else weights.
        perturb_prior: shift the prior at random too (points only); without it the prior adds no spread.
        starts: from how many points the mode on the data themselves is sought.
        initial: constrained values to start from; sites without one start from the prior.
        max_steps: bound on the steps of each search.
    """

    name: ClassVar[str] = "ensemble"
    answer: ClassVar[Answer] = "approximation"

    members: int = 200
    base: str = "point"
    settings: Mapping[str, Any] | None = None
    resample: Literal["auto", "noise", "weights", "clusters", "none"] = "auto"
    perturb_prior: bool = True
    starts: int = 4
    initial: Mapping[str, Any] | None = None
    max_steps: int = 200

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"members": 1, "starts": 1, "max_steps": 1})
        check_choice(self, "resample", ("auto", *get_args(Scheme.__value__)))
        check_initial(self.initial)
        if self.base == "point" and self.settings:
            remedy = "Set starts, initial and max_steps of the ensemble itself"
            raise InputError(
                "settings of engine ensemble", "none with base point", str(dict(self.settings)), remedy
            )

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        check_key(key)
        target, inputs = build_target(model, data)
        is_point = self.base == "point"
        scheme = chosen_scheme(target, self.resample, point=is_point)
        weighted, arrays = target, inputs
        if scheme in ("weights", "clusters"):
            cluster, count = cluster_axis(target.declaration)
            given = {**data, WEIGHTS: jnp.ones(count)}
            weighted, arrays = build_target(Weighted(model, cluster), given)
            arrays = arrays._replace(location=inputs.location, scale=inputs.scale)
        job = Job(self, target, inputs, key, options)
        if is_point:
            found, _ = iterate(job, self._steps(weighted, arrays, scheme, key))
            positions, failed = np.asarray(found.positions), ~np.asarray(found.converged)
        else:
            _, drawn = iterate(job, self._bags(weighted, arrays, scheme, key, options))
            positions, failed = (np.concatenate(drawn[name]) for name in ("position", "diverging"))
        return assemble(
            target,
            inputs,
            positions[None],
            engine=self,
            key=key,
            options=options,
            stats={"diverging": failed[None]},
            extra={
                "converged": not failed.any(),
                "resampled_by": np.asarray(scheme),
                "noise_unknown": scheme == "noise" and is_noise_unknown(target, inputs),
            },
        )

    def _mode(self, target: Target, inputs: Inputs, key: PRNGKeyArray) -> Float[Array, " dimension"]:
        mode = find_mode(
            target,
            inputs,
            key,
            objective="density",
            initial=self.initial,
            starts=self.starts,
            max_steps=self.max_steps,
        )
        return mode.optimum.position

    def _steps(self, target: Target, inputs: Inputs, scheme: Scheme, key: PRNGKeyArray) -> Steps[Members]:
        search_key, member_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
        solve = target.compiled(_block, scheme, self.perturb_prior, self.max_steps)

        def begin() -> Members:
            fitted = self._mode(target, inputs, search_key)
            positions = jnp.zeros((self.members, target.dimension), fitted.dtype)
            return Members(fitted, positions, jnp.zeros(self.members, bool), jnp.zeros((), int))

        def step(_: int, before: Members) -> tuple[Members, dict[str, Any]]:
            first = int(before.done)
            last = min(first + _BLOCK, self.members)
            found, arrived = solve(before.fitted, first, member_key, inputs)
            positions = before.positions.at[first:last].set(found[: last - first])
            converged = before.converged.at[first:last].set(arrived[: last - first])
            return Members(before.fitted, positions, converged, jnp.asarray(last)), {}

        return Steps(
            begin,
            step,
            finished=lambda members: int(members.done) >= self.members,
            most=-(-self.members // _BLOCK),
            phase=f"x {_BLOCK} members",
            note=lambda members: f"{int(jnp.sum(members.converged))} arrived",
        )

    def _bags(
        self, target: Target, inputs: Inputs, scheme: Scheme, key: PRNGKeyArray, options: RunOptions
    ) -> Steps[Bags]:
        """A step is a member; it records its draws, as positions, and whether they diverged."""
        engine = self._base()
        quiet = replace(
            options, progress=False, status_file=None, checkpoint=None, resume=False, pointwise=False
        )
        places = target.compiled(_places)

        def begin() -> Bags:
            is_noise = scheme == "noise"
            fitted = self._mode(target, inputs, jax.random.fold_in(key, 0)) if is_noise else jnp.zeros(0)
            return Bags(fitted, jnp.zeros((), int))

        def step(number: int, before: Bags) -> tuple[Bags, dict[str, Any]]:
            own = jax.random.fold_in(jax.random.fold_in(key, 1), number)
            arrays = target.compiled(_resampled, scheme)(before.fitted, own, inputs)
            given: Data = target.data(arrays)
            found = engine(jax.random.fold_in(own, 1), target.model, given, options=quiet)
            row = {
                "position": places({name: found.flat(name) for name in found.latent}, inputs),
                "diverging": np.ravel(found.sample_stats["diverging"]),
            }
            return before._replace(done=before.done + 1), row

        return Steps(
            begin,
            step,
            finished=lambda bags: int(bags.done) >= self.members,
            most=self.members,
            phase="members",
            note=lambda _: "",
        )

    def _base(self) -> AbstractEngine:
        """The engine that each member is given to."""
        from dtprob.inference.fit import resolve  # noqa: PLC0415  (which knows this engine)

        if self.base == self.name:
            raise InputError("base of engine ensemble", "another engine", self.base, 'Give "point" or "nuts"')
        if (self.settings or {}).get("enough_ess"):
            remedy = "Leave enough_ess out, so that members have equally many draws"
            raise InputError("settings of engine ensemble", "no early stop", "enough_ess", remedy)
        return resolve(self.base, **(self.settings or {}))


def _places(target: Target, values: Mapping[str, Array], inputs: Inputs) -> Float[Array, "draw dimension"]:
    """The coordinates of draws of all latent sites; of one rounded to the edge of its support, the outermost ones."""
    outermost = jnp.finfo(inputs.scale.dtype)
    low, high = (
        (edge - inputs.location) / inputs.scale
        for edge in jnp.log(jnp.array([outermost.tiny, 1 / outermost.eps]))
    )

    def one(value: dict[str, Array]) -> Array:
        u = target.unconstrained(jax.random.key(0), inputs, value)
        return jnp.where(jnp.isposinf(u), high, jnp.where(jnp.isneginf(u), low, u))

    return jax.lax.map(one, dict(values))


def _resampled(target: Target, scheme: Scheme, fitted: Array, key: PRNGKeyArray, inputs: Inputs) -> Inputs:
    """The arrays of one member."""
    arrays = dict(inputs.arrays)
    if scheme == "noise":
        arrays |= with_noise(target, inputs, fitted, key)
    elif scheme != "none":
        arrays[WEIGHTS] = cluster_weights(scheme, key, arrays[WEIGHTS].shape[0])
    return inputs._replace(arrays=arrays)


def _block(  # noqa: PLR0917
    target: Target,
    scheme: Scheme,
    shifts: bool,
    max_steps: int,
    fitted: Array,
    first: Array,
    key: PRNGKeyArray,
    inputs: Inputs,
) -> tuple[Float[Array, "member dimension"], Bool[Array, " member"]]:
    """A block of members, side by side."""

    def one(number: Array) -> tuple[Array, Array]:
        data_key, prior_key = jax.random.split(jax.random.fold_in(key, number))
        arrays = _resampled(target, scheme, fitted, data_key, inputs)
        shift = _prior_shift(target, prior_key, inputs) if shifts else jnp.zeros_like(fitted)

        def objective(u: Array) -> Array:
            prior = target.log_terms(u - shift, inputs)
            return -(prior.prior + prior.jacobian + target.log_terms(u, arrays).likelihood)

        optimum = minimise(objective, fitted, max_steps)
        return optimum.position, optimum.converged

    return jax.vmap(one)(first + jnp.arange(_BLOCK))


def _prior_shift(target: Target, key: PRNGKeyArray, inputs: Inputs) -> Float[Array, " dimension"]:
    """How far a member's prior is from the model's: mean zero, and the prior's own covariance.

    Draws of an angle on both sides of +-pi are close to each other.
    """
    first, second = (target.prior_draw(k, inputs) for k in jax.random.split(key))
    apart = first - second
    return jnp.where(target.circular, wrap(apart), apart) / jnp.sqrt(2.0)
