"""`dtprob withheld` from cases to a score, with a model of the user's own."""

import json
import shutil

import numpy as np
import pytest

from dtprob.cli import main
from dtprob.commands import withheld
from dtprob.gap.withheld.rivals.compete import RIVALS
from tests.unit.test_cli import CASE, EFFECTS, MODEL


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """One case with the effect, one without, one that cannot be read."""
    folder = tmp_path_factory.mktemp("withheld")
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 200)
    for name, bias in (("0000", 0.5), ("0001", 0.0), ("0002", 0.0)):
        own = folder / "cases" / name
        own.mkdir(parents=True)
        y = 2 * x + bias + 0.1 * rng.normal(size=200)
        np.savetxt(own / "line.csv", np.column_stack([x, y]), delimiter=",", header="x,y", comments="")
        (own / "line_model.py").write_text(MODEL)
        (own / "line_effects.py").write_text(EFFECTS)
        (own / "case.toml").write_text(CASE)
    (folder / "cases" / "0002" / "line.csv").unlink()
    key = {
        "cases": [
            {"name": "0000", "kind": "listed", "lambda": 100.0, "effects": [{"name": "bias"}]},
            {"name": "0001", "kind": "null", "lambda": 100.0, "effects": []},
            {"name": "0002", "kind": "null", "lambda": 100.0, "effects": []},
        ]
    }
    (folder / "key.json").write_text(json.dumps(key))
    return folder


@pytest.fixture(scope="module")
def answered(cases):
    status = main(
        [
            "withheld",
            "run",
            str(cases / "cases"),
            "--out",
            str(cases / "answers"),
            "--workers",
            "2",
            "--rivals",
        ]
    )
    assert status == 1  # one case cannot be read, which ends no other
    return cases


def test_answers_lie_apart_from_the_cases(cases, capsys):
    assert main(["withheld", "run", str(cases / "cases"), "--out", str(cases / "cases")]) == 2
    assert "expected a folder apart from the cases" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("records", "said"),
    [
        ([1, 2], "each with name, kind, lambda and effects"),
        (None, "each with name, kind, lambda and effects"),
        (
            [{"name": "0", "kind": "listed", "lambda": None, "effects": [{"name": "bias"}]}],
            "a number, got None",
        ),
        ([{"name": "0", "kind": "listed", "effects": [{"name": "bias"}]}], "none of 'lambda'"),
        ([{"name": "0", "kind": "listed", "lambda": 1.0, "effects": []}], "expected its effects, got 0"),
        ([{"name": "0", "kind": "listed", "lambda": 1.0, "effects": [{"name": ["bias"]}]}], "expected names"),
        ([{"name": "0", "kind": "null", "lambda": 0.0, "effects": []}] * 2, "got two of 0"),
    ],
)
def test_a_key_written_by_hand_is_checked(tmp_path, capsys, records, said):
    (tmp_path / "key.json").write_text(json.dumps({"cases": records}))
    assert main(["withheld", "score", str(tmp_path), "--key", str(tmp_path / "key.json")]) == 2
    assert said in capsys.readouterr().err


def test_a_report_that_lacks_something_is_told(tmp_path, capsys):
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "report.json").write_text('{"verdict": "NO_GAP"}')
    key = {"cases": [{"name": "0", "kind": "null", "lambda": 0.0, "effects": []}]}
    (tmp_path / "key.json").write_text(json.dumps(key))
    assert main(["withheld", "score", str(tmp_path), "--key", str(tmp_path / "key.json")]) == 2
    assert "answer 0: expected a report with its causes" in capsys.readouterr().err


def test_answers_are_reports(answered):
    verdicts = {}
    for name in ("0000", "0001"):
        report = json.loads((answered / "answers" / name / "report.json").read_text())
        verdicts[name] = report["verdict"], [cause["effects"] for cause in report["causes"]]
    assert verdicts == {"0000": ("LISTED", [["bias"]]), "0001": ("NO_GAP", [])}
    for name in ("0000", "0001"):
        said = json.loads((answered / "answers" / name / "rivals.json").read_text())
        assert set(said) == set(RIVALS)
        assert all((one["verdict"] == "NO_GAP") == (name == "0001") for one in said.values())
        assert json.loads((answered / "answers" / name / "timing.json").read_text())["seconds"] > 0
    assert "line.csv" in (answered / "answers" / "0002" / "error.txt").read_text()
    assert not (answered / "answers" / "0002" / "report.json").exists()


def test_the_score(answered, capsys):
    status = main(["withheld", "score", str(answered / "answers"), "--key", str(answered / "key.json")])
    assert status == 0
    assert "right effect first: 1/1" in capsys.readouterr().out
    score = json.loads((answered / "answers" / "score.json").read_text())
    strata = {stratum["kind"]: stratum for stratum in score["strata"]}
    assert strata["null"]["verdicts"] == {"FAILED": 1, "NO_GAP": 1}
    assert strata["listed"]["rivals"]["forward_bic"]["rates"]["right effect first"]["count"] == 1
    assert (answered / "answers" / "score.html").stat().st_size > 2000


