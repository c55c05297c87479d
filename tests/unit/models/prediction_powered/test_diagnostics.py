"""What the predictions are worth, and where they are wrong."""

import numpy as np
import pytest

from dtprob.models.prediction_powered.diagnostics import bias_map, worth
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.sample import Sample
from tests.unit.models.prediction_powered.examples import scalar


def test_good_predictions_are_worth_labels():
    found = worth(estimate("mean", scalar(noise=0.1)))
    assert found.variance_ratio < 0.3
    assert found.labels_gained == pytest.approx(40 * (1 / found.variance_ratio - 1))
    assert found.lam.low <= found.lam.value <= found.lam.high
    assert found.warnings == ()


def test_useless_and_reversed_predictions_bring_warnings():
    useless = worth(estimate("mean", scalar(slope=0.0, noise=5.0)))
    assert any(text.startswith("Nothing certain is gained") for text in useless.warnings)
    reversed_ones = worth(estimate("mean", scalar(slope=-1.0, noise=0.1)))
    assert any(text.startswith("The predictions go against the labels") for text in reversed_ones.warnings)


def mapped(*, shift=0.0, scale=1.0, moved=0.0):
    rng = np.random.default_rng(6)
    x = rng.normal(size=(400, 2))
    y = x[:, 0] + 0.2 * rng.normal(size=400)
    guess = (x[:, 0] + shift * (x[:, 1] > 0)) / scale
    other = rng.normal(size=(1000, 2)) + np.array([0, moved])
    return Sample(x=x, y=y, prediction=guess, x_unlabelled=other, prediction_unlabelled=other[:, 0] / scale)


def test_a_regional_bias_is_found_where_it_is():
    found = bias_map(mapped(shift=0.5))
    biased = found.biased()
    assert biased
    for region in biased:
        assert region.high[1] > 0
        assert region.bias.high < 0
    assert sum(region.count for region in found.regions) == 400


def test_an_honest_predictor_has_no_bias_anywhere():
    found = bias_map(mapped())
    assert found.biased(0.01) == ()
    assert found.scale.low < 1 < found.scale.high
    assert found.shift_p_value > 0.01


def test_a_timid_predictor_shows_in_the_scale():
    found = bias_map(mapped(scale=2.0))
    assert found.scale.value == pytest.approx(2.0, abs=0.1)
    assert found.scale_p_value < 1e-6


def test_two_labels_tell_nothing_of_the_scale():
    """A line goes through any two, and has no error."""
    two = Sample(x=np.array([[0.0], [1.0]]), y=np.array([1.0, 2.0]), prediction=np.array([0.5, 3.0]))
    found = bias_map(two)
    assert found.scale == (1.0, -np.inf, np.inf)
    assert found.scale_p_value == 1.0


def test_a_moved_feature_is_named():
    found = bias_map(mapped(moved=0.6))
    assert found.shifted_feature == 1
    assert found.shift_p_value < 1e-6


ORDERS = {
    "sorted": np.arange(100_000) / 100_000,
    "a grid, row by row": np.arange(100_000) % 100 / 100,  # equal steps of 100 would all hit one column
}


@pytest.mark.parametrize("chunk", [None, 3000])
@pytest.mark.parametrize("order", ORDERS)
def test_the_order_of_unlabelled_samples_is_no_shift(order, chunk):
    x, other = np.random.default_rng(7).random((50, 1)), ORDERS[order][:, None]
    fields = {"x": x, "y": x[:, 0], "prediction": x[:, 0], "prediction_unlabelled": other[:, 0]}
    alike, moved = (Sample(**fields, x_unlabelled=each, chunk=chunk) for each in (other, other**4))
    assert bias_map(alike).shift_p_value > 0.05
    assert bias_map(moved).shift_p_value < 1e-6


def test_one_label_in_a_region_proves_nothing():
    sample = Sample(y=np.array([1.0]), prediction=np.array([0.9]), x=np.zeros((1, 1)))
    (region,) = bias_map(sample, per_region=1).regions
    assert region.p_value == 1.0
    assert np.isinf(region.bias.high)


def test_a_feature_of_two_values_hides_no_region():
    """Its median halves nothing, and others go on being halved."""
    rng = np.random.default_rng(0)
    u = rng.uniform(size=4000)
    x = np.column_stack([u, rng.random(4000) < 0.3])
    truth = rng.normal(size=4000)
    guess = truth + 1.0 * ((u > 0.6) & (u < 0.7)) + 0.1 * rng.normal(size=4000)
    sample = Sample(x=x, y=truth, prediction=guess, x_unlabelled=x, prediction_unlabelled=guess)
    found = bias_map(sample)
    assert len(found.regions) > 32
    worst = min(found.biased(), key=lambda region: region.bias.value)
    assert 0.58 < worst.low[0] < worst.high[0] < 0.72
