"""Estimates with intervals from few labels and many predictions, against ppi-python on its own estimators.

    python benchmarks/bench_prediction_powered.py [--labelled 1000] [--unlabelled 100000 1000000] [--write]
    python benchmarks/bench_prediction_powered.py --memory 10000000 [--write]

Both run in turn in one process, from NumPy arrays to an interval, after one run that does not count (that of
dtprob is reported as its first call); the figures are the ratios of their least times, of the processors and of
the clock, which a busy machine changes least. With OMP_NUM_THREADS=1 threads that only wait do not count.
--memory says instead what one process needs at most that fits least squares with an interval to so many
unlabelled samples in files. --write keeps the figures in benchmarks/results.
"""

import argparse
import os
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import numpy as np  # noqa: E402
from record import record, recorded  # noqa: E402

from dtprob.models.prediction_powered.bootstrap import bootstrap  # noqa: E402
from dtprob.models.prediction_powered.estimate import estimate  # noqa: E402
from dtprob.models.prediction_powered.sample import Sample  # noqa: E402
from dtprob.models.prediction_powered.tuning import PUBLISHED  # noqa: E402

FEATURES, FOLDS, RESAMPLES, LEVEL = 5, 5, 1000, 0.9
SLOW = ("bootstrap mean", "bootstrap ols", "logistic", "cross logistic")
"""Estimators for which the rival is run once and without a run that does not count, as it compiles nothing."""


class Arrays(NamedTuple):
    """Labelled and unlabelled samples; `unlabelled` has a prediction per fold."""

    x: np.ndarray
    y: np.ndarray
    prediction: np.ndarray
    x_unlabelled: np.ndarray
    unlabelled: np.ndarray


def main() -> None:
    """Run what was asked and print its figures."""
    options = arguments()
    if options.memory:
        figures = memory(options.memory)
        if options.write:
            what = f"least squares, tuned_cppi, {FOLDS} folds, {options.memory} unlabelled samples in files"
            record("prediction_powered_memory", what, ("jax", "numpy"), figures)
        return
    rival = ppi_python()
    rows = [row for count in options.unlabelled for row in compared(rival, options, count)]
    figures = {
        "labelled": options.labelled,
        "blas_threads": os.environ.get("OMP_NUM_THREADS", "all cores"),
        "unit": "ms; processor: of all threads; clock: of the wall; first_call: of dtprob, by the clock",
        "rows": joined(rows),
    }
    if options.write:
        what = f"estimate and 90% interval, {options.labelled} labels, {FEATURES} features"
        record("prediction_powered", what, ("jax", "numpy", "ppi-python"), figures)


