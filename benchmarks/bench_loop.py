"""What the run loop costs beside the samplers themselves, and many small posteriors at once against one by one.

    python benchmarks/bench_loop.py [--rounds 5] [--sites 1000] [--alone 30] [--part loop laplace hmc nuts] [--write]

Loop: a logistic regression of 50 coefficients on 2,000 rows, the default 4 chains of 1,000 + 1,000 steps. Direct is the
kernel of NumPyro or of BlackJAX in one compiled loop with the same keys, so that both make the same trajectories; the
run loop adds chunks, statistics, the layout of the posterior and its provenance.
Sites: a line with unknown noise through 12 points at each of many places, by Laplace's method and by chains (200 + 200
steps, 2 chains): `fit_each` with laplace, hmc or nuts against `fit` with laplace or nuts for some of them, its time
scaled to all. Of chains the effective draws of a place are compared too: the least of its unknowns, median over places.
Processor time, compiled before, in turns within one process; medians. --write keeps the figures in
benchmarks/results/loop.json.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import numpyro  # noqa: E402
import numpyro.distributions as dist  # noqa: E402
from arviz_stats.base import array_stats  # noqa: E402
from record import record, recorded  # noqa: E402

from dtprob.inference import LATENTS_ONLY, NUTS, BlackJAXNUTS, Posterior, fit, fit_each  # noqa: E402
from dtprob.inference.build import build_target  # noqa: E402
from dtprob.inference.chains import START, STEP  # noqa: E402
from dtprob.inference.kernel import Place  # noqa: E402
from dtprob.inference.target import Inputs, Target  # noqa: E402

STEPS: dict[str, Any] = {"warmup": 1000, "draws": 1000, "chains": 4}
CHAINS: dict[str, Any] = {"warmup": 200, "draws": 200, "chains": 2}
SHORT: dict[str, dict[str, Any]] = {
    "laplace": {"engine": "laplace", "draws": 400},
    "hmc": {"engine": "hmc", **CHAINS},
    "nuts": {"engine": "nuts", **CHAINS},
}
ALONE = {"laplace": "laplace", "hmc": "nuts", "nuts": "nuts"}
"""What one would use for one place alone."""


def regression(x: Any, y: Any = None) -> None:
    """Fifty coefficients, binary data."""
    with numpyro.plate("column", x.shape[1]):
        weight = numpyro.sample("weight", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Bernoulli(logits=x @ weight), obs=y)


def place(x: Any, y: Any = None) -> None:
    """A line through the measurements at one place, noise unknown."""
    level = numpyro.sample("level", dist.Normal(0.0, 2.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.5))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(level + slope * x, noise), obs=y)


def main() -> None:
    """Run the benchmark and print its figures."""
    options = arguments()
    for part in options.part:
        kinds = (NUTS, BlackJAXNUTS)
        rows = [loop(kind, options.rounds) for kind in kinds] if part == "loop" else [sites(part, options)]
        print(*rows, sep="\n", flush=True)
        if options.write:
            write(rows)


def arguments() -> argparse.Namespace:
    """Sizes."""
    parser = argparse.ArgumentParser(
        description="The run loop against the samplers; many posteriors at once."
    )
    for name, default in (("rounds", 5), ("sites", 1000), ("alone", 30)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parts = ["loop", *SHORT]
    parser.add_argument("--part", nargs="+", choices=parts, default=parts)
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def loop(kind: type[NUTS] | type[BlackJAXNUTS], rounds: int) -> dict[str, Any]:
    """Processor time of the engine and of its kernel alone."""
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 50))
    y = (random.uniform(size=2000) < 1 / (1 + np.exp(-0.3 * x.sum(1) / 7))).astype(int)
    start = {"weight": np.zeros(50)}
    engine = kind(**STEPS, initial=start)
    key, data = jax.random.key(1), {"x": x, "y": y}
    target, inputs = build_target(regression, data)
    point = target.prior_median(inputs, target.latent_values(start))
    kernel: Any = engine.kernel(STEPS["warmup"])

    def direct(self: Target, u: jax.Array, chain_key: jax.Array, arrays: Inputs) -> jax.Array:
        at = Place(jnp.zeros(0), arrays)
        state = kernel.init(self, jax.random.fold_in(chain_key, START), u, at)
        step_key = jax.random.fold_in(chain_key, STEP)

        def body(number: jax.Array, carry: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
            own = jax.random.split(jax.random.fold_in(step_key, number))[0]
            moved, _ = kernel.step(self, own, carry[0], number, at)
            return moved, carry[1].at[number].set(kernel.position(moved))

        kept = jnp.zeros((STEPS["warmup"] + STEPS["draws"], self.dimension))
        return jax.lax.fori_loop(0, kept.shape[0], body, (state, kept))[1]

    compiled = target.compiled(direct)

    def plain() -> np.ndarray:
        keys = [jax.random.fold_in(key, chain) for chain in range(STEPS["chains"])]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # as the run loop does: cores share caches
            paths = list(pool.map(lambda one: np.asarray(compiled(point, one, inputs)), keys))
        return np.stack(paths)[:, STEPS["warmup"] :]

    ours = engine(key, regression, data, options=LATENTS_ONLY).draws["weight"]
    theirs = inputs.location + inputs.scale * plain()
    same = float(np.max(np.abs(ours - theirs)))
    times = in_turns(
        {"dtprob": lambda: engine(key, regression, data, options=LATENTS_ONLY), "direct": plain}, rounds
    )
    ratios = [a / b - 1 for a, b in zip(times["dtprob"], times["direct"], strict=True)]
    return {
        "what": f"loop of {engine.name}",
        "largest_difference_of_draws": same,
        "seconds": {name: round(float(np.median(t)), 3) for name, t in times.items()},
        "overhead": round(float(np.median(ratios)), 4),
    }


def sites(engine: str, options: argparse.Namespace) -> dict[str, Any]:
    """Processor time of all places at once, and of some one by one, scaled."""
    random = np.random.default_rng(1)
    x = np.linspace(-1.0, 1.0, 12)
    level, slope = random.normal(size=(2, options.sites, 1))
    y = level + slope * x + 0.5 * random.normal(size=(options.sites, 12))
    key = jax.random.key(2)
    keys = [jax.random.fold_in(key, i) for i in range(options.alone)]

    def together() -> Any:
        return fit_each(place, {"x": x, "y": y}, ["y"], key=key, options=LATENTS_ONLY, **SHORT[engine])

    def alone() -> list[Any]:
        return [
            fit(place, {"x": x, "y": y[i]}, key=keys[i], options=LATENTS_ONLY, **SHORT[ALONE[engine]])
            for i in range(options.alone)
        ]

    ours, theirs = together(), alone()
    errors = [
        np.ravel(one.draws["level"].mean() - ours.draws["level"][..., i].mean()) / one.draws["level"].std()
        for i, one in enumerate(theirs)
    ]
    times = in_turns({"fit_each": together, "fit": alone}, options.rounds)
    scale = options.sites / options.alone
    ratios = [scale * a / b for a, b in zip(times["fit"], times["fit_each"], strict=True)]
    draws = {} if engine == "laplace" else effective(ours, theirs)
    return {
        "what": f"{options.sites} places with {engine}",
        "one_by_one": {"engine": ALONE[engine], "places": options.alone},
        "largest_difference_of_means_in_sd": round(float(np.max(np.abs(errors))), 3),
        "seconds": {
            "fit_each": round(float(np.median(times["fit_each"])), 3),
            "fit_scaled_to_all": round(float(np.median(times["fit"])) * scale, 2),
        },
        "ratio": round(float(np.median(ratios)), 1),
        **draws,
    }


def effective(ours: Posterior, theirs: list[Posterior]) -> dict[str, Any]:
    """Effective draws of a place, from all places at once and one by one."""
    stats: Any = array_stats

    def least(draws: Iterable[np.ndarray]) -> float:
        return min(float(stats.ess(values, chain_axis=0, draw_axis=1)) for values in draws)

    together = [least(ours.draws[name][..., i] for name in ours.latent) for i in range(len(theirs))]
    alone = [least(one.draws[name] for name in one.latent) for one in theirs]
    return {
        "effective_draws": {
            "fit_each": round(float(np.median(together))),
            "fit": round(float(np.median(alone))),
        }
    }


def in_turns(functions: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Processor times of each, called in turn."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            begin = time.process_time()
            function()
            times[name].append(time.process_time() - begin)
    return times


def write(rows: list[dict[str, Any]]) -> None:
    """Keep the figures; rows that were not measured again stay."""
    done = {row["what"] for row in rows}
    kept = [row for row in recorded("loop").get("rows", []) if row["what"] not in done]
    what = "processor time of the run loop against the kernels alone; many posteriors at once"
    command = "python benchmarks/bench_loop.py --write"
    record("loop", what, ("jax", "numpyro", "blackjax"), {"rows": kept + rows}, command=command)


if __name__ == "__main__":
    main()
