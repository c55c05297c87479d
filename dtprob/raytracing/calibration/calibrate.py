"""The loop of a calibration: an E-step for the phases, a gradient step for the materials."""

import warnings
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
from dtprob.raytracing.calibration.objective import objective_of, residual, turned
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
        free_energy: E[log q] - E[log p] at the end, nats, by which the aware schemes' answers from several starts compare;
            NaN for "oblivious" and "uniform", whose last loss does.
    """

    permittivity: Float[Array, " object"]
    conductivity: Float[Array, " object"]
    concentration: Float[Array, ""]
    noise_power: Float[Array, " link"]
    loss: Float[Array, " iteration"]
    free_energy: Float[Array, ""]


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
    """From each concentration that the settings name; the answer of the lowest free energy is kept."""

    def arrive(concentration: Array) -> Calibration:
        return _calibrate_from(concentration, task, statistics, noise_power)

    found = lax.map(arrive, jnp.asarray(task.settings.starts, statistics.energy.dtype))
    best = jnp.argmin(jnp.where(jnp.isnan(found.free_energy), jnp.inf, found.free_energy))
    return jax.tree.map(lambda leaf: leaf[best], found)


def _calibrate_from(
    concentration: Array, task: _Task, statistics: Statistics, noise_power: Float[Array, " link"]
) -> Calibration:
    """One search."""
    settings = task.settings
    optimiser = optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(settings.rate))

    def step(state: _State, number: Array) -> tuple[_State, Array]:
        (real, imaginary), pull = jax.vjp(task.gain, state.coordinates)
        state = _expect(settings, state, lax.complex(real, imaginary), statistics, number)
        objective = objective_of(settings, state.phasors, turned(statistics, state.turn))
        loss, slopes = jax.value_and_grad(lambda parts: objective(lax.complex(*parts)))((real, imaginary))
        (slope,) = pull(slopes)
        moves, moments = optimiser.update(slope, state.moments)
        coordinates = jnp.asarray(optax.apply_updates(state.coordinates, moves))
        return state._replace(coordinates=coordinates, moments=moments), loss

    kind = statistics.energy.dtype
    start = jnp.log(jnp.asarray([settings.permittivity - 1.0, settings.conductivity], kind))
    coordinates = jnp.repeat(start[:, None], task.count, axis=1)
    one = jnp.ones_like(statistics.product)
    turn = one[..., :1]
    if settings.global_phase:  # else a search would end elsewhere for other common phases
        turn = _coherent(lax.complex(*task.gain(coordinates)), statistics)
    state = _State(
        coordinates,
        optimiser.init(coordinates),
        phases.certain(one),
        concentration,
        noise_power,
        turn,
    )
    state, losses = lax.scan(step, state, jnp.arange(settings.steps))
    assumed = {"oblivious": jnp.inf, "uniform": 0.0}.get(settings.scheme)
    found = state.concentration if assumed is None else jnp.asarray(assumed, kind)
    energy = _free_energy(task, state, statistics) if assumed is None else jnp.asarray(jnp.nan, kind)
    return Calibration(*task.materials(state.coordinates), found, state.noise_power, losses, energy)


def _free_energy(task: _Task, state: _State, statistics: Statistics) -> Array:
    """E[log q] - E[log p] of the phases and the measurement, nats, after a fresh E-step."""
    seen = turned(statistics, state.turn)
    field = _field(lax.complex(*task.gain(state.coordinates)), seen, state)
    over = state.noise_power[:, None]
    noise = statistics.size * jnp.log(over) + statistics.energy / over
    return jnp.sum(phases.free_energy(field, _afresh(field, state.phasors, task.settings)) + noise)


def _field(gain: Complex[Array, "link path"], seen: Statistics, state: _State) -> Field:
    over = state.noise_power[:, None, None]
    coupling = jnp.conj(gain)[:, :, None] * seen.gram * gain[:, None] / over
    return Field(jnp.conj(gain)[:, None] * seen.product / over, coupling, state.concentration)


def _expect(
    settings: Settings,
    state: _State,
    gain: Complex[Array, "link path"],
    statistics: Statistics,
    number: Array,
) -> _State:
    """The E-step, and what follows from it in closed form: concentration, noise power, common phases."""
    if settings.scheme == "uniform":
        return state
    if settings.scheme == "oblivious":
        turn = _coherent(gain, statistics) if settings.global_phase else state.turn
        noise_power = state.noise_power
        if settings.estimate_noise:
            noise_power = _left(gain, state.phasors, turned(statistics, turn))
        return state._replace(turn=turn, noise_power=noise_power)
    seen = turned(statistics, state.turn)
    field = _field(gain, seen, state)
    phasors, turn = _phasors(field, state.phasors, settings, number), state.turn
    exists = jnp.broadcast_to((field.snr > 0)[:, None], phasors.mean.shape)
    if settings.global_phase:
        # what the angles have in common is the phase of the snapshot: their prior is then most at ease
        common = _direction(jnp.sum(jnp.where(exists, phasors.mean, 0), axis=2, keepdims=True))
        phasors, turn = phasors._replace(mean=phasors.mean * jnp.conj(common)), turn * common
        seen = turned(statistics, turn)
    concentration, noise_power = state.concentration, state.noise_power
    if not settings.fixed_concentration:
        mean = jnp.sum(jnp.where(exists, jnp.real(phasors.mean), 0.0)) / jnp.sum(exists)
        concentration = phases.concentration_of(mean)
    if settings.estimate_noise:
        noise_power = _left(gain, phasors, seen)
    return state._replace(phasors=phasors, turn=turn, concentration=concentration, noise_power=noise_power)


def _left(gain: Array, phasors: Phasors, seen: Statistics) -> Float[Array, " link"]:
    """The noise power that the residuals show."""
    return jnp.mean(residual(gain, phasors, seen), axis=1) / seen.size


def _coherent(gain: Complex[Array, "link path"], statistics: Statistics) -> Complex[Array, "link snapshot 1"]:
    """The common phase of each snapshot with which paths without phase errors fit it best."""
    return _direction(jnp.einsum("lp,lsp->ls", jnp.conj(gain), statistics.product)[..., None])


def _direction(total: Complex[Array, "*n"]) -> Complex[Array, "*n"]:
    """Numbers over their size, 1 where that is 0."""
    size = jnp.abs(total)
    return jnp.where(size > 0, total / jnp.where(size > 0, size, 1.0), 1.0)


def _phasors(field: Field, before: Phasors, settings: Settings, number: Array) -> Phasors:
    """The phases' distributions: the paper's, or the exact updates, afresh every so often."""
    if settings.scheme == "aware_reference":
        return phases.reference(field)

    return lax.cond(
        number % settings.restart_every == 0,
        lambda before: _afresh(field, before, settings),
        lambda before: phases.swept(field, before, 1),
        before,
    )


def _afresh(field: Field, before: Phasors, settings: Settings) -> Phasors:
    return phases.best(field, (before, phases.no_error(field), phases.reference(field)), settings.sweeps)
