"""A model on data, with a few live effects, as differentiable functions of one flat vector.

The functions are compiled once per model, data shapes and set of live effects. All other candidates enter to first order
only: their directions at the sites (see `directions`) are pushed through the same compiled model, so that screening
hundreds of effects needs no compilation of theirs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.primitives import Messenger

from dtprob.effects.effect import FIELD, Effect, Rewriting
from dtprob.errors import InputError
from dtprob.gap import whiten
from dtprob.gap.layout import Block, Layout, fold, make_layout, normal_of, transform_of
from dtprob.gap.programs import Programs
from dtprob.gap.quick import quick_jit
from dtprob.gap.rows import Rows, make_rows
from dtprob.inference.posterior import Sampler
from dtprob.models.declaration import Data, Declaration, Model, declare, split_static, trace_model

_REFERENCE_DRAWS = 1000
_CHUNK = 16


class _Shift(Messenger):
    """Adds a perturbation to deterministic sites."""

    def __init__(self, deltas: Mapping[str, Any]) -> None:
        super().__init__(None)
        self._deltas = deltas

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if msg["type"] == "deterministic" and msg["name"] in self._deltas:
            msg["value"] = msg["value"] + self._deltas[msg["name"]]


class Problem:
    """Compiled views of a model with live effects on given data.

    Args:
        model: the base model.
        data: its arguments by name.
        effects: all candidates.
        cluster: axis or data column whose values are independent of one another.
        reference: draws of the nuisances from earlier data; their normal approximation replaces the prior.
        live: names of the effects whose parameters are coordinates.

    Raises:
        InputError: the data do not fit the model, an effect names no site of the model, or the cluster is unknown.
    """

    def __init__(
        self,
        model: Model,
        data: Data,
        effects: Sequence[Effect],
        cluster: str | None = None,
        reference: Sampler | None = None,
        live: Sequence[str] = (),
    ) -> None:
        self.model, self.data, self.effects = model, dict(data), tuple(effects)
        self.live = tuple(e for e in effects if e.name in live)
        self._cluster, self._reference = cluster, reference
        column = cluster if cluster is not None and cluster in data and np.ndim(data[cluster]) == 1 else None
        self.declaration: Declaration = declare(model, data, cluster=None if column else cluster)
        self.arrays, self._static = split_static(data)
        self._check_effects()
        shapes, families = self._observed_shapes()
        self.families = families
        located = {n: whiten.location_rows(f, shapes[n][0]) for n, f in families.items()}
        self._shapes = shapes
        self.rows: Rows = make_rows(self.declaration, shapes, located, data, column)
        self.layout: Layout = self._make_layout()
        self._known: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        if reference is not None:
            self._known = normal_of(self._reference_draws(reference))

    def with_live(self, names: Sequence[str]) -> Problem:
        """The same problem with other live effects."""
        if set(names) <= {e.name for e in self.live}:
            return self
        other = Problem(self.model, self.data, self.effects, self._cluster, self._reference, names)
        other.programs = self.programs
        return other

    def translate(self, x: np.ndarray, source: Problem) -> np.ndarray:
        """A point of another problem on the same model as a point of this one; what that lacks is at its null."""
        result = self.null()
        self.layout.copy_into(result, source.layout, x)
        return result

    @cached_property
    def programs(self) -> Programs:
        """Compiled derivatives of all candidates."""
        return Programs(self.effects, self.data)

    def _check_effects(self) -> None:
        for effect in self.effects:
            missing = [site for site in effect.sites if site not in self.declaration.sites]
            if missing:
                raise InputError(
                    f"effect {effect.name}",
                    f"a site among {', '.join(self.declaration.sites)}",
                    ", ".join(missing),
                    "Name the site with numpyro.deterministic in the model, or leave the effect out",
                )

    # -- sizes and names ------------------------------------------------------------------------------------------

    @property
    def n_cluster(self) -> int:
        """Number of clusters."""
        return self.rows.n_cluster

    @property
    def cluster_name(self) -> str:
        """Axis or column of the clusters."""
        return self.rows.cluster_name

    @property
    def dimension(self) -> int:
        """Length of the flat vector."""
        return self.layout.dimension

    @property
    def n_observation(self) -> int:
        """Observed entries, a complex one counted once."""
        return sum(site.size for site in self.declaration.observed.values())

    @property
    def components(self) -> dict[str, int]:
        """Whitened rows per entry of each observed site."""
        return {name: shape[0] for name, shape in self._shapes.items()}

    @property
    def rows_per_observation(self) -> float:
        """Whitened rows per observed entry."""
        return len(self.rows.ids) / max(self.n_observation, 1)

    def observed_values(self) -> dict[str, jax.Array]:
        """The data of each observed site."""
        trace = trace_model(self.model, self.data, jax.random.key(0))
        return {name: jnp.asarray(trace[name]["value"]) for name in self.declaration.observed}

    def blocks_of(self, owner: str | None) -> list[Block]:
        """The blocks of a live effect by its name, or of the base model's nuisances."""
        return [block for block in self.layout.blocks if block.owner == owner]

    @cached_property
    def float_sites(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Deterministic sites on which a perturbation makes sense, in the largest shape that a candidate gives them."""

        def run(arrays: Any) -> dict[str, Any]:
            data = eqx.combine(arrays, self._static)
            grown: dict[str, Any] = {}
            for _ in range(2):  # a site may grow because one before it has
                trace, _, _ = self._run(jnp.zeros(self.dimension), arrays, grown)
                values = {n: jnp.asarray(trace[n]["value"]) for n in self.declaration.deterministic}
                grown = {n: jnp.zeros(v.shape, v.dtype) for n, v in values.items()}
                context = {**data, **{n: m["value"] for n, m in trace.items()}}
                for effect in self.effects:
                    parameters = effect.null()
                    if effect.kind == "variance":
                        parameters[FIELD] = jnp.zeros(effect.shape_of_field(values[effect.sites[0]], context))
                    for site, rewrite in effect.rewrites.items():
                        shape = jnp.shape(rewrite(values[site], parameters, context))
                        grown[site] = jnp.zeros(
                            np.broadcast_shapes(grown[site].shape, shape), grown[site].dtype
                        )
            return grown

        sites = cast("dict[str, Any]", jax.eval_shape(run, self.arrays))
        return {n: s for n, s in sites.items() if jnp.issubdtype(s.dtype, jnp.inexact) and s.size}

    def _observed_shapes(self) -> tuple[dict[str, tuple[int, ...]], dict[str, str]]:
        families: dict[str, str] = {}

        def run(arrays: Any) -> dict[str, jax.Array]:
            data = eqx.combine(arrays, self._static)
            means = [e for e in self.live if e.kind == "mean"]
            with Rewriting(None, means, {e.name: e.null() for e in means}, data):
                trace = trace_model(self.model, data, jax.random.key(0))
            observations = self.observations(trace)
            families.update({n: o.family for n, o in observations.items()})
            return {n: whiten.residual(o, trace[n]["value"]) for n, o in observations.items()}

        shapes = cast("dict[str, Any]", jax.eval_shape(run, self.arrays))
        return {name: tuple(shapes[name].shape) for name in families}, families

    def _make_layout(self) -> Layout:
        def run(arrays: Any) -> dict[str, Any]:
            data = eqx.combine(arrays, self._static)
            trace = trace_model(self.model, data, jax.random.key(0))
            shapes = {
                n: jnp.zeros(transform_of(trace[n]["fn"]).inverse_shape(jnp.shape(trace[n]["value"])))
                for n in self.declaration.latent
            }
            context = {**data, **{n: m["value"] for n, m in trace.items()}}
            for effect in self.live:
                if effect.kind == "variance":
                    value = trace[effect.sites[0]]["value"]
                    shapes[effect.site_name(FIELD)] = jnp.zeros(effect.shape_of_field(value, context))
            return shapes

        shapes = {
            n: tuple(v.shape) for n, v in cast("dict[str, Any]", jax.eval_shape(run, self.arrays)).items()
        }
        entries: list[tuple[str, str | None, tuple[int, ...], tuple[str, ...]]] = []
        for name, site in self.declaration.latent.items():
            entries.append(
                (name, None, shapes[name], site.axes if len(site.axes) == len(shapes[name]) else ())
            )
        for effect in self.live:
            if effect.kind == "variance":
                name, axes = effect.site_name(FIELD), self.declaration.sites[effect.sites[0]].axes
                entries.append((name, effect.name, shapes[name], axes))
            else:
                entries += [(effect.site_name(p.name), effect.name, p.shape, ()) for p in effect.parameters]
        return make_layout(entries, self.declaration.cluster, self.rows.n_cluster)

    # -- points ---------------------------------------------------------------------------------------------------

    def null(self) -> np.ndarray:
        """The flat vector with live effects at their null and latent sites at zero."""
        x = np.zeros(self.dimension)
        for effect in self.live:
            for parameter in effect.parameters if effect.kind == "mean" else ():
                self.layout.put(x, effect.site_name(parameter.name), np.full(parameter.shape, parameter.null))
        return x

    def start(self, values: Mapping[str, Any]) -> np.ndarray:
        """The flat vector at constrained values of all latent sites, live effects at their null."""
        trace = trace_model(self.model, self.data, jax.random.key(0), dict(values))
        x = self.null()
        for name in self.declaration.latent:
            self.layout.put(x, name, transform_of(trace[name]["fn"]).inv(jnp.asarray(values[name])))
        return x

    def prior_draws(self, key: jax.Array, n: int) -> np.ndarray:
        """Flat vectors (n, dimension) of prior draws of the latent sites, live effects at their null."""

        def run(key: jax.Array, arrays: Any) -> dict[str, Any]:
            trace = trace_model(self.model, eqx.combine(arrays, self._static), key)
            return {m: transform_of(trace[m]["fn"]).inv(trace[m]["value"]) for m in self.declaration.latent}

        draws = jax.jit(jax.vmap(run, in_axes=(0, None)))(jax.random.split(key, n), self.arrays)
        x = np.repeat(self.null()[None], n, axis=0)
        for name, value in draws.items():
            if value[0].size:
                offset = self.layout[name].offset
                x[:, offset : offset + value[0].size] = np.asarray(value).reshape(n, -1)
        return np.where(np.isfinite(x), x, 0.0)

    def initial(self, x: np.ndarray, effects: Sequence[Effect]) -> dict[str, jax.Array]:
        """Constrained values at x of the latent sites and of the given live mean effects' parameters, by site name."""
        values = self.sites(x)
        own = [e.site_name(p.name) for e in effects for p in e.parameters]
        parts = {name: self.layout.part(jnp.asarray(x), name) for name in own}
        return {**{name: values[name] for name in self.declaration.latent}, **parts}

    def _reference_draws(self, reference: Sampler) -> dict[str, np.ndarray]:
        """Unconstrained draws (draw, size) of the global latent sites that a reference knows."""
        draws = reference.sample(jax.random.key(0), _REFERENCE_DRAWS)
        names = [b.name for b in self.blocks_of(None) if not b.local and b.name in draws]

        def unconstrain(given: Mapping[str, Any], arrays: Any) -> dict[str, Any]:
            trace = trace_model(self.model, eqx.combine(arrays, self._static), jax.random.key(0), given)
            return {n: transform_of(trace[n]["fn"]).inv(given[n]).reshape(-1) for n in names}

        chosen = {n: jnp.asarray(draws[n]) for n in names}
        flat = jax.vmap(unconstrain, in_axes=(0, None))(chosen, self.arrays)
        return {name: np.asarray(value) for name, value in flat.items()}

    # -- running the model ----------------------------------------------------------------------------------------

    def _run(
        self, x: Any, arrays: Any, deltas: Mapping[str, Any]
    ) -> tuple[dict[str, Any], jax.Array, jax.Array]:
        """Trace at x with perturbed sites; also the log prior of the base latents, global and per cluster."""
        data = eqx.combine(arrays, self._static)
        latent = {name: self.layout.part(x, name) for name in self.declaration.latent}
        jacobians: dict[str, Any] = {}

        def constrain(site: dict[str, Any]) -> Any:
            if site["type"] != "sample" or site["name"] not in latent:
                return None
            transform = transform_of(site["fn"])
            u = latent[site["name"]]
            value = transform(u)
            jacobians[site["name"]] = transform.log_abs_det_jacobian(u, value)
            return value

        with (
            handlers.trace() as trace,
            _Shift(deltas),
            Rewriting(None, self.live, self._parameters(x), data),
            handlers.substitute(substitute_fn=constrain),
            handlers.seed(rng_seed=jax.random.key(0)),
        ):
            self.model(**data)
        total, local = self._reference_prior(x), jnp.zeros(self.n_cluster)
        for name in self.declaration.latent:
            if name in self._known:
                continue
            fn = trace[name]["fn"]
            density = fn.log_prob(trace[name]["value"]) + fold(jacobians[name], fn.batch_shape)
            if self.layout[name].local:
                axis = self.declaration.sites[name].axes.index(str(self.declaration.cluster))
                local = local + jnp.moveaxis(density, axis, 0).reshape(self.n_cluster, -1).sum(1)
            else:
                total = total + jnp.sum(density)
        return trace, total, local

    def _parameters(self, x: Any) -> dict[str, dict[str, Any]]:
        parameters: dict[str, dict[str, Any]] = {}
        for effect in self.live:
            if effect.kind == "mean":
                names = {p.name: effect.site_name(p.name) for p in effect.parameters}
                parameters[effect.name] = {name: self.layout.part(x, site) for name, site in names.items()}
            else:
                unit = {p.name: jnp.ones(p.shape) for p in effect.parameters}
                parameters[effect.name] = {**unit, FIELD: self.layout.part(x, effect.site_name(FIELD))}
        return parameters

    def _reference_prior(self, x: Any) -> jax.Array:
        """Log density, up to a constant, of the nuisances that a reference informs."""
        total = jnp.zeros(())
        for name, (mean, precision) in self._known.items():
            d = self.layout.part(x, name).reshape(-1) - mean
            total = total - 0.5 * d @ (precision @ d)
        return total

    def observations(self, trace: Mapping[str, Any]) -> dict[str, whiten.Observation]:
        """The elementwise distributions of the observed sites of a trace."""
        return {
            n: whiten.observation(trace[n]["fn"], trace[n]["value"], n) for n in self.declaration.observed
        }

    def around(self, parameters: Mapping[str, whiten.Parameters]) -> dict[str, whiten.Observation]:
        """The observed distributions with given parameters."""
        return {n: whiten.Observation(f, dict(parameters[n])) for n, f in self.families.items()}

    def _log_prior(self, x: Any, arrays: Any) -> jax.Array:
        _, prior, local = self._run(x, arrays, {})
        return prior + jnp.sum(local)

    # -- compiled functions ---------------------------------------------------------------------------------------

    @cached_property
    def evaluate(self) -> Any:
        """X -> (log likelihood per cluster, log prior of global nuisances, log prior of local ones per cluster)."""

        @jax.jit
        def run(x: Any, arrays: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
            trace, prior, local = self._run(x, arrays, {})
            rows = {}
            for name, observed in self.observations(trace).items():
                density = whiten.log_prob(observed, trace[name]["value"])
                rows[name] = jnp.zeros(self._shapes[name]).at[0].set(density)
            return self.rows.stack(rows).sum(1), prior, local

        return lambda x: run(jnp.asarray(x), self.arrays)

    @cached_property
    def profile(self) -> Any:
        """X (n, dimension) -> log posterior of the base nuisances (n,), one point after another."""

        @jax.jit
        def run(xs: jax.Array, arrays: Any) -> jax.Array:
            def one(x: jax.Array) -> jax.Array:
                trace, prior, local = self._run(x, arrays, {})
                observed = self.observations(trace).items()
                density = [jnp.sum(whiten.log_prob(o, trace[n]["value"])) for n, o in observed]
                return jnp.sum(jnp.stack(density)) + prior + jnp.sum(local)

            return jax.lax.map(one, xs)

        def chunked(xs: np.ndarray) -> np.ndarray:
            padded = np.concatenate([xs, np.repeat(xs[-1:], -len(xs) % _CHUNK, axis=0)])
            parts = [
                run(jnp.asarray(padded[i : i + _CHUNK]), self.arrays) for i in range(0, len(padded), _CHUNK)
            ]
            return np.concatenate([np.asarray(p) for p in parts])[: len(xs)]

        return chunked

    @cached_property
    def residual(self) -> Any:
        """X -> whitened residuals (cluster, row)."""

        @jax.jit
        def run(x: Any, arrays: Any) -> jax.Array:
            trace, _, _ = self._run(x, arrays, {})
            observed = self.observations(trace).items()
            return self.rows.stack({n: whiten.residual(o, trace[n]["value"]) for n, o in observed})

        return lambda x: run(jnp.asarray(x), self.arrays)

    @cached_property
    def columns(self) -> Any:
        """(x, basis (k, dimension)) -> whitened tangents (cluster, row, k)."""

        @jax.jit
        def run(x: Any, basis: jax.Array, arrays: Any) -> jax.Array:
            def parameters(x: Any) -> dict[str, whiten.Parameters]:
                trace, _, _ = self._run(x, arrays, {})
                return {name: o.parameters for name, o in self.observations(trace).items()}

            here, push = jax.linearize(parameters, x)
            observations = self.around(here)

            def shifted(direction: jax.Array) -> jax.Array:
                tangent = push(direction)
                return self.rows.stack({n: whiten.shift(o, tangent[n]) for n, o in observations.items()})

            return jnp.moveaxis(jax.lax.map(shifted, basis, batch_size=_CHUNK), 0, -1)

        def chunked(x: np.ndarray, basis: np.ndarray) -> jax.Array:
            if not len(basis):
                return jnp.zeros((*self.rows.gather.shape, 0))
            padded = np.concatenate([basis, np.zeros((-len(basis) % _CHUNK, self.dimension))])
            starts = range(0, len(padded), _CHUNK)
            parts = [run(jnp.asarray(x), jnp.asarray(padded[i : i + _CHUNK]), self.arrays) for i in starts]
            return jnp.concatenate(parts, axis=-1)[..., : len(basis)]

        return chunked

    @cached_property
    def replicate(self) -> Any:
        """(x, keys (n,)) -> (whitened residuals (n, cluster, row), observed values (n, ...) by site) drawn at x."""

        @quick_jit
        def run(x: Any, keys: jax.Array, arrays: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            trace, _, _ = self._run(x, arrays, {})
            observations = self.observations(trace)

            def one(key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
                split = zip(observations.items(), jax.random.split(key, len(observations)), strict=True)
                values = {name: whiten.sample(o, k) for (name, o), k in split}
                return self.rows.stack(
                    {n: whiten.residual(o, values[n]) for n, o in observations.items()}
                ), values

            return jax.lax.map(one, keys)

        return lambda x, keys: run(jnp.asarray(x), keys, self.arrays)

    @cached_property
    def site_gradient(self) -> Any:
        """(x, rows (n, cluster, row)) -> for each deterministic site, gradients (n, ...) of <rows, whitened shift>."""

        @quick_jit
        def run(x: Any, rows: jax.Array, arrays: Any) -> dict[str, jax.Array]:
            zero = {name: jnp.zeros(s.shape, s.dtype) for name, s in self.float_sites.items()}

            def parameters(deltas: Mapping[str, Any]) -> dict[str, whiten.Parameters]:
                trace, _, _ = self._run(x, arrays, deltas)
                return {name: o.parameters for name, o in self.observations(trace).items()}

            here, push = jax.linearize(parameters, zero)
            observations = self.around(here)

            def inner(deltas: Mapping[str, Any], row: jax.Array) -> jax.Array:
                tangent = push(deltas)
                shifts = {n: whiten.shift(o, tangent[n]) for n, o in observations.items()}
                return jnp.sum(row * self.rows.stack(shifts))

            return jax.lax.map(lambda row: jax.grad(inner)(zero, row), rows)

        return lambda x, rows: run(jnp.asarray(x), rows, self.arrays)

    @cached_property
    def site_shift(self) -> Any:
        """(x, {site: perturbations (n, ...)}) -> whitened shifts (cluster, row, n) to first order."""

        @quick_jit
        def run(x: Any, deltas: dict[str, jax.Array], arrays: Any) -> jax.Array:
            zero = {name: jnp.zeros(s.shape, s.dtype) for name, s in self.float_sites.items()}

            def parameters(moved: dict[str, jax.Array]) -> dict[str, whiten.Parameters]:
                trace, _, _ = self._run(x, arrays, moved)
                return {name: o.parameters for name, o in self.observations(trace).items()}

            here, push = jax.linearize(parameters, zero)
            observations = self.around(here)

            def shifted(delta: dict[str, jax.Array]) -> jax.Array:
                tangent = push(delta)
                return self.rows.stack({n: whiten.shift(o, tangent[n]) for n, o in observations.items()})

            return jnp.moveaxis(jax.lax.map(shifted, deltas), 0, -1)

        def chunked(x: np.ndarray, deltas: Mapping[str, np.ndarray]) -> jax.Array:
            n = len(next(iter(deltas.values())))
            parts = [run(jnp.asarray(x), chunk, self.arrays) for chunk in self._padded(deltas, n)]
            return jnp.concatenate(parts, axis=-1)[..., :n]

        return chunked

    @cached_property
    def shifted_likelihood(self) -> Any:
        """(x, {site: perturbations (n, *site)}, n) -> log likelihood (n,) of the perturbed model."""

        @quick_jit
        def run(x: Any, deltas: dict[str, jax.Array], arrays: Any) -> jax.Array:
            def one(delta: dict[str, jax.Array]) -> jax.Array:
                trace, _, _ = self._run(x, arrays, delta)
                observed = self.observations(trace).items()
                return jnp.sum(
                    jnp.stack([jnp.sum(whiten.log_prob(o, trace[n]["value"])) for n, o in observed])
                )

            return jax.lax.map(one, deltas)

        def chunked(x: np.ndarray, deltas: Mapping[str, Any], n: int) -> np.ndarray:
            parts = [run(jnp.asarray(x), chunk, self.arrays) for chunk in self._padded(deltas, n)]
            return np.concatenate([np.asarray(part) for part in parts])[:n]

        return chunked

    def _padded(self, deltas: Mapping[str, Any], n: int) -> Iterator[dict[str, jax.Array]]:
        """Perturbations of all sites in chunks of one size, zero where none is given."""
        for start in range(0, n, _CHUNK):
            chunk = {}
            for name, s in self.float_sites.items():
                part = np.zeros((_CHUNK, *s.shape), s.dtype)
                if name in deltas:
                    given = np.asarray(deltas[name])[start : start + _CHUNK]
                    part[: len(given)] = given
                chunk[name] = jnp.asarray(part)
            yield chunk

    @cached_property
    def parameters(self) -> Any:
        """X -> parameters of the observed distributions, by site and name."""

        @quick_jit
        def run(x: Any, arrays: Any) -> dict[str, whiten.Parameters]:
            trace, _, _ = self._run(x, arrays, {})
            return {n: o.parameters for n, o in self.observations(trace).items()}

        return lambda x: run(jnp.asarray(x), self.arrays)

    @cached_property
    def sites(self) -> Any:
        """X -> values of the latent and deterministic sites, by name."""

        @quick_jit
        def run(x: Any, arrays: Any) -> dict[str, jax.Array]:
            trace, _, _ = self._run(x, arrays, {})
            return {n: trace[n]["value"] for n in [*self.declaration.latent, *self.declaration.deterministic]}

        return lambda x: run(jnp.asarray(x), self.arrays)

    @cached_property
    def prior_curvature(self) -> Any:
        """(x, basis (k, dimension)) -> minus Hessian of the log prior of the base latents times each basis vector."""

        @quick_jit
        def run(x: Any, basis: jax.Array, arrays: Any) -> jax.Array:
            slope = jax.grad(self._log_prior)
            return -jax.vmap(lambda b: jax.jvp(lambda y: slope(y, arrays), (x,), (b,))[1])(basis)

        return lambda x, basis: run(jnp.asarray(x), jnp.asarray(basis), self.arrays)

    @cached_property
    def prior_gradient(self) -> Any:
        """X -> gradient of the log prior of the base latents."""
        run = quick_jit(jax.grad(self._log_prior))
        return lambda x: run(jnp.asarray(x), self.arrays)

    @cached_property
    def prediction_error(self) -> Any:
        """X -> squared error and squared signal of each cluster (cluster,), over observations with a location."""

        @quick_jit
        def run(x: Any, arrays: Any) -> tuple[jax.Array, jax.Array]:
            trace, _, _ = self._run(x, arrays, {})
            error, signal = {}, {}
            for name, o in self.observations(trace).items():
                value, zero = trace[name]["value"], jnp.zeros(self._shapes[name])
                located = "loc" in o.parameters
                error[name] = zero.at[0].set(jnp.abs(value - o.parameters["loc"]) ** 2) if located else zero
                signal[name] = zero.at[0].set(jnp.abs(value) ** 2) if located else zero
            return self.rows.stack(error).sum(1), self.rows.stack(signal).sum(1)

        return lambda x: run(jnp.asarray(x), self.arrays)
