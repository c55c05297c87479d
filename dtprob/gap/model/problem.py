"""A model on data, with a few live effects, as differentiable functions of one flat vector.

The functions are compiled once per model, data shapes and set of live effects. All other candidates enter to first order
only: their directions at the sites (see `directions`) are pushed through the same compiled model, so that screening
hundreds of effects needs no compilation of theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any, Final, final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.effect import FIELD, Effect
from dtprob.effects.library import check_sites
from dtprob.effects.redrawn import drawn_apart
from dtprob.errors import InputError
from dtprob.gap.model import own
from dtprob.gap.model.angles import unrolled
from dtprob.gap.model.compiled import Compiled
from dtprob.gap.model.decentred import decentred
from dtprob.gap.model.declared import Declared
from dtprob.gap.model.in_units import in_units
from dtprob.gap.model.layout import Block, Known, Layout, make_layout, normal_of
from dtprob.gap.model.masked import counted
from dtprob.gap.model.observed import Observed
from dtprob.gap.model.own import Own
from dtprob.gap.model.prior import Prior
from dtprob.gap.model.prior_spread import DRAWS, PriorSpread
from dtprob.gap.model.programs import Programs
from dtprob.gap.model.rows import Rows, make_rows
from dtprob.gap.model.running import Arrays, Runner
from dtprob.gap.model.shapes import latent_shapes, observed_shapes, perturbed_sites, shapes_of_fields
from dtprob.gap.model.volume import Volume
from dtprob.gap.model.whole_numbers import real_sites
from dtprob.gap.observation import whiten
from dtprob.inference.posterior import Sampler
from dtprob.models.arguments import Data, Model, as_arrays, split_static, within
from dtprob.models.declaration import Declaration, declare
from dtprob.models.supported import check_supported, refuse_obs_mask
from dtprob.xla import warn_of_miscompilation

_OF_EACH: Final = 10
"""Draws of a reference for each of its unknowns, if it has as many."""


@final
class Problem:
    """Compiled views of a model with live effects on given data.

    Args:
        model: the base model.
        data: its arguments by name.
        effects: all candidates.
        cluster: axis or data column whose values are independent of one another.
        reference: draws of the nuisances from earlier data; their normal approximation replaces the prior.
        decentre: whether levels may be drawn in units of their spread, where no reference tells them.

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
        *,
        decentre: bool = True,
    ) -> None:
        warn_of_miscompilation()
        data = as_arrays(data)
        self.data, self.effects = data, tuple(effects)
        self.arrays, static = split_static(data)
        self.column = (
            cluster if cluster is not None and cluster in data and np.ndim(data[cluster]) == 1 else None
        )
        self._cluster = None if self.column else cluster
        self._declare(model, static)
        check_supported(model, data)
        refuse_obs_mask(self.declaration)
        self._check_effects()
        model = counted(unrolled(real_sites(model, data), data), data)
        changed = {s for effect in effects for s in effect.rewrites} & self.declaration.latent.keys()
        if changed:
            model = within(model, lambda: drawn_apart(changed))
        if model is not self.model:
            self._declare(model, static)
        self.known: Known = {}
        self.per_cluster: frozenset[str] = frozenset()
        self.volume: Volume | None = None
        self._find_own()
        shared = self.declaration.latent.keys() - self.own.keys()
        drawn = model if reference is not None or not decentre else decentred(model, data, shared, self.own)
        latent = set(self.declaration.latent)
        if drawn is not model:
            self._declare(drawn, static)
            self._find_own()
        self.decentred: frozenset[str] = frozenset(self.declaration.latent.keys() - latent - self.own.keys())
        self.own |= own.of_fields(self) if self.column else {}
        if reference is not None:
            shared = [b.name for b in self.blocks_of(None) if not b.local]
            count = max(DRAWS, _OF_EACH * sum(self.layout[name].size for name in shared))
            draws = self._prior.reference_draws(reference, shared, count, self.arrays)
            self.known = normal_of(draws)
            self._lay_out()

    def _declare(self, model: Model, static: Any) -> None:
        self.__dict__.pop("prior_spread", None)  # of sites that may have another name now
        self.model = model
        self.declaration: Declaration = declare(model, self.data, cluster=self._cluster)
        self._declared = Declared(model, self.declaration, static)
        self._prior = Prior(self._declared)
        self.observed = Observed(self._declared, self.arrays)

    def _find_own(self) -> None:
        """Ask the model, in which nothing counts as a cluster's own at first, what is."""
        self.own: dict[str, Own] = {}
        self.set_live(())
        self.own = own.of_latents(self)
        self._lay_out()

    def set_live(self, live: tuple[Effect, ...]) -> None:
        """Index rows and coordinates for a set of live effects; nothing is compiled yet."""
        self.live = live
        shapes, families = observed_shapes(self._declared, self.arrays, self.live)
        self.located = {n: whiten.location_rows(f, shapes[n][0]) for n, f in families.items()}
        joint = [n for n, f in families.items() if whiten.is_joint(f)]
        self.rows: Rows = make_rows(
            self.declaration, shapes, self.located, self.data, self.column, joint=joint
        )
        self._families = families
        self._lay_out()

    def _lay_out(self) -> None:
        """Index coordinates anew, where only what clusters own or what is known has changed."""
        self.__dict__.pop("compiled", None)
        self.layout: Layout = self._make_layout()
        self._runner = Runner(
            self._declared,
            self.live,
            self.layout,
            self.rows,
            self._families,
            self.own,
            frozenset(name for names in self.known for name in names),
        )

    def with_live(self, names: Sequence[str]) -> Problem:
        """The same problem with other live effects; what does not depend on them is shared."""
        if set(names) <= {e.name for e in self.live}:
            return self
        _ = self.programs, self.float_sites, self.field_shapes  # made once, then shared
        other = copy(self)
        other.set_live(tuple(e for e in self.effects if e.name in names))
        other.volume = self.volume_in(other)
        return other

    def with_fields(self, fields: Sequence[Effect], per_cluster: Sequence[str] = ()) -> Problem:
        """The same problem with more variance effects, live beside those that are; no other is a candidate any more.

        Args:
            fields: the effects.
            per_cluster: names of those whose field has a row for each cluster, whatever the axes of the site.
        """
        _ = self.float_sites  # as the candidates have grown them
        other = copy(self)
        other.effects, other.per_cluster = (*self.live, *fields), frozenset(per_cluster)
        for name in ("programs", "field_shapes"):
            other.__dict__.pop(name, None)
        other.set_live(other.effects)
        other.volume = self.volume_in(other)
        return other

    def volume_in(self, other: Problem) -> Volume | None:
        """The volume in another problem's coordinates, without those that it lacks."""
        if self.volume is None:
            return None
        mark, there = np.zeros(self.dimension), np.zeros(other.dimension)
        mark[self.volume.index] = np.arange(1, len(self.volume.index) + 1)
        other.layout.copy_into(there, self.layout, mark)
        kept = np.array([int(np.argmax(there == k)) if k in there else -1 for k in mark[self.volume.index]])
        return self.volume.part(np.flatnonzero(kept >= 0), kept[kept >= 0])

    def with_candidates(self, effects: Sequence[Effect]) -> Problem:
        """The same problem with candidates of the same names but other nulls and priors; nothing is compiled anew.

        Points stay what they are: an effect that no fit holds may still be where its null was before.
        """
        _ = self.programs, self.float_sites, self.field_shapes, self.compiled  # shared: they know no nulls
        other, by_name = copy(self), {e.name: e for e in effects}
        other.effects = tuple(effects)
        other.live = tuple(by_name[e.name] for e in self.live)
        return other

    def with_volume(self, volume: Volume | None) -> Problem:
        """The same problem, in which the clusters' own unknowns are integrated out as the volume says."""
        _ = self.compiled  # shared
        other = copy(self)
        other.volume = volume
        return other

    @cached_property
    def compiled(self) -> Compiled:
        """Functions of the flat vector."""
        return Compiled(self._runner, Arrays(self.arrays, self.known), self.float_sites)

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
        names = [effect.name for effect in self.effects]
        for effect in self.effects:
            if names.count(effect.name) > 1:
                remedy = "Give each effect a name of its own"
                raise InputError("effects", "one of each name", f"several named {effect.name!r}", remedy)
            check_sites(effect, self.declaration.sites)

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
    def families(self) -> Mapping[str, str]:
        """Distribution family of each observed site."""
        return self._runner.families

    @property
    def has_powers(self) -> bool:
        """Whether all that is observed is log-normal, as received powers are, so that its errors are in dB."""
        return set(self.families.values()) == {"LogNormal"}

    @property
    def n_observation_of_each(self) -> np.ndarray:
        """Observed entries of each cluster that count (cluster,)."""
        counted, rows = self.observed.counted, self.rows
        return rows.of_entries({n: counted[n] / k for n, k in rows.components.items()}).sum(1)

    def blocks_of(self, owner: str | None) -> list[Block]:
        """The blocks of a live effect by its name, or of the base model's nuisances."""
        return [block for block in self.layout.blocks if block.owner == owner]

    def field_of(self, effect: Effect) -> Block:
        """The block of a live variance effect's field."""
        return self.layout[effect.site_name(FIELD)]

    @cached_property
    def in_units(self) -> frozenset[str]:
        """Shared unknowns that are drawn in units of another one, by the model or since they are decentred."""
        return self.decentred | in_units(self)

    @cached_property
    def float_sites(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Deterministic sites on which a perturbation makes sense, in the largest shape that a candidate gives them."""
        return perturbed_sites(self._runner, self.effects, Arrays(self.arrays, self.known))

    @cached_property
    def field_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of the field of each variance effect."""
        fields = [e for e in self.effects if e.kind == "variance"]
        return shapes_of_fields(self._declared, self.arrays, fields, self.float_sites)

    def _make_layout(self) -> Layout:
        shapes = latent_shapes(self._declared, self.arrays)
        entries: list[tuple[str, str | None, tuple[int, ...]]] = [
            (name, None, shapes[name]) for name in self.declaration.latent
        ]
        found = dict(self.own)
        for effect in self.live:
            if effect.kind == "variance":
                name, shape = effect.site_name(FIELD), self.field_shapes[effect.name]
                entries.append((name, effect.name, shape))
                axis = self.axis_of_clusters(effect)
                if name not in found and axis is not None:
                    found[name] = Own(axis, np.arange(self.n_cluster))
            entries += [(effect.site_name(p.name), effect.name, p.shape) for p in effect.fitted]
        return make_layout(entries, found)

    def axis_of_clusters(self, effect: Effect) -> int | None:
        """Along which axis of its field a variance effect has an entry for each cluster; None where it has not."""
        axes, cluster = self.declaration.sites[effect.sites[0]].axes, self.declaration.cluster
        if effect.name in self.per_cluster:
            axis = 0
        elif self.column is None and cluster in axes:
            axis = axes.index(cluster)
        else:
            return None
        shape = self.field_shapes[effect.name]
        return axis if axis < len(shape) and shape[axis] == self.n_cluster else None

    # -- points ---------------------------------------------------------------------------------------------------

    def null(self) -> np.ndarray:
        """The flat vector with live effects at their null and latent sites at zero."""
        x = np.zeros(self.dimension)
        for effect in self.live:
            for parameter in effect.fitted:
                self.layout.put(x, effect.site_name(parameter.name), np.full(parameter.shape, parameter.null))
        return x

    def start(self, values: Mapping[str, Any]) -> np.ndarray:
        """The flat vector at constrained values of all latent sites, live effects at their null."""
        x, latent = self.null(), self.declaration.latent
        for name, value in self._prior.unconstrained({n: values[n] for n in latent}, self.arrays).items():
            self.layout.put(x, name, value)
        return x

    def prior_draws(self, key: jax.Array, n: int) -> np.ndarray:
        """Flat vectors (n, dimension) of prior draws of the latent sites, live effects at their null."""
        x = np.repeat(self.null()[None], n, axis=0)
        for name, value in self._prior.draws(key, n, self.arrays).items():
            if value.size:
                offset = self.layout[name].offset
                x[:, offset : offset + value.shape[1]] = value
        return np.where(np.isfinite(x), x, 0.0)

    @cached_property
    def prior_spread(self) -> PriorSpread:
        """Where the prior puts the base model's unknowns."""
        return PriorSpread.of_draws(self.prior_draws(jax.random.key(0), DRAWS))

    def initial(self, x: np.ndarray, effects: Sequence[Effect]) -> dict[str, jax.Array]:
        """Constrained values at x of the latent sites and of the given live mean effects' parameters, by site name."""
        values = self.compiled.sites(x)
        own = [e.site_name(p.name) for e in effects for p in e.parameters]
        parts = {name: self.layout.part(jnp.asarray(x), name) for name in own}
        return {**{name: values[name] for name in self.declaration.latent}, **parts}
