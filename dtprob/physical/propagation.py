"""Impairments of propagation: what happens between the antennas and a specular tracer leaves out."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Complex, Float
from scipy.special import fresnel

from dtprob.physical.channel import Sounding, path_channels, synthesise, synthesise_wide
from dtprob.physical.impairment import Channel, Columns, Impairment
from dtprob.physical.rays import Rays, join
from dtprob.physical.world import World, rotation


def phase_error(draw: Float[np.ndarray, "link instant path"], limit: float = 1.0) -> Impairment:
    """Every path is turned by size times a standard normal draw; size in rad.

    Args:
        draw: standard normal, one per link, snapshot (or 1, where errors last) and path; at least as many
            paths as the world has. Paths that other impairments join to these keep their phases.
        limit: of the size.
    """

    def turn(_world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        joined = max(0, rays.mask.shape[1] - draw.shape[2])
        errors = np.pad(draw, ((0, 0), (0, 0), (0, joined)))
        return rays.scaled(np.exp(1j * size * errors[..., : rays.mask.shape[1]]))

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        each = 1j * size * path_channels(world, rays, sounding)
        count = len(sounding.snapshot_time)
        if draw.shape[1] == 1:
            return np.tile(each.reshape(*each.shape[:3], -1)[:, 0], (1, 1, count))
        each = np.repeat(each, count, axis=1) if each.shape[1] == 1 else each
        return each.reshape(-1, each.shape[2], int(np.prod(each.shape[3:])))

    instance = None if draw.shape[1] == 1 else "each_packet"
    return Impairment("phase_error", "rad", limit, instance=instance, rays=turn, spread=spread)


def doppler(velocity: Float[np.ndarray, "3"], limit: float = 100.0) -> Impairment:
    """The receivers drive at size times a direction, in m/s; lengths are computed anew at every snapshot."""

    def drive(_world: World, rays: Rays, sounding: Sounding, size: float) -> Rays:
        return rays.shifted(size * velocity * sounding.snapshot_time[None, :, None])

    return Impairment("doppler", "m/s", limit, motion=drive, detail={"direction": velocity.tolist()})


def blockage(azimuth: float, distance: float, limit: float = 10.0) -> Impairment:
    """An opaque upright strip stands near the transmitter; size is its width in m.

    The field behind it follows from Fresnel's integrals and Babinet's principle, as for two knife edges; the parameter of
    each is twice the root of its detour in wavelengths. Source: ITU-R P.526-15, section 4.

    Args:
        azimuth: where its centre stands as seen from the transmitter, rad.
        distance: from the transmitter, m; shorter than every path.
        limit: of the width.
    """
    towards = np.array([np.cos(azimuth), np.sin(azimuth)])
    across = np.array([-towards[1], towards[0]])

    def shade(world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        receiver, length = rays.unfolded[..., :2], rays.length
        edges = (_edge(distance * towards + side * size / 2 * across, rays) for side in (-1, 1))
        first, last = (_fresnel(2 * side * np.sqrt(detour / world.wavelength)) for side, detour in edges)
        ahead = (receiver @ towards > 0) & (length > distance)
        return rays.scaled(np.where(ahead, 1 - (1 + 1j) / 2 * (last - first), 1.0))

    detail = {"azimuth": azimuth, "distance": distance}
    return Impairment("blockage", "m", limit, rays=shade, detail=detail)


def _edge(
    edge: Float[np.ndarray, "2"], rays: Rays
) -> tuple[Float[np.ndarray, "link instant path"], Float[np.ndarray, "link instant path"]]:
    """On which side of each ray an upright edge stands, -1 or 1, and how much longer the way past it is, m."""
    receiver = rays.unfolded[..., :2]
    side = np.sign(receiver[..., 0] * edge[1] - receiver[..., 1] * edge[0])
    level = np.hypot(*edge) + np.linalg.norm(receiver - edge, axis=-1)
    return side, np.maximum(np.hypot(level, rays.unfolded[..., 2]) - rays.length, 0.0)


def _fresnel(v: Float[np.ndarray, "*n"]) -> Complex[np.ndarray, "*n"]:
    """Integral of exp(-j pi t^2 / 2) from 0 to v."""
    sine, cosine = fresnel(v)
    return cosine - 1j * sine


def missing_path(name: str, limit: float = 8.0) -> Impairment:
    """Leaves hang before an object and weaken the paths that meet it; size is their depth in Np."""

    def weaken(_world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        return rays.scaled(np.where(rays.meeting(name), np.exp(-size), 1.0)[:, None])

    return Impairment("missing_path", "Np", limit, instance=name, rays=weaken)


def extra_path(scatterer: Float[np.ndarray, "3"], limit: float = 100.0) -> Impairment:
    """A pole or a parked car that the scene lacks reflects to every receiver.

    Size is the root of its cross-section in m. Radar equation for amplitudes,
    a = lambda sqrt(rcs) / ((4 pi)^(3/2) d1 d2).
    """
    return Impairment(
        "extra_path",
        "m",
        limit,
        joins=lambda world, rays, _sounding, size: _scattered(world, rays, scatterer, size),
        detail={"position": scatterer.tolist()},
    )


def _scattered(world: World, rays: Rays, scatterer: Float[np.ndarray, "3"], size: float) -> Rays:
    """The rays with a path of each link over a scatterer."""
    tx, rx = world.tx_position, world.rx_position
    out = np.linalg.norm(scatterer - tx, axis=-1)
    back = np.linalg.norm(rx - scatterer, axis=-1)
    gain = size * world.wavelength / ((4 * np.pi) ** 1.5 * out * back)
    via = np.broadcast_to(scatterer, (world.n_link, 1, 3))
    return join(rays, gain[:, None].astype(complex), via, tx, rx)


def diffuse_scattering(
    offset: Float[np.ndarray, "link scatterer 3"],
    deviation: Float[np.ndarray, "link scatterer"],
    draw: Complex[np.ndarray, "link scatterer"],
    limit: float = 3.0,
) -> Impairment:
    """Many weak scatterers around every receiver; size is their amplitude over that of the traced paths.

    Args:
        offset: of the scatterers from the receiver, m.
        deviation: of their amplitudes; the squares over the scatterers of a link add up to 1.
        draw: circular normal, of unit power.
        limit: of the size.
    """

    def joined(world: World, rays: Rays, amplitude: Complex[np.ndarray, "link scatterer"]) -> Rays:
        tx, rx = world.tx_position, world.rx_position
        level = np.sqrt(np.mean(np.sum(np.abs(rays.gain[:, 0]) ** 2, axis=-1)))
        return join(rays, level * amplitude, rx[:, None] + offset, tx, rx)

    def scatter(world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        return joined(world, rays, size * deviation * draw)

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        first = dataclasses.replace(rays, gain=rays.gain[:, :1], unfolded=rays.unfolded[:, :1])
        tail = joined(world, first, (size / np.sqrt(2) * deviation).astype(complex))
        each = path_channels(world, tail, sounding)[:, 0, rays.mask.shape[1] :]
        flat = np.tile(each.reshape(*each.shape[:2], -1), (1, 1, len(sounding.snapshot_time)))
        return np.concatenate([flat, 1j * flat], axis=1)

    return Impairment("diffuse_scattering", "1", limit, "near_receiver", joins=scatter, spread=spread)


def atmospheric_attenuation(limit: float = 0.5) -> Impairment:
    """Rain or gas weakens waves along their way; size in Np/m."""

    def weaken(_world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        return rays.scaled(np.exp(-size * rays.length))

    return Impairment("atmospheric_attenuation", "Np/m", limit, rays=weaken)


def antenna_pattern(limit: float = 8.0) -> Impairment:
    """The receiving elements are not isotropic: their field is sin(angle to their axis) to the power size."""

    def weigh(world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        yaw, pitch, roll = world.rx_turn
        axis = rotation((yaw, pitch, roll + world.rx_slant))[:, 2]
        sine = np.sqrt(np.clip(1 - (rays.arrival @ axis) ** 2, 1e-12, None))
        return rays.scaled((sine**size)[:, None])

    return Impairment("antenna_pattern", "1", limit, rays=weigh)


def shadowing(draw: Float[np.ndarray, " link"], limit: float = 2.0) -> Impairment:
    """Every link is weaker or stronger as a whole, exp(size * draw); size in Np.

    Args:
        draw: standard normal.
        limit: of the size.
    """

    def weigh(_world: World, rays: Rays, _sounding: Sounding, size: float) -> Rays:
        return rays.scaled(np.exp(size * draw)[:, None, None])

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        return size * synthesise(world, rays, sounding).reshape(len(draw), 1, -1)

    return Impairment("shadowing", "Np", limit, rays=weigh, spread=spread)


def pedestrian(
    start: Float[np.ndarray, "3"], velocity: Float[np.ndarray, "3"], limit: float = 100.0
) -> Impairment:
    """Somebody walks through the scene and scatters; size is the root of the cross-section in m.

    Args:
        start: where, at time zero, m.
        velocity: m/s.
        limit: of the size.
    """

    def walk(world: World, rays: Rays, sounding: Sounding, size: float) -> Rays:
        each = [_scattered(world, rays, start + velocity * time, size) for time in sounding.snapshot_time]
        gain, unfolded = (
            np.stack([part[:, min(index, part.shape[1] - 1)] for index, part in enumerate(parts)], axis=1)
            for parts in ([one.gain for one in each], [one.unfolded for one in each])
        )
        return dataclasses.replace(each[0], gain=gain, unfolded=unfolded)

    detail = {"position": start.tolist(), "velocity": velocity.tolist()}
    return Impairment("pedestrian", "m", limit, joins=walk, detail=detail)


def dispersive_walls(limit: float = 2.0) -> Impairment:
    """Reflections weaken across the band: a path loses size * f / B nepers per object that it meets."""

    def disperse(world: World, rays: Rays, sounding: Sounding, size: float) -> Channel:
        tilt = size * rays.meets.sum(axis=-1)[..., None] * sounding.subcarrier_frequency / sounding.bandwidth
        each = path_channels(world, rays, sounding) * np.exp(-tilt)[:, None, :, None, None]
        total = each.sum(axis=2)
        return np.repeat(total, len(sounding.snapshot_time) // total.shape[1], axis=1)

    return Impairment("dispersive_walls", "Np", limit, synthesis=disperse)


def near_field(limit: float = 1000.0) -> Impairment:
    """Wave fronts at the arrays are spheres and not planes; size 1 is what they are, more exaggerates it."""
    return Impairment(
        "near_field",
        "1",
        limit,
        synthesis=lambda world, rays, sounding, size: synthesise_wide(world, rays, sounding, size, 0.0),
    )


def beam_squint(limit: float = 1000.0) -> Impairment:
    """Array phases follow the frequency of each subcarrier; size 1 is what they do, more exaggerates it."""
    return Impairment(
        "beam_squint",
        "1",
        limit,
        synthesis=lambda world, rays, sounding, size: synthesise_wide(world, rays, sounding, 0.0, size),
    )
