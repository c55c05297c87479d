"""A CASE with labels: the example's file fitted, what its user is told, and what is refused."""

import json
import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.cli import main
from dtprob.data import Labels
from dtprob.errors import InputError
from dtprob.models.prediction_powered.label_data import label_data
from dtprob.workflow import prepare
from dtprob.workflow.summary import summarise

EXAMPLE = Path(__file__).parents[3] / "examples" / "labels"


def rows(n=40, count=300, *, kind="linear", quality=1.0, predicted=True, **columns):
    random = np.random.default_rng(5)
    x = random.standard_normal((n + count, 1))
    signal = 2 * x[:, 0]
    y = signal + random.standard_normal(n + count)
    if kind == "binary":
        y = (y > 0).astype(float)
    guess = quality * signal + 0.5 * random.standard_normal(n + count)
    labelled = np.arange(n + count) < n
    prediction = guess if predicted else None
    return Labels(x=x, y=np.where(labelled, y, 0.0), labelled=labelled, prediction=prediction, **columns)


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


def test_columns_of_other_names_are_told_theirs(tmp_path):
    case = example(tmp_path)
    (tmp_path / "rssi.csv").write_text("distance,level\n1,2\n2,3\n")
    with pytest.raises(
        InputError, match=r"got Table \(distance, level\).*under the names x_0, x_1, \.\.\., y"
    ):
        prepare(case, need="fit")


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
        (rows(), {"by": "contex"}, "by: expected one of the choices .* Did you mean 'context'"),
        (rows(), {"by": "context"}, "labels: expected a context of each row, to tune by context"),
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


def test_weights_count_rows_as_often_as_they_say():
    weight = np.where(np.arange(340) % 3 == 0, 2.0, 1.0)
    data = rows(weight=weight)
    twice = np.repeat(np.arange(340), weight.astype(int))
    again = Labels(
        x=data.x[twice], y=data.y[twice], labelled=data.labelled[twice], prediction=data.prediction[twice]
    )
    found, copied = (said(lambda d=d: label_data(d, loss="ols", scheme="ppi"))[0] for d in (data, again))
    np.testing.assert_allclose(found["center"], copied["center"], rtol=1e-9)
    plain = said(lambda: label_data(rows(), loss="ols", scheme="ppi"))[0]
    assert not np.allclose(found["center"], plain["center"], rtol=1e-3)


def near(weight=None):
    """Rows whose labels were collected at low x, where the predictor errs otherwise than elsewhere."""
    random = np.random.default_rng(9)
    x = random.uniform(0, 1, (1000, 1))
    y = 2 * x[:, 0] ** 2 + 0.1 * random.standard_normal(1000)
    labelled = np.arange(1000) < 60
    x[labelled] **= 2
    return Labels(x=x, y=np.where(labelled, y, 0.0), labelled=labelled, prediction=x[:, 0], weight=weight)


def test_labels_that_are_drawn_otherwise_than_the_rest_are_told():
    assert any("differ in x_0, p = " in text for text in said(lambda: label_data(near()))[1])
    for data in (rows(), near(np.ones(1000))):
        assert not any("not drawn" in text for text in said(lambda data=data: label_data(data))[1])


def test_few_labels_hide_neither_the_worth_nor_small_scales():
    data = rows(n=12)
    data = Labels(x=data.x, y=1e-9 * data.y, labelled=data.labelled, prediction=data.prediction)
    told = " ".join(said(lambda: label_data(data))[1])
    assert "With 12 labels the interval" in told
    assert re.search(r"are worth \d+ labels beside 12, lambda \S*e-", told)
    assert re.search(r"go with \S*e-", told)


