"""Room for candidates: what would be lost is searched again in smaller groups, or said."""

import warnings

import numpy as np
import pytest

from dtprob.raytracing import candidates
from dtprob.raytracing.candidates import in_groups
from dtprob.raytracing.trace import load_scene, trace

TARGETS = np.arange(100, 150)


def searched(each, **room):
    """The groups that a search ends with, when a target has so many candidates; and the sizes of all it tried."""
    tried = []

    settings = {"depth": 3, "samples": 1000, "max_paths": 10_000} | room

    def search(_, some):
        tried.append(len(some))
        return some + 1000, min(each * len(some), settings["max_paths"])

    return list(in_groups(search, [TARGETS], **settings)), tried


@pytest.mark.parametrize("each", [1, 300, 1000, 6000])
def test_groups_shrink_until_they_fit(each):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        groups, tried = searched(each)
    assert np.array_equal(np.concatenate([some for some, _ in groups]), TARGETS)
    assert all(np.array_equal(found, some + 1000) for some, found in groups)
    assert all(each * len(some) < 10_000 for some, _ in groups)
    assert sum(tried) <= 3 * len(TARGETS)


def test_later_sources_know_what_the_first_one_found():
    tried = []

    def search(source, some):
        tried.append((source, len(some)))
        return None, 3000 * len(some)

    groups = list(in_groups(search, [TARGETS, TARGETS[:7]], depth=3, samples=1000, max_paths=10_000))
    assert np.array_equal(np.concatenate([some for some, _ in groups]), [*TARGETS, *TARGETS[:7]])
    assert tried[0] == (0, 50)
    assert all(size <= 3 for _, size in tried[4:])
    assert [size for source, size in tried if source == 1] == [2, 2, 2, 1]


def test_groups_follow_from_rays_and_depth():
    groups, _ = searched(1, depth=10, samples=300_000)
    assert [len(some) for some, _ in groups] == [10] * 5


def test_a_table_that_fills_makes_groups_smaller_too():
    groups, _ = searched(10_000, max_paths=1_000_000)
    assert max(len(some) for some, _ in groups) * 10_000 < candidates.TABLE / 500


def test_what_does_not_fit_is_said():
    with pytest.warns(RuntimeWarning, match="raise max_paths"):
        searched(20_000)
    with pytest.warns(RuntimeWarning, match="about 2% of its paths"):
        searched(700_000, max_paths=1_000_000)


@pytest.mark.study
@pytest.mark.libllvm
def test_a_small_table_loses_paths_and_the_large_one_none(rt, many, monkeypatch):
    """The defect is there: without it, drop the larger table."""
    scene, (tx, rx) = load_scene("simple_street_canyon", 6e9), many
    settings = {"max_depth": 3, "samples": 10_000, "max_paths": 5_000, "allow_empty": True}
    together = trace(scene, tx, rx, **settings)
    alone = trace(scene, tx[:1], rx[:1], **settings)
    monkeypatch.setattr(candidates, "TABLE", 4999)
    small = trace(scene, tx, rx, **settings)
    assert int(together.mask[0].sum()) == int(alone.mask.sum())
    assert int(small.mask.sum()) < 0.99 * int(together.mask.sum())


@pytest.fixture
def many():
    rx = np.stack([np.linspace(-20, 30, 10), np.tile([-4.0, 4.0], 5), np.full(10, 1.5)], axis=1)
    return np.tile([-24.0, 3.0, 6.0], (10, 1)), rx
