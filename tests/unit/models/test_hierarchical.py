"""Materials of objects spread about those of their classes."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

from dtprob.models.channel import ray_traced_channel
from dtprob.testing import check_model
from tests import small_world


@pytest.fixture(scope="module")
def data():
    paths = small_world.trace()
    arguments = {"paths": paths, "subcarrier_frequency": jnp.linspace(-1e7, 1e7, 3), "noise_power": 1e-9}
    drawn = handlers.trace(handlers.seed(ray_traced_channel, 0)).get_trace(**arguments)
    return arguments | {"channel": drawn["channel"]["value"], "materials": "hierarchical"}


@pytest.mark.study
def test_contract(data):
    check_model(ray_traced_channel, data)


def test_no_spread_gives_each_object_its_class(data):
    values = {"permittivity_spread": jnp.asarray(1e-12), "conductivity_spread": jnp.asarray(1e-12)}
    model = handlers.substitute(handlers.seed(ray_traced_channel, 3), data=values)
    trace = handlers.trace(model).get_trace(**data)
    by_class = np.asarray(data["paths"].object_material)
    for name in ("permittivity", "conductivity"):
        classes = np.asarray(trace[f"material_{name}"]["value"])
        np.testing.assert_allclose(trace[name]["value"], classes[by_class], rtol=1e-9)


def test_a_spread_moves_objects_of_one_class_apart(data):
    values = {"permittivity_spread": jnp.asarray(0.3)}
    model = handlers.substitute(handlers.seed(ray_traced_channel, 3), data=values)
    trace = handlers.trace(model).get_trace(**data)
    contrast = np.asarray(trace["permittivity"]["value"]) - 1
    by_class = (
        np.asarray(trace["material_permittivity"]["value"])[np.asarray(data["paths"].object_material)] - 1
    )
    deviation = np.asarray(trace["permittivity_deviation"]["value"])
    np.testing.assert_allclose(np.log(contrast / by_class), 0.3 * deviation, rtol=1e-6)
    assert np.ptp(deviation) > 0
