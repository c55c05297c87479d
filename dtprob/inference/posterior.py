"""What inference returns, and the one way in which everything downstream uses it: by sampling parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

type Values = dict[str, np.ndarray]


@runtime_checkable
class Sampler(Protocol):
    """Something that samples parameters: a posterior, a point estimate, or the ground truth."""

    def sample(self, key: PRNGKeyArray, n: int) -> Values:
        """`n` independent draws, {site: (n, *event)}."""
        ...


@dataclass(frozen=True)
class PointMass:
    """A sampler that always gives the same values: a point estimate, or the ground truth of a study.

    Attributes:
        values: by site, the value, (*event).
    """

    values: Mapping[str, Any]

    def sample(self, key: PRNGKeyArray, n: int) -> Values:
        """`n` copies of the values; the key is not used."""
        del key
        _check_count(n)
        return {name: np.broadcast_to(np.asarray(v), (n, *np.shape(v))) for name, v in self.values.items()}


@dataclass(frozen=True)
class Posterior:
    """Draws from a posterior, or from what stands in for it.

    Attributes:
        draws: for each latent and deterministic site, its values, (chain, draw, *event); angles in (-pi, pi].
        sample_stats: per draw: `lp` (log density over the unconstrained coordinates), `diverging`, `energy`,
            `tree_depth`, `acceptance_rate`, `step_size`, each (chain, draw). Engines without trajectories
            give zeros, and one for the acceptance rate.
        log_likelihood: for each observed site, the log likelihood of each observation, (chain, draw, *batch).
        observed: for each observed site, its data.
        constant: for each other argument of the model that is an array, its values.
        predicted: what the model would observe at each draw, (chain, draw, *event); see `dtprob.inference.predictive`.
        axes: for each site, the names of its dimensions, first to last.
        latent: the sites that were inferred; the others follow from them.
        circular: the sites whose values are angles.
        coords: for an axis name, its coordinate values.
        extra: what one engine knows beyond draws, such as `log_evidence`.
        provenance: what made the draws: versions, engine and settings, model, key, hash of the data.
    """

    draws: Mapping[str, np.ndarray]
    sample_stats: Mapping[str, np.ndarray] = field(default_factory=dict)
    log_likelihood: Mapping[str, np.ndarray] = field(default_factory=dict)
    observed: Mapping[str, np.ndarray] = field(default_factory=dict)
    constant: Mapping[str, np.ndarray] = field(default_factory=dict)
    predicted: Mapping[str, np.ndarray] = field(default_factory=dict)
    axes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    latent: tuple[str, ...] = ()
    circular: tuple[str, ...] = ()
    coords: Mapping[str, np.ndarray] = field(default_factory=dict)
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse draws that do not share one (chain, draw) layout."""
        layouts = {np.shape(value)[:2] for value in self.draws.values()}
        if len(layouts) != 1 or len(next(iter(layouts))) != 2:
            got = ", ".join(str(layout) for layout in sorted(layouts)) or "no site"
            remedy = "Lay every site out as (chain, draw, *event)"
            raise InputError("draws of a posterior", "one common number of chains and draws", got, remedy)

    def __repr__(self) -> str:
        """Engine, chains and draws, and each latent site with its shape."""
        engine = self.provenance.get("engine", "draws")
        latent = ", ".join(
            f"{n} {self.draws[n].shape[2:]}" for n in self.latent or self.draws if n in self.draws
        )
        return f"Posterior({engine}: {self.chains} chains of {self.draws_per_chain}; {latent})"

    @property
    def chains(self) -> int:
        """Number of chains."""
        return next(iter(self.draws.values())).shape[0]

    @property
    def draws_per_chain(self) -> int:
        """Number of draws of each chain."""
        return next(iter(self.draws.values())).shape[1]

    def flat(self, site: str) -> np.ndarray:
        """All draws of a site, (chain * draw, *event)."""
        value = self.draws[site]
        return value.reshape(self.chains * self.draws_per_chain, *value.shape[2:])

    def sample(self, key: PRNGKeyArray, n: int) -> Values:
        """`n` draws, {site: (n, *event)}: without replacement while there are enough, else with.

        Args:
            key: typed JAX key.
            n: how many.
        """
        _check_count(n)
        total = self.chains * self.draws_per_chain
        index = np.asarray(jax.random.choice(key, total, (n,), replace=n > total))
        return {name: self.flat(name)[index] for name in self.draws}

    def to_datatree(self) -> xr.DataTree:
        """The ArviZ form: groups posterior, sample_stats, log_likelihood, observed_data, constant_data and extra.

        After `dtprob.inference.predictive` there is posterior_predictive, too.
        A complex site `x` becomes `x.real` and `x.imag`: neither ArviZ nor NetCDF takes complex numbers.
        """
        from dtprob.inference.storage import to_datatree  # noqa: PLC0415  (xarray takes a second to import)

        return to_datatree(self)

    def save(self, path: str | Path) -> None:
        """Write a NetCDF file; it is there whole or not at all.

        Args:
            path: the file, `.nc`.
        """
        from dtprob.inference.storage import save  # noqa: PLC0415

        save(self, Path(path))

    @staticmethod
    def load(path: str | Path) -> Posterior:
        """Read what `save` wrote.

        Raises:
            InputError: there is no such file, or it holds no posterior of a known format.
        """
        from dtprob.inference.storage import load  # noqa: PLC0415

        return load(Path(path))


def _check_count(n: int) -> None:
    if n < 1:
        raise InputError("number of draws", "1 or more", str(n), "Ask for at least one draw")
