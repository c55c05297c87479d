"""Effective draws per second of the materials of a phase-error channel: dtprob, plain NumPyro, and PyMC with nutpie.

    python benchmarks/bench_nuts.py [--links 10 50] [--rounds 3] [--nutpie PYTHON] [--write]

Each link has 8 paths with random delays that 64 tones tell apart; gains follow Fresnel's law at one unknown
permittivity and conductivity; phase errors, their concentration and the noise power are unknown. Everyone draws 500
after 500 steps of warm-up, in 2 chains, on the same data. dtprob has the model through its sufficient statistics and
with whole phases; the rivals have it as the formulas stand, in single sites.
--nutpie names the interpreter of an environment with pymc and nutpie (dependency group `rivals`).

The figure is the smaller bulk effective sample size of permittivity and conductivity over processor time, which all
cores together spend, in turns, medians; wall time is given too. Posterior means are compared with those of
dtprob's nuts, in standard deviations. --write keeps the table in benchmarks/results/nuts.json.
"""

import argparse
import datetime as dt
import functools
import json
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from dtprob.xla import avoid_miscompilation

avoid_miscompilation()  # before jax is imported

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import numpyro  # noqa: E402
import numpyro.distributions as dist  # noqa: E402
from arviz_stats.base import array_stats  # noqa: E402
from numpyro.infer import MCMC  # noqa: E402
from numpyro.infer import NUTS as RIVAL  # noqa: E402
from numpyro.infer.reparam import CircularReparam  # noqa: E402
from scipy.constants import epsilon_0  # noqa: E402

from dtprob.inference import RunOptions, fit  # noqa: E402
from dtprob.models.complex_normal import ComplexNormal  # noqa: E402

FILE = Path(__file__).parent / "results" / "nuts.json"
LEAN = RunOptions(pointwise=False, deterministics=False)
STEPS: dict[str, Any] = {"warmup": 500, "draws": 500, "chains": 2}
PATHS, TONES, FREQUENCY = 8, 64, 6.0e9
TRUTH = {"permittivity": 5.31, "conductivity": 0.139, "concentration": 2.0}


class Outcome(NamedTuple):
    """Draws of both materials, (material, chain, draw), processor and wall seconds, leapfrog steps of a draw."""

    draws: np.ndarray
    processor: float
    wall: float
    steps: float


def main() -> None:
    """Run the benchmark and print its table."""
    options = arguments()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    for links in options.links:
        rows += compared(simulated(links), options)
    if options.write:
        write(rows)


def arguments() -> argparse.Namespace:
    """Sizes, and where nutpie is."""
    parser = argparse.ArgumentParser(description="Effective draws per second against NumPyro and nutpie.")
    parser.add_argument("--links", type=int, nargs="+", default=[10, 50])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--nutpie", metavar="PYTHON")
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def simulated(links: int) -> dict[str, Any]:
    """Data of the channel, and what is known of it."""
    random = np.random.default_rng(links)
    delay = np.sort(random.uniform(0, TONES / PATHS - 1.5, (links, PATHS))) + np.arange(PATHS) * TONES / PATHS
    columns = np.exp(-2j * np.pi * np.arange(TONES)[:, None] * delay[:, None] / TONES)
    base, cosine = random.uniform(0.3, 1.0, (links, PATHS)), random.uniform(0.2, 0.95, (links, PATHS))
    data: dict[str, Any] = {"columns": columns, "base": base, "cosine": cosine}
    data["loss_per_conductivity"] = 1 / (2 * np.pi * FREQUENCY * epsilon_0)
    error = random.vonmises(0.0, TRUTH["concentration"], (links, PATHS))
    weight = np.asarray(gain(TRUTH["permittivity"], TRUTH["conductivity"], data)) * np.exp(1j * error)
    clean = np.einsum("ltp,lp->lt", columns, weight)
    noise = 0.01 * float(np.mean(np.abs(clean) ** 2))
    drawn = random.normal(size=(2, *clean.shape)) * np.sqrt(noise / 2)
    return data | {"noise": noise, "y": clean + drawn[0] + 1j * drawn[1]}


