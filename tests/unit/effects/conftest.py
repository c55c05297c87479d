"""The small ray-traced world as fixtures."""

import pytest

from tests import small_world


@pytest.fixture(scope="session")
def world() -> small_world.World:
    """The world with everything in it: two arrays, a band, snapshots in time, a drawn channel."""
    return small_world.drawn()


@pytest.fixture(scope="session")
def build_world():
    """Function that builds a variant of the world."""
    return small_world.build


@pytest.fixture(scope="session")
def trace_world():
    """Function that traces the world with rx, tx or planes displaced."""
    return small_world.trace
