"""Impairments as they may be met in a given campaign: what is random in each is drawn here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import unknown_name
from dtprob.physical import antennas, disturbances, front_end, placement, propagation
from dtprob.physical.channel import Sounding
from dtprob.physical.impairment import Impairment
from dtprob.physical.noise import circular
from dtprob.physical.rays import Rays
from dtprob.physical.waveform import symmetric_pilot
from dtprob.physical.world import Material, World


@dataclass(frozen=True)
class Setting:
    """What a draw may look at.

    Attributes:
        world: the world without the impairment.
        rays: its paths.
        sounding: subcarriers and snapshots.
        classes: for every object, the class of its material.
        materials: true materials by class.
    """

    world: World
    rays: Rays
    sounding: Sounding
    classes: Mapping[str, str]
    materials: Mapping[str, Material]

    @property
    def interval(self) -> float:
        """Time between the first two snapshots, s."""
        return float(self.sounding.snapshot_time[1] - self.sounding.snapshot_time[0])

    def objects(self, share: float = 0.003) -> list[str]:
        """Objects whose paths carry at least this share of the power."""
        power = np.abs(self.rays.gain[:, 0]) ** 2
        total = power.sum()
        return [name for name in self.rays.objects if (power * self.rays.meeting(name)).sum() > share * total]

    def walls(self) -> list[str]:
        """Such objects, without the ground."""
        return [name for name in self.objects() if name not in ("floor", "ground")]

    def mixed(self) -> list[str]:
        """Such objects whose class has other members that paths meet, so that they can differ from it."""
        seen = [self.classes[name] for name in self.objects()]
        return [name for name in self.objects() if seen.count(self.classes[name]) > 1]


type Draw = Callable[[np.random.Generator, Setting], Impairment | None]
"""Makes an impairment of a family; None where the campaign has no place for it."""


def draw(rng: np.random.Generator, family: str, setting: Setting) -> Impairment | None:
    """An impairment of a family, its random part drawn.

    Args:
        rng: source of randomness.
        family: a name in `FAMILIES`.
        setting: the campaign.

    Returns:
        The impairment, or None where the campaign has no place for it.

    Raises:
        InputError: no such family.
    """
    if family not in FAMILIES:
        raise unknown_name("family of impairments", family, FAMILIES, "family")
    return FAMILIES[family](rng, setting)


def _direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _receiver(rng: np.random.Generator, setting: Setting) -> Impairment:
    if rng.random() < 0.5:
        return placement.receiver_displacement(_direction(rng))
    return placement.receiver_scatter(rng.standard_normal((setting.world.n_link, 3)))


def _object(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    walls = setting.walls()
    if not walls:
        return None
    angle = rng.uniform(0, 2 * np.pi)
    return placement.object_displacement(str(rng.choice(walls)), (np.cos(angle), np.sin(angle), 0.0))


def _rotation(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    walls = setting.walls()
    return placement.object_rotation(str(rng.choice(walls))) if walls else None


def _material(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    mixed = setting.mixed()
    if not mixed:
        return None
    name, angle = str(rng.choice(mixed)), rng.uniform(0, 2 * np.pi)
    nominal = setting.materials[setting.classes[name]]
    return placement.material_mismatch(name, nominal, (float(np.cos(angle)), 2 * float(np.sin(angle))))


def _thickness(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    objects = setting.objects()
    if not objects:
        return None
    name = str(rng.choice(objects))
    return placement.thickness_mismatch(name, setting.materials[setting.classes[name]])


def _orientation(rng: np.random.Generator, _setting: Setting) -> Impairment:
    axis = _direction(rng)
    return placement.antenna_orientation((axis[0], axis[1], axis[2]))


def _phase_error(rng: np.random.Generator, setting: Setting) -> Impairment:
    world, count = setting.world, len(setting.sounding.snapshot_time)
    snapshots = count if rng.random() < 0.5 else 1
    return propagation.phase_error(rng.standard_normal((world.n_link, snapshots, setting.rays.mask.shape[1])))


def _over_time(draw: Callable[[np.random.Generator, Setting], Impairment]) -> Draw:
    """A draw of what shows from snapshot to snapshot; a campaign of a single one has no place for it."""
    return lambda rng, setting: draw(rng, setting) if len(setting.sounding.snapshot_time) > 1 else None


def _doppler(rng: np.random.Generator, setting: Setting) -> Impairment:
    limit = 0.4 * setting.world.wavelength / setting.interval
    return propagation.doppler(_direction(rng) * (1, 1, 0.1), limit)


def _missing(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    objects = setting.objects()
    return propagation.missing_path(str(rng.choice(objects))) if objects else None


def _blockage(rng: np.random.Generator, setting: Setting) -> Impairment:
    link = int(rng.integers(setting.world.n_link))
    away = setting.world.rx_position[link] - setting.world.tx_position[link]
    shortest = float(setting.rays.length[:, 0][setting.rays.mask].min())
    azimuth = float(np.arctan2(away[1], away[0]) + 0.05 * rng.standard_normal())
    return propagation.blockage(azimuth, float(rng.uniform(0.1, 0.4)) * shortest)


def _spot(rng: np.random.Generator, setting: Setting) -> Float[np.ndarray, "3"]:
    """A point among the receivers, not far from 1 m above them."""
    places = setting.world.rx_position
    return rng.uniform(places.min(axis=0), places.max(axis=0)) + np.array([0.0, 0.0, rng.uniform(0, 2)])


def _pedestrian(rng: np.random.Generator, setting: Setting) -> Impairment:
    speed = min(1.4, 0.2 * setting.world.wavelength / setting.interval)
    return propagation.pedestrian(_spot(rng, setting), speed * _direction(rng))


def _diffuse(rng: np.random.Generator, setting: Setting) -> Impairment:
    count, links = 24, setting.world.n_link
    offset = rng.uniform(3, 15, (links, count, 1)) * _unit(rng.standard_normal((links, count, 3)))
    offset[..., 2] = np.abs(offset[..., 2])
    excess = np.exp(-np.linalg.norm(offset, axis=-1) / 10)
    deviation = np.sqrt(excess / excess.sum(axis=1, keepdims=True))
    return propagation.diffuse_scattering(offset, deviation, circular(rng, (links, count)))


def _unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _calibration(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    count = len(setting.world.rx_array)
    draws = rng.standard_normal(count) * 0.5 + 1j * rng.standard_normal(count)
    return antennas.array_calibration(draws - draws.mean()) if count > 1 else None


def _with_array(made: Impairment) -> Draw:
    return lambda _rng, setting: made if len(setting.world.rx_array) > 1 else None


def _cable(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    count = len(setting.world.rx_array)
    return antennas.cable_delay(int(rng.integers(count))) if count > 2 else None


def _iq(rng: np.random.Generator, setting: Setting) -> Impairment:
    angle = rng.uniform(0, 2 * np.pi)
    pilot = symmetric_pilot(rng, len(setting.sounding.subcarrier_frequency))
    return front_end.iq_imbalance((float(np.cos(angle)), float(np.sin(angle))), pilot)


def _interference(rng: np.random.Generator, setting: Setting) -> Impairment:
    count, snapshots = len(setting.sounding.subcarrier_frequency), len(setting.sounding.snapshot_time)
    width = max(1, count // 8)
    first = int(rng.integers(count - width + 1))
    band = (np.arange(count) >= first) & (np.arange(count) < first + width)
    on = rng.random(snapshots) < 0.7
    on[int(rng.integers(snapshots))] = True
    return disturbances.interference(np.ones(setting.world.n_link, bool), on, band)


def _imbalance(rng: np.random.Generator, setting: Setting) -> Impairment | None:
    count = len(setting.world.rx_array)
    return disturbances.noise_imbalance(rng.standard_normal(count)) if count > 1 else None


def _walk(rng: np.random.Generator, setting: Setting) -> Float[np.ndarray, "link snapshot sample"]:
    sounding = setting.sounding
    shape = (setting.world.n_link, len(sounding.snapshot_time), len(sounding.subcarrier_frequency))
    return rng.standard_normal(shape)


FAMILIES: Final[dict[str, Draw]] = {
    "receiver_displacement": _receiver,
    "transmitter_displacement": lambda rng, _: placement.transmitter_displacement(_direction(rng)),
    "object_displacement": _object,
    "object_rotation": _rotation,
    "material_mismatch": _material,
    "thickness_mismatch": _thickness,
    "antenna_orientation": _orientation,
    "polarization_mismatch": lambda _rng, _: placement.polarization_mismatch(),
    "element_spacing": _with_array(placement.element_spacing()),
    "phase_error": _phase_error,
    "doppler": _over_time(_doppler),
    "missing_path": _missing,
    "blockage": _blockage,
    "extra_path": lambda rng, setting: propagation.extra_path(_spot(rng, setting)),
    "pedestrian": _over_time(_pedestrian),
    "dispersive_walls": lambda _rng, _: propagation.dispersive_walls(),
    "shadowing": lambda rng, setting: propagation.shadowing(rng.standard_normal(setting.world.n_link)),
    "diffuse_scattering": _diffuse,
    "atmospheric_attenuation": lambda _rng, _: propagation.atmospheric_attenuation(),
    "antenna_pattern": lambda _rng, _: propagation.antenna_pattern(),
    "near_field": _with_array(propagation.near_field()),
    "beam_squint": _with_array(propagation.beam_squint()),
    "array_calibration": _calibration,
    "mutual_coupling": _with_array(antennas.mutual_coupling()),
    "cable_delay": _cable,
    "timing_offset": lambda _rng, setting: front_end.timing_offset(1 / setting.sounding.bandwidth),
    "sampling_clock_offset": _over_time(
        lambda _rng, s: front_end.sampling_clock_offset(1 / s.sounding.bandwidth / s.interval)
    ),
    "carrier_frequency_offset": _over_time(
        lambda _rng, s: front_end.carrier_frequency_offset(0.4 / s.interval)
    ),
    "carrier_phase": lambda _rng, _: front_end.carrier_phase(),
    "iq_imbalance": _iq,
    "amplifier_nonlinearity": lambda rng, _: front_end.amplifier_nonlinearity(float(rng.uniform(1.0, 1.5))),
    "frequency_response": lambda rng, _: front_end.frequency_response(int(rng.integers(1, 4))),
    "frequency_ripple": lambda rng, setting: front_end.frequency_ripple(
        float(rng.uniform(1.5, 8)) / setting.sounding.bandwidth
    ),
    "crosstalk": lambda rng, _: front_end.crosstalk(
        float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0, 1e-9))
    ),
    "gain_offset": lambda _rng, _: front_end.gain_offset(),
    "gain_drift": _over_time(lambda _rng, setting: front_end.gain_drift(2 * setting.interval)),
    "phase_noise": lambda rng, setting: front_end.phase_noise(_walk(rng, setting), 1e5),
    "carrier_phase_drift": lambda rng, setting: front_end.carrier_phase_drift(_walk(rng, setting)),
    "quantization": lambda _rng, _: front_end.quantization(),
    "interference": _interference,
    "colored_noise": lambda rng, setting: disturbances.colored_noise(
        float(rng.uniform(-0.5, 0.5)) * setting.sounding.bandwidth
    ),
    "correlated_noise": lambda _rng, _: disturbances.correlated_noise(),
    "noise_imbalance": _imbalance,
    "heavy_tailed_noise": lambda rng, _: disturbances.heavy_tailed_noise(float(rng.uniform(0.01, 0.05))),
}
"""For each family of impairments, how one is drawn."""
