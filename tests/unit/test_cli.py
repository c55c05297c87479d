"""The command line: what it promises about exit status, messages and files."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from dtprob import __version__, stopping
from dtprob.cli import COMMANDS, main, parser
from dtprob.errors import Terminated
from dtprob.inference import SVI, Posterior

MODEL = """
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist


def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 10.0))
    mean = numpyro.deterministic("mean", slope * x)
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(mean, 0.1), obs=y)
"""

EFFECTS = """
import numpyro.distributions as dist

from dtprob.effects import Effect, Parameter

bias = Effect(
    "bias",
    {"mean": lambda value, parameters, context: value + parameters["size"]},
    (Parameter("size", dist.Normal(0.0, 1.0)),),
    physics="the instrument adds a constant",
)
"""

CASE = """
[model]
name = "line_model:line"
[data]
file = "line.csv"
[effects]
use = "line_effects:bias"
[engine]
name = "laplace"
"""


EXAMPLE = str(Path(__file__).parents[2] / "examples" / "network" / "twin.toml")


@pytest.fixture
def case(tmp_path) -> Path:
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 200)
    y = 2 * x + 0.5 + 0.1 * rng.normal(size=200)
    np.savetxt(tmp_path / "line.csv", np.column_stack([x, y]), delimiter=",", header="x,y", comments="")
    (tmp_path / "line_model.py").write_text(MODEL)
    (tmp_path / "line_effects.py").write_text(EFFECTS)
    path = tmp_path / "case.toml"
    path.write_text(CASE)
    return path


def run(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dtprob.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **options)


def test_help_is_quick():
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        assert run("--help").returncode == 0
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.3


def test_help_names_every_command():
    text = parser().format_help()
    assert all(re.search(rf"^ +{name}\b", text, re.MULTILINE) for name in COMMANDS)


WRONG_WORDS = {
    ("fitt",): "Did you mean 'fit'?",
    (): "the following arguments are required: COMMAND. See `dtprob --help`.",
    ("fit",): "the following arguments are required: CASE, --out. See `dtprob fit --help`.",
    ("list", "engine"): "Did you mean 'engines'?",
    ("fit", "a.toml", "--out", "b", "--sed", "x"): "",
    ("diagnose", "a.toml", "--out", "b", "--no-cod"): "",
}


@pytest.mark.parametrize("words", WRONG_WORDS)
def test_wrong_words_are_answered_in_one_line(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(words)
    except SystemExit as left:
        status = left.code
    text = capsys.readouterr().err
    assert status == 2
    assert text.startswith("dtprob: ")
    assert text.count("\n") == 1
    assert text.endswith(f"{WRONG_WORDS[words]}\n")


def change(case: Path, old: str, new: str) -> None:
    case.write_text(case.read_text().replace(old, new))


WRONG_INPUT = {
    "no case": (lambda case: case.unlink(), (), "expected a CASE file (TOML), got no such file"),
    "no data": (
        lambda case: change(case, "line.csv", "lin.csv"),
        (),
        "expected a data file, got no such file",
    ),
    "engine": (lambda case: change(case, "laplace", "laplas"), (), "Did you mean 'laplace'?"),
    "engine option": (lambda case: None, ("--engine", "nut"), "Did you mean 'nuts'?"),
    "setting": (
        lambda case: case.write_text(case.read_text() + "[engine.options]\ndrws = 3\n"),
        (),
        "Did you mean 'draws'?",
    ),
    "setting type": (
        lambda case: case.write_text(case.read_text() + "[engine.options]\ndraws = 'x'\n"),
        (),
        "expected a value like",
    ),
    "model": (
        lambda case: change(case, "line_model:line", "phase_error_chanel"),
        (),
        "'phase_error_channel'?",
    ),
    "own function": (
        lambda case: change(case, "line_model:line", "line_model:lin"),
        (),
        "Did you mean 'line'?",
    ),
    "not a function": (lambda case: change(case, "line_model:line", "line_model:__doc__"), (), "a function"),
    "code refused": (lambda case: None, ("--no-code",), "Leave --no-code out if you trust this code."),
    "seed": (lambda case: None, ("--seed", "-1"), "--seed: expected a whole number from 0, got -1"),
    "option": (
        lambda case: change(case, "[data]", "[model.options]\nz = 1\n[data]"),
        (),
        "[model.options]: expected no options, got 'z'",
    ),
    "effects": (
        lambda case: change(case, "line_effects:bias", "line_model:line"),
        (),
        "expected an Effect or a list of them",
    ),
    "exclude": (
        lambda case: change(case, "[engine]", 'exclude = ["bia"]\n[engine]'),
        (),
        "[effects] exclude: expected one of the effects",
    ),
    "nan": (
        lambda case: (case.parent / "line.csv").write_text("x,y\n1,2\n2,nan\n"),
        (),
        "line.csv: y: expected finite numbers, got NaN at index 1",
    ),
    "channels wanted": (
        lambda case: change(case, "line_model:line", "ray_traced_channel"),
        (),
        "line.csv: expected ChannelData, got Labels (x, y, labelled)",
    ),
}


@pytest.mark.parametrize("mistake", WRONG_INPUT)
def test_wrong_input_is_answered_in_one_line_with_status_2(mistake, case, capsys, tmp_path):
    make, options, message = WRONG_INPUT[mistake]
    make(case)
    assert main(["diagnose", str(case), "--out", str(tmp_path / "out"), *options]) == 2
    text = capsys.readouterr().err
    assert message in text
    assert text.startswith("dtprob: ")
    assert text.count("\n") == 1
    assert not (tmp_path / "out" / "report.json").exists()


def test_wrong_input_in_a_process_of_its_own(case, tmp_path):
    change(case, "laplace", "laplas")
    done = run("fit", case, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
    shown = run("fit", case, "--out", tmp_path / "out", "--debug")
    assert shown.returncode == 2
    assert "Traceback" in shown.stderr


@pytest.mark.parametrize(
    "words",
    [
        "--debug withheld score {} --key {}",
        "withheld --debug score {} --key {}",
        "withheld score {} --key {} --debug",
    ],
)
def test_debug_goes_before_and_after_a_step(words, capsys, tmp_path):
    assert main(words.format(tmp_path, tmp_path / "key.json").split()) == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_failure_of_the_job_is_status_1(case, capsys, tmp_path):
    (tmp_path / "line_model.py").write_text(MODEL.replace("slope * x", "slope * x / undefined"))
    assert main(["fit", str(case), "--out", str(tmp_path / "out")]) == 1
    text = capsys.readouterr().err
    assert text.startswith(
        "dtprob: fit failed: NameError: name 'undefined' is not defined (in line_model.py, line "
    )


def test_out_that_is_a_file(case, capsys, tmp_path):
    (tmp_path / "out").write_text("")
    assert main(["fit", str(case), "--out", str(tmp_path / "out")]) == 2
    assert "expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ("demo",),
        ("reproduce", "fig2"),
        ("twin", "run", EXAMPLE),
        ("withheld", "generate", "--track", "custom", "--count", "1"),
    ],
)
def test_out_that_is_a_file_is_said_before_any_work(words, capsys, tmp_path):
    (tmp_path / "out").write_text("")
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert "expected a folder" in capsys.readouterr().err


def test_fit_writes_a_posterior_and_its_summary(case, capsys, tmp_path):
    from dtprob.inference import Posterior

    out = tmp_path / "new" / "out"
    assert main(["fit", str(case), "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    posterior = Posterior.load(out / "posterior.nc")
    slope = summary["parameters"]["slope"]
    np.testing.assert_allclose(slope["mean"], posterior.flat("slope").mean())
    np.testing.assert_allclose(slope["mean"], 2.0, atol=0.1)
    assert slope["low"] < slope["mean"] < slope["high"]
    assert summary["provenance"]["engine"] == "laplace"
    assert len(summary["provenance"]["data_sha256"]) == 64
    told = capsys.readouterr().out
    assert "this case runs code of its own: line_model:line" in told
    assert "posterior.nc" in told.splitlines()[-1]
    again = tmp_path / "again"
    assert main(["fit", str(case), "--out", str(again)]) == 0
    assert (again / "summary.json").read_bytes() == (out / "summary.json").read_bytes()


def test_diagnose_writes_the_report_the_page_and_the_maps(case, tmp_path):
    import xarray as xr

    from dtprob.report import validate

    out = tmp_path / "out"
    assert main(["diagnose", str(case), "--out", str(out), "--debug"]) == 0
    report = validate(json.loads((out / "report.json").read_text()))
    assert report["verdict"] == "LISTED"
    assert report["causes"][0]["effects"] == ["bias"]
    np.testing.assert_allclose(next(iter(report["causes"][0]["size"].values()))["mean"], 0.5, atol=0.05)
    assert report["provenance"]["seed"] == 0
    assert "<html" in (out / "report.html").read_text()
    with xr.open_datatree(out / "gap.nc", engine="h5netcdf") as tree:
        assert tree.children


def test_a_finished_fit_is_kept_by_resume_only_while_nothing_changed(case, capsys, tmp_path):
    out = tmp_path / "out"
    words = ["fit", str(case), "--out", str(out), "--resume"]
    assert main(words) == 0
    first = (out / "summary.json").read_bytes()
    capsys.readouterr()
    assert main(words) == 0
    assert "posterior.nc is there already" in capsys.readouterr().out
    assert (out / "summary.json").read_bytes() == first
    assert main([*words, "--seed", "1"]) == 0
    assert "there already" not in capsys.readouterr().out
    assert (out / "summary.json").read_bytes() != first


@pytest.mark.study
def test_resume_keeps_no_posterior_of_another_model(case, capsys, tmp_path):
    out = tmp_path / "out"
    words = ["fit", str(case), "--out", str(out), "--resume"]
    assert main(words) == 0
    (tmp_path / "line_model.py").write_text(MODEL.replace("slope * x", "2 * slope * x"))
    del sys.modules["line_model"]
    assert main(words) == 0
    assert "there already" not in capsys.readouterr().out
    assert float(Posterior.load(out / "posterior.nc").sample(jax.random.key(0), 20)["slope"].mean()) < 1.2


def test_a_checkpoint_of_another_run_is_not_gone_on_with(case, capsys, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "posterior.checkpoint").write_text("of something else")
    (out / "posterior.begun").write_text("something else")
    words = ["fit", str(case), "--out", str(out)]
    assert main([*words, "--resume"]) == 2
    assert (
        "expected a run of the same case by the same state of dtprob, got another" in capsys.readouterr().err
    )
    assert (out / "posterior.checkpoint").read_text() == "of something else"
    assert main(words) == 0
    assert {entry.name for entry in out.iterdir()} == {"posterior.nc", "posterior.identity", "summary.json"}


def test_a_setting_that_cannot_work_costs_no_earlier_result(case, capsys, tmp_path):
    out = tmp_path / "out"
    words = ["fit", str(case), "--out", str(out)]
    assert main(words) == 0
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    for setting, said in (("draws = 0", "draws of engine laplace"), ('initial = "zzz"', "initial values")):
        text = case.read_text()
        change(case, 'name = "laplace"', f'name = "laplace"\n[engine.options]\n{setting}')
        assert main(words) == 2
        assert said in capsys.readouterr().err
        case.write_text(text)
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


@pytest.mark.parametrize(
    ("command", "line", "name"),
    [
        ("fit", 'file = "posterior.nc"', "posterior.nc"),
        ("diagnose", 'file = "line.csv"\nreference = "reference.nc"', "reference.nc"),
        ("diagnose", 'file = "gap.nc"', "gap.nc"),
    ],
)
def test_no_result_takes_the_place_of_an_input(case, capsys, command, line, name):
    (case.parent / name).write_text("the user's own")
    change(case, 'file = "line.csv"', line)
    assert main([command, str(case), "--out", str(case.parent)]) == 2
    assert f"got {name}, which is read" in capsys.readouterr().err
    assert (case.parent / name).read_text() == "the user's own"


def test_a_twin_takes_no_log_away(capsys, tmp_path):
    (tmp_path / "log.csv").write_text("slots")
    lines = Path(EXAMPLE).read_text().splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("[physical.options]"))
    end = next(k for k in range(begin + 1, len(lines)) if lines[k].startswith("["))
    text = "\n".join(lines[:begin] + lines[end:])
    changed = re.sub(r'environment = "multi_access".*', 'log = "log.csv"', text)
    (tmp_path / "twin.toml").write_text(changed)
    assert main(["twin", "run", str(tmp_path / "twin.toml"), "--out", str(tmp_path)]) == 2
    assert "got log.csv, which is read" in capsys.readouterr().err
    assert (tmp_path / "log.csv").read_text() == "slots"


def test_a_demo_overwrites_nothing(capsys, tmp_path):
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "case.toml").write_text("# mine")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "got another file" in capsys.readouterr().err
    assert {file.name for file in (tmp_path / "case").iterdir()} == {"case.toml"}
    assert (tmp_path / "case" / "case.toml").read_text() == "# mine"


def test_out_that_cannot_be_written_to_is_said_before_any_work(case, capsys):
    assert main(["diagnose", str(case), "--out", "/proc"]) == 2
    assert "expected a folder that can be written to" in capsys.readouterr().err


@pytest.mark.study
def test_a_run_that_ends_before_its_first_checkpoint_leaves_no_other_ones(case, monkeypatch, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "posterior.checkpoint").write_text("of something else")
    (out / "posterior.begun").write_text("something else")
    change(case, 'name = "laplace"', 'name = "svi"\n[engine.options]\nsteps = 20\ndraws = 20')
    words = ["fit", str(case), "--out", str(out)]
    with monkeypatch.context() as broken:
        broken.setattr(SVI, "__call__", lambda *_, **__: sys.exit(3))
        with pytest.raises(SystemExit):
            main(words)
    assert main([*words, "--resume"]) == 0


def test_a_failed_run_leaves_no_results_of_an_earlier_one(case, tmp_path):
    out = tmp_path / "out"
    assert main(["fit", str(case), "--out", str(out)]) == 0
    (tmp_path / "broken_model.py").write_text(MODEL.replace("slope * x", "slope * x / undefined"))
    change(case, "line_model", "broken_model")
    assert main(["fit", str(case), "--out", str(out)]) == 1
    assert not any((out / name).exists() for name in ("summary.json", "posterior.nc", "posterior.identity"))


def test_list(capsys):
    assert main(["list", "engines", "--json"]) == 0
    engines = json.loads(capsys.readouterr().out)
    assert {"nuts", "laplace"} <= {entry["name"] for entry in engines}
    for what in ("models", "engines", "effects"):
        assert main(["list", what]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert all(len(line.split("  ", 1)) == 2 and line.split("  ", 1)[1].strip() for line in lines)


def test_doctor(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("DTPROB_DATA", str(tmp_path))
    monkeypatch.setattr("dtprob.raytracing.llvm.find_libraries", list)
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    checks = {check["ability"]: check for check in found["checks"]}
    assert checks["infer and diagnose"]["ok"]
    assert checks["trace scenes on the CPU"] == {
        "ability": "trace scenes on the CPU",
        "ok": False,
        "found": "no libLLVM (19 or newer needed)",
        "remedy": "apt-get install libllvm19",
    }
    assert not checks["tests on measured data"]["ok"]
    assert all(check["ok"] or check["remedy"] for check in found["checks"])
    assert main(["doctor"]) == 0
    assert "missing  trace scenes on the CPU" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.study)]
)
def test_an_interrupted_fit_leaves_no_half_files(case, tmp_path, number, status):
    (tmp_path / "line_model.py").write_text(
        MODEL + "\nimport time\nprint('ready', flush=True)\ntime.sleep(60)\n"
    )
    out = tmp_path / "out"
    command = [sys.executable, "-m", "dtprob.cli", "fit", str(case), "--out", str(out)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509  (a background job may ignore it)
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        for line in process.stdout:
            if line.startswith("ready"):
                break
        process.send_signal(number)
        assert process.wait(timeout=60) == status
        text = process.stderr.read()
    assert "Traceback" not in text
    if number == signal.SIGINT:
        assert text == "dtprob: stopped. Continue with the same command and --resume.\n"
    assert not list(out.iterdir())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("lost", ["swallowed", "turned into another error"])
def test_a_signal_whose_exception_is_lost_is_raised_again(number, lost, monkeypatch):
    """Python swallows what is raised in a callback, and JAX makes a ValueError of it where it compares cache keys."""
    monkeypatch.setattr(stopping, "_AGAIN", 0.05)

    def lose() -> None:
        with stopping.Stopping() as asked:
            try:
                signal.raise_signal(number)
            except BaseException:  # noqa: BLE001
                assert asked.asked == number
                if lost == "turned into another error":
                    asked.again()
            time.sleep(5)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job may ignore it
    try:
        with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else Terminated):
            lose()
    finally:
        signal.signal(signal.SIGINT, before)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_signal_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopping.Stopping():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_cleans_up_after_a_signal_is_left_alone(number, monkeypatch):
    """The reminder is for what was lost; an alarm of whoever calls is his again afterwards."""
    monkeypatch.setattr(stopping, "_AGAIN", 0.05)
    heard: list[int] = []
    former = signal.signal(signal.SIGALRM, lambda number, _: heard.append(number))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 600.0)
    finished = False

    def ask() -> None:
        nonlocal finished
        with stopping.Stopping():
            try:
                signal.raise_signal(number)
            finally:
                time.sleep(0.3)
                finished = True

    try:
        with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else Terminated):
            ask()
        assert finished
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 500
        signal.raise_signal(signal.SIGALRM)
        assert heard == [signal.SIGALRM]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)
        signal.signal(signal.SIGINT, before)


def test_the_command_line_is_there_as_a_module():
    command = [sys.executable, "-m", "dtprob", "--version"]
    found = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert found.stdout == f"dtprob {__version__}\n"
