"""The compiled derivatives of all candidate effects at the sites."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.effects.effect import FIELD, Context, Effect
from dtprob.gap.model.quick import Hoisted
from dtprob.models.declaration import Data, split_static

TRIALS: Final = 16
"""Sizes of each effect that are tried in one run."""
_PLACES: Final = 96
"""Places of an effect whose tangents are held at once."""
_HELD: Final = 10_000_000
"""Numbers that the tangents of a field at several places may take."""


class Programs:
    """The compiled derivatives of all candidates, shared by every fit of one diagnosis.

    Sites come in the largest shape that any candidate gives them, so one compilation serves all fits. Mean effects have a
    program for each family: it is kept between commands, and so serves other sets of candidates.
    """

    def __init__(self, effects: Sequence[Effect], data: Data) -> None:
        self._arrays, self._static = split_static(data)
        means = [e for e in effects if e.kind == "mean" and e.rewrites]
        fields = [e for e in effects if e.kind == "variance"]
        families: dict[str, list[Effect]] = {}
        for effect in means:
            families.setdefault(effect.family, []).append(effect)

        def energy(
            values: Mapping[str, jax.Array],
            gradients: Mapping[str, jax.Array],
            nulls: Mapping[str, jax.Array],
            arrays: Any,
        ) -> dict[str, jax.Array]:
            context = Context(eqx.combine(arrays, self._static), values)
            return {e.name: _field_energy(e, values, gradients, nulls[e.name], context) for e in fields}

        self._energy = Hoisted(energy)
        self._families = {family: [e.name for e in own] for family, own in families.items()}
        self._tangents = {family: self._tangents_of(own) for family, own in families.items()}
        self._trials = {family: self._trials_of(own) for family, own in families.items()}
        self._place_scores: dict[str, Hoisted] = {}
        self._effects = {e.name: e for e in (*means, *fields)}
        self._nulls = {name: np.asarray(null_vector(e)) for name, e in self._effects.items()}

    def _tangents_of(self, effects: Sequence[Effect]) -> Hoisted:
        def tangents(
            values: Mapping[str, jax.Array], nulls: Mapping[str, jax.Array], arrays: Any
        ) -> dict[str, dict[str, jax.Array]]:
            context = Context(eqx.combine(arrays, self._static), values)
            return {
                e.name: {s: _derivative(e, s, values[s], nulls[e.name], context) for s in e.rewrites}
                for e in effects
            }

        return Hoisted(tangents)

    def _trials_of(self, effects: Sequence[Effect]) -> Hoisted:
        def trials(
            values: Mapping[str, jax.Array], sizes: Mapping[str, jax.Array], arrays: Any
        ) -> dict[str, dict[str, jax.Array]]:
            context = Context(eqx.combine(arrays, self._static), values)
            return {e.name: _trial_shifts(e, values, context, sizes[e.name]) for e in effects}

        return Hoisted(trials)

    def site_tangents(
        self, values: Mapping[str, jax.Array], effects: Sequence[Effect]
    ) -> dict[str, dict[str, jax.Array]]:
        """For each mean effect and rewritten site the derivative (*site, parameter) at the null.

        Args:
            values: of the sites.
            effects: the candidates; those that have been given another null than at first are taken there.
        """
        nulls = self._nulls_of(effects)
        found: dict[str, dict[str, jax.Array]] = {}
        for family, names in self._families.items():
            found |= self._tangents[family](dict(values), {n: nulls[n] for n in names}, self._arrays)
        return found

    def _nulls_of(self, effects: Sequence[Effect]) -> dict[str, Any]:
        return self._nulls | {e.name: null_vector(e) for e in effects if e.name in self._nulls}

    def place_scores(
        self,
        name: str,
        values: Mapping[str, jax.Array],
        gradients: Mapping[str, jax.Array],
        points: Float[np.ndarray, "place parameter"],
    ) -> Float[np.ndarray, "place n"]:
        """Scores of an effect of one size at each of its places; of a random field the energies, entries weighed alike.

        Args:
            name: of the effect.
            values: of the sites, at the fit.
            gradients: of the data and then of replicates under the fit, (n, *site) for each site.
            points: its flat parameters, the size at its null.
        """

        def scores(values: Any, gradients: Any, points: jax.Array, arrays: Any) -> jax.Array:
            context = Context(eqx.combine(arrays, self._static), values)
            effect = self._effects[name]
            told = _place_scores if effect.kind == "mean" else _place_energies
            return told(effect, values, gradients, points, context)

        run = self._place_scores.setdefault(name, Hoisted(scores, jax.jit))
        return np.asarray(run(dict(values), dict(gradients), points, self._arrays))

    def trial_shifts(
        self, values: Mapping[str, jax.Array], sizes: Mapping[str, np.ndarray]
    ) -> Iterator[tuple[str, slice, dict[str, jax.Array]]]:
        """For each named effect, its rewritten sites less their values at flat parameters (trial, n).

        Yields:
            name, which of its trials, and for each site the shifts (trial, *site); all effects in portions of one
            size, so that nothing is compiled anew.
        """
        for family, names in self._families.items():
            wanted = {n: sizes[n] for n in names if n in sizes}
            for start in range(0, max((len(v) for v in wanted.values()), default=0), TRIALS):
                portion = {n: v[start : start + TRIALS] for n, v in wanted.items() if len(v) > start}
                filled = {n: self._filled(n, portion) for n in names}
                shifts = self._trials[family](dict(values), filled, self._arrays)
                for name, part in portion.items():
                    moved = {site: shift[: len(part)] for site, shift in shifts[name].items()}
                    yield name, slice(start, start + len(part)), moved

    def _filled(self, name: str, portion: Mapping[str, np.ndarray]) -> np.ndarray:
        """One portion of an effect's trials, the null where there are none."""
        rows = np.repeat(self._nulls[name][None], TRIALS, axis=0)
        if name in portion:
            rows[: len(portion[name])] = portion[name]
        return rows

    def field_energy(
        self,
        values: Mapping[str, jax.Array],
        gradients: Mapping[str, jax.Array],
        effects: Sequence[Effect],
    ) -> dict[str, np.ndarray]:
        """Weighted sums of squared field scores (n, weighting) of each variance effect, the first with equal weights.

        Args:
            values: of the sites, at the fit.
            gradients: of the data and then of replicates under the fit, (n, *site) for each site.
            effects: the candidates; those that may act anywhere do so where their null is now.
        """
        found = self._energy(dict(values), dict(gradients), self._nulls_of(effects), self._arrays)
        return {name: np.asarray(value) for name, value in found.items()}


