"""The loop of a calibration: an E-step for the phases, a gradient step for the materials."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from dtprob.errors import InputError
from dtprob.raytracing.calibration import phases
from dtprob.raytracing.calibration.groups import check_groups, untouched
from dtprob.raytracing.calibration.phases import Field, Phasors
from dtprob.raytracing.calibration.settings import Settings
from dtprob.raytracing.calibration.statistics import Statistics
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet


class Calibration(NamedTuple):
    """What a calibration found; `calibrate_runs` gives every array a leading axis of runs.

    Attributes:
        permittivity: of each object, relative.
        conductivity: of each object, S/m.
        concentration: of the phase errors; infinity for "oblivious", 0 for "uniform", which assume so.
        noise_power: as given, or as estimated.
        loss: that of the scheme before each iteration.
    """

    permittivity: Float[Array, " object"]
    conductivity: Float[Array, " object"]
    concentration: Float[Array, ""]
    noise_power: Float[Array, " link"]
    loss: Float[Array, " iteration"]


class _Task(eqx.Module):
    """What all runs have in common: the twin, which objects share a material, how many such groups, the settings."""

    paths: PathSet
    groups: Int[Array, " object"]
    count: int = eqx.field(static=True)
    settings: Settings = eqx.field(static=True)

    def gain(self, coordinates: Float[Array, "2 group"]) -> tuple[Array, Array]:
        """Gains of the paths, real and imaginary part."""
        permittivity, conductivity = self.materials(coordinates)
        gain = path_gain(self.paths, permittivity, conductivity, law=self.settings.law)
        return jnp.real(gain), jnp.imag(gain)

    def materials(self, coordinates: Float[Array, "2 group"]) -> tuple[Array, Array]:
        """Permittivity and conductivity of each object."""
        return 1.0 + jnp.exp(coordinates[0])[self.groups], jnp.exp(coordinates[1])[self.groups]


class _State(NamedTuple):
    """The state of the loop: coordinates (contrast and conductivity by group, logarithms), phases and their laws."""

    coordinates: Float[Array, "2 group"]
    moments: Any
    phasors: Phasors
    concentration: Float[Array, ""]
    noise_power: Float[Array, " link"]
    turn: Array


def calibrate(
    paths: PathSet,
    statistics: Statistics,
    noise_power: float | Float[Array, " link"],
    *,
    settings: Settings | None = None,
    groups: Int[np.ndarray, " object"] | None = None,
) -> Calibration:
    """Fit the materials of a scene to measured channels.

    Groups of objects that no path touches keep the scene's values, and a warning names them.

    Args:
        paths: of the twin.
        statistics: of the measurement against these paths, from `project`.
        noise_power: E |noise|^2 per entry of the channel, scalar or (link,).
        settings: scheme and steps; phase-error-aware by default.
        groups: for each object, the number of the group whose material it shares, counted from 0; one material for all
            objects when None; `paths.object_material` gives one to each class.

    Raises:
        InputError: statistics of other links or paths, without what the scheme needs, a noise power that is not
            positive or of another shape, or groups that do not fit.
    """
    runs = jax.tree.map(lambda leaf: leaf[None], statistics)
    found = calibrate_runs(paths, runs, jnp.asarray(noise_power)[None], settings=settings, groups=groups)
    return jax.tree.map(lambda leaf: leaf[0], found)


def calibrate_runs(
    paths: PathSet,
    statistics: Statistics,
    noise_power: Float[Array, " run *link"],
    *,
    settings: Settings | None = None,
    groups: Int[np.ndarray, " object"] | None = None,
) -> Calibration:
    """Many calibrations of one twin at once, such as repetitions of a study; see `calibrate`.

    Args:
        paths: of the twin, common to all runs.
        statistics: of each run, a leading axis on every array.
        noise_power: of each run, (run,) or (run, link).
        settings: common to all runs.
        groups: common to all runs.
    """
    chosen = settings or Settings()
    table = np.zeros(paths.n_object, int) if groups is None else np.asarray(groups)
    _check(paths, statistics, noise_power, chosen, table)
    power = jnp.asarray(noise_power, statistics.energy.dtype)
    power = power.reshape(power.shape[0], -1)
    power = jnp.broadcast_to(power, (power.shape[0], paths.n_link))
    task = _Task(paths, jnp.asarray(table), int(table.max(initial=0)) + 1, chosen)
    return _with_nominal(paths, _runs(task, statistics, power), untouched(paths, table))


def _with_nominal(paths: PathSet, found: Calibration, idle: np.ndarray) -> Calibration:
    """Give some objects the scene's own values, and say which."""
    if not np.any(idle):
        return found
    names = [name for name, one in zip(paths.object_names, idle, strict=True) if one]
    shown = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
    text = (
        f"no path touches the material of {shown}, which the scene's own values stand for; trace more links."
    )
    warnings.warn(text, RuntimeWarning, stacklevel=3)
    permittivity = jnp.where(idle, jnp.asarray(paths.permittivity), found.permittivity)
    conductivity = jnp.where(idle, jnp.asarray(paths.conductivity), found.conductivity)
    return found._replace(permittivity=permittivity, conductivity=conductivity)


