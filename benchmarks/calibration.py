"""Simulation-based calibration of the engines, at full size.

    python benchmarks/calibration.py [--engine NAME ...] [--case NAME ...] [--runs 200] [--seconds 600] [--write]

For each engine and model: values are drawn from the prior, data from them, and the true value is ranked among
19 draws of the posterior of these data. An exact engine gives even ranks and 90% intervals that hold the true value
nine times in ten; of the others the table tells how far they are from that. The prediction-powered loss has no law
of its data: there the data come from a population whose parameters are known.

--write keeps how often each rank occurred in benchmarks/results/calibration.json, and a later call goes on from there;
--seconds ends a call after so long, --table prints the table of what is there.
"""

import argparse
import itertools
import time
from typing import Any

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import numpy as np  # noqa: E402
from record import record, recorded  # noqa: E402

from dtprob.errors import InputError  # noqa: E402
from dtprob.inference import resolve  # noqa: E402
from dtprob.testing.calibration import DRAWS, judge, simulated_ranks  # noqa: E402
from dtprob.testing.calibration_cases import CASES  # noqa: E402

BLOCK = 20
CHAIN = {"warmup": 300, "draws": 10 * DRAWS, "chains": 1}
SETTINGS: dict[str, dict[str, Any]] = {
    "exact": {"draws": DRAWS},
    "laplace": {"draws": DRAWS, "starts": 2},
    "von_mises_em": {"draws": DRAWS},
    "ensemble": {"members": DRAWS, "starts": 2},
    "nuts": CHAIN,
    "blackjax_nuts": CHAIN,
    "hmc": CHAIN,
    "svi": {"draws": DRAWS, "starts": 2},
    "smc": {"draws": 10 * DRAWS, "chains": 1},
}
MODELS = ("multi_access", "phase_error_channel", "prediction_powered", "custom")

type Counts = dict[str, dict[str, dict[str, list[int]]]]


def main() -> None:
    """Run the calibration and print its table."""
    options = arguments()
    end = time.monotonic() + options.seconds
    kept = recorded("calibration")
    counts: Counts = kept.get("counts", {}) if options.write or options.table else {}
    refused: dict[str, dict[str, str]] = kept.get("refused", {})
    for engine, case in () if options.table else itertools.product(options.engine, options.case):
        if case in refused.get(engine, {}) or time.monotonic() > end:
            continue
        try:
            continued(counts.setdefault(engine, {}).setdefault(case, {}), engine, case, options.runs, end)
        except InputError as error:
            refused.setdefault(engine, {})[case] = str(error)
        if options.write:
            write({name: found for name, found in counts.items() if any(found.values())}, refused)
    table(counts, refused)


def arguments() -> argparse.Namespace:
    """Which engines and models, and how many data sets."""
    parser = argparse.ArgumentParser(description="Simulation-based calibration of the engines.")
    parser.add_argument("--engine", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(MODELS))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--table", action="store_true")
    return parser.parse_args()


def continued(counts: dict[str, list[int]], engine: str, case: str, runs: int, end: float) -> None:
    """Go on from the data sets that are counted already, in blocks, while there is time."""
    begin = time.process_time()
    done = first = sum(next(iter(counts.values()), []))
    made = CASES[case]()
    while done < runs and time.monotonic() < end:
        block = range(done, min(done + BLOCK, runs))
        found = simulated_ranks(resolve(engine, **SETTINGS[engine]), made, jax.random.key(11), block)
        for site, ranks in found.items():
            before = np.asarray(counts.get(site, [0] * (DRAWS + 1)))
            counts[site] = (before + np.bincount(ranks, minlength=DRAWS + 1)).tolist()
        done = block.stop
    seconds = time.process_time() - begin
    print(
        f"{engine:14s} {case:20s} {first} to {done} data sets, {seconds:.0f} s of processor time", flush=True
    )


def table(counts: Counts, refused: dict[str, dict[str, str]]) -> None:
    """A line per model and engine: coverage, least and most over unknowns, and p-values for all of them together."""
    for case, engine in itertools.product(MODELS, SETTINGS):
        sites = counts.get(engine, {}).get(case, {})
        if case in refused.get(engine, {}):
            print(f"| `{engine}` | {case} | refused | | | |")
        if sites:
            verdicts = {name: judge(np.repeat(np.arange(DRAWS + 1), c)) for name, c in sites.items()}
            coverage = {name: verdict.coverage for name, verdict in verdicts.items()}
            low, high = min(coverage, key=coverage.__getitem__), max(coverage, key=coverage.__getitem__)
            uneven, misses = (
                min(1.0, len(verdicts) * min(getattr(v, name) for v in verdicts.values()))
                for name in ("p_value", "coverage_p_value")
            )
            runs = sum(next(iter(sites.values())))
            print(
                f"| `{engine}` | {case} | {runs} | {coverage[low]:.2f} (`{low}`) to {coverage[high]:.2f} "
                f"| {_p(misses)} | {_p(uneven)} |"
            )


def _p(value: float) -> str:
    return f"{value:.3f}" if value >= 0.001 else "< .001"


def write(counts: Counts, refused: dict[str, dict[str, str]]) -> None:
    """Keep the counts."""
    what = "simulation-based calibration: how often each rank of the true value among 19 draws occurred"
    figures = {"settings": SETTINGS, "refused": refused, "counts": counts}
    command = "python benchmarks/calibration.py --write"
    record("calibration", what, ("jax", "numpyro", "blackjax"), figures, command=command)


if __name__ == "__main__":
    main()
