"""Gains, steering and synthesis."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import speed_of_light

from dtprob.errors import InputError
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize
from dtprob.raytracing.paths import DIFFRACTION, DIFFUSE, SPECULAR, PathSet

NAMES = ("permittivity", "conductivity", "thickness")


def walls_of(paths):
    return tuple(np.asarray(getattr(paths, name)) for name in NAMES)


@functools.partial(jax.jit, static_argnames="law")
def power(paths: PathSet, walls, law="slab"):
    """A smooth number that every parameter moves."""
    permittivity, conductivity, thickness = walls
    gain = path_gain(paths, permittivity, conductivity, thickness=thickness, law=law)
    weight = jnp.cos(jnp.arange(gain.size)).reshape(gain.shape)
    return 1e5 * jnp.sum(weight * jnp.real(gain) + weight[::-1] * jnp.imag(gain))


gains_of = jax.jit(path_gain, static_argnames="law")
gradient = jax.jit(jax.grad(power, argnums=(0, 1), allow_int=True), static_argnames="law")


@pytest.mark.parametrize("law", ["slab", "half_space"])
@pytest.mark.parametrize("antenna", [("iso", "V"), ("dipole", 0.7), ("tr38901", "H")])
def test_agrees_with_the_textbook(oracles, law, antenna):
    paths = oracles.box_paths(pattern=antenna[0], polarization=antenna[1])
    found = gains_of(paths, paths.permittivity, paths.conductivity, law=law)
    expected = oracles.gains(paths, walls_of(paths), law)
    assert np.sum(np.asarray(paths.interaction) == 4) > 20
    assert np.max(np.abs(found - expected)) < 1e-11 * np.max(np.abs(expected))


@pytest.mark.parametrize(("polarization", "sign"), [("V", 1), ("H", -1)])
def test_two_rays_over_a_floor(oracles, polarization, sign):
    """The closed form of the two-ray model; horizontal antennas that face each other are mirrored."""
    paths = oracles.box_paths(
        tx=np.array([[1.0, 1.0, 1.5]]), rx=np.array([[3.0, 2.0, 0.8]]), polarization=polarization
    )
    gain = np.asarray(path_gain(paths, paths.permittivity, paths.conductivity, law="half_space"))[0]
    code, item = np.asarray(paths.interaction[0]), np.asarray(paths.object[0])
    direct, floor = (
        np.flatnonzero(code.sum(1) == 0)[0],
        np.flatnonzero((code.sum(1) == 1) & (item[:, 0] == 4))[0],
    )
    distance, unfolded = np.hypot(np.sqrt(5.0), 0.7), np.hypot(np.sqrt(5.0), 2.3)
    wall = [float(values[4]) for values in walls_of(paths)]
    r_te, r_tm, *_ = oracles.slab(2.3 / unfolded, wall, paths.frequency, "half_space")
    wavelength = speed_of_light / paths.frequency
    assert gain[direct] == pytest.approx(sign * wavelength / (4 * np.pi * distance), rel=1e-12)
    reflected = r_tm if polarization == "V" else -r_te
    assert gain[floor] == pytest.approx(reflected * wavelength / (4 * np.pi * unfolded), rel=1e-12)


@pytest.mark.parametrize("law", ["slab", "half_space"])
def test_gradients_against_differences(box, law):
    walls = walls_of(box)
    found = gradient(box, walls, law=law)[1]
    for number, item in itertools.product(range(3), range(box.n_object)):
        step = 1e-6 * walls[number][item]
        value = [power(box, moved(walls, number, item, way * step), law=law) for way in (1, -1)]
        difference = float(value[0] - value[1]) / (2 * step)
        assert float(found[number][item]) == pytest.approx(difference, rel=2e-6, abs=1e-6)


def moved(walls, number, item, step):
    changed = [np.array(values) for values in walls]
    changed[number][item] += step
    return tuple(changed)


def test_gradients_in_geometry_and_antennas(box):
    walls, random = walls_of(box), np.random.default_rng(0)
    found = gradient(box, walls)[0]
    for name in ("departure", "normal", "length", "tx_field", "rx_field"):
        value = np.asarray(getattr(box, name))
        way = random.normal(size=value.shape)
        if name in {"departure", "normal"}:  # of unit length, so they turn
            way = way - np.sum(way * value, axis=-1, keepdims=True) * value
        ends = (power(dataclasses.replace(box, **{name: value + t * way}), walls) for t in (1e-6, -1e-6))
        difference = float(np.subtract(*ends)) / 2e-6
        assert float(jnp.sum(getattr(found, name) * way)) == pytest.approx(difference, rel=2e-6), name


def test_gradients_are_finite_where_nothing_is(box):
    """Missing paths, no loss, no thickness and normal incidence; in both precisions."""
    head_on = dataclasses.replace(box, normal=jnp.broadcast_to(box.departure[:, :, None], box.normal.shape))
    for dtype in (jnp.float32, jnp.float64):
        paths = jax.tree.map(lambda a, dtype=dtype: a.astype(dtype) if a.dtype.kind == "f" else a, head_on)
        for permittivity in (1.0, 4.0):
            walls = jnp.full(7, permittivity, dtype), jnp.zeros(7, dtype), jnp.zeros(7, dtype)
            grads = gradient(paths, walls)
            floats = [leaf for leaf in jax.tree.leaves(grads) if leaf.dtype in (np.float32, np.float64)]
            assert len(floats) > 10
            assert all(np.all(np.isfinite(leaf)) for leaf in floats)


def test_missing_paths_have_no_gain(box):
    none = dataclasses.replace(box, mask=jnp.zeros_like(box.mask))
    assert not np.any(gains_of(none, box.permittivity, box.conductivity))


def test_jit_and_vmap(box):
    plain = gains_of(box, box.permittivity, box.conductivity)
    scale = jnp.linspace(0.8, 1.2, 5)
    many = jax.jit(jax.vmap(lambda s: path_gain(box, s * box.permittivity, box.conductivity)))(scale)
    assert many.shape == (5, *plain.shape)
    assert np.allclose(many[2], plain, rtol=1e-12, atol=0)
    assert np.allclose(path_gain(box, box.permittivity, box.conductivity), plain, rtol=1e-12, atol=1e-18)


def test_single_precision(oracles):
    paths = oracles.box_paths(conductivity=1e-3)
    exact = gains_of(paths, paths.permittivity, paths.conductivity)
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, paths)
    found = gains_of(single, single.permittivity, single.conductivity)
    assert found.dtype == np.complex64
    scale = paths.wavelength / (4 * np.pi * np.asarray(paths.length))
    assert np.max(np.abs(found - exact) / scale) < 2e-5


def test_scattering_weakens_reflections(box):
    scattering = jnp.full(7, 0.6)
    rough = dataclasses.replace(box, scattering=scattering)
    gain, weak = (gains_of(p, box.permittivity, box.conductivity) for p in (box, rough))
    bounces = np.sum(np.asarray(box.interaction) == SPECULAR, axis=-1)
    assert np.allclose(weak, gain * 0.8**bounces, rtol=1e-12)


def test_what_is_not_known_is_refused(box):
    for code, name in ((DIFFUSE, "diffuse reflection"), (DIFFRACTION, "diffraction")):
        other = dataclasses.replace(box, interaction=box.interaction.at[0, 0, 0].set(code))
        with pytest.raises(InputError, match=f"got {name}"):
            path_gain(other, box.permittivity, box.conductivity)
    with pytest.raises(InputError, match="7 objects"):
        path_gain(box, jnp.ones(3), box.conductivity)
    with pytest.raises(InputError, match="half_space"):
        path_gain(box, box.permittivity, box.conductivity, law="halfspace")  # pyright: ignore[reportArgumentType]


def test_steering_is_the_phase_of_a_displaced_antenna(oracles, box):
    """An element displaced by r sees the path of a transmitter or receiver that stands there."""
    element = np.array([[0.0, 0.0, 0.0], [0.004, -0.01, 0.006]])
    for side, sign, direction in (("tx", 1, box.departure), ("rx", -1, box.arrival)):
        there = oracles.box_paths(**{side: np.asarray(getattr(box, f"{side}_position")) + element[1]})
        phase = np.angle(there.carrier_phasor * np.conj(box.carrier_phasor))
        found = np.angle(steering(jnp.asarray(element), direction, box.frequency, sign))
        near = np.asarray(box.mask & there.mask & jnp.all(box.object == there.object, -1) & (box.length > 4))
        assert np.all(found[..., 0] == 0)
        assert np.max(np.abs(np.angle(np.exp(1j * (found[..., 1] - phase))))[near]) < 5e-3


def test_frequency_response(box):
    offset = jnp.linspace(-50e6, 50e6, 11)
    found = frequency_response(box, offset)
    expected = np.exp(-2j * np.pi * np.asarray(box.delay)[..., None] * (box.frequency + np.asarray(offset)))
    assert np.max(np.abs(found - expected)) < 1e-6
    moved = box.delay + 0.2e-9
    later = frequency_response(box, offset, moved)
    assert np.max(np.abs(later - found * np.exp(-2j * np.pi * 0.2e-9 * (box.frequency + offset)))) < 1e-9


def test_carrier_phase_survives_single_precision(oracles):
    paths = oracles.box_paths(frequency=60e9)
    offset, change = jnp.linspace(-1e8, 1e8, 5), 3e-12
    exact = frequency_response(paths, offset, paths.delay + change)
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, paths)
    single = dataclasses.replace(single, carrier_phasor=paths.carrier_phasor.astype(np.complex64))
    kept = frequency_response(single, offset.astype(np.float32))
    assert np.max(np.abs(kept - frequency_response(paths, offset))) < 1e-5
    moved = frequency_response(single, offset.astype(np.float32), single.delay + jnp.float32(change))
    assert np.max(np.abs(moved - exact)) < 60e9 * 2 * np.pi * np.spacing(np.float32(5e-8))


def test_synthesis_is_the_sum_over_paths(box):
    random = np.random.default_rng(1)

    def number(*shape):
        return random.normal(size=shape) + 1j * random.normal(size=shape)

    links, paths = box.n_link, box.n_path
    gain, response = number(links, paths), number(links, paths, 5)
    rx, tx, snapshot = number(links, paths, 3), number(links, paths, 2), number(links, 4, paths)
    found = synthesize(*map(jnp.asarray, (gain, response, rx, tx, snapshot)))
    expected = np.einsum("lp,lpk,lpr,lpt,lsp->lsrtk", gain, response, rx, tx, snapshot)
    assert np.max(np.abs(found - expected)) < 1e-12 * np.max(np.abs(expected))
    alone = synthesize(jnp.asarray(gain), jnp.asarray(response))
    assert alone.shape == (links, 1, 1, 1, 5)
    assert np.allclose(alone[:, 0, 0, 0], np.einsum("lp,lpk->lk", gain, response))
