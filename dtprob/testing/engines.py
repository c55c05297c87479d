"""The contract of an engine, checked on models whose posteriors are known."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from scipy import special

from dtprob.errors import InputError
from dtprob.inference.engine import AbstractEngine
from dtprob.inference.posterior import Posterior
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.dirichlet import LogDirichlet
from dtprob.testing.contract import expect, same

_UNITS, _ROWS, _OBSERVED = 3, 8, "y"
_STATS = ("lp", "diverging", "energy", "tree_depth", "acceptance_rate", "step_size")
_Z = 5.0
_COMPILED = "/jax/core/compile/backend_compile_duration"  # JAX's name of the event


class _Case(NamedTuple):
    """A model, data, and the posterior's summary that is known."""

    model: Any
    data: dict[str, Any]
    site: str
    moments: np.ndarray  # expected values of `_features`, (feature, unit)
    mode: np.ndarray


def check_engine(engine: AbstractEngine, *, key: jax.Array | None = None) -> None:
    """Check that an engine keeps the contract, on a conjugate model.

    Draws are laid out (chain, draw, *event) with deterministic sites among them; the same key gives the
    same draws and another key others; other data of the same shapes compile nothing; statistics and
    pointwise log likelihoods are there; `sample`, `save` and `load` work; a key that is not a typed JAX key
    and data that the model does not take are refused; and the posterior is that of the closed form within
    the Monte-Carlo error (five standard errors; engines with a single value: the mode).

    Args:
        engine: the engine.
        key: typed JAX key; by default a fixed one.

    Raises:
        ContractError: the contract is broken.
    """
    key = jax.random.key(0) if key is None else key
    what = f"engine {engine.name}"
    case = {"circular": _circular_case, "tables": _table_case, "continuous": _normal_case}[engine.serves]()
    posterior = engine(key, case.model, case.data)
    _check_layout(what, posterior, case)
    _check_keys(what, engine, case, posterior, key)
    _check_compiled(what, engine, case, key)
    _check_sampler(what, posterior, key)
    _check_file(what, posterior)
    _check_refusals(what, engine, case, key)
    _check_answer(what, engine, posterior, case)


def _normal(noise: float, y: Any = None) -> None:
    with numpyro.plate("unit", _UNITS):
        level = numpyro.sample("level", dist.Normal(1.0, 2.0))
        doubled = numpyro.deterministic("doubled", 2 * level)
        with numpyro.plate("row", _ROWS):
            numpyro.sample(_OBSERVED, dist.Normal(0.5 * doubled, noise), obs=y)


def _normal_case() -> _Case:
    y = np.random.default_rng(0).normal(2.0, 1.5, (_ROWS, _UNITS))
    precision = 1 / 4 + _ROWS / 1.5**2
    mean = (1.0 / 4 + y.sum(0) / 1.5**2) / precision
    moments = np.stack([mean, mean**2 + 1 / precision])
    return _Case(_normal, {"noise": 1.5, _OBSERVED: y}, "level", moments, mean)


def _phasor(noise: float, y: Any = None) -> None:
    with numpyro.plate("unit", _UNITS):
        phase = numpyro.sample("phase", dist.VonMises(0.5, 1.0))
        doubled = numpyro.deterministic("doubled", 2 * jnp.exp(1j * phase))
        with numpyro.plate("row", _ROWS):
            numpyro.sample(_OBSERVED, ComplexNormal(0.5 * doubled, noise), obs=y)


def _circular_case() -> _Case:
    random = np.random.default_rng(0)
    phase = np.asarray([3.1, -1.0, 0.5])  # the first one near the cut
    parts = random.normal(0, np.sqrt(2.0), (2, _ROWS, _UNITS))
    y = np.exp(1j * phase) + parts[0] + 1j * parts[1]
    eta = np.exp(0.5j) + 2 / 4.0 * y.sum(0)
    kappa, direction = np.abs(eta), np.angle(eta)
    length = np.exp(1j * direction) * np.asarray(dist.VonMises(0.0, kappa).variance * -1 + 1)
    return _Case(
        _phasor, {"noise": 4.0, _OBSERVED: y}, "phase", np.stack([length.real, length.imag]), direction
    )


def _coins(concentration: float, y: Any = None) -> None:
    allowed = np.ones((_UNITS, 2), dtype=bool)
    table = jnp.asarray(numpyro.sample("table", LogDirichlet(concentration, allowed)))
    level = numpyro.deterministic("level", table[:, 1])
    numpyro.deterministic("doubled", 2 * jnp.asarray(level))
    with numpyro.plate("row", _ROWS, dim=-2), numpyro.plate("unit", _UNITS, dim=-1):
        numpyro.sample(_OBSERVED, dist.CategoricalLogits(table), obs=y)


def _table_case() -> _Case:
    y = np.random.default_rng(0).integers(0, 2, (_ROWS, _UNITS))
    heads, total = 0.5 + y.sum(0), 1.0 + _ROWS
    mean = special.digamma(heads) - special.digamma(total)
    variance = special.polygamma(1, heads) - special.polygamma(1, total)
    moments = np.stack([mean, mean**2 + variance])
    return _Case(_coins, {"concentration": 0.5, _OBSERVED: y}, "level", moments, mean)


def _features(case: _Case, values: np.ndarray) -> np.ndarray:
    """What the closed form gives the expectation of, (feature, chain, draw, unit)."""
    if case.site == "phase":
        return np.stack([np.cos(values), np.sin(values)])
    return np.stack([values, values**2])


