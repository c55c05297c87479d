"""Maps of received power by a calibrated twin, with what is not known of its materials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.posterior import Sampler
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.slab import Law

_SITES = ("permittivity", "conductivity")


@final
@dataclass(frozen=True)
class CoverageMap:
    """Power of each link over draws of the materials.

    Attributes:
        power: sum over paths of |a_p|^2, relative to the power sent; 0 where no path arrives.
    """

    power: Float[np.ndarray, "draw link"]

    @property
    def covered(self) -> Bool[np.ndarray, " link"]:
        """Which links have a path."""
        return np.any(self.power > 0, axis=0)

    @property
    def mean(self) -> Float[np.ndarray, " link"]:
        """Expected power."""
        return self.power.mean(axis=0)

    def interval(
        self, probability: float = 0.9
    ) -> tuple[Float[np.ndarray, " link"], Float[np.ndarray, " link"]]:
        """Ends of the central interval of each link's power.

        Args:
            probability: that the interval holds the power.

        Raises:
            InputError: a probability outside of (0, 1).
        """
        if not 0 < probability < 1:
            got = f"{probability:g}"
            raise InputError("probability of an interval", "between 0 and 1", got, "Correct it")
        low, high = np.quantile(self.power, [0.5 - probability / 2, 0.5 + probability / 2], axis=0)
        return low, high

    def outage(self, threshold: float) -> Float[np.ndarray, " link"]:
        """Probability that a link's power is below a threshold, relative to the power sent."""
        return np.mean(self.power < threshold, axis=0)


def coverage_map(
    key: PRNGKeyArray, sampler: Sampler, paths: PathSet, *, draws: int = 100, law: Law = "slab"
) -> CoverageMap:
    """Received power over a map, for draws of the materials.

    Args:
        key: typed JAX key.
        sampler: of `permittivity` and `conductivity` of each object: a posterior of a ray-traced model, or a
            `PointMass` of one calibration.
        paths: to the places of the map, from `dtprob.raytracing.trace.trace`; links without a path are allowed. Their
            scene is that of the calibration.
        draws: how many.
        law: of the walls, as calibrated.

    Raises:
        InputError: the sampler does not give the materials, or those of another number of objects.
    """
    values = sampler.sample(key, draws)
    found: list[Array] = []
    for name in _SITES:
        value = values.get(name)
        if value is None:
            remedy = "Fit a ray-traced model, and keep its deterministic sites"
            raise InputError("materials of the sampler", f"a site '{name}'", ", ".join(values), remedy)
        if np.shape(value) != (draws, paths.n_object):
            expected = f"values of the {paths.n_object} objects of the map's path set"
            got = f"shape {np.shape(value)[1:]}"
            raise InputError(f"site '{name}'", expected, got, "Trace the map in the scene of the calibration")
        found.append(jnp.asarray(value))
    return CoverageMap(np.asarray(_powers(paths, found[0], found[1], law)))


@partial(jax.jit, static_argnames="law")
def _powers(paths: PathSet, permittivity: Array, conductivity: Array, law: Law) -> Array:
    """Power of each link for each draw, (draw, link)."""

    def one(materials: tuple[Array, Array]) -> Array:
        gain = path_gain(paths, *materials, law=law)
        return jnp.sum(jnp.real(gain) ** 2 + jnp.imag(gain) ** 2, axis=1)

    return jax.lax.map(one, (permittivity, conductivity))  # a draw at a time: memory of one map