def _check(
    paths: PathSet, statistics: Statistics, noise_power: Array, settings: Settings, groups: np.ndarray
) -> None:
    expected = (paths.n_link, paths.n_path, paths.n_path)
    if statistics.gram.shape[1:] != expected:
        got = f"a Gram matrix of shape {statistics.gram.shape[1:]}"
        raise InputError(
            "statistics", f"those of the path set, {expected}", got, "Project on the paths of the twin"
        )
    if settings.scheme == "uniform" and statistics.power is None:
        remedy = "Project with powers=True"
        raise InputError("statistics for the scheme 'uniform'", "powers", "none", remedy)
    runs = statistics.energy.shape[0]
    if np.shape(noise_power) not in {(runs,), (runs, paths.n_link)}:
        expected = f"one value, or one for each of {paths.n_link} links, of each of {runs} runs"
        got = f"shape {np.shape(noise_power)}"
        raise InputError("noise_power", expected, got, "Average it over antennas and subcarriers")
    if np.any(~(np.asarray(noise_power) > 0)):
        got = str(np.asarray(noise_power).min())
        raise InputError("noise_power", "positive values", got, "Give the variance of the noise")
    check_groups(paths, groups)


@eqx.filter_jit
def _runs(task: _Task, statistics: Statistics, noise_power: Float[Array, "run link"]) -> Calibration:
    return jax.vmap(lambda each, power: _calibrate(task, each, power))(statistics, noise_power)


def _calibrate(task: _Task, statistics: Statistics, noise_power: Float[Array, " link"]) -> Calibration:
    settings = task.settings
    optimiser = optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(settings.rate))

    def step(state: _State, number: Array) -> tuple[_State, Array]:
        (real, imaginary), pull = jax.vjp(task.gain, state.coordinates)
        state = _expect(settings, state, lax.complex(real, imaginary), statistics, number)
        objective = _objective(settings, state.phasors, _turned(statistics, state.turn))
        loss, slopes = jax.value_and_grad(lambda parts: objective(lax.complex(*parts)))((real, imaginary))
        (slope,) = pull(slopes)
        moves, moments = optimiser.update(slope, state.moments)
        coordinates = jnp.asarray(optax.apply_updates(state.coordinates, moves))
        return state._replace(coordinates=coordinates, moments=moments), loss

    kind = statistics.energy.dtype
    start = jnp.log(jnp.asarray([settings.permittivity - 1.0, settings.conductivity], kind))
    coordinates = jnp.repeat(start[:, None], task.count, axis=1)
    one = jnp.ones_like(statistics.product)
    state = _State(
        coordinates,
        optimiser.init(coordinates),
        Phasors(one, jnp.ones_like(jnp.real(one))),
        jnp.asarray(settings.concentration, kind),
        noise_power,
        one[..., :1],
    )
    state, losses = lax.scan(step, state, jnp.arange(settings.steps))
    assumed = {"oblivious": jnp.inf, "uniform": 0.0}.get(settings.scheme)
    concentration = state.concentration if assumed is None else jnp.asarray(assumed, kind)
    return Calibration(*task.materials(state.coordinates), concentration, state.noise_power, losses)


def _turned(statistics: Statistics, turn: Array) -> Statistics:
    """The statistics of the measurement turned back by its common phases."""
    return eqx.tree_at(lambda s: s.product, statistics, statistics.product * jnp.conj(turn))


