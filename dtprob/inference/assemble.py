"""From an engine's unconstrained draws to a posterior: the same for every engine."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

import dtprob
from dtprob.inference.engine import AbstractEngine, RunOptions
from dtprob.inference.posterior import Posterior
from dtprob.inference.target import Evaluation, Inputs, Target
from dtprob.models.axes import lent, unnamed_axes
from dtprob.models.declaration import Declaration
from dtprob.models.execution import trace_model

_BLOCK, _BLOCK_ENTRIES = 32, 2_000_000
_RECORDED = ("jax", "numpyro", "blackjax")


def assemble(
    target: Target,
    inputs: Inputs,
    positions: Float[Array, "chain draw dimension"] | np.ndarray,
    *,
    engine: AbstractEngine,
    key: PRNGKeyArray,
    options: RunOptions,
    stats: Mapping[str, np.ndarray] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Posterior:
    """The posterior of draws in unconstrained coordinates.

    Args:
        target: the target that the engine worked on.
        inputs: its arrays.
        positions: the draws, (chain, draw, dimension).
        engine: who made them, for the provenance.
        key: the run's key, for the provenance.
        options: which sites to keep.
        stats: per-draw statistics, (chain, draw); what is missing is filled in as for independent draws.
        extra: what the engine knows beyond the draws.
    """
    chains, draws = positions.shape[:2]
    shapes = jax.eval_shape(target.compiled(Target.evaluate), positions[0, 0], inputs)
    kept, left_out = kept_sites(target, shapes, options, chains * draws)
    given = dict(stats or {})
    size, has_lp = block_size(shapes), "lp" in given
    pushed = [_pushed(target, inputs, np.asarray(chain), kept, size, has_lp=has_lp) for chain in positions]
    values, pointwise, lp = jax.tree.map(lambda *parts: np.stack(parts), *pushed)
    declaration = target.declaration
    sites = [name for name in declaration.sites if name in values]
    constant = constant_data(target, inputs)
    return Posterior(
        draws={name: values[name] for name in sites},
        sample_stats=independent_stats(given["lp"] if has_lp else lp) | given,
        log_likelihood=pointwise,
        observed=observed_data(target, inputs),
        constant=constant,
        axes=_axes(declaration, constant),
        latent=tuple(target.coordinates),
        circular=tuple(name for name in sites if declaration.sites[name].is_circular),
        extra={name: np.asarray(value) for name, value in (extra or {}).items()},
        provenance=provenance(target, inputs, engine, key) | {"left_out": left_out},
    )


def provenance(target: Target, inputs: Inputs, engine: AbstractEngine, key: PRNGKeyArray) -> dict[str, Any]:
    """What made a posterior: versions, engine and settings, model, key, hash of the data."""
    return {
        "dtprob": dtprob.__version__,
        "versions": {name: importlib.metadata.version(name) for name in _RECORDED},
        "engine": engine.name,
        "settings": {name: _plain(value) for name, value in _settings(engine).items()},
        "model": target.declaration.name,
        "key": [str(jax.random.key_impl(key)), *np.ravel(jax.random.key_data(key)).tolist()],
        "data_sha256": data_hash(inputs),
    }


def data_hash(inputs: Inputs) -> str:
    """SHA-256 over names, shapes, types and values of the data's arrays."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(inputs.arrays):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.shape} {array.dtype.str}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def observed_data(target: Target, inputs: Inputs) -> dict[str, np.ndarray]:
    """The data of each observed site."""
    return jax.tree.map(np.asarray, target.compiled(observed_sites)(inputs))


def constant_data(target: Target, inputs: Inputs) -> dict[str, np.ndarray]:
    """The arguments that are arrays and are not observed."""
    observed = {site.argument for site in target.declaration.observed.values()}
    columns = {name: entry for name, entry in inputs.arrays.items() if name not in observed}
    return {name: np.asarray(entry) for name, entry in columns.items() if isinstance(entry, jax.Array)}


