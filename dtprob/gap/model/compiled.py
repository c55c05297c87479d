"""What a diagnosis asks of a model on data, each compiled when first asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Final, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap.model.bend import bending
from dtprob.gap.model.misses import Miss, misses
from dtprob.gap.model.one_by_one import one_by_one
from dtprob.gap.model.quick import Adaptive, quick_jit
from dtprob.gap.model.rows import stacked
from dtprob.gap.model.running import Arrays, Outcome, Runner
from dtprob.gap.model.tangents import CHUNK, Tangents, chunks
from dtprob.gap.observation import whiten

_POINTS: Final = 64
"""Points that are evaluated in one run, at most."""


@final
class Compiled:
    """Compiled functions of a flat vector.

    Args:
        runner: the model.
        arrays: its arguments that are arrays, and what is known of nuisances.
        float_sites: deterministic sites that may be moved, in the largest shape that a candidate gives them.
    """

    def __init__(
        self, runner: Runner, arrays: Arrays, float_sites: Mapping[str, jax.ShapeDtypeStruct]
    ) -> None:
        self._runner, self.arrays, self._float_sites = runner, arrays, float_sites

    def terms(self, x: Any, arrays: Arrays) -> Terms:
        """Terms of the log posterior at x, to be traced: derivatives can be taken of it."""
        return self._terms(self._runner.run(x, arrays, {}))

    def _terms(self, found: Outcome) -> Terms:
        rows = {}
        for name, observed in self._runner.around(found.parameters).items():
            density = whiten.log_prob(observed, found.values[name])
            rows[name] = jnp.zeros(self._runner.rows.shapes[name]).at[0].set(density)
        return Terms(self._runner.rows.stack(rows).sum(1), found.prior, found.local)

    @cached_property
    def _many(self) -> Callable[[np.ndarray], Terms]:
        """Points (n, dimension), at most `_POINTS` -> the terms of so many points, zero beyond the given ones.

        One program serves single points and lines of them: how many there are is known only when it runs.
        """

        @jax.jit
        def many(xs: jax.Array, count: Any, arrays: Arrays) -> Terms:
            shapes = jax.eval_shape(self.terms, xs[0], arrays)
            nothing = jax.tree.map(lambda s: jnp.zeros((len(xs), *s.shape), s.dtype), shapes)
            return one_by_one(lambda i: self.terms(xs[i], arrays), count, nothing)

        def padded(xs: np.ndarray) -> Terms:
            whole = np.zeros((_POINTS, xs.shape[1]))
            whole[: len(xs)] = xs
            return many(whole, len(xs), self.arrays)

        return padded

    def evaluate(self, x: np.ndarray) -> Terms:
        """Log likelihood per cluster, log prior of global nuisances, log prior of local ones per cluster at x."""
        likelihood, prior, local = self._many(np.asarray(x)[None])
        return Terms(np.asarray(likelihood)[0], np.asarray(prior)[0], np.asarray(local)[0])

    def by_cluster(self, x: np.ndarray) -> np.ndarray:
        """Log likelihood and log prior of local nuisances at x, per cluster (cluster,)."""
        likelihood, _, local = self.evaluate(x)
        return likelihood + local

    def profile(self, xs: np.ndarray) -> np.ndarray:
        """Log posterior of the base nuisances (n,) at points (n, dimension), one after another."""
        values = []
        for start in range(0, len(xs), _POINTS):
            part = xs[start : start + _POINTS]
            likelihood, prior, local = (np.asarray(term)[: len(part)] for term in self._many(part))
            values.append(likelihood.sum(1) + prior + local.sum(1))
        return np.concatenate(values)

    def residual(self, x: np.ndarray) -> jax.Array:
        """Whitened residuals (cluster, row) at x."""
        return self.linearised(x, np.zeros((0, self._runner.layout.dimension)))[0]

    @cached_property
    def slope(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """(x, weights (cluster,)) -> gradient (dimension,) of the clusters' weighted log likelihoods."""

        @Adaptive
        def slope(x: Any, weights: Any, arrays: Arrays) -> jax.Array:
            def total(y: Any) -> jax.Array:
                likelihood = self.terms(y, arrays).likelihood
                return jnp.sum(weights * jnp.where(weights > 0, likelihood, 0.0))

            return jax.grad(total)(x)

        return lambda x, weights: np.asarray(slope(jnp.asarray(x), jnp.asarray(weights), self.arrays))

    @cached_property
    def curvature(self) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """(x, weights (cluster,), basis (k, dimension)) -> minus the Hessian of the log posterior times the basis.

        Weights are those of what clusters add to it.
        """

        @jax.jit
        def curvature(x: Any, weights: Any, basis: jax.Array, count: Any, arrays: Arrays) -> jax.Array:
            def total(y: Any) -> jax.Array:
                found = self.terms(y, arrays)
                own = jnp.where(weights > 0, found.likelihood + found.local, 0.0)
                return found.prior + jnp.sum(weights * own)

            def along(i: Any) -> jax.Array:
                return -jax.jvp(jax.grad(total), (x,), (basis[i],))[1]

            return one_by_one(along, count, jnp.zeros_like(basis))

        def chunked(x: np.ndarray, weights: np.ndarray, basis: np.ndarray) -> np.ndarray:
            given = jnp.asarray(x), jnp.asarray(weights, float)
            parts = [curvature(*given, *chunk, self.arrays) for chunk in chunks(basis)]
            return np.concatenate([np.asarray(part) for part in parts])[: len(basis)]

        return chunked

    @cached_property
    def linearised(self) -> Callable[[np.ndarray, np.ndarray], tuple[jax.Array, jax.Array]]:
        """(x, basis (k, dimension)) -> whitened residuals (cluster, row) and tangents (cluster, row, k)."""
        tangents = Tangents(self._runner)
        return lambda x, basis: tangents(x, basis, self.arrays)

    def replicate(self, x: np.ndarray, keys: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Whitened residuals (n, cluster, row) and observed values (n, ...) by site, drawn at x with keys (n,)."""
        families = tuple(self._runner.families.items())
        return _replicate(self._state(x).observed, keys, self._runner.rows.gather, families=families)

    @cached_property
    def site_gradient(self) -> Any:
        """(x, rows (n, cluster, row)) -> for each deterministic site, gradients (n, ...) of <rows, whitened shift>."""

        @quick_jit
        def site_gradient(x: Any, rows: jax.Array, arrays: Any) -> dict[str, jax.Array]:
            zero = {name: jnp.zeros(s.shape, s.dtype) for name, s in self._float_sites.items()}

            def parameters(deltas: Mapping[str, Any]) -> dict[str, whiten.Parameters]:
                return self._runner.run(x, arrays, deltas).parameters

            here, push = jax.linearize(parameters, zero)
            rows_at = {n: whiten.about(o) for n, o in self._runner.around(here).items()}

            def inner(deltas: Mapping[str, Any], row: jax.Array) -> jax.Array:
                tangent = push(deltas)
                shifts = {n: at.shift(tangent[n]) for n, at in rows_at.items()}
                return jnp.sum(row * self._runner.rows.stack(shifts))

            return jax.lax.map(lambda row: jax.grad(inner)(zero, row), rows)

        return lambda x, rows: site_gradient(jnp.asarray(x), rows, self.arrays)

    @cached_property
    def bend(self) -> Callable[[np.ndarray, np.ndarray, np.ndarray], dict[str, jax.Array]]:
        """(x, weights (cluster, row, k), basis (k, dimension)) -> slopes by site; see `dtprob.gap.model.bend`."""
        run = bending(self._runner)
        return lambda x, weights, basis: run(x, weights, basis, self.arrays)

    @cached_property
    def site_shift(self) -> Any:
        """(x, {site: perturbations (n, ...)}) -> whitened shifts (cluster, row, n) to first order."""

        @quick_jit
        def site_shift(x: Any, deltas: dict[str, jax.Array], arrays: Any) -> jax.Array:
            zero = {name: jnp.zeros(s.shape, s.dtype) for name, s in self._float_sites.items()}

            def parameters(moved: dict[str, jax.Array]) -> dict[str, whiten.Parameters]:
                return self._runner.run(x, arrays, moved).parameters

            here, push = jax.linearize(parameters, zero)
            rows_at = {n: whiten.about(o) for n, o in self._runner.around(here).items()}

            def shifted(delta: dict[str, jax.Array]) -> jax.Array:
                tangent = push(delta)
                return self._runner.rows.stack({n: at.shift(tangent[n]) for n, at in rows_at.items()})

            return jnp.moveaxis(jax.lax.map(shifted, deltas), 0, -1)

        def chunked(x: np.ndarray, deltas: Mapping[str, np.ndarray]) -> jax.Array:
            n = len(next(iter(deltas.values())))
            parts = [site_shift(jnp.asarray(x), chunk, self.arrays) for chunk in self._padded(deltas, n)]
            return jnp.concatenate(parts, axis=-1)[..., :n]

        return chunked

    @cached_property
    def shifted(self) -> Any:
        """(x, {site: perturbations (n, *site)}, n) -> what clusters add to the log posterior (n, cluster), perturbed."""

        @jax.jit
        def shifted(x: Any, deltas: dict[str, jax.Array], count: Any, arrays: Any) -> jax.Array:
            def perturbed(i: Any) -> jax.Array:
                found = self._terms(self._runner.run(x, arrays, {n: delta[i] for n, delta in deltas.items()}))
                return found.likelihood + found.local

            return one_by_one(perturbed, count, jnp.zeros((CHUNK, self._runner.rows.n_cluster)))

        def chunked(x: np.ndarray, deltas: Mapping[str, Any], n: int) -> np.ndarray:
            chunks = zip(range(n, 0, -CHUNK), self._padded(deltas, n), strict=True)
            parts = [shifted(jnp.asarray(x), chunk, min(left, CHUNK), self.arrays) for left, chunk in chunks]
            return np.concatenate([np.asarray(part) for part in parts])[:n]

        return chunked

    def _padded(self, deltas: Mapping[str, Any], n: int) -> Iterator[dict[str, jax.Array]]:
        """Perturbations of all sites in chunks of one size, zero where none is given."""
        for start in range(0, n, CHUNK):
            chunk = dict(self._nowhere)
            for name, given in deltas.items():
                chunk[name] = _filled(given[start : start + CHUNK], self._nowhere[name])
            yield chunk

    @cached_property
    def _nowhere(self) -> dict[str, jax.Array]:
        """One chunk of perturbations that perturb nothing."""
        return {n: jnp.zeros((CHUNK, *s.shape), s.dtype) for n, s in self._float_sites.items()}

    @cached_property
    def _state(self) -> Callable[..., _State]:
        @quick_jit
        def state(x: Any, arrays: Any) -> _State:
            found = self._runner.run(x, arrays, {})
            data = self._runner.declared.data(arrays.data)
            return _State(found.sites, found.parameters, misses(self._runner, found, data))

        def at(x: np.ndarray, given: Mapping[str, Any] = MappingProxyType({})) -> _State:
            return state(jnp.asarray(x), self.arrays._replace(data={**self.arrays.data, **given}))

        return at

    def sites(self, x: np.ndarray, given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, jax.Array]:
        """Values of the latent and deterministic sites at x, by name; `given` replaces arguments of the model."""
        return self._state(x, given).sites

    def observations(self, x: np.ndarray) -> dict[str, whiten.Observation]:
        """The observed distributions at x, by site."""
        return self._runner.around(self._state(x).observed)

    def misses(self, x: np.ndarray) -> dict[str, Miss]:
        """How far predictions at x miss what was seen, by observed site and measure."""
        return self._state(x).misses

    @cached_property
    def prior(self) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
        """(x, basis (k, dimension)) -> gradient of the log prior of the base latents, minus its Hessian times the basis.

        A third argument weights the priors of what clusters own (cluster,); all count fully by default.
        """

        @jax.jit
        def prior(
            x: Any, basis: jax.Array, count: Any, weights: Any, arrays: Any
        ) -> tuple[jax.Array, jax.Array]:
            slope, push = jax.linearize(lambda y: jax.grad(self._runner.log_prior)(y, weights, arrays), x)
            return slope, one_by_one(lambda i: -push(basis[i]), count, jnp.zeros_like(basis))

        def chunked(
            x: np.ndarray, basis: np.ndarray, weights: np.ndarray | None = None
        ) -> tuple[np.ndarray, np.ndarray]:
            given = jnp.ones(self._runner.rows.n_cluster) if weights is None else jnp.asarray(weights, float)
            parts = [prior(jnp.asarray(x), *chunk, given, self.arrays) for chunk in chunks(basis)]
            return np.asarray(parts[0][0]), np.concatenate([c for _, c in parts])[: len(basis)]

        return chunked


class Terms(NamedTuple):
    """Terms of the log posterior: log likelihood of clusters, log prior of global nuisances, of clusters' own."""

    likelihood: Any
    prior: Any
    local: Any


class _State(NamedTuple):
    """What a model says at a point: its sites, its observed distributions, and how far these miss what was seen."""

    sites: dict[str, jax.Array]
    observed: dict[str, whiten.Parameters]
    misses: dict[str, Miss]


@partial(jax.jit, static_argnames="families")
def _replicate(
    parameters: Mapping[str, whiten.Parameters],
    keys: jax.Array,
    gather: np.ndarray,
    *,
    families: tuple[tuple[str, str], ...],
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Draws of observations of these families: whitened residuals (n, cluster, row), and values (n, ...) by site."""
    observations = {n: whiten.Observation(f, parameters[n]) for n, f in families}
    rows_at = {n: whiten.about(o) for n, o in observations.items()}

    def one(key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        split = zip(observations.items(), jax.random.split(key, len(observations)), strict=True)
        values = {name: whiten.sample(o, k) for (name, o), k in split}
        return stacked([at.residual(values[n]) for n, at in rows_at.items()], gather), values

    return jax.lax.map(one, keys)


def _filled(given: Any, like: jax.Array) -> jax.Array:
    """Perturbations of one site (n, ...) as one whole chunk."""
    if given.shape == like.shape:
        return jnp.asarray(given, like.dtype)
    part = np.zeros(like.shape, like.dtype)
    part[: len(given)] = given
    return jnp.asarray(part)
