"""Small data sets of known law for the tests of prediction-powered inference."""

import numpy as np

from dtprob.models.prediction_powered.sample import Sample

COEFFICIENT = np.array([0.5, -0.8, 0.3])


def linear(n=60, count=500, folds=3, *, quality=0.9, seed=0, kind="ols"):
    """A sample for a generalised linear loss, with K predictors that err in a way of their own."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([np.ones(n + count), rng.normal(size=(n + count, 2))])
    eta = x @ COEFFICIENT
    if kind == "ols":
        y = eta + rng.normal(size=n + count)
    elif kind == "logistic":
        y = (rng.random(n + count) < 1 / (1 + np.exp(-eta))).astype(float)
    else:
        y = rng.poisson(np.exp(eta)).astype(float)
    errors = rng.normal(size=(n + count, folds)) * 0.1
    target = y if kind == "ols" else {"logistic": 1 / (1 + np.exp(-eta)), "poisson": np.exp(eta)}[kind]
    guess = quality * target[:, None] + 0.2 + errors
    if kind == "logistic":
        guess = np.clip(guess - 0.1, 0.01, 0.99)
    guess = np.maximum(guess, 0.01) if kind == "poisson" else guess
    fold = np.arange(n) % folds
    return Sample(
        x=x[:n],
        y=y[:n],
        prediction=guess[np.arange(n), fold],
        x_unlabelled=x[n:],
        prediction_unlabelled=guess[n:],
    )


def scalar(n=40, count=300, folds=4, *, slope=0.8, noise=0.5, seed=1):
    """Labels without features, for means and quantiles."""
    rng = np.random.default_rng(seed)
    y = rng.normal(2.0, 1.5, n + count)
    guess = 0.3 + slope * y[:, None] + noise * rng.normal(size=(n + count, folds))
    fold = np.arange(n) % folds
    return Sample(y=y[:n], prediction=guess[np.arange(n), fold], prediction_unlabelled=guess[n:])
