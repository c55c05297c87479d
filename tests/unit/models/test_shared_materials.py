"""The prior of one material for all objects, which no order of the objects in a file may decide."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

from dtprob.models.scene import unknown_materials
from tests import small_world

CONCRETE, METAL = (5.24, 0.1), (1.0, 1e7)


def prior(values, hit=(True, True, True, True)):
    """Means and standard deviations of log-contrast and log-conductivity; paths reflect off the objects `hit` only."""
    paths = small_world.trace()
    permittivity, conductivity = jnp.asarray(values).T
    keep = paths.mask & jnp.all((paths.interaction == 0) | jnp.asarray(hit)[paths.object], axis=-1)
    changed = (permittivity, conductivity, keep)
    paths = eqx.tree_at(lambda p: (p.permittivity, p.conductivity, p.mask), paths, changed)
    trace = handlers.trace(handlers.seed(unknown_materials, 0)).get_trace(paths, "shared")
    contrast = trace["material_permittivity"]["fn"].base_dist
    conductance = trace["material_conductivity"]["fn"].base_dist
    return [np.asarray(value).item() for d in (contrast, conductance) for value in (d.loc, d.scale)]


@pytest.mark.parametrize("place", range(4))
def test_a_metal_has_no_say_wherever_the_file_lists_it(place):
    values = [CONCRETE] * 4
    values[place] = METAL
    np.testing.assert_allclose(prior(values), [np.log(4.24), 0.4, np.log(0.1), 1.0], rtol=1e-6)


def test_metals_alone_are_metals():
    np.testing.assert_allclose(prior([METAL] * 4), [np.log(1e-2), 0.4, np.log(1e7), 1.0], rtol=1e-6)


def test_objects_that_no_path_hits_have_no_say():
    values = [CONCRETE, CONCRETE, CONCRETE, (80.0, 5.0)]
    np.testing.assert_allclose(
        prior(values, (True, True, True, False)), [np.log(4.24), 0.4, np.log(0.1), 1.0], rtol=1e-6
    )
    assert prior(values)[1] > 0.4


def test_what_objects_differ_by_is_added_to_the_spread():
    values = [(1 + np.exp(x), np.exp(2 * x)) for x in (-1.0, 0.0, 0.0, 1.0)]
    found = prior(values)
    np.testing.assert_allclose(
        found, [0.0, np.sqrt(0.4**2 + 0.5), 0.0, np.sqrt(1 + 2.0)], rtol=1e-6, atol=1e-6
    )


def test_without_reflections_all_objects_count():
    assert prior([CONCRETE] * 4, (False,) * 4) == prior([CONCRETE] * 4)