def _check_layout(what: str, posterior: Posterior, case: _Case) -> None:
    expect(isinstance(posterior, Posterior), what, "a Posterior", type(posterior).__name__, "Return one")
    layout = (posterior.chains, posterior.draws_per_chain)
    for name in (case.site, "doubled"):
        expect(name in posterior.draws, what, f"draws of {name!r}", "none", "Keep deterministic sites too")
        shape = posterior.draws[name].shape
        expected = (*layout, _UNITS)
        expect(shape == expected, f"{what}, draws of {name!r}", f"shape {expected}", shape, "Lay them out so")
    doubled = 2 * (
        np.exp(1j * posterior.draws["phase"]) if case.site == "phase" else posterior.draws["level"]
    )
    agree = np.allclose(posterior.draws["doubled"], doubled, rtol=1e-5)
    expect(
        agree, what, "deterministic sites of the same draws", "others", "Push every draw through the model"
    )
    for name in _STATS:
        shape = _shape(posterior.sample_stats, name)
        expect(shape == layout, f"{what}, statistic {name!r}", f"shape {layout}", shape, "Give one per draw")
    shape = _shape(posterior.log_likelihood, _OBSERVED)
    expected = (*layout, _ROWS, _UNITS)
    expect(
        shape == expected, f"{what}, log likelihood", f"shape {expected}", shape, "Give one per observation"
    )


def _shape(values: Mapping[str, np.ndarray], name: str) -> tuple[int, ...] | None:
    return values[name].shape if name in values else None


def _check_keys(what: str, engine: AbstractEngine, case: _Case, posterior: Posterior, key: jax.Array) -> None:
    again = engine(key, case.model, case.data)
    equal = all(same(posterior.draws[name], again.draws[name]) for name in posterior.draws)
    expect(equal, what, "the same draws for the same key", "others", "Take all randomness from the key")
    if engine.answer != "point":
        other = engine(jax.random.fold_in(key, 1), case.model, case.data)
        differs = not same(posterior.draws[case.site], other.draws[case.site])
        expect(differs, what, "other draws for another key", "the same", "Take all randomness from the key")


def _check_compiled(what: str, engine: AbstractEngine, case: _Case, key: jax.Array) -> None:
    """Whether the programs of earlier calls serve data of the same shapes: the same rows in another order."""
    turned = np.roll(case.data[_OBSERVED], 1, axis=0)
    with _compilations() as compiled:
        engine(key, case.model, {**case.data, _OBSERVED: turned})
    remedy = "Pass data as arguments to compiled functions, as Target.compiled does"
    expect(not compiled, what, "nothing to compile for other data of known shapes", len(compiled), remedy)


@contextlib.contextmanager
def _compilations() -> Generator[list[float]]:
    """The seconds of each compilation meanwhile."""
    found: list[float] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        del kwargs
        if event == _COMPILED:
            found.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def _check_sampler(what: str, posterior: Posterior, key: jax.Array) -> None:
    for count in (1, 7):
        drawn = posterior.sample(key, count)
        for name, values in posterior.draws.items():
            expected, got = (count, *values.shape[2:]), _shape(drawn, name)
            expect(got == expected, f"{what}, sample of {name!r}", f"shape {expected}", got, "Give n draws")


def _check_file(what: str, posterior: Posterior) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "posterior.nc"
        posterior.save(path)
        loaded = Posterior.load(path)
    for group in ("draws", "sample_stats", "log_likelihood", "observed", "extra"):
        before: Mapping[str, Any] = getattr(posterior, group)
        after: Mapping[str, Any] = getattr(loaded, group)
        kept = set(before) == set(after) and all(same(before[n], after[n]) for n in before)
        expect(
            kept,
            f"{what}, {group}",
            "the same after save and load",
            "others",
            "Keep arrays that NetCDF takes",
        )


def _check_refusals(what: str, engine: AbstractEngine, case: _Case, key: jax.Array) -> None:
    attempts = {
        "an integer for the key": (0, case.data),
        "data that the model does not take": (key, {**case.data, "nonsense": 1.0}),
    }
    for name, (given, data) in attempts.items():
        try:
            engine(given, case.model, data)  # pyright: ignore[reportArgumentType]
        except InputError:
            continue
        expect(False, what, f"an InputError for {name}", "a result", "Call check_key and build_target")


def _check_answer(what: str, engine: AbstractEngine, posterior: Posterior, case: _Case) -> None:
    values = posterior.draws[case.site]
    if engine.answer == "point":
        error = values - case.mode
        if case.site == "phase":
            error = np.angle(np.exp(1j * error))
        expect(
            np.max(np.abs(error)) < 1e-3,
            what,
            f"the mode {case.mode}",
            values.ravel(),
            "See whether the search arrived",
        )
        return
    features = _features(case, values)
    z = np.abs(_mean(features) - case.moments) / _standard_error(features)
    got = f"{z.max():.1f} standard errors from it"
    expect(z.max() < _Z, what, "the posterior of the closed form", got, "See whether the engine converged")


def _mean(features: np.ndarray) -> np.ndarray:
    return features.mean(axis=(1, 2))


def _standard_error(features: np.ndarray) -> np.ndarray:
    """Monte-Carlo standard error of the means, from effective sample sizes, (feature, unit)."""
    from arviz_stats.base import array_stats  # noqa: PLC0415  (takes a second)

    size = array_stats.ess(np.moveaxis(features, 0, -1), chain_axis=0, draw_axis=1, method="mean")
    return features.std(axis=(1, 2)) / np.sqrt(np.asarray(size).T)