def joined(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with those that are kept of other estimators and numbers of unlabelled samples."""
    new = {(row["estimator"], row["unlabelled"]) for row in rows}
    old = recorded("prediction_powered").get("rows", [])
    kept = [row for row in old if (row["estimator"], row["unlabelled"]) not in new]
    return sorted([*kept, *rows], key=lambda row: (row["unlabelled"], row["estimator"]))


def arguments() -> argparse.Namespace:
    """Sizes and number of rounds."""
    parser = argparse.ArgumentParser(description="Prediction-powered estimates against ppi-python.")
    parser.add_argument("--labelled", type=int, default=1000)
    parser.add_argument("--unlabelled", type=int, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--estimators", nargs="+", help="only these; what else was measured is kept")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def ppi_python() -> ModuleType:
    """The rival; it silences all warnings of the process when imported, which is undone."""
    try:
        version("ppi-python")
    except PackageNotFoundError:
        sys.exit("ppi-python is not installed: install the group dev (uv sync --group dev), or use --memory")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import ppi_py  # noqa: PLC0415

    warnings.filterwarnings("ignore", category=FutureWarning, module="sklearn")
    return ppi_py


def drawn(n: int, count: int, *, binary: bool) -> Arrays:
    """A linear or logistic model, and predictions of fair quality."""
    random = np.random.default_rng(0)
    slope = np.linspace(-1, 1, FEATURES)

    def rows(size: int) -> tuple[np.ndarray, np.ndarray]:
        x = np.column_stack([np.ones(size), random.standard_normal((size, FEATURES - 1))])
        return x, x @ slope

    (x, mean), (x_unlabelled, mean_unlabelled) = rows(n), rows(count)
    noise = random.standard_normal(n)
    y = (random.random(n) < 1 / (1 + np.exp(-mean))).astype(float) if binary else mean + noise
    each = mean_unlabelled[:, None] + 0.3 * random.standard_normal((count, FOLDS))
    own = mean + 0.3 * random.standard_normal(n)
    if binary:
        own, each = (1 / (1 + np.exp(-value)) for value in (own, each))
    return Arrays(x, y, own, x_unlabelled, each)


def compared(rival: ModuleType, options: argparse.Namespace, count: int) -> list[dict[str, Any]]:
    """One row per estimator."""
    rows: list[dict[str, Any]] = []
    for binary in (False, True):
        data = drawn(options.labelled, count, binary=binary)
        for name, (ours, theirs) in pairs(rival, data, binary=binary).items():
            if options.estimators and name not in options.estimators:
                continue
            rounds = 1 if name in SLOW else options.rounds
            first, times = in_turns({"dtprob": ours, "ppi_python": theirs}, rounds, warm=name not in SLOW)
            row: dict[str, Any] = {"estimator": name, "unlabelled": count}
            for part in Seconds._fields:
                own, other = (getattr(times[key], part) for key in ("dtprob", "ppi_python"))
                shown = {"dtprob": round(1e3 * own, 1), "ppi_python": round(1e3 * other, 1)}
                row[part] = shown | {"ratio": float(f"{other / own:.3g}")}
            rows.append(row | {"first_call": round(1e3 * first.clock, 1)})
            print(f"{name:16s} N={count:8d} {row['processor']} {row['clock']}", flush=True)
    return rows


type Step = Callable[[], Any]


class Seconds(NamedTuple):
    """What a step took, of all processors and by the clock."""

    processor: float
    clock: float


def pairs(rival: ModuleType, data: Arrays, *, binary: bool) -> dict[str, tuple[Step, Step]]:
    """For each estimator, dtprob's way and the rival's."""
    x, y, own, x_unlabelled, each = data
    one = each[:, 0]
    alpha = 1 - LEVEL

    def ours(loss: str, scheme: str) -> Step:
        features: dict[str, Any] = {} if loss == "mean" else {"x": x, "x_unlabelled": x_unlabelled}
        predictions = each if scheme == "cppi" else one

        def step() -> Any:
            sample = Sample(y=y, prediction=own, prediction_unlabelled=predictions, **features)
            found = estimate(loss, sample, scheme, level=LEVEL, practice=PUBLISHED)
            return found.low, found.high

        return step

    def resampled(loss: str) -> Step:
        features: dict[str, Any] = {} if loss == "mean" else {"x": x, "x_unlabelled": x_unlabelled}

        def step() -> Any:
            sample = Sample(y=y, prediction=own, prediction_unlabelled=one, **features)
            found = estimate(loss, sample, "tuned_ppi", level=LEVEL)
            found = bootstrap(jax.random.key(0), loss, sample, found, draws=RESAMPLES)
            return found.low, found.high

        return step

    def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.linalg.solve(x.T @ x, x.T @ y)

    if binary:
        return {
            "logistic": (
                ours("logistic", "tuned_ppi"),
                lambda: rival.ppi_logistic_ci(x, y, own, x_unlabelled, one, alpha),
            ),
            "cross logistic": (
                ours("logistic", "cppi"),
                lambda: rival.crossppi_logistic_ci(
                    x, y, own, x_unlabelled, each, alpha, optimizer_options={}
                ),
            ),
        }
    return {
        "mean": (ours("mean", "tuned_ppi"), lambda: rival.ppi_mean_ci(y, own, one, alpha)),
        "cross mean": (ours("mean", "cppi"), lambda: rival.crossppi_mean_ci(y, own, each, alpha)),
        "ols": (ours("ols", "tuned_ppi"), lambda: rival.ppi_ols_ci(x, y, own, x_unlabelled, one, alpha)),
        "cross ols": (
            ours("ols", "cppi"),
            lambda: rival.crossppi_ols_ci(x, y, own, x_unlabelled, each, alpha),
        ),
        "bootstrap mean": (
            resampled("mean"),
            lambda: rival.ppboot(np.mean, y, own, one, n_resamples=RESAMPLES, alpha=alpha),
        ),
        "bootstrap ols": (
            resampled("ols"),
            lambda: rival.ppboot(fit, y, own, one, x, x_unlabelled, n_resamples=RESAMPLES, alpha=alpha),
        ),
    }


def in_turns(steps: dict[str, Step], rounds: int, *, warm: bool) -> tuple[Seconds, dict[str, Seconds]]:
    """The first call of dtprob, and the least seconds of each step, taken in turn.

    Args:
        steps: what to time, dtprob first.
        rounds: how often.
        warm: whether the rival too has a run that does not count; dtprob always has.
    """
    results: dict[str, Any] = {}
    times: dict[str, list[Seconds]] = {name: [] for name in steps}

    def timed(name: str) -> Seconds:
        begin = time.process_time(), time.perf_counter()
        results[name] = steps[name]()
        return Seconds(time.process_time() - begin[0], time.perf_counter() - begin[1])

    first = timed("dtprob")
    if warm:
        timed("ppi_python")
    for _ in range(rounds):
        for name, taken in times.items():
            taken.append(timed(name))
    ends = [np.array([np.ravel(end) for end in result]) for result in results.values()]
    width = np.abs(ends[1][1] - ends[1][0])
    if np.max(np.abs(ends[0] - ends[1]) / width) > 0.25:
        sys.exit(f"the two do not compute the same thing: {ends}")
    least = {
        name: Seconds(*(min(part) for part in zip(*taken, strict=True))) for name, taken in times.items()
    }
    return first, least


def memory(count: int) -> dict[str, Any]:
    """Least squares on files larger than what is held: seconds and the greatest memory of the process."""
    small = drawn(1000, 10, binary=False)
    random = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        x = np.memmap(Path(folder) / "x", np.float64, "w+", shape=(count, FEATURES))
        each = np.memmap(Path(folder) / "prediction", np.float64, "w+", shape=(count, FOLDS))
        for start in range(0, count, 100_000):
            rows = slice(start, min(start + 100_000, count))
            x[rows] = random.standard_normal((rows.stop - start, FEATURES))
            each[rows] = x[rows, :1] + 0.3 * random.standard_normal((rows.stop - start, FOLDS))
        sample = Sample(
            x=small.x, y=small.y, prediction=small.prediction, x_unlabelled=x, prediction_unlabelled=each
        )
        begin = time.perf_counter()
        estimate("ols", sample, "tuned_cppi")
        seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(f"{count} unlabelled samples: {seconds:.1f} s, at most {peak / 2**30:.2f} GiB")
    return {
        "seconds": round(seconds, 1),
        "peak_gibibyte": round(peak / 2**30, 2),
        "files_gibibyte": round(8 * count * (FEATURES + FOLDS) / 2**30, 2),
    }


if __name__ == "__main__":
    main()
