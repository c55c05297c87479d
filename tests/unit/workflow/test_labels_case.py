"""A CASE with labels: the example's file fitted, what its user is told, and what is refused."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data import Labels
from dtprob.errors import InputError
from dtprob.models.prediction_powered.label_data import label_data
from dtprob.workflow import prepare
from dtprob.workflow.summary import summarise

EXAMPLE = Path(__file__).parents[3] / "examples" / "labels"


def rows(n=40, count=300, *, kind="linear", quality=1.0, predicted=True):
    random = np.random.default_rng(5)
    x = random.standard_normal((n + count, 1))
    signal = 2 * x[:, 0]
    y = signal + random.standard_normal(n + count)
    if kind == "binary":
        y = (y > 0).astype(float)
    guess = quality * signal + 0.5 * random.standard_normal(n + count)
    labelled = np.arange(n + count) < n
    return Labels(
        x=x, y=np.where(labelled, y, 0.0), labelled=labelled, prediction=guess if predicted else None
    )


def example(folder, options=""):
    for name in ("case.toml", "rssi.csv"):
        shutil.copy(EXAMPLE / name, folder)
    file = folder / "case.toml"
    text = file.read_text().replace('scheme = "tuned_cppi"', options or 'scheme = "tuned_cppi"')
    file.write_text(text)
    return load_case(file)


def said(call):
    """What a call gives, and the sentences that it warns with."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    return found, [str(warning.message) for warning in caught]


def fitted(case):
    prepared = prepare(case, need="fit")
    return prepared.engine(prepared.key, prepared.model, prepared.data)


def test_the_example_is_fitted_with_less_spread_than_without_predictions(tmp_path):
    posterior, sentences = said(lambda: fitted(example(tmp_path)))
    assert any(text.startswith("Labels differ from predictions by -") for text in sentences)
    summary = summarise(posterior)
    json.dumps(summary, allow_nan=False)
    alone, _ = said(lambda: fitted(example(tmp_path, 'scheme = "erm"')))
    spread = [np.std(each.flat("theta")) for each in (posterior, alone)]
    assert spread[0] < 0.7 * spread[1]
    # The places of all readings, drawn anew as the example draws them.
    truth = np.random.default_rng(6).uniform(0, 40, 1500).mean()
    assert abs(posterior.flat("theta").mean() - truth) < 3 * spread[0]


def test_an_option_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(InputError, match="schema"):
        said(lambda: prepare(example(tmp_path, 'schema = "erm"'), need="fit"))


@pytest.mark.parametrize("predictor", ["ridge", "neighbours"])
def test_predictors_are_trained_where_the_file_has_none(predictor):
    found, _ = said(lambda: label_data(rows(predicted=False), loss="mean", predictor=predictor))
    given, _ = said(lambda: label_data(rows(quality=1.0), loss="mean"))
    assert abs(float(found["center"][0] - given["center"][0])) < 0.3


def test_no_unlabelled_rows_is_erm_and_says_so():
    data = rows(count=0)
    found, sentences = said(lambda: label_data(data, loss="ols"))
    assert sentences == ["There are no unlabelled samples with predictions, so this is plain ERM."]
    design = np.column_stack([np.ones(40), data.x])
    np.testing.assert_allclose(found["center"], np.linalg.lstsq(design, data.y, rcond=None)[0], rtol=1e-6)


def test_nothing_gained_is_said():
    _, sentences = said(lambda: label_data(rows(quality=0.0), loss="mean"))
    assert sentences[0].startswith("Nothing certain is gained from the predictions")


def test_a_scale_that_is_off_is_said():
    _, sentences = said(lambda: label_data(rows(quality=2.0), loss="mean"))
    assert any(text.startswith("Labels go with 0.") for text in sentences)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (rows(n=3, predicted=False), {}, r"labelled samples: expected at least one per fold \(5\), got 3"),
        (rows(), {"loss": "logistic"}, "y with loss logistic: expected labels 0 and 1"),
        (rows(), {"loss": "poisson"}, "y with loss poisson: expected labels from 0 up"),
        (rows(), {"loss": "ridge"}, "ridge"),
        (rows(), {"predictor": "forest"}, "forest"),
        (rows(), {"scheme": "cpi"}, "cpi"),
        (rows(), {"calibration": "full"}, "calibration: expected matrix, scalar or none"),
    ],
)
def test_what_cannot_be_is_one_clear_line(data, options, message):
    with pytest.raises(InputError, match=message) as caught:
        said(lambda: label_data(data, **options))
    assert "\n" not in str(caught.value)


def test_training_labels_of_one_class_are_refused():
    data = rows(kind="binary", predicted=False)
    y = np.zeros_like(data.y)
    y[0] = 1.0
    alike = Labels(x=data.x, y=y, labelled=data.labelled)
    with pytest.raises(InputError, match=r"training labels of fold \d: expected both classes, got only 0"):
        label_data(alike, loss="logistic")