@pytest.mark.parametrize("predicted", [True, False])
def test_rows_of_one_cluster_count_as_one(predicted):
    """Every row ten times, as of a log that repeats itself: clusters give the errors of the rows that there are."""
    data = rows(predicted=predicted)
    many = np.repeat(np.arange(340), 10)
    again = {name: getattr(data, name)[many] for name in ("x", "y", "labelled")}
    again |= {"prediction": data.prediction[many]} if predicted else {}

    def spread(data):
        found, told = said(lambda: label_data(data, seed=1))
        return float(found["prior_scale"][0]), told

    single, _ = spread(data)
    clustered, told = spread(Labels(**again, cluster=many))
    assert clustered == pytest.approx(single, rel=0.15)
    assert spread(Labels(**again))[0] < 0.5 * single
    assert not any("differ" in text for text in told)


def test_each_context_of_a_file_has_a_lambda():
    data = rows(context=np.arange(340) % 2)
    found, _ = said(lambda: label_data(data, loss="mean", by="context"))
    overall, _ = said(lambda: label_data(data, loss="mean"))
    assert float(found["center"][0]) != float(overall["center"][0])


def table(data):
    """The columns of a file of labels."""
    columns = {"x_0": data.x[:, 0], "y": np.where(data.labelled, data.y, np.nan)}
    return columns if data.prediction is None else columns | {"prediction": data.prediction}


def changed(name, index, value):
    columns = table(rows())
    columns[name] = columns.get(name, np.ones(340)).copy()
    columns[name][index] = value
    return columns


WRONG_FILES = {
    "fewer labels than folds": (
        table(rows(n=3, predicted=False)),
        "mean",
        "labelled samples: expected at least one per fold (5), got 3. Use 3 folds or fewer",
    ),
    "one class in a fold": (
        table(rows(predicted=False)) | {"y": np.where(np.arange(340) < 40, np.arange(340) == 0, np.nan)},
        "logistic",
        "expected both classes, got only 0. Use fewer folds",
    ),
    "no label": (changed("y", slice(None), np.nan), "mean", "y: expected at least one label, got none"),
    "infinite label": (
        changed("y", 7, np.inf),
        "mean",
        "y: expected finite numbers, got infinity at index 7",
    ),
    "a feature missing": (
        changed("x_0", 5, np.nan),
        "ols",
        "x: expected finite numbers, got NaN at index (5, 0)",
    ),
    "features of other names": (
        table(rows()) | {"x_2": np.ones(340)},
        "ols",
        "x: expected columns x_0 to x_1, got x_0, x_2. Number them from 0",
    ),
    "negative weight": (changed("weight", 4, -1.0), "mean", "weight: expected values from 0 up, got -1"),
    "no weight at a label": (
        table(rows()) | {"weight": np.where(np.arange(340) < 40, 0.0, 1.0)},
        "mean",
        "weight: expected a weight above 0, got zeros only",
    ),
    "misspelt column": (
        table(rows()) | {"weigth": np.ones(340)},
        "mean",
        "Did you mean 'weight'?",
    ),
}


def case_of(folder, columns, loss):
    np.savetxt(
        folder / "labels.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    file = folder / "case.toml"
    file.write_text(
        f"""[model]
name = "prediction_powered"
[model.options]
loss = "{loss}"
[data]
file = "labels.csv"
[engine]
name = "laplace"
"""
    )
    return file


@pytest.mark.parametrize("mistake", WRONG_FILES)
def test_fit_answers_a_wrong_file_in_one_line(mistake, tmp_path, capsys):
    columns, loss, message = WRONG_FILES[mistake]
    file = case_of(tmp_path, columns, loss)
    assert main(["fit", str(file), "--out", str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert message in text
    assert text.startswith("dtprob: ")
    assert text.count("\n") == 1


def test_fit_says_that_it_is_erm_without_unlabelled_rows(tmp_path, capsys):
    file = case_of(tmp_path, table(rows(count=0)), "mean")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["fit", str(file), "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr()
    assert "There are no unlabelled samples with predictions, so this is plain ERM." in told.out + told.err


def test_a_diagnosis_asks_for_the_model_of_the_labels(tmp_path):
    example(tmp_path)
    message = r"\[model\] name: .* got prediction_powered\. Set name = \"label_twin\", which asks where"
    with pytest.raises(InputError, match=message):
        prepare(load_case(tmp_path / "case.toml"), need="diagnosis")
