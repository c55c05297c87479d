"""Small campaigns in a street: where antennas stand, what walls are made of, how strong the noise is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float

from dtprob.errors import InputError
from dtprob.physical.bench import Bench, Phase, prepare, varied
from dtprob.physical.channel import Sounding, mean_power, subcarriers, synthesise
from dtprob.physical.draws import Setting
from dtprob.physical.front_end import packet_phase
from dtprob.physical.impairment import Impairment, Tracer, thermal
from dtprob.physical.propagation import phase_error
from dtprob.physical.rays import Rays
from dtprob.physical.tracing import object_classes, scene_materials
from dtprob.physical.world import SPEED_OF_LIGHT, Material, World, planar_array, set_materials
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.trace import load_scene
from dtprob.raytracing.trace import trace as trace_twin

type ModelName = Literal["ray_traced_channel", "phase_error_channel"]

AGREE: Final = 1e-6
"""The twin's lengths and the truth's must agree this well, in m, for a link to be used."""


@dataclass(frozen=True)
class Plan:
    """What the campaigns of a set have in common; the defaults make cases that are quick to diagnose.

    Attributes:
        scene: a street with buildings on both sides, along x.
        frequency: carrier, Hz.
        street: lowest and highest x and y of the receivers, m.
        links: number of links, all from one transmitter.
        rx_shape: rows and columns of the receiving array, half a wavelength apart.
        tx_shape: likewise.
        subcarriers: number.
        bandwidth: Hz.
        snapshots: number.
        interval: time between them, s.
        snr_db: mean power of the channel over that of the noise.
        material_spread: standard deviation of log(permittivity - 1) about the scene's value; that of
            log(conductivity) is four times as large.
        noise_spread: standard deviation of the log of the recorded noise power about the true one.
        model: the twin's model.
        phase: what the twin knows of phases, for "ray_traced_channel".
        max_depth: largest number of reflections.
        rays: rays shot per transmitter to find the paths.
    """

    scene: str = "simple_street_canyon"
    frequency: float = 6e9
    street: tuple[float, float, float, float] = (-60.0, 60.0, -6.0, 7.0)
    links: int = 24
    rx_shape: tuple[int, int] = (2, 2)
    tx_shape: tuple[int, int] = (1, 2)
    subcarriers: int = 16
    bandwidth: float = 100e6
    snapshots: int = 2
    interval: float = 1e-3
    snr_db: float = 20.0
    material_spread: float = 0.05
    noise_spread: float = 0.05
    model: ModelName = "ray_traced_channel"
    phase: Literal["coherent", "per_packet"] = "coherent"
    max_depth: int = 3
    rays: int = 50_000

    @property
    def sounding(self) -> Sounding:
        """Subcarriers and snapshots."""
        times = self.interval * np.arange(self.snapshots)
        return Sounding(subcarriers(self.subcarriers, self.bandwidth), times)


@dataclass(frozen=True)
class Site:
    """One place where several cases are measured.

    Attributes:
        paths: what the twin traced.
        nominal: the world as the twin has it.
        setting: the true world and its paths.
        bench: the campaign measured, and what the twin can mimic.
        recorded_noise: the noise power that the data file tells, true up to `Plan.noise_spread`.
        concentration: of the phase errors; None without.
    """

    paths: PathSet
    nominal: World
    setting: Setting
    bench: Bench
    recorded_noise: float
    concentration: float | None


def make_site(rng: np.random.Generator, plan: Plan) -> Site:
    """Choose positions, true materials, noise and phase errors, and trace twin and truth."""
    tracer = Tracer()
    nominal, paths = place(rng, plan, tracer)
    scene = scene_materials(nominal)
    materials = {
        name: varied(material, *(plan.material_spread * np.array([1, 4]) * rng.standard_normal(2)).tolist())
        for name, material in scene.items()
    }
    world = set_materials(nominal, materials)
    rays = tracer(world)
    power = mean_power(synthesise(world, rays, plan.sounding)) / 10 ** (plan.snr_db / 10)
    always, concentration = _phases(rng, plan, rays)
    phase: Phase = "per_path" if plan.model == "phase_error_channel" else plan.phase
    classes = object_classes(nominal)
    met = {classes[name] for name in rays.objects if rays.meeting(name).any()}
    bench = prepare(
        world,
        plan.sounding,
        thermal(power),
        tracer,
        {name: material for name, material in materials.items() if name in met},
        phase=phase,
        always=always,
        concentration=concentration or 0.0,
    )
    recorded = power * float(np.exp(plan.noise_spread * rng.standard_normal()))
    setting = Setting(world, rays, plan.sounding, classes, materials)
    return Site(paths, nominal, setting, bench, recorded, concentration)


def _phases(
    rng: np.random.Generator, plan: Plan, rays: Rays
) -> tuple[tuple[tuple[Impairment, float], ...], float | None]:
    """The phases that the twin knows to be unknown."""
    shape = (len(rays.mask), plan.snapshots)
    if plan.model == "phase_error_channel":
        concentration = float(np.exp(rng.uniform(np.log(3), np.log(50))))
        angles = rng.vonmises(0.0, concentration, (*shape, rays.mask.shape[1]))
        return ((phase_error(angles), 1.0),), concentration
    if plan.phase == "per_packet":
        return ((packet_phase(rng.uniform(-np.pi, np.pi, shape)), 1.0),), None
    return (), None


def place(rng: np.random.Generator, plan: Plan, tracer: Tracer) -> tuple[World, PathSet]:
    """A transmitter and receivers in the street, whose paths twin and truth find alike.

    Raises:
        InputError: the street has too few places with three or more paths.
    """
    half = SPEED_OF_LIGHT / plan.frequency / 2
    west, east, south, north = plan.street
    for _ in range(20):
        tx = [rng.uniform(west / 2, east / 2), rng.uniform(south, north), rng.uniform(3, 10)]
        count = 3 * plan.links
        rx = np.stack(
            [rng.uniform(west, east, count), rng.uniform(south, north, count), np.full(count, 1.5)], -1
        )
        world = World(
            plan.scene,
            plan.frequency,
            np.tile(tx, (count, 1)),
            rx,
            planar_array(*plan.tx_shape, half),
            planar_array(*plan.rx_shape, half),
            max_depth=plan.max_depth,
            rays=plan.rays,
        )
        rays = tracer(world)
        far = np.linalg.norm(rx - np.asarray(tx), axis=1) > 5
        kept = np.flatnonzero(far & (rays.mask.sum(axis=1) >= 3))
        if len(kept) < plan.links:
            continue
        twin = trace_nominal(select(world, kept))
        agreed = _agreeing(rays.length[kept, 0], rays.mask[kept], twin)
        if agreed.sum() >= plan.links:
            chosen = np.flatnonzero(agreed)[: plan.links]
            return select(world, kept[chosen]), twin.take(chosen)
    raise InputError("street", f"{plan.links} places with paths", "fewer", "Give a larger street")


def select(world: World, links: np.ndarray) -> World:
    """The world with some of its links."""
    return dataclasses.replace(
        world, tx_position=world.tx_position[links], rx_position=world.rx_position[links]
    )


def trace_nominal(world: World) -> PathSet:
    """The twin's paths: the scene as its file has it, and of the world no more than positions."""
    scene = load_scene(world.scene, world.frequency, merge_shapes=False)
    return trace_twin(
        scene,
        world.tx_position,
        world.rx_position,
        max_depth=world.max_depth,
        frequency=world.frequency,
        samples=world.rays,
    )


def _agreeing(
    length: Float[np.ndarray, "link path"], mask: Bool[np.ndarray, "link path"], twin: PathSet
) -> Bool[np.ndarray, " link"]:
    """Links in which twin and truth have the same paths."""
    own = [np.sort(row[there]) for row, there in zip(length, mask, strict=True)]
    other = [
        np.sort(row[there]) for row, there in zip(np.asarray(twin.length), np.asarray(twin.mask), strict=True)
    ]
    return np.array(
        [len(a) == len(b) and np.allclose(a, b, atol=AGREE) for a, b in zip(own, other, strict=True)]
    )


def describe(materials: Mapping[str, Material]) -> dict[str, dict[str, float]]:
    """Materials as plain numbers, for the record."""
    return {
        name: {"permittivity": one.permittivity, "conductivity": one.conductivity}
        for name, one in sorted(materials.items())
    }
