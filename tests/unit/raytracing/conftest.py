"""What the tests of this room share: independent oracles, and scenes traced once."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.raytracing.sionna import sionna_rt


@pytest.fixture(scope="session")
def oracles() -> ModuleType:
    """The module oracles.py beside this file."""
    spec = importlib.util.spec_from_file_location(
        "raytracing_oracles", Path(__file__).with_name("oracles.py")
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def box(oracles):
    """Three links in a box with a partition, in double precision."""
    return oracles.box_paths()


@pytest.fixture(scope="session")
def rt():
    """The module sionna.rt, or a skip where it cannot run."""
    try:
        return sionna_rt()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def places():
    """Transmitter and receivers of two scenes, in the open."""
    random = np.random.default_rng(5)
    street = np.c_[random.uniform(-40, 40, 12), random.uniform(-8, 8, 12), np.full(12, 1.5)]
    city = np.array(
        [[8, 62, 1.5], [35, 55, 1.5], [60, 90, 1.5], [-10, 70, 1.5], [45, 90, 1.5], [20, 95, 1.5]]
    )
    return {
        "simple_street_canyon": (np.array([-30.0, 1.0, 20.0]), street),
        "munich": (np.array([8.5, 21.0, 27.0]), city),
    }
