"""Paths that reality has and the twin lacks: around edges, off small scatterers, and the diffuse rest.

They are added to the noiseless channel, so they get what a model lets all paths share: the sites
`frequency_response`, `path_phase` (that of the first path), and `receiver_gain` and `receiver_delay` where a
model has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.constants import speed_of_light

from dtprob.effects.common import (
    COMPLEX,
    DIRECTIONS,
    Band,
    Data,
    Family,
    Sites,
    band,
    chain,
    complex_of,
    half_normal,
    has_phase,
    meets,
    n_antenna,
    normal,
    offers,
    phasor,
    place,
    positions,
    touched_objects,
)
from dtprob.effects.effect import FIELD, Effect
from dtprob.raytracing.field import steering
from dtprob.raytracing.paths import NONE, PathSet

_NEEDS: Final = ("paths", "subcarrier_frequency", "path_phase", "frequency_response")
_TAPS: Final = 16
"""Taps of the diffuse tail at most."""
_STEP: Final = 2.0
"""Step in m between places of a scatterer where nothing tells delays apart."""
_MOST: Final = 600
"""Places of a scatterer in the plane, about."""
_HEIGHTS: Final = 3
"""Heights of a scatterer that are tried."""


def extra_path(sites: Sites, data: Data) -> list[Effect]:
    """Something scatters as a point to every link: an object in the scene, or what it lacks, wherever that stands."""
    if not _sums_paths(sites) or data.get("paths") is None:
        return []
    effects = [_over_any_point(data["paths"], band(data))]
    for index, name in touched_objects(data):
        paths: PathSet = data["paths"]
        centre = np.asarray(paths.vertex)[np.asarray(meets(paths, index))].mean(axis=0)

        def scatter(
            value: Any, p: Mapping[str, Any], context: Mapping[str, Any], centre: Any = centre
        ) -> Any:
            return value + complex_of(p["scattering"]) * _echo(context, centre)

        effects.append(
            Effect(
                "extra_path",
                {"noiseless_channel": scatter},
                (normal("scattering", 1.0, "m", 2, COMPLEX),),
                instance=name,
                physics=f"A point at {_text(centre)} on {name} scatters to all links; the size is the complex"
                " square root of its radar cross section (real, imaginary).",
                source="Bistatic radar equation: lambda sqrt(sigma) / ((4 pi)^(3/2) r1 r2).",
                requires=_NEEDS,
            )
        )
    return effects


def _over_any_point(paths: PathSet, measured: Band | None) -> Effect:
    """The path over a point that is looked for, with a gain of its own for each link: its phase is not told by metres."""
    low, high = _region(paths)
    step = _STEP if measured is None else speed_of_light / (2 * measured.width)
    step = max(step, float(np.sqrt(np.prod((high - low)[:2]) / _MOST)), 1e-3)
    tried = [low[i] + step * np.arange(int((high[i] - low[i]) / step) + 1) for i in range(2)]
    tried.append(np.linspace(low[2], high[2], _HEIGHTS) if high[2] - low[2] > step / 2 else low[2:])

    def scatter(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        point = jnp.stack([p[axis] for axis in DIRECTIONS])
        echo = _echo(context, point, carrier=False)
        return value + p["scale"] / jnp.sqrt(2.0) * complex_of(p[FIELD]) * echo

    middles, spreads = (low + high) / 2, np.maximum((high - low) / np.sqrt(12), step)
    return Effect(
        "extra_path",
        {"noiseless_channel": scatter},
        (
            half_normal("scale", 1.0, "m"),
            *(
                place(axis, values, "m", centre=float(middle), spread=float(spread))
                for axis, values, middle, spread in zip(DIRECTIONS, tried, middles, spreads, strict=True)
            ),
        ),
        instance="anywhere",
        kind="variance",
        physics="Something that the scene lacks scatters to all links, with a random complex gain for each; the size is the"
        " root of the mean radar cross section.",
        source="Bistatic radar equation: lambda sqrt(sigma) / ((4 pi)^(3/2) r1 r2); Swerling, fluctuating targets.",
        requires=_NEEDS,
        field_shape=lambda value, _: (value.shape[0], 1, 1, 1, 1, 2),
    )


def _region(paths: PathSet) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest corner of where links end and their paths are turned."""
    mask, kinds = np.asarray(paths.mask), np.asarray(paths.interaction)
    turned = np.asarray(paths.vertex)[mask[..., None] & (kinds != NONE)].reshape(-1, 3)
    points = np.concatenate([np.asarray(paths.tx_position), np.asarray(paths.rx_position), turned])
    return points.min(axis=0), points.max(axis=0)


