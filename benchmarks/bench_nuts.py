"""Effective draws per second on two models: dtprob, plain NumPyro, and PyMC with nutpie.

    python benchmarks/bench_nuts.py [--problem NAME ...] [--rounds 3] [--nutpie PYTHON] [--write]

Problems (benchmarks/sampler_problems.py): materials of a phase-error channel of 10 or 50 links with 8 paths and 64 tones;
tables of a network of four devices from 5,000 slots. Everyone draws 500 after 500 steps of warm-up, in 2 chains, on the
same data (`exact` draws 1,000). dtprob has the models through their sufficient statistics, and the channel with whole
phases; the rivals have them as the formulas stand, in single sites.
--nutpie names the interpreter of an environment with pymc and nutpie (dependency group `rivals`).

The figure is the least bulk effective sample size of what is compared (permittivity and conductivity; entries of the
tables) over processor time, which all cores together spend, in turns, medians; wall time is given too. Means are
compared with those of dtprob's nuts, in standard deviations of the posterior. --write keeps each problem's table in
benchmarks/results/nuts.json once it is done, beside those of other problems.
"""

import argparse
import functools
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import numpy as np  # noqa: E402
from arviz_stats.base import array_stats  # noqa: E402
from numpyro.infer import MCMC  # noqa: E402
from numpyro.infer import NUTS as RIVAL  # noqa: E402
from record import record, recorded  # noqa: E402
from sampler_problems import PROBLEMS, Problem  # noqa: E402

from dtprob.inference import LATENTS_ONLY, fit  # noqa: E402

STEPS: dict[str, Any] = {"warmup": 500, "draws": 500, "chains": 2}


class Outcome(NamedTuple):
    """Draws of what is compared, (quantity, chain, draw), processor and wall seconds, leapfrog steps of a draw."""

    draws: np.ndarray
    processor: float
    wall: float
    steps: float


def main() -> None:
    """Run the benchmark and print its table."""
    options = arguments()
    for name in options.problem:
        rows = compared(name, PROBLEMS[name](), options)
        if options.write:
            write(rows)


def arguments() -> argparse.Namespace:
    """Which problems, and where nutpie is."""
    parser = argparse.ArgumentParser(description="Effective draws per second against NumPyro and nutpie.")
    parser.add_argument("--problem", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--nutpie", metavar="PYTHON")
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def compared(name: str, problem: Problem, options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each sampler, run in turns."""
    runs: dict[str, Callable[[], Outcome]] = {
        f"dtprob {engine}": functools.partial(ours, problem, engine) for engine in problem.ours
    }
    runs["numpyro"] = functools.partial(plain, problem, sampler(problem))
    first = {sampler_name: run() for sampler_name, run in runs.items()}  # these compile
    if options.nutpie:
        runs["nutpie"] = functools.partial(nutpie, options.nutpie, name.split(",", maxsplit=1)[0], problem)
    outcomes: dict[str, list[Outcome]] = {sampler_name: [] for sampler_name in runs}
    for _ in range(options.rounds):
        for sampler_name, run in runs.items():
            outcomes[sampler_name].append(run())
    reference = outcomes["dtprob nuts"][0].draws
    rows: list[dict[str, Any]] = []
    for sampler_name, found in outcomes.items():
        apart = (found[0].draws.mean((1, 2)) - reference.mean((1, 2))) / reference.std((1, 2))
        cold = first[sampler_name].processor if sampler_name in first else None
        rows.append(
            {
                "problem": name,
                "sampler": sampler_name,
                "ess_per_processor_second": middle([ess(o) / o.processor for o in found], 1),
                "ess_per_wall_second": middle([ess(o) / o.wall for o in found], 1),
                "least_ess": round(middle([ess(o) for o in found], 0)),
                "processor_seconds": middle([o.processor for o in found], 2),
                "processor_seconds_first": cold and round(cold, 2),
                "wall_seconds_first": cold and round(first[sampler_name].wall, 2),
                "leapfrog_steps": middle([o.steps for o in found], 1),
                "means_apart_in_sd": round(float(np.max(np.abs(apart))), 3),
            }
        )
        print(rows[-1], flush=True)
    return rows


def middle(values: list[float], digits: int) -> float:
    """The median, rounded."""
    return round(float(np.median(values)), digits)


def ess(outcome: Outcome) -> float:
    """The least bulk effective sample size of what is compared."""
    stats: Any = array_stats
    return min(float(stats.ess(one, chain_axis=0, draw_axis=1)) for one in outcome.draws)


def timed(function: Callable[[], Any]) -> tuple[Any, float, float]:
    """A result, and its processor and wall seconds."""
    begin = time.process_time(), time.monotonic()
    result = function()
    return result, time.process_time() - begin[0], time.monotonic() - begin[1]


def ours(problem: Problem, engine: str) -> Outcome:
    """An engine of dtprob."""
    given, key = problem.ours[engine], jax.random.key(0)
    settings = given.settings or STEPS
    found, processor, wall = timed(
        lambda: fit(given.model, given.data, engine=engine, key=key, options=LATENTS_ONLY, **settings)
    )
    steps = float(np.mean(2.0 ** found.sample_stats["tree_depth"] - 1))
    return Outcome(given.quantities(found.draws), processor, wall, steps)


def sampler(problem: Problem) -> MCMC:
    """NumPyro's own loop, which compiles once where data are arguments."""
    settings: dict[str, Any] = {
        "num_warmup": STEPS["warmup"],
        "num_samples": STEPS["draws"],
        "num_chains": STEPS["chains"],
    }
    kernel = RIVAL(problem.naive)
    return MCMC(kernel, **settings, chain_method="sequential", progress_bar=False, jit_model_args=True)


def plain(problem: Problem, chains: MCMC) -> Outcome:
    """NumPyro."""
    _, processor, wall = timed(
        lambda: chains.run(jax.random.key(0), *problem.given, extra_fields=("num_steps",))
    )
    draws = problem.naive_quantities(chains.get_samples(group_by_chain=True))
    return Outcome(draws, processor, wall, float(np.mean(chains.get_extra_fields()["num_steps"])))


def nutpie(interpreter: str, model: str, problem: Problem) -> Outcome:
    """PyMC with nutpie, sampling alone: what is compiled is not counted."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "data.npz", Path(folder) / "draws.npz"
        np.savez(given, **problem.arrays)
        script = Path(__file__).with_name("rival_nutpie.py")
        subprocess.run([interpreter, str(script), model, str(given), str(found)], check=True)
        with np.load(found) as file:
            processor, wall = file["sampling"]
            return Outcome(file["draws"], float(processor), float(wall), float(file["steps"]))


def write(rows: list[dict[str, Any]]) -> None:
    """Keep a problem's table; those of other problems stay."""
    done = {row["problem"] for row in rows}
    kept = [row for row in recorded("nuts").get("rows", []) if row["problem"] not in done]
    order = list(PROBLEMS)
    table = sorted(kept + rows, key=lambda row: order.index(row["problem"]))
    command = "python benchmarks/bench_nuts.py --nutpie PYTHON --write"
    what = "effective draws per second of the unknowns of two models"
    record("nuts", what, ("jax", "numpyro", "blackjax"), {"rows": table}, command=command)


if __name__ == "__main__":
    main()
