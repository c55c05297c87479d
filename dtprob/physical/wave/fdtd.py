"""Time steps of the field: E_z at nodes, H_x and H_y half way between them, times the impedance of space."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.constants import epsilon_0

from dtprob.physical.wave.absorber import Layer, layers
from dtprob.physical.wave.grid import ABSORBER, COURANT, Grid
from dtprob.physical.wave.scene import Raster

type Strip = Float[Array, "a b"]


class State(NamedTuple):
    """The field at one instant; single precision.

    Attributes:
        ez: V/m.
        hx, hy: times the impedance of free space, V/m.
        memory: of the absorbing layers, for the differences of E_z along y and x and of H_x along y and H_y
            along x.
    """

    ez: Float[Array, "nx ny"]
    hx: Float[Array, "nx ny-1"]
    hy: Float[Array, "nx-1 ny"]
    memory: tuple[Strip, Strip, Strip, Strip]


class Factors(NamedTuple):
    """What a step needs to know of the scene.

    Attributes:
        keep: factor of E_z, at all nodes but the outermost.
        gain: factor of the curl of H, likewise.
        gain_x: factor of the difference of E_z along y.
        gain_y: of that along x.
        electric: absorbing layers of differences of E_z.
        magnetic: of differences of H.
    """

    keep: Float[Array, "nx-2 ny-2"]
    gain: Float[Array, "nx-2 ny-2"]
    gain_x: Float[Array, "nx ny-1"]
    gain_y: Float[Array, "nx-1 ny"]
    electric: Layer
    magnetic: Layer


class Patches(NamedTuple):
    """Places between nodes: each is a weighted sum over 4 x 4 nodes.

    Attributes:
        corner: first node along x and y.
        weight: of the nodes.
    """

    corner: Int[Array, "place 2"]
    weight: Float[Array, "place 4 4"]


def factors(grid: Grid, raster: Raster, frequency: float) -> Factors:
    """The factors of a time step.

    Args:
        grid: nodes.
        raster: media at the nodes.
        frequency: of the source, Hz.
    """
    inner = (slice(1, -1), slice(1, -1))
    loss = raster.conductivity[inner] * grid.step / (2 * epsilon_0 * raster.permittivity[inner])
    there = ~raster.metal[inner]
    keep = np.where(there, (1 - loss) / (1 + loss), 0.0)
    gain = np.where(there, COURANT / raster.permittivity[inner] / (1 + loss), 0.0)
    values = Factors(
        jnp.asarray(keep),
        jnp.asarray(gain),
        jnp.asarray(COURANT / raster.permeability_x),
        jnp.asarray(COURANT / raster.permeability_y),
        *layers(grid, frequency),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), values)


def rest(grid: Grid) -> State:
    """No field at all."""
    nx, ny = grid.shape
    two = 2 * ABSORBER
    shapes = [(nx, ny), (nx, ny - 1), (nx - 1, ny), (nx, two), (two, ny), (nx - 2, two), (two, ny - 2)]
    ez, hx, hy, *memory = (jnp.zeros(shape, jnp.float32) for shape in shapes)
    return State(ez, hx, hy, (memory[0], memory[1], memory[2], memory[3]))


def patches(grid: Grid, position: Float[np.ndarray, "place 2"]) -> Patches:
    """Cubic Lagrange weights of positions inside the grid, at least two cells from its edge."""
    exact = (np.asarray(position, np.float64) - grid.origin) / grid.spacing
    nearest = np.round(exact)
    exact = np.where(np.abs(exact - nearest) < 1e-6, nearest, exact)
    corner = np.floor(exact).astype(np.int32) - 1
    t = (exact - corner)[..., None]
    nodes = np.arange(4.0)
    each = np.ones((*exact.shape, 4))
    for other in range(4):
        factor = (t - other) / np.where(nodes == other, 1.0, nodes - other)
        each *= np.where(nodes == other, 1.0, factor)
    weight = each[:, 0, :, None] * each[:, 1, None, :]
    return Patches(jnp.asarray(corner), jnp.asarray(weight, jnp.float32))


@partial(jax.jit, donate_argnums=0)
def advance(
    state: State, scene: Factors, source: Patches, probes: Patches, current: Float[Array, " step"]
) -> tuple[State, Float[Array, "step probe"]]:
    """Run some time steps; the state given is used up.

    Args:
        state: where to start.
        scene: factors of a step.
        source: one place.
        probes: any number of places.
        current: of the source at the middle of each step, times - eta0 / d, V/m.

    Returns:
        The state, and the field at the probes after each step.
    """

    def one(before: State, drive: Array) -> tuple[State, Array]:
        after = _electric(_magnetic(before, scene), scene, source, drive)
        return after, jax.vmap(_at, (None, 0, 0))(after.ez, probes.corner, probes.weight)

    return jax.lax.scan(one, state, current)


def _magnetic(state: State, scene: Factors) -> State:
    """Half a step: H from the differences of E_z, each averaged over its neighbours."""
    ez, hx, hy, memory = state
    along_y = _averaged(ez[:, 1:] - ez[:, :-1], 0)
    along_x = _averaged(ez[1:] - ez[:-1], 1)
    psi_y = _remember(memory[0], along_y, scene.electric, 1)
    psi_x = _remember(memory[1], along_x, scene.electric, 0)
    hx = _add_ends(hx - scene.gain_x * along_y, -_ends(scene.gain_x, 1) * psi_y, 1)
    hy = _add_ends(hy + scene.gain_y * along_x, _ends(scene.gain_y, 0) * psi_x, 0)
    return State(ez, hx, hy, (psi_y, psi_x, *memory[2:]))


def _electric(state: State, scene: Factors, source: Patches, drive: Array) -> State:
    """The other half: E_z from the curl of H and the source's current; the outermost nodes stay 0."""
    ez, hx, hy, memory = state
    along_y = hx[1:-1, 1:] - hx[1:-1, :-1]
    along_x = hy[1:, 1:-1] - hy[:-1, 1:-1]
    psi_y = _remember(memory[2], along_y, scene.magnetic, 1)
    psi_x = _remember(memory[3], along_x, scene.magnetic, 0)
    ez = ez.at[1:-1, 1:-1].set(scene.keep * ez[1:-1, 1:-1] + scene.gain * (along_x - along_y))
    low, high = jnp.split(-_ends(scene.gain, 1) * psi_y, 2, 1)
    ez = ez.at[1:-1, 1 : ABSORBER + 1].add(low).at[1:-1, -ABSORBER - 1 : -1].add(high)
    low, high = jnp.split(_ends(scene.gain, 0) * psi_x, 2, 0)
    ez = ez.at[1 : ABSORBER + 1, 1:-1].add(low).at[-ABSORBER - 1 : -1, 1:-1].add(high)
    start = source.corner[0, 0], source.corner[0, 1]
    there = jax.lax.dynamic_slice(ez, start, (4, 4))
    gain = jax.lax.dynamic_slice(scene.gain, (start[0] - 1, start[1] - 1), (4, 4))
    ez = jax.lax.dynamic_update_slice(ez, there + drive * gain * source.weight[0], start)
    return State(ez, hx, hy, (*memory[:2], psi_y, psi_x))


