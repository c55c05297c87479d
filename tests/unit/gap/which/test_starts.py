"""From which pair a search starts once more."""

from types import SimpleNamespace

import numpy as np
import pytest

from dtprob.gap.settings import Settings
from dtprob.gap.which.pairs import Pair
from dtprob.gap.which.starts import promising

TILT_AND_NOISE, TILT_AND_SHIFT = Pair(("noise", "tilt"), 900.0), Pair(("shift", "tilt"), 880.0)


def end(effects, *, leaves, pairs=(TILT_AND_NOISE, TILT_AND_SHIFT)):
    """A fit with these effects, at which a way ended; noise alone moves no mean."""
    scores = SimpleNamespace(
        pairs=lambda: pairs,
        locating=frozenset({"shift", "tilt", "gain"}),
        log_bayes_factor=np.array([700.0, 500.0]),
    )
    return SimpleNamespace(
        problem=SimpleNamespace(effects=("shift", "tilt", "gain", "noise")),
        fitted=SimpleNamespace(effects=effects),
        screening=SimpleNamespace(scores=scores),
        alarmed=lambda _: leaves,
    )


def promised(seen, reached, settings):
    """The pair that promises most, of one view that is the base fit's and a way's end."""
    return promising(seen, [seen], reached, settings)


def test_noise_is_no_start_where_what_moves_the_mean_leaves_nothing():
    assert promised(end(("gain",), leaves=False), 800.0, Settings()) == ("shift", "tilt")
    only_noise = end(("gain",), leaves=False, pairs=(TILT_AND_NOISE,))
    assert promised(only_noise, 800.0, Settings()) is None


@pytest.mark.parametrize(("effects", "leaves"), [(("gain",), True), (("noise",), False)])
def test_noise_is_a_start_where_something_is_left_or_noise_was_needed(effects, leaves):
    assert promised(end(effects, leaves=leaves), 800.0, Settings()) == ("noise", "tilt")


@pytest.mark.parametrize(("effects", "reached"), [(("noise", "tilt"), 800.0), (("gain",), 1500.0), ((), 0.0)])
def test_no_pair_that_was_reached_or_promises_less_or_where_nothing_was_found(effects, reached):
    assert promised(end(effects, leaves=True), reached, Settings()) is None


def test_no_pair_where_one_effect_is_all_that_is_looked_for():
    assert promised(end(("gain",), leaves=True), 800.0, Settings(max_effects=1)) is None
