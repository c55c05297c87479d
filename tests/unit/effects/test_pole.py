"""A pole in front of a transmitter: the field that it takes away against Kirchhoff's integral, path by path."""

import equinox as eqx
import numpy as np
import pytest
from numpyro import handlers
from scipy import constants, integrate

from dtprob.effects import Rewriting, catalogue


@pytest.fixture(scope="module")
def pole(world):
    return next(e for e in catalogue(world.sites, world.data) if e.name == "blockage[pole]")


@pytest.fixture(scope="module")
def shaded(world, pole):
    """(width, azimuth, log_distance) -> gain of each path with the pole over that without, where there is a path."""

    def ratio(**parameters):
        found = []
        for given in (pole.null(), parameters):
            with (
                handlers.trace() as trace,
                Rewriting(None, [pole], {pole.name: given}, world.data),
                handlers.seed(rng_seed=0),
                handlers.substitute(data={"scale": 1.05}),
            ):
                world.model(**world.data)
            found.append(np.asarray(trace["path_gain"]["value"]))
        mask = np.asarray(world.data["paths"].mask) & (np.abs(found[0]) > 0)
        return np.where(mask, found[1] / np.where(mask, found[0], 1.0), 1.0), mask

    return ratio


def kirchhoff(width, offset, scale):
    """1 less the wave through a Gaussian screen of a cylinder wave, integrated over its breadth."""

    def wave(x):
        return np.exp(-np.pi * (x / width) ** 2 - 0.5j * np.pi * (scale * (x - offset)) ** 2)

    reach = 4 * width
    real = integrate.quad(lambda x: wave(x).real, -reach, reach, limit=500)[0]
    imaginary = integrate.quad(lambda x: wave(x).imag, -reach, reach, limit=500)[0]
    return 1 - (1 + 1j) / 2 * scale * (real + 1j * imaginary)


@pytest.mark.parametrize(
    ("width", "azimuth", "share"), [(0.02, 0.3, 0.25), (0.3, -0.4, 0.4), (1.0, 0.9, 0.12)]
)
def test_what_a_pole_takes_away(world, shaded, width, azimuth, share):
    paths = world.data["paths"]
    away = share * float(np.asarray(paths.length)[np.asarray(paths.mask)].min())
    found, mask = shaded(width=width, azimuth=azimuth, distance=away)
    direction, length = np.asarray(paths.departure, float), np.asarray(paths.length, float)
    level = np.hypot(direction[..., 0], direction[..., 1])
    turn = np.arctan2(direction[..., 1], direction[..., 0]) - azimuth
    ahead = (np.cos(turn) > 0.3) & (level > 0.2) & (level * length * np.cos(turn) > 1.1 * away) & mask
    assert ahead.any()
    for link, path in np.argwhere(ahead):
        before = away / np.cos(turn[link, path])
        after = level[link, path] * length[link, path] - before
        offset = away * np.tan(turn[link, path])
        wavelength = constants.speed_of_light / paths.frequency
        scale = np.sqrt(2 / wavelength * level[link, path] * (1 / before + 1 / after))
        exact = kirchhoff(width, offset, scale)
        np.testing.assert_allclose(found[link, path], exact, rtol=2e-3, atol=2e-3)
    behind = mask & (np.cos(turn) < 0)
    np.testing.assert_allclose(found[behind], 1.0, atol=1e-6)


def test_a_wide_pole_takes_all_of_what_it_stands_before(world, shaded):
    paths = world.data["paths"]
    east = np.asarray(paths.departure)[0, 0]
    found, _ = shaded(width=200.0, azimuth=float(np.arctan2(east[1], east[0])), distance=1.0)
    assert abs(found[0, 0]) < 0.02


def test_a_pole_may_stand_anywhere(world, pole):
    azimuth, distance = (p.tried for p in pole.parameters if p.is_place)
    assert np.ptp(azimuth) > 1.99 * np.pi
    assert 0 < 5 * min(distance) < max(distance) < np.asarray(world.data["paths"].length).max()
    many = catalogue(world.sites, {**world.data, "paths": _scattered(world.data["paths"])})
    assert not [e.name for e in many if "pole" in e.name]  # each link has a transmitter of its own


def _scattered(paths):
    places = np.asarray(paths.tx_position) + np.arange(paths.n_link)[:, None]
    return eqx.tree_at(lambda p: p.tx_position, paths, places)
