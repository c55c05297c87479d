"""The image method."""

import numpy as np
import pytest

from dtprob.raytracing.geometry import unfold
from dtprob.raytracing.paths import DIFFUSE


def test_lengths_and_directions_of_the_box_follow_its_vertices(box):
    """Independent of images: reflect each leg at its vertex and add the legs up."""
    for link, path in np.argwhere(np.asarray(box.mask)):
        code = np.asarray(box.interaction[link, path])
        count = np.count_nonzero(code)
        ends = np.asarray(box.tx_position[link]), np.asarray(box.rx_position[link])
        legs = np.diff(np.vstack([ends[0], np.asarray(box.vertex[link, path])[:count], ends[1]]), axis=0)
        length = np.linalg.norm(legs, axis=1)
        way = legs / length[:, None]
        assert box.length[link, path] == pytest.approx(length.sum(), rel=1e-12)
        assert np.allclose(box.departure[link, path], way[0], atol=1e-12)
        assert np.allclose(box.arrival[link, path], way[-1], atol=1e-12)
        for step in range(count):
            normal = np.asarray(box.normal[link, path, step])
            mirrored = way[step] - (code[step] == 1) * 2 * (way[step] @ normal) * normal
            assert np.allclose(way[step + 1], mirrored, atol=1e-12)


def test_rough_vertices_of_the_solver_do_not_matter(box):
    """Only the planes enter; a vertex anywhere on its plane gives the same path."""
    tx = np.repeat(np.asarray(box.tx_position)[:, None], box.n_path, 1).reshape(-1, 3)
    rx = np.repeat(np.asarray(box.rx_position)[:, None], box.n_path, 1).reshape(-1, 3)
    code, normal, vertex = (
        np.asarray(a).reshape(-1, box.depth, *a.shape[3:]) for a in (box.interaction, box.normal, box.vertex)
    )
    random = np.random.default_rng(0).normal(size=vertex.shape)
    along = random - np.sum(random * normal, axis=-1, keepdims=True) * normal
    exact, rough = unfold(tx, rx, code, normal, vertex), unfold(tx, rx, code, -normal, vertex + 0.1 * along)
    for one, other in zip(exact, rough, strict=True):
        assert np.allclose(one, other, atol=1e-11)


def test_diffuse_paths_keep_their_vertices():
    vertex = np.array([[[1.0, 2.0, 0.3]]])
    found = unfold(
        np.array([[0.0, 0.0, 1.0]]),
        np.array([[4.0, 0.0, 1.0]]),
        np.array([[DIFFUSE]]),
        np.array([[[0, 0, 1.0]]]),
        vertex,
    )
    assert np.array_equal(found.vertex, vertex)
    legs = np.sqrt(1 + 4 + 0.49) + np.sqrt(9 + 4 + 0.49)
    assert found.length[0] == pytest.approx(legs, rel=1e-14)
    assert np.allclose(found.arrival[0], np.array([3, -2, 0.7]) / np.sqrt(9 + 4 + 0.49))