def _averaged(difference: Float[Array, "a b"], axis: int) -> Float[Array, "a b"]:
    """Over the two neighbours along an axis, weights 1/12, 10/12, 1/12; zero beyond the edge."""
    wide = jnp.pad(difference, [(1, 1) if axis == number else (0, 0) for number in range(2)])
    size = difference.shape[axis]
    before, after = (jax.lax.slice_in_dim(wide, at, at + size, axis=axis) for at in (0, 2))
    return difference * (5 / 6) + (before + after) * (1 / 12)


def _ends(value: Float[Array, "a b"], axis: int) -> Strip:
    """The first and the last cells along an axis."""
    size = value.shape[axis]
    first = jax.lax.slice_in_dim(value, 0, ABSORBER, axis=axis)
    return jnp.concatenate([first, jax.lax.slice_in_dim(value, size - ABSORBER, size, axis=axis)], axis)


def _remember(psi: Strip, difference: Float[Array, "a b"], layer: Layer, axis: int) -> Strip:
    decay, gain = (jnp.expand_dims(part, 1 - axis) for part in layer)
    return decay * psi + gain * _ends(difference, axis)


def _add_ends(value: Float[Array, "a b"], psi: Strip, axis: int) -> Float[Array, "a b"]:
    first, last = jnp.split(psi, 2, axis)
    if axis == 0:
        return value.at[:ABSORBER].add(first).at[-ABSORBER:].add(last)
    return value.at[:, :ABSORBER].add(first).at[:, -ABSORBER:].add(last)


def _at(ez: Float[Array, "nx ny"], corner: Int[Array, "2"], weight: Float[Array, "4 4"]) -> Array:
    return jnp.sum(jax.lax.dynamic_slice(ez, (corner[0], corner[1]), (4, 4)) * weight)
