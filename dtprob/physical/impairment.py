"""An impairment: a way in which reality departs from a clean ray-traced channel; size 0 is none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Complex, Float

from dtprob.errors import InputError
from dtprob.physical.channel import Sounding, synthesise
from dtprob.physical.noise import Noise
from dtprob.physical.rays import Rays
from dtprob.physical.tracing import trace
from dtprob.physical.world import World

type Channel = Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]
type OnWorld = Callable[[World, float], World]
type OnRays = Callable[[World, Rays, Sounding, float], Rays]
type Synthesis = Callable[[World, Rays, Sounding, float], Channel]
type OnChannel = Callable[[World, Channel, Sounding, float], Channel]
type OnNoise = Callable[[Noise, Channel, Sounding, float], Noise]
type Columns = Complex[np.ndarray, "block component entry"]
type Spread = Callable[[World, Rays, Sounding, float], Columns]


@dataclass(frozen=True)
class Impairment:
    """One departure from the clean channel; what is random in it was drawn when it was made.

    The stages act in the order of the attributes; those left None do nothing.

    Attributes:
        family: name of the physics.
        unit: SI unit of the size.
        limit: largest size that makes sense.
        instance: which object or antenna; None where there is only one.
        world: changes the world before it is traced.
        joins: joins paths to the traced ones, where the antennas stand at time zero.
        motion: moves the receivers while they measure.
        rays: changes the gains of all paths.
        synthesis: replaces the sum over paths.
        channel: changes the noiseless channel as antennas, radio-frequency parts and sampling do.
        noise: changes the law of the noise.
        spread: for a random change of the mean, what one standard deviation of each random component adds.
        detail: what was drawn, for the record.
    """

    family: str
    unit: str
    limit: float
    instance: str | None = None
    world: OnWorld | None = None
    joins: OnRays | None = None
    motion: OnRays | None = None
    rays: OnRays | None = None
    synthesis: Synthesis | None = None
    channel: OnChannel | None = None
    noise: OnNoise | None = None
    spread: Spread | None = None
    detail: Mapping[str, object] = field(default_factory=dict[str, object])

    @property
    def name(self) -> str:
        """`family` or `family[instance]`."""
        return self.family if self.instance is None else f"{self.family}[{self.instance}]"


@dataclass(frozen=True)
class Simulation:
    """What a campaign would measure, but for the draw of the noise."""

    world: World
    rays: Rays
    mean: Channel
    noise: Noise


class Tracer:
    """Traces worlds, and remembers the rays of those it has seen.

    Args:
        remember: how many.
    """

    def __init__(self, remember: int = 64) -> None:
        self._known: dict[str, Rays] = {}
        self._remember = remember

    def __call__(self, world: World) -> Rays:
        """The rays of a world."""
        key = world.trace_key()
        if key not in self._known:
            while len(self._known) >= self._remember:
                del self._known[next(iter(self._known))]
            self._known[key] = trace(world)
        return self._known[key]


def simulate(
    world: World,
    sounding: Sounding,
    noise: Noise,
    impairments: Sequence[tuple[Impairment, float]] = (),
    *,
    tracer: Callable[[World], Rays] = trace,
) -> Simulation:
    """Send a sounding through the world with impairments of given sizes.

    Args:
        world: the world without them.
        sounding: subcarriers and snapshots.
        noise: thermal noise.
        impairments: each with its size; at one stage they act in this order.
        tracer: makes the rays of a world.

    Raises:
        InputError: two impairments replace the sum over paths.
    """
    for one, size in impairments:
        world = one.world(world, size) if one.world else world
    rays = tracer(world)
    for one, size in impairments:
        rays = one.joins(world, rays, sounding, size) if one.joins else rays
    for one, size in impairments:
        rays = one.motion(world, rays, sounding, size) if one.motion else rays
    for one, size in impairments:
        rays = one.rays(world, rays, sounding, size) if one.rays else rays
    mean = _sum(world, rays, sounding, impairments)
    for one, size in impairments:
        mean = one.channel(world, mean, sounding, size) if one.channel else mean
    for one, size in impairments:
        noise = one.noise(noise, mean, sounding, size) if one.noise else noise
    return Simulation(world, rays, mean, noise)


def _sum(
    world: World, rays: Rays, sounding: Sounding, impairments: Sequence[tuple[Impairment, float]]
) -> Channel:
    special = [(one.synthesis, size) for one, size in impairments if one.synthesis]
    if len(special) > 1:
        names = ", ".join(one.name for one, _ in impairments if one.synthesis)
        raise InputError(
            "impairments", "at most one that replaces the sum over paths", names, "Leave one out"
        )
    return (
        special[0][0](world, rays, sounding, special[0][1]) if special else synthesise(world, rays, sounding)
    )


def measure(rng: np.random.Generator, simulation: Simulation, sounding: Sounding) -> Channel:
    """One noisy measurement."""
    return simulation.noise.measure(rng, simulation.mean, sounding)


def thermal(power: Float[np.ndarray, ""] | float) -> Noise:
    """White noise of one power everywhere."""
    return Noise(np.full((1, 1, 1, 1, 1), float(power)))
