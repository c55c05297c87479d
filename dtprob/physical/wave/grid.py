"""The grid of a wave simulation and what it does to waves, in closed form.

The scheme is Yee's with the difference across each line averaged over its neighbours (weights 1/12, 10/12,
1/12), so that waves are equally slow in all directions up to fourth order in the cell. On the grid a plane
wave of angular frequency w and wavenumber k along the angle phi obeys

    [2 sin(w dt / 2) / (c dt)]^2 = (4 / d^2) (p + q - 2 p q / 3),
    p = sin^2(k d cos(phi) / 2), q = sin^2(k d sin(phi) / 2),

which gives, for each frequency, the one at which the grid's waves have the right length. Source of the two
ideas: J. B. Cole, A high-accuracy realization of the Yee algorithm using non-standard finite differences,
IEEE Trans. Microw. Theory Tech. 45 (1997); A. Taflove and S. Hagness, Computational Electrodynamics (2005),
chapter 4 (dispersion).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.constants import epsilon_0

from dtprob.physical.wave.scene import Acting, Medium, Scene2D
from dtprob.physical.world import SPEED_OF_LIGHT

COURANT: Final = 0.8
"""c dt / d; the scheme is stable up to sqrt(3) / 2."""
ABSORBER: Final = 20
"""Cells of the absorbing layer on every side."""


class Grid(NamedTuple):
    """Nodes of the electric field, the absorbing layers included.

    Attributes:
        spacing: d, m.
        origin: x and y of the first node, m.
        shape: nodes along x and y.
    """

    spacing: float
    origin: tuple[float, float]
    shape: tuple[int, int]

    @property
    def step(self) -> float:
        """Time step, s."""
        return COURANT * self.spacing / SPEED_OF_LIGHT

    @property
    def x(self) -> Float[np.ndarray, " nx"]:
        """Of the nodes, m."""
        return self.origin[0] + self.spacing * np.arange(self.shape[0])

    @property
    def y(self) -> Float[np.ndarray, " ny"]:
        """Of the nodes, m."""
        return self.origin[1] + self.spacing * np.arange(self.shape[1])


def make_grid(scene: Scene2D, spacing: float) -> Grid:
    """The smallest grid that covers a scene, with a node at its lower corner and an absorbing layer around."""
    inner = [
        int(np.ceil((high - low) / spacing - 1e-6)) + 1
        for low, high in zip(scene.lower, scene.upper, strict=True)
    ]
    origin = (scene.lower[0] - ABSORBER * spacing, scene.lower[1] - ABSORBER * spacing)
    return Grid(spacing, origin, (inner[0] + 2 * ABSORBER, inner[1] + 2 * ABSORBER))


def grid_frequency(grid: Grid, frequency: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The frequency at which waves on the grid are as long as those of a frequency in free space, Hz.

    The mean over directions; along an axis and along a diagonal the wavenumber is wrong by at most
    3.6e-4 (k d)^4.

    Args:
        grid: whose spacing and time step.
        frequency: Hz.
    """
    wavenumber = 2 * np.pi * np.asarray(frequency) / SPEED_OF_LIGHT
    return np.arcsin(SPEED_OF_LIGHT * grid.step / 2 * np.sqrt(_mean_symbol(grid, wavenumber))) / (
        np.pi * grid.step
    )


def grid_wavenumber(
    grid: Grid, frequency: Float[np.ndarray, "*#n"], angle: Float[np.ndarray, "*#n"]
) -> Float[np.ndarray, "*#n"]:
    """Wavenumber of a plane wave of a frequency that crosses the grid, rad/m, by Newton's method.

    Args:
        grid: whose spacing and time step.
        frequency: Hz, as the time steps see it.
        angle: direction of travel from the x-axis, rad.
    """
    right = (2 * np.sin(np.pi * np.asarray(frequency) * grid.step) / (SPEED_OF_LIGHT * grid.step)) ** 2
    k = np.sqrt(right) + 0 * np.asarray(angle)
    for _ in range(8):
        value, slope = _symbol(grid, k, angle)
        k = k - (value - right) / slope
    return k


def source_gain(grid: Grid, frequency: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Amplitude of the field of a line source on the grid over that in free space.

    It is 2 k / D'(k) with D the right side of the dispersion relation, since the residue at the pole of
    1 / (D(k) - w^2 / c^2) stands for the source.

    Args:
        grid: whose spacing and time step.
        frequency: of the wave in free space, Hz.
    """
    k = 2 * np.pi * np.asarray(frequency) / SPEED_OF_LIGHT
    slope = np.mean([_symbol(grid, k, angle)[1] for angle in (0.0, np.pi / 4)], axis=0)
    return 2 * k / slope


def acting(grid: Grid, frequency: float, medium: Medium) -> Acting:
    """The medium that time steps need so that waves in another one, and their reflections, come out right.

    With k the wavenumber in the medium and k0 that in air, it has permeability m(k) / m(k0), m(k) = sin(k d) / (k d),
    so that a surface along the grid reflects as it should up to fourth order in k d at all angles (on the grid the
    admittance of a wave is in proportion to sin(k d)), and the permittivity with which waves are as long as they
    should be. Both are right at one frequency and nearly so around it.

    Args:
        grid: whose spacing and time step.
        frequency: Hz.
        medium: no metal.
    """
    k0 = 2 * np.pi * frequency / SPEED_OF_LIGHT
    index = np.sqrt(medium.permittivity - 1j * medium.conductivity / (2 * np.pi * frequency * epsilon_0))
    k, turn = index * k0, np.pi * float(grid_frequency(grid, np.asarray(frequency))) * grid.step
    permeability = float(np.real(_sinc(k * grid.spacing) / _sinc(k0 * grid.spacing)))
    permittivity = _mean_symbol(grid, k) / (permeability * _mean_symbol(grid, k0))
    rate = 2 * np.sin(turn) / grid.step
    conductivity = -permittivity.imag * rate * epsilon_0 / np.cos(turn)
    return Acting(float(permittivity.real), float(conductivity), permeability)


def _sinc(turns: complex) -> complex:
    return np.sin(turns) / turns


def _mean_symbol(grid: Grid, wavenumber: Any) -> Any:
    """The right side of the dispersion relation, between an axis and a diagonal; also of complex wavenumbers."""
    return np.mean([_symbol(grid, wavenumber, angle)[0] for angle in (0.0, np.pi / 4)], axis=0)


def _symbol(grid: Grid, wavenumber: Any, angle: Float[np.ndarray, "*#n"] | float) -> tuple[Any, Any]:
    """The right side of the dispersion relation and its derivative in the wavenumber."""
    half_x, half_y = grid.spacing / 2 * np.cos(angle), grid.spacing / 2 * np.sin(angle)
    p, q = np.sin(half_x * wavenumber) ** 2, np.sin(half_y * wavenumber) ** 2
    dp, dq = half_x * np.sin(2 * half_x * wavenumber), half_y * np.sin(2 * half_y * wavenumber)
    scale = 4 / grid.spacing**2
    return scale * (p + q - 2 / 3 * p * q), scale * (dp + dq - 2 / 3 * (dp * q + p * dq))
