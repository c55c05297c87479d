"""Every engine keeps the engine's contract."""

import pytest

from dtprob.inference import ENGINES
from dtprob.testing import check_engine

SETTINGS = {
    "nuts": {"warmup": 300, "draws": 500, "chains": 2},
    "blackjax_nuts": {"warmup": 300, "draws": 500, "chains": 2},
    "hmc": {"warmup": 300, "draws": 500, "chains": 2},
}


@pytest.mark.parametrize("name", ENGINES)
def test_engine(name):
    check_engine(ENGINES[name](**SETTINGS.get(name, {})))