def _axes(declaration: Declaration, constant: Mapping[str, np.ndarray]) -> dict[str, tuple[str, ...]]:
    """Names of the axes of sites, and of arguments as of what is observed beside them.

    An argument that is called as a plate is has other axes: xarray would take it for the axis' own values.
    """
    observed = [(site.shape, site.axes) for site in declaration.observed.values()]
    own = {n: unnamed_axes(n, c.ndim) for n, c in constant.items()}
    found = {n: lent(c.shape, own[n], observed) for n, c in constant.items()}
    given = {n: own[n] if n in axes else axes for n, axes in found.items()}
    return given | {name: site.axes for name, site in declaration.sites.items()}


def observed_sites(target: Target, inputs: Inputs) -> dict[str, Array]:
    """The value of each observed site."""
    trace = trace_model(target.model, target.data(inputs), jax.random.key(0))
    return {name: jnp.asarray(trace[name]["value"]) for name in target.declaration.observed}


def _settings(engine: AbstractEngine) -> dict[str, Any]:
    return {f.name: getattr(engine, f.name) for f in fields(cast("Any", engine))}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    return value if isinstance(value, str | int | float | bool | None) else np.asarray(value).tolist()


def independent_stats(lp: np.ndarray) -> dict[str, np.ndarray]:
    """The statistics of independent draws of these log densities."""
    return {
        "lp": lp,
        "energy": -lp,
        "diverging": np.zeros(lp.shape, dtype=bool),
        "tree_depth": np.zeros(lp.shape, dtype=int),
        "acceptance_rate": np.ones(lp.shape),
        "step_size": np.zeros(lp.shape),
    }


type Kept = tuple[tuple[str, ...], tuple[str, ...]]


def kept_sites(target: Target, shapes: Evaluation, options: RunOptions, draws: int) -> tuple[Kept, list[str]]:
    """(value sites, pointwise sites) to keep, and the names left out for their size."""
    values, pointwise, left_out = [], [], []
    for name, site in target.declaration.sites.items():
        wanted = options.pointwise if site.kind == "observed" else options.deterministics
        entries = shapes.log_likelihood if site.kind == "observed" else shapes.values
        chosen = pointwise if site.kind == "observed" else values
        if site.kind == "latent" or (wanted and draws * entries[name].size <= options.max_entries):
            chosen.append(name)
        elif wanted:
            left_out.append(name)
    return (tuple(values), tuple(pointwise)), left_out


def block_size(shapes: Evaluation) -> int:
    """How many draws to evaluate at once, within bounds of memory; the same however many draws there are."""
    entries = sum(x.size for x in jax.tree.leaves((shapes.values, shapes.log_likelihood)))
    return max(1, min(_BLOCK, _BLOCK_ENTRIES // max(entries, 1)))


def _pushed(
    target: Target,
    inputs: Inputs,
    positions: Float[np.ndarray, "draw dimension"],
    kept: Kept,
    block: int,
    *,
    has_lp: bool,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], Float[np.ndarray, " draw"]]:
    """A chain's draws pushed through the model by one program of one shape.

    Programs of other shapes round otherwise, and a draw shall not depend on how many there are.
    """
    through = target.compiled(push, kept, has_lp)
    padded = np.concatenate([positions, np.repeat(positions[-1:], -len(positions) % block, axis=0)])
    blocks = [
        jax.tree.map(np.asarray, through(padded[begin : begin + block], inputs))
        for begin in range(0, len(padded), block)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(positions)], *blocks)


def push(
    target: Target, kept: Kept, has_lp: bool, positions: Float[Array, "draw dimension"], inputs: Inputs
) -> tuple[dict[str, Array], dict[str, Array], Float[Array, " draw"]]:
    """Values, pointwise log likelihoods and log density of each draw; 0 for the last where it is known already."""

    def one(u: Float[Array, " dimension"]) -> tuple[dict[str, Array], dict[str, Array], Array]:
        run = target.evaluate(u, inputs)
        values = {name: run.values[name] for name in kept[0]}
        pointwise = {name: run.log_likelihood[name] for name in kept[1]}
        zero = jnp.zeros(())
        return values, pointwise, zero if has_lp else sum(run.terms, start=zero)

    return jax.vmap(one)(positions)
