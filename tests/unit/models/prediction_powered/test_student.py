"""Networks taught by corrected losses: a linear one against closed forms, lambda of a step against its formula."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.neural import Neural
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.student import Groups, Rows, per_step_lambda, teach
from tests.unit.models.prediction_powered.examples import linear, scalar

KEY = jax.random.key(3)


def line(steps=600):
    return Neural.of_equinox(lambda key: eqx.nn.Linear(2, 1, key=key), steps=steps, step_size=0.05, decay=0.0)


def without_constant(sample, prediction=None):
    """The network brings its own constant."""
    given = sample.prediction_unlabelled if prediction is None else prediction[sample.n :]
    own = sample.prediction if prediction is None else prediction[: sample.n]
    return Sample(
        x=sample.x[:, 1:],
        y=sample.y,
        prediction=own,
        x_unlabelled=sample.x_unlabelled[:, 1:],
        prediction_unlabelled=given,
    )


@pytest.mark.parametrize("scheme", ["erm", "ss", "cppi"])
def test_a_linear_student_is_least_squares(scheme):
    sample = linear()
    taught = teach(KEY, without_constant(sample), line(), scheme, batch=10_000)
    expected = sample.x @ estimate("ols", sample, scheme).theta
    np.testing.assert_allclose(taught.predict(sample.x[:, 1:]), expected, atol=2e-3)


def test_batches_of_unlabelled_samples_lead_to_the_same_place():
    sample = linear()
    taught = teach(KEY, without_constant(sample), line(), "cppi", batch=100)
    expected = sample.x @ estimate("ols", sample, "cppi").theta
    assert np.sqrt(np.mean((np.asarray(taught.predict(sample.x[:, 1:])) - expected) ** 2)) < 0.05


def groups(y, prediction, count=500, weight=None):
    x = np.random.default_rng(1).normal(size=(len(y), 2))
    unlabelled = Rows(jnp.zeros((count, 2)), jnp.zeros(count), jnp.ones(count))
    own = jnp.ones(len(y)) if weight is None else jnp.asarray(weight)
    rows = (Rows(jnp.asarray(x), jnp.asarray(labels), own) for labels in (y, prediction))
    return Groups(*rows, unlabelled)


@pytest.mark.parametrize("weighted", [False, True])
def test_lambda_of_a_step_is_the_ratio_of_covariances(weighted):
    rng = np.random.default_rng(2)
    y = rng.normal(size=300)
    prediction = y + rng.normal(size=300) + 5 * weighted
    weight = rng.exponential(size=300) if weighted else np.ones(300)
    weight /= weight.mean()
    data, network = groups(y, prediction, weight=weight), line()
    parameters = network.init(KEY, data.true.x)
    output = np.asarray(network.apply(parameters, data.true.x))[:, 0]
    # The squared loss of a line: its gradients in slopes and constant.
    design = np.column_stack([data.true.x, np.ones(300)])
    g, f = (2 * (output - labels)[:, None] * design for labels in (y, prediction))
    g, f = (weight[:, None] * (part - weight @ part / 300) for part in (g, f))
    expected = np.sum(g * f) / ((1 + 300 / 500) * np.sum(f * f))
    assert 0 < expected < 1
    assert float(per_step_lambda(network, parameters, data)) == pytest.approx(expected, rel=1e-9)


def test_lambda_of_a_perfect_and_of_a_contrary_predictor():
    y = np.random.default_rng(2).normal(size=60)
    network = line()
    parameters = jax.tree.map(jnp.zeros_like, network.init(KEY, jnp.zeros((1, 2))))
    found = [float(per_step_lambda(network, parameters, groups(y, guess))) for guess in (y, -y, 0 * y)]
    assert found == pytest.approx([1 / (1 + 60 / 500), 0.0, 0.0])


def test_a_tuned_student_gains_from_good_predictions_and_ignores_bad_ones():
    sample = linear(n=40, count=1000)
    useless = np.random.default_rng(4).normal(size=1040) * 3
    good, bad = (teach(KEY, without_constant(sample, p), line()) for p in (None, useless))
    assert float(good.lam.mean()) > 0.7
    assert float(bad.lam.mean()) < 0.25
    assert good.lam.shape == (600,)


@pytest.mark.parametrize(
    ("sample", "options", "message"),
    [
        (scalar(), {}, "student: expected features, and a batch from 1, got 0 features"),
        (linear(), {"batch": 0}, "got 3 features, batch 0"),
        (linear(), {"scheme": "cpi"}, "Did you mean 'cppi'"),
        (
            Sample(x=np.ones((4, 1)), y=np.arange(4.0)),
            {},
            "sample: expected unlabelled samples with predictions",
        ),
    ],
)
def test_what_cannot_be_taught_is_refused(sample, options, message):
    with pytest.raises(InputError, match=message):
        teach(KEY, sample, line(), **options)
