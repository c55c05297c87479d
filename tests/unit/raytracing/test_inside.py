"""Points inside and outside of meshes, and receivers inside of walls."""

import itertools

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.raytracing.inside import winding_number


def cube():
    """Twelve triangles of the unit cube, all turned outwards."""
    faces = []
    for axis, end in itertools.product(range(3), (0.0, 1.0)):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        corner = end * np.eye(3)[axis]
        square = [corner, corner + u, corner + u + v, corner + v]
        order = (0, 1, 2, 0, 2, 3) if end else (0, 2, 1, 0, 3, 2)
        faces += [[square[i] for i in order[:3]], [square[i] for i in order[3:]]]
    return np.asarray(faces)


@pytest.mark.parametrize(
    ("point", "times"),
    [
        ((0.5, 0.5, 0.5), 1),
        ((0.01, 0.9, 0.3), 1),
        ((1.2, 0.5, 0.5), 0),
        ((-5, 0.1, 0), 0),
        ((0.5, 0.5, 3), 0),
    ],
)
def test_winding_number_of_a_cube(point, times):
    assert winding_number(cube(), np.asarray(point)) == pytest.approx(times, abs=1e-9)


@pytest.mark.libllvm
def test_a_receiver_inside_a_building_is_named(rt):
    from dtprob.raytracing.trace import load_scene, trace

    scene = load_scene("simple_street_canyon", 3.5e9, merge_shapes=False)
    box = scene.objects["building_1"].mi_mesh.bbox()
    middle = (np.asarray(box.min).ravel() + np.asarray(box.max).ravel()) / 2
    tx = np.array([[0.0, 0.0, 20.0]])
    with pytest.raises(InputError, match=r"rx_position of link 0: expected a place in the open.*building_1"):
        trace(scene, tx, middle[None], max_depth=1, samples=10_000)
    with pytest.raises(InputError, match="none for links 0"):
        trace(scene, tx, np.array([[0.0, 0.0, -50.0]]), max_depth=0, samples=10_000)
