"""Running a model with live effects at a flat vector of coordinates, its sites moved if need be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
from numpyro import handlers

from dtprob.effects.changing import Shift
from dtprob.effects.effect import FIELD, Effect
from dtprob.effects.rewriting import Rewriting
from dtprob.gap.model.declared import Declared
from dtprob.gap.model.layout import Layout, fold, transform_of
from dtprob.gap.model.own import Own
from dtprob.gap.model.rows import Rows
from dtprob.gap.observation import whiten
from dtprob.models.declaration import Declaration


class Arrays(NamedTuple):
    """What programs take as arguments, so that they serve all data of the same shapes.

    Attributes:
        data: arguments of the model that are arrays, by name.
        known: mean and precision, unconstrained, of nuisances that earlier data inform instead of the prior, by name.
    """

    data: Any
    known: Mapping[tuple[str, ...], tuple[Any, Any]]


class Outcome(NamedTuple):
    """What a model says at a point.

    Attributes:
        sites: values of the latent and deterministic sites.
        values: of the observed ones, the data.
        parameters: of the observed distributions.
        prior: log prior of the global base latents, and what `numpyro.factor` adds.
        local: log prior of the local ones, per cluster.
    """

    sites: dict[str, jax.Array]
    values: dict[str, jax.Array]
    parameters: dict[str, whiten.Parameters]
    prior: jax.Array
    local: jax.Array

    @property
    def everything(self) -> dict[str, jax.Array]:
        """Values of all sites."""
        return {**self.sites, **self.values}


@final
@dataclass(frozen=True)
class Runner:
    """A model with live effects; what of its arguments is an array comes with every call.

    Attributes:
        declared: the base model.
        live: effects whose parameters are coordinates.
        layout: where each latent site and parameter lies in the flat vector.
        rows: the whitened rows of the observations.
        families: the distribution family of each observed site.
        own: which latent sites have entries for each cluster.
        known: nuisances that earlier data inform instead of the prior.
    """

    declared: Declared
    live: tuple[Effect, ...]
    layout: Layout
    rows: Rows
    families: Mapping[str, str]
    own: Mapping[str, Own]
    known: frozenset[str]

    @cached_property
    def run(self) -> Callable[[Any, Any, Mapping[str, Any]], Outcome]:
        """(x, arrays, perturbations of sites) -> what the model says there; all that calls it shares one trace.

        Where x is split into its blocks, derivatives by some of them do not pass through what depends on the others.
        """
        return jax.jit(self._run)

    def _run(self, x: Any, arrays: Arrays, deltas: Mapping[str, Any]) -> Outcome:
        data, declaration = self.declared.data(arrays.data), self.declared.declaration
        latent = {name: self.layout.part(x, name) for name in declaration.latent}

        def constrain(site: dict[str, Any]) -> Any:
            if site["type"] != "sample" or site["name"] not in latent:
                return None
            return transform_of(site["fn"])(latent[site["name"]])

        with (
            handlers.trace() as trace,
            Shift(deltas),
            Rewriting(None, self.live, self._parameters(x), data),
            handlers.substitute(substitute_fn=constrain),
            handlers.seed(rng_seed=jax.random.key(0)),
        ):
            self.declared.model(**data)
        total, local = self._reference_prior(x, arrays.known), jnp.zeros(self.rows.n_cluster)
        for name in declaration.latent:
            if name in self.known:
                continue
            fn, value = trace[name]["fn"], trace[name]["value"]
            jacobian = transform_of(fn).log_abs_det_jacobian(latent[name], value)
            density = fn.log_prob(value) + fold(jacobian, fn, value)
            if name in self.own:
                local = local + self.own[name].summed(density)
            else:
                total = total + jnp.sum(density)
        for name in declaration.factors:
            total = total + jnp.sum(trace[name]["fn"].log_prob(trace[name]["value"]))
        names = [*declaration.latent, *declaration.deterministic]
        observed = observations(declaration, trace)
        return Outcome(
            {n: jnp.asarray(trace[n]["value"]) for n in names},
            {n: jnp.asarray(trace[n]["value"]) for n in observed},
            {n: o.parameters for n, o in observed.items()},
            total,
            local,
        )

    def _parameters(self, x: Any) -> dict[str, dict[str, Any]]:
        parameters: dict[str, dict[str, Any]] = {}
        for effect in self.live:
            unit = {p.name: jnp.ones(p.shape) for p in effect.parameters}
            names = [*(p.name for p in effect.fitted), *([FIELD] if effect.kind == "variance" else [])]
            parts = {name: self.layout.part(x, effect.site_name(name)) for name in names}
            parameters[effect.name] = {**unit, **parts}
        return parameters

    def _reference_prior(self, x: Any, known: Mapping[tuple[str, ...], tuple[Any, Any]]) -> jax.Array:
        """Log density, up to a constant, of the nuisances that a reference informs."""
        total = jnp.zeros(())
        for names, (mean, precision) in known.items():
            d = jnp.concatenate([self.layout.part(x, name).reshape(-1) for name in names]) - mean
            total = total - 0.5 * d @ (precision @ d)
        return total

    def around(self, parameters: Mapping[str, whiten.Parameters]) -> dict[str, whiten.Observation]:
        """The observed distributions with given parameters."""
        return {n: whiten.Observation(f, dict(parameters[n])) for n, f in self.families.items()}

    def log_prior(self, x: Any, weights: Any, arrays: Arrays) -> jax.Array:
        """Log prior of the base latents, those that clusters own weighted (cluster,)."""
        found = self.run(x, arrays, {})
        return found.prior + weights @ found.local


def observations(declaration: Declaration, trace: Mapping[str, Any]) -> dict[str, whiten.Observation]:
    """The elementwise distributions of a model's observed sites in a trace."""
    return {n: whiten.observation(trace[n]["fn"], trace[n]["value"], n) for n in declaration.observed}
