"""A campaign on the bench: its clean measurement, what a fitted twin can mimic, and sizes by information."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding, path_channels
from dtprob.physical.impairment import Columns, Impairment, Simulation, simulate
from dtprob.physical.information import mean_information, projected, size_for, spread_information
from dtprob.physical.noise import Noise
from dtprob.physical.rays import Rays
from dtprob.physical.world import Material, World, set_materials

type Phase = Literal["coherent", "per_packet", "per_path"]
"""What the twin knows of phases: all; all but one per link and snapshot; a von Mises error on every path."""

STEP: Final = 0.003
"""Of finite differences by the logarithms of contrast and conductivity; slabs may turn by 25 rad per unit."""


@dataclass(frozen=True)
class Bench:
    """A world without the effects under study, measured, with the free parameters of its twin.

    Attributes:
        world: true materials, everything else as the twin has it.
        sounding: subcarriers and snapshots.
        noise: thermal noise.
        always: impairments that the twin models (phase errors), with their sizes.
        tracer: makes the rays of a world.
        base: the measurement without the effects under study.
        tangents: derivative of its mean by each free parameter of the twin.
        precision: prior precision of each.
    """

    world: World
    sounding: Sounding
    noise: Noise
    always: tuple[tuple[Impairment, float], ...]
    tracer: Callable[[World], Rays]
    base: Simulation
    tangents: Complex[np.ndarray, "nuisance entry"]
    precision: Float[np.ndarray, " nuisance"]

    def simulate(self, *impairments: tuple[Impairment, float]) -> Simulation:
        """The measurement with impairments of given sizes."""
        return simulate(
            self.world, self.sounding, self.noise, (*self.always, *impairments), tracer=self.tracer
        )

    @property
    def noise_power(self) -> float:
        """Mean power of the thermal noise."""
        return self.noise.mean_power(self.base.mean.shape)

    def information(self, impairment: Impairment, size: float) -> float:
        """Lambda of an impairment alone, against the base with its free parameters fitted."""
        if impairment.noise is not None:
            found = self.simulate((impairment, size))
            return found.noise.information(found.mean, self.sounding, self.tangents, self.precision)
        if impairment.spread is not None:
            columns = self._received(impairment.spread(self.base.world, self.base.rays, self.sounding, size))
            return spread_information(columns, self.tangents, self.noise_power, self.precision)
        return mean_information(
            self.difference(impairment, size), self.tangents, self.noise_power, self.precision
        )

    def _received(self, columns: Columns) -> Columns:
        """What columns add behind the impairments that the twin models, which are linear in the channel."""
        behind = [(one.channel, size) for one, size in self.always if one.channel]
        if not behind:
            return columns
        rows = []
        for column in columns.swapaxes(0, 1).reshape(columns.shape[1], *self.base.mean.shape):
            found = column
            for change, size in behind:
                found = change(self.world, found, self.sounding, size)
            rows.append(found.reshape(len(columns), -1))
        return np.stack(rows, axis=1)

    def size_for(self, impairment: Impairment, target: float) -> tuple[float, float]:
        """Size of an impairment whose lambda is `target`, and the lambda reached.

        Raises:
            InputError: it is not that informative at any size that makes sense.
        """
        return size_for(target, lambda size: self.information(impairment, size), limit=impairment.limit)

    def difference(self, impairment: Impairment, size: float) -> Complex[np.ndarray, " entry"]:
        """What an impairment adds to the mean."""
        return (self.simulate((impairment, size)).mean - self.base.mean).reshape(-1)

    def visible(self, impairment: Impairment, size: float) -> Float[np.ndarray, " twice"]:
        """What remains of it, real and imaginary parts stacked, once the free parameters are fitted."""
        return projected(self.difference(impairment, size), self.tangents, self.noise_power, self.precision)


def prepare(
    world: World,
    sounding: Sounding,
    noise: Noise,
    tracer: Callable[[World], Rays],
    materials: Mapping[str, Material],
    *,
    phase: Phase = "coherent",
    always: tuple[tuple[Impairment, float], ...] = (),
    concentration: float = 0.0,
) -> Bench:
    """Measure a world and find what its twin can mimic.

    Args:
        world: true materials, everything else as the twin has it.
        sounding: subcarriers and snapshots.
        noise: thermal noise.
        tracer: makes the rays of a world.
        materials: true materials by class, all of which the twin fits.
        phase: what the twin knows of phases.
        always: impairments that the twin models.
        concentration: prior precision of the phase of each path, for "per_path".
    """
    base = simulate(world, sounding, noise, always, tracer=tracer)

    def mean(changed: World) -> Complex[np.ndarray, " entry"]:
        return simulate(changed, sounding, noise, always, tracer=tracer).mean.reshape(-1)

    rows = material_tangents(world, materials, mean)
    free = len(rows)
    if phase == "per_packet":
        rows = np.concatenate([rows, _packet_tangents(base.mean)])
    if phase == "per_path":
        rows = np.concatenate([rows, _path_tangents(base, sounding)])
    precision = np.where(np.arange(len(rows)) < free, 0.0, concentration if phase == "per_path" else 0.0)
    return Bench(world, sounding, noise, always, tracer, base, rows, precision)


def material_tangents(
    world: World,
    materials: Mapping[str, Material],
    mean: Callable[[World], Complex[np.ndarray, " entry"]],
) -> Complex[np.ndarray, "nuisance entry"]:
    """Derivative of the mean by log(permittivity - 1) and log(conductivity) of every class, by tracing again.

    Classes on which nothing depends are left out.
    """
    rows: list[np.ndarray] = []
    for name, material in sorted(materials.items()):
        for contrast, loss in ((STEP, 0.0), (0.0, STEP)):
            sides = [
                mean(set_materials(world, {name: varied(material, sign * contrast, sign * loss)}))
                for sign in (1, -1)
            ]
            row = (sides[0] - sides[1]) / (2 * STEP)
            if np.any(row):
                rows.append(row)
    return np.stack(rows) if rows else np.zeros((0, mean(world).size), complex)


def varied(material: Material, contrast: float, loss: float) -> Material:
    """The material with the logarithms of permittivity - 1 and of conductivity changed by these amounts."""
    permittivity = 1 + (material.permittivity - 1) * float(np.exp(contrast))
    return Material(permittivity, material.conductivity * float(np.exp(loss)), material.thickness)


def _packet_tangents(
    mean: Complex[np.ndarray, "link snapshot a b k"],
) -> Complex[np.ndarray, "nuisance entry"]:
    links, snapshots = mean.shape[:2]
    packets = 1j * mean.reshape(links * snapshots, -1)
    rows = np.zeros((len(packets), *packets.shape), complex)
    rows[np.arange(len(packets)), np.arange(len(packets))] = packets
    return rows.reshape(len(packets), -1)


def _path_tangents(base: Simulation, sounding: Sounding) -> Complex[np.ndarray, "nuisance entry"]:
    each = 1j * path_channels(base.world, base.rays, sounding)
    each = np.repeat(each, base.mean.shape[1] // each.shape[1], axis=1)
    links, snapshots, paths = each.shape[:3]
    there = np.repeat(base.rays.mask[:, None], snapshots, axis=1)
    rows = np.zeros((links * snapshots, paths, links * snapshots, each[0, 0, 0].size), complex)
    packet = np.arange(links * snapshots)
    rows[packet, :, packet] = each.reshape(links * snapshots, paths, -1)
    return rows.reshape(links * snapshots * paths, -1)[there.reshape(-1)]