def _expect(
    settings: Settings,
    state: _State,
    gain: Complex[Array, "link path"],
    statistics: Statistics,
    number: Array,
) -> _State:
    """The E-step, and what follows from it in closed form: concentration, noise power, common phases."""
    if settings.scheme not in ("aware", "aware_reference"):
        return state
    seen = _turned(statistics, state.turn)
    over = state.noise_power[:, None, None]
    coupling = jnp.conj(gain)[:, :, None] * seen.gram * gain[:, None] / over
    field = Field(jnp.conj(gain)[:, None] * seen.product / over, coupling, state.concentration)
    phasors, turn = _phasors(field, state.phasors, settings, number), state.turn
    exists = jnp.broadcast_to((field.snr > 0)[:, None], phasors.mean.shape)
    if settings.global_phase:
        # what the angles have in common is the phase of the snapshot: their prior is then most at ease
        total = jnp.sum(jnp.where(exists, phasors.mean, 0), axis=2, keepdims=True)
        size = jnp.abs(total)
        common = jnp.where(size > 0, total / jnp.where(size > 0, size, 1.0), 1.0)
        phasors, turn = phasors._replace(mean=phasors.mean * jnp.conj(common)), turn * common
        seen = _turned(statistics, turn)
    concentration, noise_power = state.concentration, state.noise_power
    if not settings.fixed_concentration:
        mean = jnp.sum(jnp.where(exists, jnp.real(phasors.mean), 0.0)) / jnp.sum(exists)
        concentration = phases.concentration_of(mean)
    if settings.estimate_noise:
        noise_power = jnp.mean(_residual(gain, phasors, seen), axis=1) / statistics.size
    return state._replace(phasors=phasors, turn=turn, concentration=concentration, noise_power=noise_power)


def _phasors(field: Field, before: Phasors, settings: Settings, number: Array) -> Phasors:
    """The phases' distributions: the paper's, or the exact updates, afresh every so often."""
    if settings.scheme == "aware_reference":
        return phases.reference(field)

    def afresh(before: Phasors) -> Phasors:
        starts = before, phases.no_error(field), phases.reference(field)
        return phases.best(field, starts, settings.sweeps)

    is_due = number % settings.restart_every == 0
    return lax.cond(is_due, afresh, lambda before: phases.swept(field, before, 1), before)


def _residual(gain: Array, phasors: Phasors, statistics: Statistics) -> Float[Array, "link snapshot"]:
    """E |h - sum_p exp(j z_p) a_p|^2."""
    means = phasors.mean * gain[:, None]
    own = jnp.abs(gain) ** 2 * jnp.real(jnp.diagonal(statistics.gram, axis1=1, axis2=2))
    crossed = jnp.real(jnp.einsum("lsp,lpq,lsq->ls", jnp.conj(means), statistics.gram, means))
    matched = jnp.real(jnp.sum(jnp.conj(means) * statistics.product, axis=2))
    spread = jnp.sum(own[:, None] * (1 - phasors.length**2), axis=2)
    return statistics.energy - 2 * matched + crossed + spread


def _objective(settings: Settings, phasors: Phasors, statistics: Statistics) -> Callable[[Array], Array]:
    """What a scheme minimises, as a function of the gains (link, path).

    Each is quadratic, in the gains or in their powers, with coefficients that hold all snapshots.
    """
    if settings.scheme == "uniform":
        return _power_objective(statistics)
    if settings.scheme == "oblivious":
        weight = jnp.full_like(statistics.energy, 1 / jnp.sum(statistics.energy))
        mean, length = jnp.ones_like(phasors.mean), jnp.ones_like(phasors.length)
    else:
        heard = statistics.energy > 0  # a link of which nothing was received says nothing of the gains
        weight = jnp.where(heard, 1 / jnp.where(heard, statistics.energy, 1.0), 0.0) / statistics.energy.size
        mean, length = phasors.mean, phasors.length
    linear = jnp.einsum("ls,lsp,lsp->lp", weight, jnp.conj(mean), statistics.product)
    pairs = jnp.einsum("ls,lsp,lsq->lpq", weight, jnp.conj(mean), mean) * statistics.gram
    own = jnp.real(jnp.diagonal(statistics.gram, axis1=1, axis2=2))
    spread = own * jnp.einsum("ls,lsp->lp", weight, 1 - length**2)
    constant = jnp.sum(weight * statistics.energy)

    def objective(gain: Array) -> Array:
        fit = jnp.sum(jnp.conj(gain) * jnp.einsum("lpq,lq->lp", pairs, gain))
        fit -= 2 * jnp.sum(jnp.conj(gain) * linear)
        return constant + jnp.real(fit) + jnp.sum(spread * jnp.abs(gain) ** 2)

    return objective


def _power_objective(statistics: Statistics) -> Callable[[Array], Array]:
    """Squared difference of measured and modelled powers over the square of the measured ones."""
    kept = statistics.power
    if kept is None:
        raise InputError("statistics for the scheme 'uniform'", "powers", "none", "Project with powers=True")
    total = jnp.sum(kept.square)

    def objective(gain: Array) -> Array:
        power = jnp.real(gain) ** 2 + jnp.imag(gain) ** 2
        fit = jnp.einsum("lp,lpq,lq->", power, kept.normal, power)
        return (total - 2 * jnp.sum(power * kept.right) + fit) / total

    return objective
