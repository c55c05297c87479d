"""Schemes on passages made by hand, with a predictor that is right and one that is wrong."""

import jax
import numpy as np
import pytest

from dtprob.data.deepsense import BEAMS, NAME, Sweeps
from dtprob.data.location import measured_data
from dtprob.errors import InputError
from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import deepsense
from dtprob.reproduce.deepsense import studies
from dtprob.reproduce.progress import Progress

NAMES = list(SCHEMES)


def street(bend=0.0):
    """20 passages along a street 15 m away; the best beam follows the direction, bent by a sine."""
    random = np.random.default_rng(3)
    along = np.tile(np.linspace(-25, 25, 60), 20)
    position = np.column_stack([15 + 0.5 * random.standard_normal(len(along)), along])
    sine = position[:, 1] / np.linalg.norm(position, axis=1)
    best = 32 + 28 * sine + bend * np.sin(9 * sine)
    level = np.exp(0.3 * random.standard_normal(len(along)))
    power = np.exp(-0.5 * (np.arange(BEAMS) - best[:, None]) ** 2 / 1.5**2) * level[:, None]
    return Sweeps(position, power + 0.02 * random.random(power.shape), np.repeat(np.arange(20), 60))


@pytest.fixture(scope="module")
def losses():
    keys = jax.random.split(jax.random.key(2), 6)
    return {bend: studies(keys, street(bend), (30, 200)).mean(axis=0) for bend in (0.0, 9.0)}


def test_a_predictor_that_is_right_is_believed(losses):
    found = losses[0.0]
    erm, tuned = NAMES.index("erm"), NAMES.index("tuned_cppi")
    assert found[0, tuned, 0] < 0.7 * found[0, erm, 0]
    assert np.all(found[:, tuned, 1] > 0.6)


def test_one_that_is_wrong_misleads_only_who_believes_it(losses):
    found = losses[9.0]
    erm, ss, tuned = (NAMES.index(name) for name in ("erm", "ss", "tuned_cppi"))
    assert found[1, ss, 0] > 2 * found[1, erm, 0]
    assert found[1, tuned, 0] < 1.1 * found[1, erm, 0]
    assert found[1, tuned, 1] < 0.5


@pytest.mark.measured
def test_on_measured_sweeps_the_tuned_scheme_saves_and_never_costs(monkeypatch):
    try:
        measured_data(NAME)
    except InputError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(deepsense, "LABELLED", (20, 100))
    figure = deepsense.run(jax.random.key(0), 4, Progress())
    assert len(figure.panels) == 4
    for panel in figure.panels:
        curves = {series.name: series.median for series in panel.series}
        assert np.all(curves["tuned_cppi"] < curves["erm"] + 0.15)
    assert "dB that tuned_cppi saves" in figure.notes[1]