def test_a_case_that_was_broken_off_is_missing(answered, tmp_path):
    folder = tmp_path / "answers"
    shutil.copytree(answered / "answers", folder)
    (folder / "0001" / "report.json").unlink()
    assert main(["withheld", "score", str(folder), "--key", str(answered / "key.json")]) == 0
    assert json.loads((folder / "score.json").read_text())["missing"] == ["0001"]


def test_resume_keeps_answers(answered):
    file = answered / "answers" / "0000" / "report.json"
    before = file.stat().st_mtime_ns
    shutil.rmtree(answered / "cases" / "0002")
    assert (
        main(["withheld", "run", str(answered / "cases"), "--out", str(answered / "answers"), "--resume"])
        == 0
    )
    assert file.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    "change", ["code", *(pytest.param(what, marks=pytest.mark.study) for what in ("table", "seed"))]
)
def test_resume_keeps_no_answers_to_another_case(answered, tmp_path, change, monkeypatch):
    """Nor does a case that breaks off keep an older answer."""
    folder = tmp_path / "study"
    shutil.copytree(answered / "cases" / "0001", folder / "cases" / "0001")
    shutil.copytree(answered / "answers" / "0001", folder / "answers" / "0001")
    (folder / "cases" / "0001" / "line_effects.py").write_text(EFFECTS)  # the same content
    run = ["withheld", "run", str(folder / "cases"), "--out", str(folder / "answers"), "--resume"]
    report = folder / "answers" / "0001" / "report.json"
    before = report.stat().st_mtime_ns
    assert main(run) == 0
    assert report.stat().st_mtime_ns == before
    if change == "table":
        (folder / "cases" / "0001" / "line.csv").write_text("x,y\n1,a\n")
        assert main(run) == 1
        assert not report.exists()
        assert not (report.parent / "rivals.json").exists()
        return
    if change == "code":
        (report.parent / "identity.txt").write_text("dtprob 0.0.1\n")
    assert main([*run, *(["--seed", "5"] if change == "seed" else [])]) == 0
    assert report.stat().st_mtime_ns > before


@pytest.mark.study
def test_a_worker_that_dies_ends_no_other_case_and_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(withheld, "_LIFE", 2)
    for name in "abcdef":
        folder = tmp_path / "cases" / name
        folder.mkdir(parents=True)
        own = "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n" if name == "b" else MODEL
        (folder / "line_model.py").write_text(own)
        (folder / "line_effects.py").write_text(EFFECTS)
        (folder / "case.toml").write_text(CASE)
    assert (
        main(["withheld", "run", str(tmp_path / "cases"), "--out", str(tmp_path / "out"), "--workers", "1"])
        == 1
    )
    told = {name: (tmp_path / "out" / name / "error.txt").read_text() for name in "abcdef"}
    assert "ended with status -9" in told.pop("b")
    assert all("line.csv" in text for text in told.values())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["run", "nowhere", "--out", "out"], "folders with a case.toml each"),
        (["run", ".", "--out", "out", "--workers", "0"], "--workers: expected a number from 1"),
        (["score", ".", "--key", "key.json"], "No such file"),
        (["score", ".", "--key", "list.json"], "expected a JSON object, got list"),
        (["generate", "--track", "chanel", "--count", "1", "--out", "out"], "Did you mean 'channel'?"),
        (
            ["generate", "--track", "channel", "--count", "0", "--out", "out"],
            "--count: expected a number from 1",
        ),
        (["genrate"], "Did you mean 'generate'?"),
    ],
)
def test_wrong_input(words, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.json").write_text("[]")
    try:
        status = main(["withheld", *words])
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    assert text in capsys.readouterr().err


def _one_case(folder):
    """A case whose answer, and whose failure before, are there."""
    own, answer = folder / "cases" / "a", folder / "answers" / "a"
    own.mkdir(parents=True)
    answer.mkdir(parents=True)
    (own / "case.toml").write_text(CASE)
    (answer / "report.json").write_text("{}")
    (answer / "error.txt").write_text("why it failed before")
    return own, answer


def test_a_wrong_seed_costs_no_answers(tmp_path, capsys):
    own, answer = _one_case(tmp_path)
    words = ["withheld", "run", str(own.parent), "--out", str(answer.parent), "--seed", "-1"]
    assert main(words) == 2
    assert "--seed: expected a whole number from 0, got -1" in capsys.readouterr().err
    assert (answer / "report.json").is_file()


@pytest.mark.parametrize(
    "words", [["withheld", "generate", "--track", "labels", "--count", "1"], ["reproduce", "fig2"]]
)
@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_that_no_key_can_be_made_of_is_refused(tmp_path, capsys, words, seed):
    assert main([*words, "--out", str(tmp_path / "new"), "--seed", str(seed)]) == 2
    assert f"--seed: expected a whole number from 0, got {seed}" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_case_that_breaks_off_keeps_no_older_failure(tmp_path, monkeypatch):
    """A score would count that failure, though this run has not ended."""
    own, answer = _one_case(tmp_path)

    def killed(path):
        raise KeyboardInterrupt

    monkeypatch.setattr("dtprob.case.load_case", killed)
    job = withheld._Job(own, answer, ("report.json",), seed=None, no_code=False, resume=False)
    with pytest.raises(KeyboardInterrupt):
        withheld._diagnose(job)
    assert {entry.name for entry in answer.iterdir()} == {"identity.txt"}
