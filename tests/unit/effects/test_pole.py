"""A pole in front of a transmitter: the field that it takes away against Kirchhoff's integral, path by path."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from scipy import constants, integrate

from dtprob.effects import Rewriting, catalogue
from dtprob.raytracing.paths import DIFFRACTION, DIFFUSE, SPECULAR


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


def kirchhoff(pole, receiver, height, width, wavelength):
    """1 less the wave through a Gaussian screen, every way past it as long as it is, as seen from the transmitter at 0."""
    away = np.linalg.norm(pole)
    across = np.array([-pole[1], pole[0]]) / away
    after = np.linalg.norm(receiver - pole)
    direct = np.hypot(np.linalg.norm(receiver), height)
    turn = (receiver - pole) @ pole / (after * away)
    rise = (away + after) / np.hypot(away + after, height)
    strength = np.sqrt(1j * rise * (1 / away + 1 / after) / wavelength)
    strength *= np.linalg.norm(receiver) / (away + after) * (1 + turn) / 2

    def wave(x):
        point = pole + x * across
        level = np.linalg.norm(point) + np.linalg.norm(receiver - point)
        return np.exp(
            -np.pi * (x / width) ** 2 - 2j * np.pi * (np.hypot(level, height) - direct) / wavelength
        )

    real, imaginary = (
        integrate.quad(lambda x, part=part: getattr(wave(x), part), -3 * width, 3 * width, limit=2000)[0]
        for part in ("real", "imag")
    )
    return 1 - strength * (real + 1j * imaginary)


@pytest.mark.parametrize(
    ("width", "azimuth", "share"), [(0.01, 0.3, 0.25), (0.05, -0.4, 0.4), (0.1, 0.9, 0.12), (0.05, 2.5, 0.3)]
)
def test_what_a_pole_takes_away(world, shaded, width, azimuth, share):
    paths = world.data["paths"]
    away = share * float(np.asarray(paths.length)[np.asarray(paths.mask)].min())
    found, mask = shaded(width=width, azimuth=azimuth, distance=away)
    pole, wavelength = (
        away * np.array([np.cos(azimuth), np.sin(azimuth)]),
        constants.speed_of_light / paths.frequency,
    )
    unfolded = np.asarray(paths.departure, float) * np.asarray(paths.length, float)[..., None]
    turned = (np.asarray(paths.interaction) != 0) & (np.abs(np.asarray(paths.normal)[..., 2]) < 0.9)
    free = (
        mask
        & ~turned.any(axis=-1)
        & (np.hypot(unfolded[..., 0], unfolded[..., 1]) > 0.1 * np.asarray(paths.length))
    )
    assert free.sum() > 3
    for link, path in np.argwhere(free):
        exact = kirchhoff(pole, unfolded[link, path, :2], unfolded[link, path, 2], width, wavelength)
        np.testing.assert_allclose(found[link, path], exact, atol=0.02 * abs(1 - exact) + 1e-3)


def test_every_path_has_a_derivative_in_the_width(world, pole):
    """Exact where nothing is there yet, at any place, as the search for places takes it."""
    place = {"azimuth": jnp.array(0.3), "distance": jnp.array(1.5)}
    gain = jnp.ones(np.asarray(world.data["paths"].delay).shape, complex)

    def moved(width):
        return pole.rewrites["path_gain"](gain, {"width": width, **place}, world.data)

    def both(width, distance):
        return pole.rewrites["path_gain"](gain, {**place, "width": width, "distance": distance}, world.data)

    points, ways = (jnp.zeros(()), place["distance"]), (jnp.ones(()), jnp.zeros(()))
    slope = np.asarray(jax.jvp(both, points, ways)[1])
    step = 1e-4
    np.testing.assert_allclose(slope, np.asarray(moved(step) - moved(0.0)) / step, rtol=1e-3, atol=1e-3)
    mask = np.asarray(world.data["paths"].mask)
    assert np.count_nonzero(slope[mask]) > 3


def test_behind_a_wall_a_pole_takes_nothing_away(shaded):
    """Paths that end, or that a wall turns aside, before they reach the pole."""
    found, mask = shaded(width=0.05, azimuth=0.3, distance=200.0)
    np.testing.assert_allclose(found[mask], 1.0, atol=2e-2)
    near, _ = shaded(width=0.05, azimuth=0.3, distance=1.0)
    assert np.abs(near[mask] - 1).max() > 0.02


def test_beyond_the_wall_that_turns_a_path_aside_no_pole_is_in_its_way(world, shaded):
    paths = world.data["paths"]
    turned = np.isin(np.asarray(paths.interaction), (SPECULAR, DIFFUSE, DIFFRACTION))
    upright = turned & (np.abs(np.asarray(paths.normal)[..., 2]) < 0.9)
    departure, length = np.asarray(paths.departure), np.asarray(paths.length)
    seen = 0
    for link, path in np.argwhere(upright[..., 0] & np.asarray(paths.mask)):
        start, wall = np.asarray(paths.tx_position)[link, :2], np.asarray(paths.vertex)[link, path, 0, :2]
        leg, level = np.linalg.norm(wall - start), np.hypot(*departure[link, path, :2])
        if not 1.5 * leg < 0.9 * level * length[link, path]:
            continue
        azimuth = float(np.arctan2(departure[link, path, 1], departure[link, path, 0]))
        beyond, before = (
            shaded(width=20.0, azimuth=azimuth, distance=d)[0][link, path] for d in (1.5 * leg, 0.5 * leg)
        )
        assert abs(beyond - 1) < 0.1
        assert abs(before) < 0.1
        seen += 1
    assert seen > 0


def test_a_pole_stands_before_its_own_transmitter_alone(world):
    paths = world.data["paths"]
    elsewhere = np.arange(paths.n_link) == paths.n_link - 1
    places = np.asarray(paths.tx_position) + 100.0 * elsewhere[:, None]
    data = {**world.data, "paths": eqx.tree_at(lambda p: p.tx_position, paths, places)}
    (pole,) = (
        e for e in catalogue(world.sites, data) if "pole" in e.name
    )  # one link's own transmitter has none
    gain = jnp.ones(np.asarray(paths.delay).shape, complex)
    wide = {**pole.null(), "width": jnp.array(5.0)}
    change = np.abs(np.asarray(pole.rewrites["path_gain"](gain, wide, data)) - 1)
    assert not change[elsewhere].any()
    assert change[~elsewhere].max() > 0.02


def test_a_wide_pole_takes_all_of_what_it_stands_before(world, shaded):
    paths = world.data["paths"]
    east = np.asarray(paths.departure)[0, 0]
    found, _ = shaded(width=20.0, azimuth=float(np.arctan2(east[1], east[0])), distance=1.0)
    assert abs(found[0, 0]) < 0.05


def test_a_pole_may_stand_anywhere(world, pole):
    azimuth, distance = (p.tried for p in pole.parameters if p.is_place)
    assert np.ptp(azimuth) > 1.99 * np.pi
    assert 0 < 5 * min(distance) < max(distance) < np.asarray(world.data["paths"].length).max()
    many = catalogue(world.sites, {**world.data, "paths": _scattered(world.data["paths"])})
    assert not [e.name for e in many if "pole" in e.name]  # each link has a transmitter of its own


def _scattered(paths):
    places = np.asarray(paths.tx_position) + np.arange(paths.n_link)[:, None]
    return eqx.tree_at(lambda p: p.tx_position, paths, places)
