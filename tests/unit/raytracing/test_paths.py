"""The path set itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.raytracing.paths import DIMENSIONS, validate


def test_sizes(box):
    assert (box.n_link, box.depth, box.n_object, box.n_material) == (3, 5, 7, 3)
    assert box.n_path == box.mask.shape[1]
    assert box.wavelength == pytest.approx(299_792_458 / 3.5e9)


def test_names_are_static_and_arrays_are_leaves(box):
    leaves, structure = jax.tree.flatten(box)
    absent = {"scattering", "object_center", "beyond"}
    assert {name for name in DIMENSIONS if getattr(box, name) is None} == absent
    assert len(leaves) == len(DIMENSIONS) - len(absent)
    assert jax.tree.unflatten(structure, leaves).object_names == box.object_names


@pytest.mark.parametrize("links", [[2, 0], np.array([True, False, True])])
def test_take(box, links):
    some = validate(box.take(links))
    chosen = np.flatnonzero(links) if np.asarray(links).dtype == bool else links
    assert some.n_link == len(chosen)
    assert np.array_equal(some.delay, box.delay[np.asarray(chosen)])
    assert np.array_equal(some.normal, box.normal[np.asarray(chosen)])
    assert some.object_names == box.object_names
    assert np.array_equal(some.permittivity, box.permittivity)


@pytest.mark.parametrize("links", [[3], [-1], [[0]], [0.0], [True], [True, False, True, False]])
def test_take_no_such_link(box, links):
    with pytest.raises(InputError, match="indices from 0 to 2"):
        box.take(links)


WRONG = {
    "shape": (lambda p: {"delay": p.delay[:, :-1]}, r"paths\.carrier_phasor: expected shape \(link, path\)"),
    "objects": (lambda p: {"permittivity": p.permittivity[:-1]}, r"paths\.permittivity: expected shape"),
    "nan": (lambda p: {"tx_field": p.tx_field.at[0, 0, 0].set(jnp.nan)}, r"paths\.tx_field.*NaN"),
    "code": (lambda p: {"interaction": p.interaction.at[0, 0, 0].set(3)}, r"got \[3\]"),
    "object": (lambda p: {"object": p.object.at[0, 0, 0].set(7)}, "indices from 0 to 6, got 0 to 7"),
    "material": (lambda p: {"object_material": p.object_material - 1}, "indices from 0 to 2"),
    "direction": (lambda p: {"arrival": 2 * p.arrival}, "unit vectors"),
    "length": (lambda p: {"length": -p.length}, "positive values"),
    "delay in ns": (
        lambda p: {"delay": 1e9 * p.delay},
        "paths.delay: expected s, the path's length over the speed of",
    ),
    "other ends": (
        lambda p: {"rx_position": p.rx_position + 50.0},
        "paths.length: expected m, no less than from end",
    ),
    "carrier": (
        lambda p: {"frequency": 1.1 * p.frequency},
        "paths.carrier_phasor: expected .* got .* for path 0 of",
    ),
    "conjugate": (
        lambda p: {"carrier_phasor": p.carrier_phasor.conj()},
        "paths.carrier_phasor: expected exp",
    ),
    "frequency": (lambda _: {"frequency": 0.0}, "positive carrier"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_named(box, what):
    change, text = WRONG[what]
    with pytest.raises(InputError, match=text):
        validate(dataclasses.replace(box, **change(box)))