def gain(permittivity: Any, conductivity: Any, data: Mapping[str, Any]) -> Any:
    """Gain of each path: Fresnel's coefficient of a half-space, across the plane of incidence."""
    eta = permittivity - 1j * conductivity * data["loss_per_conductivity"]
    root = jnp.sqrt(eta - 1 + data["cosine"] ** 2)
    return data["base"] * (data["cosine"] - root) / (data["cosine"] + root)


def unknowns(noise: Any) -> tuple[Any, Any, Any, Any]:
    """Concentration, permittivity, conductivity, noise power."""
    concentration: Any = numpyro.sample("concentration", dist.LogNormal(0.0, 1.5))
    contrast: Any = numpyro.sample("contrast", dist.LogNormal(jnp.log(4.0), 0.4))
    conductivity: Any = numpyro.sample("conductivity", dist.LogNormal(jnp.log(0.1), 1.0))
    return (
        concentration,
        1 + contrast,
        conductivity,
        numpyro.sample("noise", dist.LogNormal(jnp.log(noise), 0.1)),
    )


def naive(data: Mapping[str, Any], y: Any) -> None:
    """As the formulas stand."""
    concentration, permittivity, conductivity, noise = unknowns(data["noise"])
    with numpyro.plate("link", len(data["base"]), dim=-2), numpyro.plate("path", PATHS, dim=-1):
        error: Any = numpyro.sample("error", dist.VonMises(0.0, concentration))
    weight = gain(permittivity, conductivity, data) * jnp.exp(1j * error)
    mean = jnp.einsum("ltp,lp->lt", data["columns"], weight)
    spread = jnp.sqrt(noise / 2)
    numpyro.sample("real", dist.Normal(mean.real, spread).to_event(2), obs=y.real)
    numpyro.sample("imaginary", dist.Normal(mean.imag, spread).to_event(2), obs=y.imag)


def reduced(data: Mapping[str, Any], root: Any, outside: Any, y: Any) -> None:
    """Through sufficient statistics, whole phases instead of errors."""
    concentration, permittivity, conductivity, noise = unknowns(data["noise"])
    found = gain(permittivity, conductivity, data)
    direction = jnp.arctan2(found.imag, found.real)
    with numpyro.plate("link", len(root), dim=-2), numpyro.plate("path", PATHS, dim=-1):
        phase: Any = numpyro.sample("phase", dist.VonMises(direction, concentration))
        weight = jnp.abs(found) * jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
        mean = jnp.sum(root * weight[:, None], axis=-1)
        numpyro.sample("y", ComplexNormal(mean, noise), obs=y)
    with numpyro.plate("links", len(root)):
        numpyro.sample("outside", dist.Gamma(float(TONES - PATHS), 1 / noise), obs=outside)


