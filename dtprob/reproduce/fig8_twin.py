"""The twin of figure 8: rays by the image method, calibrated with the rival schemes, and what it predicts."""

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from dtprob.raytracing.calibration import Calibration
from dtprob.raytracing.calibration.phases import resultant
from dtprob.raytracing.field import frequency_response, path_gain
from dtprob.raytracing.geometry import Geometry, unfold
from dtprob.raytracing.paths import NONE, SPECULAR, PathSet, validate
from dtprob.reproduce.fig8_scene import BLOCKER, CARRIER, LOWER, RX, THICKNESS, TX, UPPER, WAVELENGTH

MAX_DEPTH: Final = 3
SHIFT: Final = -0.25 * WAVELENGTH
"""Of the twin's lower wall, m."""
_UP: Final = (0.0, 1.0, 0.0)
_PADDING: Final = 4


class Materials(NamedTuple):
    """Of both walls.

    Attributes:
        permittivity: relative.
        conductivity: S/m.
    """

    permittivity: float
    conductivity: float


def trace_scene(materials: Materials, shift: float = SHIFT) -> PathSet:
    """The paths to the three receivers: direct and by way of the walls, but for those that the blocker cuts.

    The fields of the elements carry the spreading of a cylinder: gains are lambda / (4 pi sqrt(L)).

    Args:
        materials: that the twin starts from.
        shift: of the lower wall, m.
    """
    walls = np.array([UPPER, LOWER + shift])
    orders = [order for depth in range(MAX_DEPTH + 1) for order in itertools.product((0, 1), repeat=depth)]
    orders = [order for order in orders if all(a != b for a, b in itertools.pairwise(order))]
    interaction, index = _tables(orders)
    point = np.zeros((*index.shape, 3))
    point[..., 1] = walls[index]
    links = [_unfolded(place, interaction, point) for place in RX]
    open_ = [_is_open(place, geometry) for place, geometry in zip(RX, links, strict=True)]
    whole = Geometry(*(np.stack(parts) for parts in zip(*links, strict=True)))
    return _path_set(whole, np.stack(open_), (interaction, index), materials)


def expected_profile(
    paths: PathSet,
    found: Calibration,
    subcarrier_frequency: Float[np.ndarray, " subcarrier"],
    link: int,
) -> tuple[Float[np.ndarray, " delay"], Float[np.ndarray, " delay"]]:
    """Delays in s and the power-delay profile that a calibrated twin expects for a link.

    It is the mean over phase errors of the concentration that the scheme found or assumes: the power of the sum of
    the paths' means, and for each path what its phase error takes out of its mean.

    Args:
        paths: of the twin.
        found: its calibration.
        subcarrier_frequency: Hz from the carrier.
        link: which.
    """
    gain = path_gain(paths, found.permittivity, found.conductivity)[link]
    each = np.asarray(gain[:, None] * frequency_response(paths, jnp.asarray(subcarrier_frequency))[link])
    concentration = float(found.concentration)
    kept = 1.0 if np.isinf(concentration) else float(resultant(jnp.asarray(concentration)))
    delay, mean = profile(kept * each.sum(axis=0), subcarrier_frequency)
    return delay, mean + (1 - kept**2) * sum(profile(path, subcarrier_frequency)[1] for path in each)


def profile(
    channel: Complex[np.ndarray, " subcarrier"], subcarrier_frequency: Float[np.ndarray, " subcarrier"]
) -> tuple[Float[np.ndarray, " delay"], Float[np.ndarray, " delay"]]:
    """Delays in s and power-delay profile of a channel: Hann window, four delays per resolved one."""
    count = len(subcarrier_frequency)
    window = np.hanning(count + 2)[1:-1]
    spacing = subcarrier_frequency[1] - subcarrier_frequency[0]
    taps = np.fft.ifft(window * channel, _PADDING * count)
    return np.arange(_PADDING * count) / (_PADDING * count * spacing), np.abs(taps) ** 2


