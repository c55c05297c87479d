"""What a diagnosis takes with more candidates and more links: processor time by part and in all, and peak memory.

    python benchmarks/bench_diagnosis.py [--case CANDIDATES LINKS OUTPUTS]... [--write]

A channel of four paths per link over a band, its complex gain and its noise unknown; candidates are ripples over the band
and gains of groups of links, and the data have one of the ripples, of lambda 100. Timed are the fit of the base model and
the first look: scores of all candidates with their bootstrap of 400 data sets, and the tests of all sites, compilation
included. "scores again" is what the scores and their information take once everything is compiled and without the
bootstrap; "gradient" is one of the model's own log posterior, compiled. "whole" is a diagnosis from the data to its result
by `laplace`, and "whole, by the clock" its seconds. Each case runs in a process of its own; memory is the process's peak.
--write keeps the figures, beside those of other cases, in benchmarks/results/diagnosis.json.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from typing import Any

import dtprob
from dtprob.threads import one_thread

dtprob.configure()  # before the first array
one_thread()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import numpyro  # noqa: E402
import numpyro.distributions as dist  # noqa: E402
from record import record, recorded  # noqa: E402

from dtprob.effects.effect import Effect, Parameter  # noqa: E402
from dtprob.gap.diagnose import diagnose  # noqa: E402
from dtprob.gap.fitting.base import fit_base  # noqa: E402
from dtprob.gap.fitting.bootstrap import replicate  # noqa: E402
from dtprob.gap.fitting.projection import project  # noqa: E402
from dtprob.gap.model.problem import Problem  # noqa: E402
from dtprob.gap.settings import Settings  # noqa: E402
from dtprob.gap.where.locate import locate  # noqa: E402
from dtprob.gap.which.directions import surroundings, tangents  # noqa: E402
from dtprob.gap.which.screen import screen  # noqa: E402
from dtprob.inference import Laplace  # noqa: E402
from dtprob.models.complex_normal import ComplexNormal  # noqa: E402
from dtprob.models.declaration import model  # noqa: E402

CASES = (
    [(n, 100, 64) for n in (16, 64, 256, 1024)]
    + [(64, n, 64) for n in (10, 1000, 10_000)]
    + [(250, 1000, 256)]
)
PATHS, GRADIENTS = 4, 20
NOISE, LAMBDA = 0.2, 100.0


@model(axes={"path_gain": ("link", "path"), "noiseless": ("link", "subcarrier")}, cluster="link")
def channel(gain: Any, delay: Any, frequency: Any, y: Any = None) -> None:
    """Known paths through a front end of unknown gain, in unknown noise."""
    size = numpyro.sample("size", dist.LogNormal(0.0, 0.3))
    turn = numpyro.sample("turn", dist.Normal(0.0, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-3.0, 1.0))
    path_gain = jnp.asarray(numpyro.deterministic("path_gain", gain))
    phase = -2 * jnp.pi * delay[..., None] * frequency
    response = jnp.sum(path_gain[..., None] * jax.lax.complex(jnp.cos(phase), jnp.sin(phase)), axis=1)
    front_end = size * jax.lax.complex(jnp.cos(turn), jnp.sin(turn))
    noiseless = numpyro.deterministic("noiseless", front_end * response)
    with numpyro.plate("link", gain.shape[0], dim=-2), numpyro.plate("subcarrier", len(frequency), dim=-1):
        numpyro.sample("y", ComplexNormal(noiseless, noise), obs=y)


def candidates(count: int, links: int) -> list[Effect]:
    """Half of them ripples over the band, half of them gains of groups of links."""
    parameters = (Parameter("share", dist.Normal(0.0, 0.1)),)

    def ripple(j: int) -> Effect:
        def rewrite(value: Any, p: Any, context: Any) -> Any:
            return value * (1 + p["share"] * jnp.cos(2 * jnp.pi * (j + 1) / count * context["frequency"]))

        return Effect("ripple", {"noiseless": rewrite}, parameters, instance=str(j))

    def level(j: int) -> Effect:
        chosen = (np.arange(links) % 7 == j % 7) & (np.random.default_rng(j).random(links) < 0.5)

        def rewrite(value: Any, p: Any, _: Any) -> Any:
            return value * (1 + p["share"] * jnp.asarray(chosen)[:, None])

        return Effect("level", {"path_gain": rewrite}, parameters, instance=str(j))

    return [ripple(j // 2) if j % 2 else level(j // 2) for j in range(count)]


def data(count: int, links: int, outputs: int) -> dict[str, Any]:
    """A measurement of which the twin lacks the middle ripple: the first ones look like another gain of the front end."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    gain, delay = normal(links, PATHS), rng.uniform(0.0, 0.4, (links, PATHS)) * outputs / 64
    frequency = np.arange(outputs) - (outputs - 1) / 2
    clean = np.einsum("lp,lpk->lk", gain, np.exp(-2j * np.pi * delay[..., None] * frequency))
    ripple = clean * np.cos(2 * np.pi * (count // 4 + 1) / count * frequency)
    share = np.sqrt(LAMBDA / (2 * np.sum(np.abs(ripple) ** 2) / NOISE**2))
    y = clean + share * ripple + NOISE * normal(links, outputs)
    return {"gain": gain, "delay": delay, "frequency": frequency, "y": y}


def measure(count: int, links: int, outputs: int) -> dict[str, Any]:
    """The figures of one case."""
    seconds: dict[str, float] = {}
    latest = time.process_time()

    def mark[T](name: str, value: T) -> T:
        nonlocal latest
        jax.block_until_ready(value)
        seconds[name], latest = round(time.process_time() - latest, 3), time.process_time()
        return value

    key, settings = jax.random.key(0), Settings()
    problem = Problem(channel, data(count, links, outputs), candidates(count, links))
    fitted = mark("fit", fit_base(problem, key))
    projection = project(problem, fitted)
    drawn = mark("bootstrap", replicate(problem, fitted, projection, key, settings))
    found = mark("scores", screen(problem, fitted, projection, drawn, settings))
    mark("sites", locate(problem, fitted, projection, drawn, settings))
    arrays = problem.compiled.arrays
    slope = jax.jit(jax.grad(lambda x, arrays: jnp.sum(problem.compiled.terms(x, arrays).likelihood)))
    mark("compilation of a gradient", slope(jnp.asarray(fitted.x), arrays))
    mark("gradient", [slope(jnp.asarray(fitted.x), arrays) for _ in range(GRADIENTS)])
    around = surroundings(problem, fitted.x)
    mark("scores again", projection.information(tangents(around, problem.effects, problem.programs).columns))
    clock = time.perf_counter()
    answer = mark(
        "whole",
        diagnose(problem.model, problem.data, problem.effects, key=key, engine=Laplace(), settings=settings),
    )
    seconds["whole, by the clock"] = round(time.perf_counter() - clock, 3)
    seconds["gradient"] = round(seconds["gradient"] / GRADIENTS, 5)
    del seconds["compilation of a gradient"]
    return {
        "candidates": count,
        "links": links,
        "outputs": outputs,
        "seconds": seconds,
        "peak_GiB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "verdict": answer.verdict,
        "causes": [list(cause.effects) for cause in answer.causes],
        "largest_z": round(float(np.abs(found.z).max()), 2),
    }


def main() -> None:
    """Measure each case in a process of its own."""
    parser = argparse.ArgumentParser(description="time and memory of a diagnosis against its size")
    parser.add_argument(
        "--case", type=int, nargs=3, action="append", metavar=("CANDIDATES", "LINKS", "OUTPUTS")
    )
    parser.add_argument("--write", action="store_true", help="keep the figures")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(measure(*options.case[0])))
        return
    for case in options.case or CASES:
        words = [sys.executable, __file__, "--alone", "--case", *map(str, case)]
        done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
        row = json.loads(done.stdout.splitlines()[-1])
        print(row, flush=True)
        if options.write:
            sizes = ("candidates", "links", "outputs")
            others = [r for r in recorded("diagnosis").get("cases", []) if any(r[s] != row[s] for s in sizes)]
            rows = sorted([*others, row], key=lambda r: [r[s] for s in sizes])
            record("diagnosis", "a diagnosis against its size", ["jax", "numpyro"], {"cases": rows})


if __name__ == "__main__":
    main()
