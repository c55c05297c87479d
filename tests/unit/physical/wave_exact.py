"""Fields of a line source that are known exactly, normalised as `dtprob.physical.wave.simulate.Response.field`."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import epsilon_0
from scipy.special import hankel2

C = 299_792_458.0
CARRIER = 6e9
WAVELENGTH = C / CARRIER
FREQUENCY = np.linspace(5.5e9, 6.5e9, 5)
WAVENUMBER = 2 * np.pi * FREQUENCY / C

type Law = Callable[[np.ndarray], np.ndarray]
"""From the cosine of the angle of incidence, which may be complex, to a coefficient for each frequency."""


def line_source(distance: Float[np.ndarray, " probe"]) -> Complex[np.ndarray, "probe frequency"]:
    """In free space."""
    return _scale() * hankel2(0, np.asarray(distance)[:, None] * WAVENUMBER)


def by_way_of(
    law: Law, along: Float[np.ndarray, " probe"], across: Float[np.ndarray, " probe"]
) -> Complex[np.ndarray, "probe frequency"]:
    """Sommerfeld's integral of the plane waves of a line source, each times a coefficient.

    With k_x = k sin(a) for waves that travel and k cosh(b) for those that fade, the integrand has no singularity.

    Args:
        law: coefficient of each wave.
        along: distance of source and probe along the surface, m.
        across: way in air across it, from the source to the surface and from there to the probe, m.
    """
    nodes, weights = np.polynomial.legendre.leggauss(1500)
    angle, fading = nodes * np.pi / 2, (nodes + 1) / 2 * 6
    x, y = np.asarray(along)[:, None, None], np.asarray(across)[:, None, None]
    k = WAVENUMBER[:, None]
    waves = np.exp(-1j * k * (x * np.sin(angle) + y * np.cos(angle))) * law(np.cos(angle) + 0j)
    tails = np.exp(-k * y * np.sinh(fading)) * np.cos(k * x * np.cosh(fading)) * law(-1j * np.sinh(fading))
    return _scale() / np.pi * (waves @ weights * np.pi / 2 + 2j * tails @ weights * 3)


def half_space(permittivity: float, conductivity: float) -> Law:
    """Reflection of a field along the surface."""
    return lambda cosine: (
        (cosine - _root(permittivity, conductivity, cosine))
        / (cosine + _root(permittivity, conductivity, cosine))
    )


def slab(permittivity: float, conductivity: float, thickness: float) -> tuple[Law, Law]:
    """Reflection and transmission of a wall, all internal reflections summed."""

    def parts(cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        once = np.exp(-1j * thickness * WAVENUMBER[:, None] * _root(permittivity, conductivity, cosine))
        return half_space(permittivity, conductivity)(cosine), once

    def reflected(cosine: np.ndarray) -> np.ndarray:
        surface, once = parts(cosine)
        return surface * (1 - once**2) / (1 - surface**2 * once**2)

    def transmitted(cosine: np.ndarray) -> np.ndarray:
        surface, once = parts(cosine)
        return (1 - surface**2) * once / (1 - surface**2 * once**2)

    return reflected, transmitted


def error(
    found: Complex[np.ndarray, "probe frequency"], exact: Complex[np.ndarray, "probe frequency"]
) -> Float[np.ndarray, " frequency"]:
    """Relative root mean square over probes."""
    return np.sqrt((np.abs(found - exact) ** 2).sum(axis=0) / (np.abs(exact) ** 2).sum(axis=0))


def _scale() -> Complex[np.ndarray, " frequency"]:
    return np.sqrt(np.pi * WAVENUMBER / 2) * np.exp(-1j * np.pi / 4)


def _root(permittivity: float, conductivity: float, cosine: np.ndarray) -> np.ndarray:
    """Of eta - sin^2, on the branch of a wave that decays inside."""
    eta = permittivity - 1j * conductivity / (2 * np.pi * FREQUENCY[:, None] * epsilon_0)
    root = np.sqrt(eta - 1 + cosine**2)
    return np.where(root.imag > 0, -root, root)