def ray_channel(
    paths: PathSet, subcarrier_frequency: Float[np.ndarray, " subcarrier"]
) -> Complex[np.ndarray, "link subcarrier"]:
    """The channel of the paths with the materials that they have, all phases as traced."""
    gain = path_gain(paths, paths.permittivity, paths.conductivity)
    response = frequency_response(paths, jnp.asarray(subcarrier_frequency))
    return np.asarray(jnp.einsum("lp,lpk->lk", gain, response))


def _tables(
    orders: Sequence[tuple[int, ...]],
) -> tuple[Int[np.ndarray, "path depth"], Int[np.ndarray, "path depth"]]:
    """Interactions and walls of each path, filled up to the largest depth."""
    interaction = np.full((len(orders), MAX_DEPTH), NONE)
    index = np.zeros_like(interaction)
    for row, order in enumerate(orders):
        interaction[row, : len(order)] = SPECULAR
        index[row, : len(order)] = order
    return interaction, index


def _unfolded(
    place: tuple[float, float],
    interaction: Int[np.ndarray, "path depth"],
    point: Float[np.ndarray, "path depth 3"],
) -> Geometry:
    count = len(interaction)
    tx, rx = (np.tile((*end, 0.0), (count, 1)) for end in (TX, place))
    return unfold(tx, rx, interaction, np.broadcast_to(_UP, point.shape), point)


def _is_open(place: tuple[float, float], geometry: Geometry) -> np.ndarray:
    """Which paths pass the blocker: no straight piece of them crosses it."""
    count = len(geometry.length)
    ends = [np.tile((*end, 0.0), (count, 1, 1)) for end in (TX, place)]
    corners = np.concatenate([ends[0], geometry.vertex, ends[1]], axis=1)[..., :2]
    start, step = corners[:, :-1], np.diff(corners, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = np.sort(np.stack([(np.asarray(c) - start) / step for c in BLOCKER]), axis=0)
    cuts = np.nan_to_num(cuts, nan=-np.inf)
    enters, leaves = cuts[0].max(axis=-1), cuts[1].min(axis=-1)
    return ~np.any((enters < leaves) & (leaves > 0) & (enters < 1), axis=1)


def _path_set(
    geometry: Geometry,
    mask: np.ndarray,
    tables: tuple[Int[np.ndarray, "path depth"], Int[np.ndarray, "path depth"]],
    materials: Materials,
) -> PathSet:
    links = len(RX)
    delay = geometry.length / (WAVELENGTH * CARRIER)
    upright = np.broadcast_to((0.0, 0.0, 1.0), geometry.departure.shape)

    def per_link(table: np.ndarray) -> Array:
        return jnp.asarray(np.tile(table, (links, 1, 1)))

    def three(places: Sequence[tuple[float, float]]) -> Array:
        return jnp.asarray([(*place, 0.0) for place in places])

    return validate(
        PathSet(
            delay=jnp.asarray(delay),
            carrier_phasor=jnp.asarray(np.exp(-2j * np.pi * np.mod(CARRIER * delay, 1.0))),
            departure=jnp.asarray(geometry.departure),
            arrival=jnp.asarray(geometry.arrival),
            mask=jnp.asarray(mask),
            interaction=per_link(tables[0]),
            object=per_link(tables[1]),
            vertex=jnp.asarray(geometry.vertex),
            normal=jnp.broadcast_to(jnp.asarray(_UP), geometry.vertex.shape),
            length=jnp.asarray(geometry.length),
            tx_field=jnp.asarray(upright * np.sqrt(geometry.length)[..., None]),
            rx_field=jnp.asarray(upright),
            rx_position=three(RX),
            tx_position=three([TX] * links),
            object_material=jnp.zeros(2, jnp.int32),
            permittivity=jnp.full(2, materials.permittivity),
            conductivity=jnp.full(2, materials.conductivity),
            thickness=jnp.full(2, THICKNESS),
            frequency=CARRIER,
            object_names=("upper_wall", "lower_wall"),
            material_names=("concrete",),
        )
    )