def statistics(data: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `reduced`."""
    basis, root = np.linalg.qr(data["columns"])
    y = np.einsum("ltp,lt->lp", basis.conj(), data["y"])
    outside = np.sum(np.abs(data["y"] - np.einsum("ltp,lp->lt", basis, y)) ** 2, axis=-1)
    known = {name: data[name] for name in ("base", "cosine", "loss_per_conductivity", "noise")}
    return {"data": known, "root": root, "outside": outside, "y": y}


def compared(data: dict[str, Any], options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each sampler, run in turns."""
    runs: dict[str, Callable[[], Outcome]] = {
        f"dtprob {name}": functools.partial(ours, name, statistics(data))
        for name in ("blackjax_nuts", "nuts")
    }
    runs["numpyro"] = functools.partial(plain, data)
    first = {name: run() for name, run in runs.items()}  # these compile
    if options.nutpie:
        runs["nutpie"] = functools.partial(nutpie, options.nutpie, data)
    outcomes: dict[str, list[Outcome]] = {name: [] for name in runs}
    for _ in range(options.rounds):
        for name, run in runs.items():
            outcomes[name].append(run())
    reference = outcomes["dtprob nuts"][0].draws
    rows: list[dict[str, Any]] = []
    for name, found in outcomes.items():
        apart = (found[0].draws.mean((1, 2)) - reference.mean((1, 2))) / reference.std((1, 2))
        rows.append(
            {
                "links": len(data["base"]),
                "sampler": name,
                "ess_per_processor_second": round(float(np.median([ess(o) / o.processor for o in found])), 1),
                "ess_per_wall_second": round(float(np.median([ess(o) / o.wall for o in found])), 1),
                "least_ess": round(float(np.median([ess(o) for o in found]))),
                "processor_seconds": round(float(np.median([o.processor for o in found])), 2),
                "processor_seconds_first": round(first[name].processor, 2) if name in first else None,
                "leapfrog_steps": round(float(np.median([o.steps for o in found])), 1),
                "means_apart_in_sd": round(float(np.max(np.abs(apart))), 3),
            }
        )
        print(rows[-1], flush=True)
    return rows


def ess(outcome: Outcome) -> float:
    """The smaller bulk effective sample size of the two materials."""
    stats: Any = array_stats
    return min(float(stats.ess(one, chain_axis=0, draw_axis=1)) for one in outcome.draws)


def timed(function: Callable[[], Any]) -> tuple[Any, float, float]:
    """A result, and its processor and wall seconds."""
    begin = time.process_time(), time.monotonic()
    result = function()
    return result, time.process_time() - begin[0], time.monotonic() - begin[1]


def ours(name: str, data: dict[str, Any]) -> Outcome:
    """An engine of dtprob."""
    found, processor, wall = timed(
        lambda: fit(reduced, data, engine=name, key=jax.random.key(0), options=LEAN, **STEPS)
    )
    draws = np.stack([1 + found.draws["contrast"], found.draws["conductivity"]])
    return Outcome(draws, processor, wall, float(np.mean(2.0 ** found.sample_stats["tree_depth"] - 1)))


@functools.cache
def sampler() -> MCMC:
    """NumPyro's own loop, which compiles once where data are arguments; angles as it advises, or they get stuck."""
    settings: dict[str, Any] = {
        "num_warmup": STEPS["warmup"],
        "num_samples": STEPS["draws"],
        "num_chains": STEPS["chains"],
    }
    advised = numpyro.handlers.reparam(naive, config={"error": CircularReparam()})
    return MCMC(
        RIVAL(advised), **settings, chain_method="sequential", progress_bar=False, jit_model_args=True
    )


def plain(data: dict[str, Any]) -> Outcome:
    """NumPyro."""
    known = {name: jnp.asarray(value) for name, value in data.items() if name != "y"}
    chains = sampler()
    fields = ("num_steps",)
    _, processor, wall = timed(
        lambda: chains.run(jax.random.key(0), known, jnp.asarray(data["y"]), extra_fields=fields)
    )
    drawn = chains.get_samples(group_by_chain=True)
    draws = np.stack([1 + np.asarray(drawn["contrast"]), np.asarray(drawn["conductivity"])])
    return Outcome(draws, processor, wall, float(np.mean(chains.get_extra_fields()["num_steps"])))


def nutpie(interpreter: str, data: dict[str, Any]) -> Outcome:
    """PyMC with nutpie, sampling alone: what is compiled is not counted."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "data.npz", Path(folder) / "draws.npz"
        np.savez(given, **data)
        script = Path(__file__).with_name("rival_nutpie.py")
        subprocess.run([interpreter, str(script), str(given), str(found)], check=True)
        with np.load(found) as file:
            draws = np.stack([file["permittivity"], file["conductivity"]])
            processor, wall = file["sampling"]
            return Outcome(draws, float(processor), float(wall), float(file["steps"]))


def write(rows: list[dict[str, Any]]) -> None:
    """Keep the table with what it takes to repeat it; rows of other numbers of links stay."""
    done = {row["links"] for row in rows}
    old = json.loads(FILE.read_text())["rows"] if FILE.is_file() else []
    result = {
        "benchmark": "effective draws per second of the materials of a phase-error channel",
        "command": shlex.join(["python", "benchmarks/bench_nuts.py", *sys.argv[1:]]),
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, 2 shared CPU cores, no GPU",
        "versions": {name: version(name) for name in ("jax", "numpyro", "blackjax")},
        "rows": [row for row in old if row["links"] not in done] + rows,
    }
    FILE.write_text(json.dumps(result, indent=2) + "\n")
    print(f"written to {FILE.relative_to(Path.cwd()) if FILE.is_relative_to(Path.cwd()) else FILE}")


if __name__ == "__main__":
    main()