def unflatten(effect: Effect, flat: jax.Array) -> dict[str, jax.Array]:
    """Parameters by name from one flat vector."""
    result, low = {}, 0
    for parameter in effect.parameters:
        size = int(np.prod(parameter.shape, dtype=int))
        result[parameter.name] = flat[low : low + size].reshape(parameter.shape)
        low += size
    return result


def null_vector(effect: Effect) -> jax.Array:
    """The null of all parameters as one flat vector."""
    return jnp.concatenate([jnp.full(p.shape, p.null).reshape(-1) for p in effect.parameters])


def _derivative(effect: Effect, site: str, value: jax.Array, null: jax.Array, context: Context) -> jax.Array:
    def moved(flat: jax.Array) -> jax.Array:
        return jnp.asarray(effect.rewrites[site](value, unflatten(effect, flat), context)).astype(value.dtype)

    if len(null) > 1:
        return jax.jacfwd(moved)(null)
    return jax.jvp(moved, (null,), (jnp.ones(1),))[1][..., None]  # half the tracing


def _place_scores(
    effect: Effect,
    values: Mapping[str, jax.Array],
    gradients: Mapping[str, jax.Array],
    points: jax.Array,
    context: Context,
) -> jax.Array:
    sites = [site for site in effect.rewrites if site in gradients]
    flat = jnp.concatenate([gradients[site].reshape(len(gradients[site]), -1) for site in sites], axis=1)
    size = jnp.concatenate(
        [jnp.full(p.shape, 0.0 if p.is_place else 1.0).reshape(-1) for p in effect.parameters]
    )

    def moved(at: jax.Array) -> jax.Array:
        parameters, parts = unflatten(effect, at), []
        for site in sites:
            new = jnp.asarray(effect.rewrites[site](values[site], parameters, context))
            parts.append(
                jnp.broadcast_to(new.astype(values[site].dtype), gradients[site].shape[1:]).reshape(-1)
            )
        return jnp.concatenate(parts)

    def one(point: jax.Array) -> jax.Array:
        return jnp.real(flat @ jax.jvp(moved, (point,), (size,))[1])

    return jax.lax.map(one, points, batch_size=_PLACES)


def _trial_shifts(
    effect: Effect, values: Mapping[str, jax.Array], context: Context, sizes: jax.Array
) -> dict[str, jax.Array]:
    def one(flat: jax.Array) -> dict[str, jax.Array]:
        parameters, result = unflatten(effect, flat), {}
        for site, rewrite in effect.rewrites.items():
            new = jnp.asarray(rewrite(values[site], parameters, context)).astype(values[site].dtype)
            result[site] = new - values[site]
        return result

    return jax.vmap(one)(sizes)


