"""Training of predictors: no label is predicted by a model that saw it, and folds agree with training apart."""

import equinox as eqx
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.neighbors import KNeighborsRegressor

from dtprob.errors import InputError
from dtprob.models.prediction_powered import predictors as predictors_module
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.neural import Neural
from dtprob.models.prediction_powered.predictors import Neighbours, Ridge
from dtprob.models.prediction_powered.training import assign_folds, train

KEY = jax.random.key(7)


def data(n=40, count=150):
    rng = np.random.default_rng(2)
    x = rng.normal(size=(n + count, 2))
    y = 1 + x @ np.array([1.0, -2.0]) + 0.3 * rng.normal(size=n + count)
    return {"x": x[:n], "y": y[:n], "x_unlabelled": x[n:]}


class Memory:
    """Predicts 1 for what it was trained on and 0 for the rest; an object with fit and predict."""

    def fit(self, x, _y):
        self.seen = {tuple(row) for row in x}

    def predict(self, x):
        return np.array([float(tuple(row) in self.seen) for row in x])


def test_folds_are_of_one_size():
    fold = assign_folds(KEY, 23, 5)
    assert sorted(np.bincount(fold)) == [4, 4, 5, 5, 5]
    assert not np.array_equal(fold, np.sort(fold))


@pytest.mark.parametrize(("scheme", "n", "predictors"), [("cppi", 40, 4), ("tuned_ppi", 20, 1)])
def test_no_label_is_predicted_by_who_saw_it(scheme, n, predictors):
    sample = train(KEY, scheme, Memory(), **data(), folds=4)
    assert sample.n == n
    assert sample.prediction_unlabelled.shape == (150, predictors)
    np.testing.assert_array_equal(sample.prediction, 0)


def test_one_label_is_not_split():
    given = data(n=1)
    with pytest.raises(InputError, match="2 or more, half of which train, got 1"):
        train(KEY, "ppi", Ridge(), **given)


def test_semi_supervised_trains_on_all_and_erm_on_none():
    np.testing.assert_array_equal(train(KEY, "ss", Memory(), **data()).prediction, 1)
    alone = train(KEY, "erm", Memory(), **data())
    assert alone.prediction is None
    assert not alone.has_predictions


def test_ridge_is_least_squares_in_every_fold():
    own = train(KEY, "cppi", Ridge(1e-12), **data(), folds=4)
    other = train(KEY, "cppi", LinearRegression(), **data(), folds=4)
    np.testing.assert_allclose(own.prediction, other.prediction, rtol=1e-6)
    np.testing.assert_allclose(own.prediction_unlabelled, other.prediction_unlabelled, rtol=1e-6)


def test_neighbours_are_those_of_scikit_learn_in_every_fold():
    own = train(KEY, "cppi", Neighbours(3), **data(), folds=4)
    other = train(KEY, "cppi", KNeighborsRegressor(3, weights="distance"), **data(), folds=4)
    np.testing.assert_allclose(own.prediction, other.prediction, rtol=1e-5)
    np.testing.assert_allclose(own.prediction_unlabelled, other.prediction_unlabelled, rtol=1e-5)


class Line(nn.Module):
    @nn.compact
    def __call__(self, x):
        return nn.Dense(1)(x)


class Turned(eqx.Module):
    """A linear module that takes its features in an order of whole numbers."""

    inner: eqx.nn.Linear
    order: jax.Array

    def __init__(self, key):
        self.inner, self.order = eqx.nn.Linear(2, 1, key=key), jnp.array([1, 0])

    def __call__(self, x):
        return self.inner(x[self.order])


NETWORKS = {
    "equinox_with_whole_numbers": lambda: Neural.of_equinox(Turned, steps=800, step_size=0.05, decay=0.0),
    "equinox": lambda: Neural.of_equinox(
        lambda key: eqx.nn.Linear(2, 1, key=key), steps=800, step_size=0.05, decay=0.0
    ),
    "flax": lambda: Neural.of_flax(Line(), steps=800, step_size=0.05, decay=0.0),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_linear_network_learns_least_squares_in_every_fold(name):
    own = train(KEY, "cppi", NETWORKS[name](), **data(), folds=4)
    other = train(KEY, "cppi", LinearRegression(), **data(), folds=4)
    np.testing.assert_allclose(own.prediction_unlabelled, other.prediction_unlabelled, atol=2e-3)


def test_probabilities_come_from_predict_proba():
    inputs = data()
    labels = (inputs["y"] > 1).astype(float)
    settings = {**inputs, "y": labels, "folds": 4, "probability": True}
    sample = train(KEY, "cppi", LogisticRegression(), **settings)
    unlabelled = sample.prediction_unlabelled
    assert 0 < unlabelled.min() < 0.3
    assert 0.7 < unlabelled.max() < 1


def test_from_data_to_estimate_beats_labels_alone():
    inputs = data()
    ones = {
        "features": np.column_stack([np.ones(40), inputs["x"][:, 0]]),
        "features_unlabelled": np.column_stack([np.ones(150), inputs["x_unlabelled"][:, 0]]),
    }
    tuned, alone = (
        estimate("ols", train(KEY, scheme, Ridge(), **inputs, **ones, folds=4), scheme)
        for scheme in ("tuned_cppi", "erm")
    )
    assert np.all(tuned.standard_error < 0.7 * alone.standard_error)
    assert np.all(np.abs(tuned.theta - [1.0, 1.0]) < 4 * tuned.standard_error)


@pytest.mark.parametrize("offset", [0.0, 5e6, 5e8])
def test_neighbours_do_not_depend_on_the_origin(offset):
    """Labels at the samples' own places, on coordinates of a map, too."""
    rng = np.random.default_rng(0)
    places, labels = jnp.asarray(rng.uniform(0, 50, (200, 2)) + offset), jnp.arange(200.0)
    learned = Neighbours(3).train(KEY, places, labels, jnp.ones(200))
    np.testing.assert_allclose(Neighbours(3).predict(learned, places), labels, atol=1e-6)


def test_neighbours_are_the_same_a_few_rows_at_a_time(monkeypatch):
    """With distances of all rows at once, 65,536 by 3,000 in a chunk, they would take gigabytes."""
    rng = np.random.default_rng(0)
    places, rows, labels = rng.normal(size=(300, 3)), rng.normal(size=(1000, 3)), rng.normal(size=300)
    learned = (jnp.asarray(places), jnp.asarray(labels), jnp.ones(300))
    whole = Neighbours().predict(learned, jnp.asarray(rows))
    monkeypatch.setattr(predictors_module, "_DISTANCES", 7 * 300)
    few = Neighbours().predict(learned, jnp.asarray(rows))
    np.testing.assert_allclose(few, whole, rtol=1e-12)
    memory = jax.jit(Neighbours().predict).lower(learned, jnp.asarray(rows)).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 1000 * 300 * 8