def diffraction(sites: Sites, data: Data) -> list[Effect]:
    """Links that the twin calls obstructed get a wave bent around the obstacle."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not _sums_paths(sites) or not np.any(np.asarray(_obstructed(paths))):
        return []

    def bend(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths = context["paths"]
        direction, length = _leg(paths.tx_position, paths.rx_position)
        loss = jnp.where(_obstructed(paths), paths.wavelength / (4 * jnp.pi * length), 0.0)
        path = _path(context, direction, direction, length)
        return value + p["scale"] * loss[:, None, None, None, None] * complex_of(p[FIELD]) * path

    return [
        Effect(
            "diffraction",
            {"noiseless_channel": bend},
            (half_normal("scale", 0.2),),
            kind="variance",
            physics="A path near the obstructed line of sight, with a random complex gain per link relative"
            " to free space: the edge that bends it is not in the path set.",
            source="Shadow region of a knife edge, ITU-R P.526, sec. 4.1.",
            requires=_NEEDS,
            field_shape=lambda value, _: (value.shape[0], 1, 1, 1, 1, 2),
        )
    ]


def diffuse_scattering(sites: Sites, data: Data) -> list[Effect]:
    """A dense tail behind the first path, of many weak waves without direction."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not _sums_paths(sites):
        return []
    measured = band(data)
    taps = 1 if measured is None else min(_TAPS, measured.size)
    step = 0.0 if measured is None else 1.0 / measured.width
    decay = max(_delay_spread(paths), step, 1e-12)
    weight = np.exp(-step * np.arange(taps) / (2 * decay))
    weight = weight / np.linalg.norm(weight)

    def tail(near: str | None) -> Effect:
        def fill(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
            paths = context["paths"]
            first = jnp.min(jnp.where(paths.mask, paths.delay, jnp.inf), axis=1)
            first = jnp.where(jnp.isfinite(first), first, 0.0)
            delay = first[:, None] + step * jnp.arange(taps)
            tone = phasor(-2 * jnp.pi * delay[..., None] * jnp.asarray(context["subcarrier_frequency"]))
            waves = complex_of(p[FIELD])[:, :, :, :, 0] * jnp.asarray(weight)
            loss = jnp.sqrt(jnp.sum(_free_space(paths) ** 2, axis=1))[:, None, None, None, None]
            waves = waves * _towards(context, near)
            rest = jnp.einsum("lsrtm,lmk->lsrtk", waves, tone) / jnp.sqrt(2.0)
            return value + p["scale"] * loss * rest * _shared(context)

        def shape(value: Any, _: Any) -> tuple[int, ...]:
            receive = 1 if near == "transmitter" else value.shape[2]
            transmit = 1 if near == "receiver" else value.shape[3]
            return (value.shape[0], 1, receive, transmit, 1, taps, 2)

        where = "white over antennas" if near is None else f"off scatterers around the {near}"
        return Effect(
            "diffuse_scattering",
            {"noiseless_channel": fill},
            (half_normal("scale", 0.2),),
            instance=None if near is None else f"near_{near}",
            kind="variance",
            physics=f"Dense multipath from the first arrival on, exponential in delay, {where};"
            " its rms is the size times that of all paths in free space.",
            source="Richter, Estimation of Radio Channel Parameters, TU Ilmenau 2005, ch. 2.",
            requires=_NEEDS,
            field_shape=shape,
        )

    antennas = {"receiver": n_antenna(sites, "tx"), "transmitter": n_antenna(sites, "rx")}
    return [tail(None), *(tail(near) for near, count in antennas.items() if count > 1)]


def _towards(context: Mapping[str, Any], near: str | None) -> jax.Array:
    """Response, (link, 1, rx_antenna, tx_antenna, 1), of the array that sees scatterers at the other end as one point."""
    paths = context["paths"]
    direction, _ = _leg(paths.tx_position, paths.rx_position)
    if near == "receiver":
        return _response(context, "tx", direction, 1.0)[:, None, None, :, None]
    if near == "transmitter":
        return _response(context, "rx", direction, -1.0)[:, None, :, None, None]
    return jnp.ones((1, 1, 1, 1, 1))


def _sums_paths(sites: Sites) -> bool:
    return has_phase(sites) and offers(sites, "path_phase", "frequency_response")


def _echo(
    context: Mapping[str, Any], point: Any, *, carrier: bool = True
) -> Complex[Array, "link 1 rx_antenna tx_antenna subcarrier"]:
    """What a point of radar cross section 1 m^2 scatters to each link; see `_path`."""
    paths = context["paths"]
    first, second = _leg(paths.tx_position, point), _leg(point, paths.rx_position)
    loss = paths.wavelength / ((4 * jnp.pi) ** 1.5 * first[1] * second[1])
    path = _path(context, first[0], second[0], first[1] + second[1], carrier=carrier)
    return loss[:, None, None, None, None] * path


def _path(
    context: Mapping[str, Any],
    departure: Float[Array, "link 3"],
    arrival: Float[Array, "link 3"],
    length: Float[Array, " link"],
    *,
    carrier: bool = True,
) -> Complex[Array, "link 1 rx_antenna tx_antenna subcarrier"]:
    """One path per link of unit gain, given by its directions of travel and its length in m.

    Without the carrier its phase is that of the middle of the band: a random phase of each link takes up what turns with
    every wavelength.
    """
    tones = jnp.asarray(context["subcarrier_frequency"]) / speed_of_light
    tones = tones + 1.0 / context["paths"].wavelength if carrier else tones
    tone = phasor(-2 * jnp.pi * length[:, None] * tones)
    rx = _response(context, "rx", arrival, -1.0)
    tx = _response(context, "tx", departure, 1.0)
    return jnp.einsum("lr,lt,lk->lrtk", rx, tx, tone)[:, None] * _shared(context)


def _shared(context: Mapping[str, Any]) -> Complex[Array, "*link_snapshot_rx_tx_subcarrier"]:
    """What all paths share on their way into the measurement, broadcastable to the channel."""
    return phasor(context["path_phase"][:, :, :1, None, None]) * chain(context)


def _response(
    context: Mapping[str, Any], side: str, direction: Float[Array, "link 3"], sign: float
) -> Complex[Array, "link antenna"]:
    return steering(positions(context, side), direction[:, None], context["paths"].frequency, sign)[:, 0]


def _leg(start: Any, stop: Any) -> tuple[jax.Array, jax.Array]:
    """Unit vector and distance in m from one point to another, per link."""
    step = jnp.asarray(stop) - jnp.asarray(start)
    length = jnp.maximum(jnp.linalg.norm(step, axis=-1), 1e-3)
    return step / length[:, None], length


def _obstructed(paths: PathSet) -> jax.Array:
    """Links without an existing path of order 0."""
    direct = jnp.all(jnp.asarray(paths.interaction) == NONE, axis=-1) & paths.mask & ~paths.is_untold
    return ~jnp.any(direct, axis=-1)


def _free_space(paths: PathSet) -> jax.Array:
    """Free-space gain lambda / (4 pi L) of every path, 0 where there is none."""
    return jnp.where(
        paths.mask, paths.wavelength / (4 * jnp.pi * jnp.where(paths.mask, paths.length, 1.0)), 0.0
    )


def _delay_spread(paths: PathSet) -> float:
    """Rms delay in s of all paths after the first of their link, each weighed by its free-space power."""
    mask, delay = np.asarray(paths.mask), np.asarray(paths.delay)
    first = np.min(np.where(mask, delay, np.inf), axis=1, keepdims=True)
    power = np.asarray(_free_space(paths)) ** 2
    excess = np.where(mask, delay - np.where(np.isfinite(first), first, 0.0), 0.0)
    return float(np.sqrt(np.sum(power * excess**2) / max(float(np.sum(power)), 1e-300)))


def _text(point: np.ndarray) -> str:
    return "(" + " ".join(f"{x:.1f}" for x in point) + ") m"


FAMILIES: Final[dict[str, Family]] = {
    "extra_path": extra_path,
    "diffraction": diffraction,
    "diffuse_scattering": diffuse_scattering,
}
