"""The evidence on predictions, in small: counts are those of logs, twins take turns, every curve is there."""

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.inference import PointMass
from dtprob.reproduce import prediction


def test_counts_of_the_collected_logs():
    truth = {name: jnp.asarray(value) for name, value in prediction._TRUTH.parameters.items()}
    counts = prediction._collected(jax.random.key(0), truth, 400, 20)
    arrival, reception = (np.asarray(counts[name]) for name in ("log_arrival", "log_reception"))
    assert np.all(arrival.sum(axis=-1) == 20)
    assert np.all(reception.sum(axis=(1, 2)) == 20)
    assert not reception[:, prediction._TRUTH.reception == 0].any()
    frequency = arrival.mean(axis=(0, 1, 2)) / 20
    np.testing.assert_allclose(frequency, [0.2, 0.4, 0.4, 0.0], atol=4.5 * np.sqrt(0.24 / 16_000))


def test_twins_take_turns():
    sampler = prediction._InTurn(PointMass({"t": np.arange(6.0).reshape(3, 2)}))
    drawn = sampler.sample(jax.random.key(0), 6)["t"]
    assert np.array_equal(drawn, np.arange(12.0).reshape(6, 2) % 6)


class Counted:
    """Progress that gives made-up parts: every second interval holds the value."""

    def part(self, _name, _compute):
        methods = prediction._NAMES
        found = {f"{method}.throughput.inside": np.tile([0.0, 1.0], 5) for method in methods}
        return found | {f"{method}.throughput.width": np.linspace(0.1, 0.3, 10) for method in methods}


def test_the_figure():
    figure = prediction.run(jax.random.key(0), 10, Counted())
    coverage, width = figure.panels
    names = {"bayesian", "bayesian_jeffreys", "bayesian_learned", "map"}
    for panel in figure.panels:
        assert {series.name for series in panel.series} == names
    assert all(np.all(series.median == 0.5) for series in coverage.series)
    np.testing.assert_allclose(coverage.series[0].high, 0.5 + 2 * np.sqrt(0.025))
    assert all(np.allclose(series.median, 0.2) for series in width.series)
