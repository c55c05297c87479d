"""The compiled derivatives of all candidate effects at the sites."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from dtprob.effects.effect import Context, Effect
from dtprob.gap.model.quick import Hoisted
from dtprob.gap.model.rewrites import (
    derivative,
    field_energy,
    field_shifts,
    null_vector,
    place_energies,
    place_scores,
    trial_shifts,
)
from dtprob.models.arguments import Data, split_static

TRIALS: Final = 16
"""Sizes of each effect that are tried in one run."""


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
            return {e.name: field_energy(e, values, gradients, nulls[e.name], context) for e in fields}

        self._energy = Hoisted(energy)
        self._families = {family: [e.name for e in own] for family, own in families.items()}
        self._tangents = {family: self._tangents_of(own) for family, own in families.items()}
        self._trials = {family: self._trials_of(own) for family, own in families.items()}
        self._place_scores: dict[str, Hoisted] = {}
        self._field_shifts: dict[str, Hoisted] = {}
        self._effects = {e.name: e for e in (*means, *fields)}
        self._nulls = {name: np.asarray(null_vector(e)) for name, e in self._effects.items()}

    def _tangents_of(self, effects: Sequence[Effect]) -> Hoisted:
        def tangents(
            values: Mapping[str, jax.Array], nulls: Mapping[str, jax.Array], arrays: Any
        ) -> dict[str, dict[str, jax.Array]]:
            context = Context(eqx.combine(arrays, self._static), values)
            return {
                e.name: {s: derivative(e, s, values[s], nulls[e.name], context) for s in e.rewrites}
                for e in effects
            }

        return Hoisted(tangents)

    def _trials_of(self, effects: Sequence[Effect]) -> Hoisted:
        def trials(
            values: Mapping[str, jax.Array],
            sizes: Mapping[str, jax.Array],
            counts: Mapping[str, jax.Array],
            arrays: Any,
        ) -> dict[str, dict[str, jax.Array]]:
            context = Context(eqx.combine(arrays, self._static), values)
            return {e.name: trial_shifts(e, values, context, sizes[e.name], counts[e.name]) for e in effects}

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

    def declared(self, name: str) -> Effect:
        """A candidate as it was at first, whatever null it has been given since."""
        return self._effects[name]

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
            told = place_scores if effect.kind == "mean" else place_energies
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
                counts = {n: np.asarray(len(portion.get(n, ()))) for n in names}
                shifts = self._trials[family](dict(values), filled, counts, self._arrays)
                for name, part in portion.items():
                    moved = {site: shift[: len(part)] for site, shift in shifts[name].items()}
                    yield name, slice(start, start + len(part)), moved

    def field_shifts(
        self, name: str, values: Mapping[str, jax.Array], fields: np.ndarray
    ) -> Iterator[tuple[slice, dict[str, jax.Array]]]:
        """The rewritten sites of a variance effect less their values at fields (trial, *field), in portions.

        Yields:
            which of the trials, and for each site the shifts (trial, *site).
        """

        def shifts(values: Any, fields: jax.Array, arrays: Any) -> dict[str, jax.Array]:
            context = Context(eqx.combine(arrays, self._static), values)
            return field_shifts(self._effects[name], values, context, fields)

        run = self._field_shifts.setdefault(name, Hoisted(shifts))
        for start in range(0, len(fields), TRIALS):
            given = fields[start : start + TRIALS]
            filled = np.concatenate([given, np.zeros((TRIALS - len(given), *given.shape[1:]))])
            found = run(dict(values), filled, self._arrays)
            yield slice(start, start + len(given)), {s: shift[: len(given)] for s, shift in found.items()}

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
        return {name: np.asarray(value, float) for name, value in found.items()}
