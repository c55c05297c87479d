"""How often 90% intervals of materials hold the truth: five unknown materials at once, over many synthetic data sets.

    python benchmarks/material_intervals.py [--sets 200] [--links 6] [--write]

For each data set the materials are drawn from the prior and a channel from them, on the paths of the demonstration's street
canyon; the channel is projected on the paths (`compressed_channel`) and the posterior sampled by the No-U-Turn sampler of
NumPyro, as the engine `nuts` does, for all data sets side by side. Walls are half-spaces: those of slabs have several modes
in the permittivity, which a single chain does not visit.
"""

import argparse
import time
from importlib import resources
from typing import Any

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from numpyro import handlers  # noqa: E402
from numpyro.infer import MCMC, NUTS  # noqa: E402
from record import record  # noqa: E402
from scipy import stats  # noqa: E402

from dtprob.case import load_case  # noqa: E402
from dtprob.models.channel import ray_traced_channel  # noqa: E402
from dtprob.models.compressed_channel import compress, compressed_channel  # noqa: E402
from dtprob.raytracing.calibration import project  # noqa: E402
from dtprob.raytracing.paths import PathSet  # noqa: E402
from dtprob.workflow import prepare  # noqa: E402

SITES = ("material_permittivity", "material_conductivity")
TONES = jnp.linspace(-50e6, 50e6, 32)
SNR_DB = 20.0


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description="Coverage of intervals of materials.")
    for name, default in (("sets", 200), ("links", 6), ("warmup", 300), ("draws", 300)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    begin = time.process_time()
    paths = street(options.links)
    truth, draws, diverging = studied(paths, options)
    seconds = round(time.process_time() - begin)
    rows = [row for site in SITES for row in judged(site, paths, truth[site], draws[site])]
    for row in rows:
        print(row)
    every = float(np.mean([row["coverage"] for row in rows]))
    print(f"all: {every:.3f} of 90% intervals hold the truth; {diverging:.4f} of draws diverged; {seconds} s")
    if options.write:
        write(rows, every, diverging, seconds)


def street(links: int) -> PathSet:
    """Paths of the demonstration, some of its links."""
    case = load_case(str(resources.files("dtprob.data") / "demo" / "case.toml"))
    paths: PathSet = prepare(case, need="fit").data["paths"]
    return paths.take(np.arange(links))


def studied(
    paths: PathSet, options: argparse.Namespace
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], float]:
    """True values (set, material), draws (set, draw, material), and the share of draws that diverged."""
    free = jnp.where(paths.mask, (paths.wavelength / (4 * jnp.pi * paths.length)) ** 2, 0.0)
    noise_power = float(jnp.mean(jnp.sum(free, axis=1))) / 10 ** (SNR_DB / 10)
    whole = {"paths": paths, "subcarrier_frequency": TONES, "noise_power": noise_power, "law": "half_space"}
    short = {"paths": paths, "noise_power": noise_power, "law": "half_space", "phase": "coherent"}

    def one(key: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array], jax.Array]:
        data_key, fit_key = jax.random.split(key)
        trace = handlers.trace(handlers.seed(ray_traced_channel, data_key)).get_trace(**whole)
        seen = compress(project(paths, TONES, trace["channel"]["value"], powers=False))
        kernel = NUTS(compressed_channel, target_accept_prob=0.9, max_tree_depth=7)
        chain = MCMC(kernel, num_warmup=options.warmup, num_samples=options.draws, progress_bar=False)
        chain.run(fit_key, **short, **seen)
        draws = chain.get_samples()
        kept = {site: trace[site]["value"] for site in SITES}, {site: draws[site] for site in SITES}
        return *kept, chain.get_extra_fields()["diverging"]

    truth, draws, diverging = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(5), options.sets))
    arrays: tuple[Any, Any] = jax.tree.map(np.asarray, (truth, draws))
    return *arrays, float(jnp.mean(diverging))


def judged(site: str, paths: PathSet, truth: np.ndarray, draws: np.ndarray) -> list[dict[str, Any]]:
    """Coverage of each material's central 90% intervals."""
    low, high = np.quantile(draws, [0.05, 0.95], axis=1)
    inside = (truth > low) & (truth < high)
    return [
        {
            "parameter": f"{site}[{name}]",
            "coverage": round(float(inside[:, index].mean()), 3),
            "p_value": round(float(stats.binomtest(int(inside[:, index].sum()), len(inside), 0.9).pvalue), 4),
            "sets": len(inside),
        }
        for index, name in enumerate(paths.material_names)
    ]


def write(rows: list[dict[str, Any]], every: float, diverging: float, seconds: int) -> None:
    """Keep the table."""
    figures = {
        "coverage": round(every, 4),
        "diverging": round(diverging, 5),
        "seconds_processor": seconds,
        "rows": rows,
    }
    what = "share of 90% intervals that hold the true material, five materials at once"
    record("material_intervals", what, ("jax", "numpyro"), figures)


if __name__ == "__main__":
    main()
