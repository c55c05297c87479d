"""Effects on path sets of which another ray tracer tells lengths and directions, but not where paths are turned."""

import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.effects import unfolding
from dtprob.effects.array import _detour
from dtprob.effects.extra import _obstructed
from dtprob.effects.obstacle import _crossings
from dtprob.effects.visibility import _order
from dtprob.raytracing.imported import ImportedPaths, path_set

WALL = 5.0
TX, RX = np.array([0.0, 0.0, 0.0]), np.array([10.0, 1.0, 0.5])


def image(tx):
    """The transmitter's image in the wall at y = 5."""
    return np.array([tx[0], 2 * WALL - tx[1], tx[2]])


def exact(tx, rx):
    """Length, departure and arrival of the path over the wall."""
    way = rx - image(tx)
    length = np.linalg.norm(way)
    arrival = way / length
    return length, arrival * [1, -1, 1], arrival


def imported(tx=TX, rx=RX, *, direct=True):
    """The line of sight, where it is told, and the path over the wall."""
    straight = (rx - tx) / np.linalg.norm(rx - tx)
    length, departure, arrival = exact(tx, rx)
    lengths = np.array([[np.linalg.norm(rx - tx), length]])
    told = ImportedPaths(
        coefficient=np.full((1, 2), 1e-4 + 0j),
        delay=lengths / 299_792_458.0,
        departure=np.stack([straight, departure])[None],
        arrival=np.stack([straight, arrival])[None],
        mask=np.array([[direct, True]]),
        rx_position=rx[None],
        tx_position=tx[None],
    )
    return path_set(told, 3.5e9, ())


@pytest.mark.parametrize("end", ["rx", "tx"])
@pytest.mark.parametrize("step", [[0.1, 0, 0], [0, 0.1, 0], [0.03, -0.05, 0.08]])
def test_ends_move_as_with_the_wall_that_nobody_told(end, step):
    step = np.array(step)
    paths = imported()
    shift = (unfolding.of_receiver if end == "rx" else unfolding.of_transmitter)(paths, jnp.asarray(step))
    found = unfolding.moved(paths, shift)
    ends = {"tx": TX, "rx": RX}
    ends[end] = ends[end] + step
    length, departure, arrival = exact(**ends)
    before = exact(TX, RX)
    assert found.stretch[0, 1] == pytest.approx(length - before[0], rel=1e-9)
    np.testing.assert_allclose(found.departure[0, 1], departure - before[1], atol=1e-12)
    np.testing.assert_allclose(found.arrival[0, 1], arrival - before[2], atol=1e-12)
    straight = np.linalg.norm(ends["rx"] - ends["tx"]) - np.linalg.norm(RX - TX)
    assert found.stretch[0, 0] == pytest.approx(straight, rel=1e-9)


def test_elements_are_as_far_apart_as_with_the_wall():
    element = {"rx": np.array([0.0, 0.2, 0.1]), "tx": np.array([0.1, 0.3, 0.0])}
    found = _detour(imported(), jnp.asarray(element["rx"][None]), jnp.asarray(element["tx"][None]))
    length, departure, arrival = exact(TX, RX)
    plane = length + element["rx"] @ arrival - element["tx"] @ departure
    assert found[0, 1, 0, 0] == pytest.approx(
        exact(TX + element["tx"], RX + element["rx"])[0] - plane, rel=1e-6
    )


def test_only_the_straight_path_is_in_line_of_sight():
    np.testing.assert_array_equal(np.asarray(imported().is_untold), [[False, True]])
    np.testing.assert_array_equal(np.asarray(_order(imported())), [[0, -1]])
    assert not np.asarray(_obstructed(imported()))[0]
    assert np.asarray(_obstructed(imported(direct=False)))[0]


def test_a_screen_is_crossed_by_paths_whose_way_is_known():
    across = np.array([5.0, -1.0]), np.array([5.0, 2.0])
    np.testing.assert_array_equal(np.asarray(_crossings(imported(), *across)), [[1, 0]])
