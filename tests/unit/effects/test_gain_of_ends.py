"""The gain of one of several transmitters or receivers: which there are, and which links one of them changes."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from dtprob.effects.effect import Context
from dtprob.effects.loss import gain_offset


def paths(tx, rx):
    places = np.array([[0.0, 0.0, 10.0], [300.0, 0.0, 10.0], [50.0, 40.0, 1.5]])
    return SimpleNamespace(tx_position=places[tx], rx_position=places[rx] + [1.0, 0.0, 0.0])


def effects(world, tx, rx):
    data = {"paths": paths(tx, rx)}
    return {e.instance: e for e in gain_offset(world.sites, data)}, data


def test_each_of_several_transmitters_has_a_gain(world):
    found, data = effects(world, [0, 0, 1, 1, 0], [0, 1, 2, 0, 2])
    assert set(found) == {None, "transmitter_0", "transmitter_1"}  # one receiver has a single link
    value = jnp.ones((5, 4), complex)
    moved = found["transmitter_1"].rewrites["path_gain"](value, {"log_gain": 0.5}, Context(data, {}))
    np.testing.assert_allclose(moved, np.exp(0.5 * np.array([0, 0, 1, 1, 0]))[:, None] * np.ones((5, 4)))


def test_other_links_of_the_same_transmitter_count_too(world):
    """A design measures elsewhere, with more links."""
    found, _ = effects(world, [0, 0, 1, 1], [0, 0, 1, 1])
    assert set(found) == {None, "transmitter_0", "transmitter_1", "receiver_0", "receiver_1"}
    other = Context({"paths": paths([1, 0, 1], [2, 2, 2])}, {})
    moved = found["transmitter_1"].rewrites["path_gain"](jnp.ones((3, 2)), {"log_gain": 1.0}, other)
    np.testing.assert_allclose(moved[:, 0], np.exp([1.0, 0.0, 1.0]))


def test_no_gain_of_an_only_transmitter(world):
    assert set(effects(world, [0, 0, 0], [0, 1, 2])[0]) == {None}


def test_devices_are_counted_by_their_places_as_elsewhere(world):
    found, data = effects(
        world, [1, 1, 0, 0, 1], [0, 1, 2, 0, 2]
    )  # the first link is of the device farther along x
    value = jnp.ones((5, 4), complex)
    moved = found["transmitter_0"].rewrites["path_gain"](value, {"log_gain": 0.5}, Context(data, {}))
    np.testing.assert_allclose(moved[:, 0], np.exp(0.5 * np.array([0, 0, 1, 1, 0])))
