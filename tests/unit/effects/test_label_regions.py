"""Regions of features: thirds of what is measured, each value of what is counted or named, each thing once."""

import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.effects.effect import FIELD, Context
from dtprob.effects.library import catalogue
from dtprob.models.declaration import declare
from dtprob.models.label_twin import label_twin


def effects(x, use):
    """Of a family, by instance."""
    rng = np.random.default_rng(0)
    n = len(x)
    data = {
        "x": jnp.asarray(x, float),
        "prediction": jnp.asarray(rng.normal(size=n)),
        "y": jnp.asarray(rng.normal(size=n)),
    }
    found = catalogue(declare(label_twin, data).sites, data, use=use)
    return {effect.instance: effect for effect in found}, data


def storeys(*counts):
    """A feature that is 0 so often, 1 so often, and so on, and one that is measured."""
    place = np.repeat(np.arange(len(counts)), counts)
    return np.stack([place, np.random.default_rng(1).permutation(len(place)) / len(place)], axis=1)


def test_each_storey_is_a_region():
    found, data = effects(storeys(30, 40, 50), "regional_bias")
    assert {name for name in found if name.startswith("x0")} == {"x0_is_0", "x0_is_1", "x0_is_2", "x0_slope"}
    assert {"x1_low", "x1_middle", "x1_high"} <= set(found)
    shifted = found["x0_is_1"].rewrites["predicted_label"](
        jnp.zeros(120), {"bias": 2.0}, Context(data, {"predicted_label": jnp.zeros(120)})
    )
    assert np.asarray(shifted) == pytest.approx(2.0 * (np.asarray(data["x"])[:, 0] == 1))


def test_noise_on_one_side_is_noise_on_the_other():
    found, _ = effects(storeys(50, 70), "label_noise")
    assert {name for name in found if name.startswith("x0")} == {"x0_is_1"}
    three, _ = effects(storeys(50, 40, 30), "label_noise")
    assert "x0_slope" in three
    bias, _ = effects(storeys(50, 70), "regional_bias")
    assert {"x0_is_0", "x0_is_1"} <= set(bias)


def test_many_storeys_are_regions_alone_and_together():
    found, _ = effects(storeys(*[20] * 6), "regional_bias")
    own = {name for name in found if name.startswith("x0")}
    values = (f"x0_is_{k}" for k in range(6))
    assert own == {*values, "x0_low", "x0_middle", "x0_high", "x0_slope", "x0_each_value"}


def test_each_value_has_a_constant_of_its_own():
    x = storeys(*[20] * 6)
    found, data = effects(x, "regional_bias")
    effect, sites = found["x0_each_value"], {"predicted_label": jnp.zeros(120)}
    z = jnp.arange(6.0)
    shifted = effect.rewrites["predicted_label"](
        jnp.zeros(120), {"scale": 2.0, FIELD: z.reshape(1, -1)}, Context(data, sites)
    )
    assert np.asarray(shifted) == pytest.approx(2.0 * x[:, 0])


@pytest.mark.parametrize(("most", "below"), [(30.0, "low"), (0.0, "high"), (15.0, "low")])
def test_a_meter_at_its_end_parts_what_it_reads_elsewhere(most, below):
    """Three in four samples have one value: both thirds ended there, and one region was everywhere."""
    rng = np.random.default_rng(2)
    column = np.where(rng.permutation(400) < 300, most, rng.uniform(0, 30, 400))
    found, data = effects(column[:, None], "regional_bias")
    weight = found[f"x0_{below}"].rewrites["predicted_label"](
        jnp.zeros(400), {"bias": 1.0}, Context(data, {"predicted_label": jnp.zeros(400)})
    )
    expected = column > most if below == "high" else column < most
    assert np.array_equal(np.asarray(weight) > 0.5, expected)


def test_cells_of_large_numbers_have_names():
    x = 130817537.0 + np.repeat(np.arange(3), 40)[:, None]
    names = {name for name in effects(x, "regional_bias")[0] if "_is_" in name}
    assert names == {f"x0_is_13081753{k}" for k in (7, 8, 9)}


def test_no_region_of_single_samples():
    found, _ = effects(storeys(*[1] * 10), "regional_bias")
    assert {name for name in found if name.startswith("x0")} == {"x0_low", "x0_middle", "x0_high", "x0_slope"}


@pytest.mark.parametrize("value", [-1.0, 0.25])
def test_any_value_makes_a_name(value):
    x = np.where(np.arange(80)[:, None] % 2 == 0, value, 3.0)
    assert f"x0_is_{value:g}" in effects(x, "regional_bias")[0]