def _place_energies(
    effect: Effect,
    values: Mapping[str, jax.Array],
    gradients: Mapping[str, jax.Array],
    points: jax.Array,
    context: Context,
) -> jax.Array:
    """As `_squares` and a sum, by products of matrices: an entry of the field moves its own part of the site alone."""
    (site,) = effect.rewrites
    shape, of_site = effect.shape_of_field(values[site], context), gradients[site].shape[1:]
    rank, free = len(of_site), shape[len(of_site) :]
    own = [i for i in range(rank) if shape[i] == of_site[i]]
    order = [*own, *(i for i in range(rank) if i not in own)]
    parts = int(np.prod([of_site[i] for i in own], dtype=int))
    count = int(np.prod(free, dtype=int))
    units = jnp.eye(count).reshape(count, *(1,) * rank, *free) * jnp.ones(shape)

    def arranged(entries: jax.Array) -> jax.Array:
        """(n, *site) -> (n, part, rest), real and imaginary parts one after another."""
        flat = entries.transpose(0, *(1 + i for i in order)).reshape(len(entries), parts, -1)
        return jnp.concatenate([flat.real, flat.imag], axis=-1) if jnp.iscomplexobj(flat) else flat

    pulled = arranged(jnp.conj(gradients[site]))

    def one(point: jax.Array) -> jax.Array:
        moved = _with_field(effect, values, {site: gradients[site]}, point, context)
        along = jax.vmap(lambda unit: jax.jvp(moved, (jnp.zeros(shape),), (unit,))[1][site])(units)
        return jnp.sum(jnp.einsum("npr,fpr->npf", pulled, arranged(along)) ** 2, axis=(1, 2))

    held = max(_HELD // (gradients[site][0].size * count), 1)
    return jax.lax.map(one, points, batch_size=min(held, _PLACES))


def _squares(
    effect: Effect,
    values: Mapping[str, jax.Array],
    gradients: Mapping[str, jax.Array],
    null: jax.Array,
    context: Context,
) -> Callable[[Mapping[str, jax.Array]], jax.Array]:
    """The function from gradients at the sites of one data set to the squared scores of a field's entries."""
    shape = effect.shape_of_field(values[effect.sites[0]], context)
    _, pull = jax.vjp(_with_field(effect, values, gradients, null, context), jnp.zeros(shape))
    return lambda gradient: pull(gradient)[0] ** 2


def _with_field(
    effect: Effect,
    values: Mapping[str, jax.Array],
    gradients: Mapping[str, jax.Array],
    null: jax.Array,
    context: Context,
) -> Callable[[jax.Array], dict[str, jax.Array]]:
    """The function from a field of unit spread to the sites, those that have gradients, its places where the null is."""
    at = unflatten(effect, null)
    unit = {p.name: at[p.name] if p.is_place else jnp.ones(p.shape) for p in effect.parameters}

    def moved(field: jax.Array) -> dict[str, jax.Array]:
        result = {}
        for site, gradient in gradients.items():
            new = jnp.asarray(effect.rewrites[site](values[site], {**unit, FIELD: field}, context))
            result[site] = jnp.broadcast_to(new.astype(values[site].dtype), gradient.shape[1:])
        return result

    return moved


def _field_energy(
    effect: Effect,
    values: Mapping[str, jax.Array],
    gradients: Mapping[str, jax.Array],
    null: jax.Array,
    context: Context,
) -> jax.Array:
    shape = effect.shape_of_field(values[effect.sites[0]], context)
    chosen = {site: gradients[site] for site in effect.rewrites if site in gradients}
    square = _squares(effect, values, chosen, null, context)

    def add(total: jax.Array, gradient: Mapping[str, jax.Array]) -> tuple[jax.Array, None]:
        return total + square(gradient), None

    replicates = {site: value[1:] for site, value in chosen.items()}
    total, _ = jax.lax.scan(add, jnp.zeros(shape), replicates)
    information = total / max(len(next(iter(replicates.values()))), 1)
    return jax.lax.map(lambda g: _weights(information) @ square(g).reshape(-1), chosen)


def _weights(information: jax.Array) -> jax.Array:
    """Weights (1 + reference, entry) of squared scores: equal for a faint field, inverse to the information for a strong.

    The best test of entries with variance s^2 weights them by 1 / (1 + s^2 J); s^2 J is 1 at quantiles of J in turn.
    """
    flat = information.reshape(-1)
    reference = jnp.quantile(flat, jnp.array([0.9, 0.5, 0.1])) * jnp.array([1.0, 1.0, 0.1])
    reference = jnp.maximum(reference, 1e-12 * jnp.max(flat, initial=0.0) + 1e-300)
    return jnp.concatenate([jnp.ones((1, flat.size)), 1.0 / (1.0 + flat / reference[:, None])])
