"""Simulation-based calibration of the engines on small models, at full size.

    python benchmarks/calibration.py [--engine NAME ...] [--case NAME ...] [--runs 300] [--write]

For each engine and model: values are drawn from the prior, data from them, and the true value is ranked among
19 draws of the posterior of these data. An exact engine gives even ranks and 90% intervals that hold the true value
nine times in ten; of the others the table tells how far they are from that. --write adds the rows to
benchmarks/results/calibration.json.
"""

import argparse
import datetime as dt
import json
import platform
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dtprob.xla import avoid_miscompilation

avoid_miscompilation()  # before jax is imported

import jax  # noqa: E402

from dtprob.errors import InputError  # noqa: E402
from dtprob.inference import resolve  # noqa: E402
from dtprob.testing.calibration import CASES, DRAWS, judge, simulated_ranks  # noqa: E402

FILE = Path(__file__).parent / "results" / "calibration.json"
CHAIN = {"warmup": 300, "draws": 10 * DRAWS, "chains": 1}
SETTINGS: dict[str, dict[str, Any]] = {
    "nuts": CHAIN,
    "blackjax_nuts": CHAIN,
    "smc": {"draws": 20 * DRAWS, "chains": 1},
    "svi": {"draws": DRAWS},
    "laplace": {"draws": DRAWS},
    "ensemble": {"members": DRAWS},
    "exact": {"draws": DRAWS},
}


def main() -> None:
    """Run the calibration and print its table."""
    options = arguments()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    for engine in options.engine:
        for case in options.case:
            rows += calibrated(engine, case, options.runs)
    if options.write:
        write(rows)


def arguments() -> argparse.Namespace:
    """Which engines and models, and how many data sets."""
    parser = argparse.ArgumentParser(description="Simulation-based calibration of the engines.")
    parser.add_argument("--engine", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def calibrated(engine: str, case: str, runs: int) -> list[dict[str, Any]]:
    """A row for each entry of each site; none where the engine does not serve the model."""
    begin = time.process_time()
    try:
        ranks = simulated_ranks(resolve(engine, **SETTINGS[engine]), CASES[case], jax.random.key(11), runs)
    except InputError as error:
        print(f"{engine:14s} {case:13s} refused: {error}")
        return []
    seconds = time.process_time() - begin
    rows: list[dict[str, Any]] = []
    for site, found in ranks.items():
        verdict = judge(found)
        print(
            f"{engine:14s} {case:13s} {site:10s} uneven p {verdict.p_value:.4f}   90% intervals hold "
            f"{verdict.coverage:.3f} (p {verdict.coverage_p_value:.4f})   mean rank {verdict.mean:.3f}",
            flush=True,
        )
        facts = {name: round(value, 5) for name, value in verdict._asdict().items()}
        rows.append({"engine": engine, "case": case, "site": site, "runs": runs, **facts})
    print(f"{engine:14s} {case:13s} {seconds:.0f} s of processor time")
    return rows


def write(rows: list[dict[str, Any]]) -> None:
    """Put the rows in place of older ones of the same engine and case."""
    old = json.loads(FILE.read_text())["rows"] if FILE.is_file() else []
    done = {(row["engine"], row["case"]) for row in rows}
    kept = [row for row in old if (row["engine"], row["case"]) not in done]
    result = {
        "benchmark": "simulation-based calibration: ranks of true values among 19 draws",
        "command": shlex.join(["python", "benchmarks/calibration.py", *sys.argv[1:]]),
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, 2 shared CPU cores, no GPU",
        "versions": {name: version(name) for name in ("jax", "numpyro", "blackjax")},
        "rows": kept + rows,
    }
    FILE.write_text(json.dumps(result, indent=2) + "\n")
    print(f"written to {FILE.relative_to(Path.cwd()) if FILE.is_relative_to(Path.cwd()) else FILE}")


if __name__ == "__main__":
    main()
