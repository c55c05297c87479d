"""Cost and error of every engine on three models, against a long run or the closed form.

    python benchmarks/bench_engines.py [--engine NAME ...] [--model NAME ...] [--write]

Cost is processor time: of the first call, which compiles, and of a second one with other data of the same
shapes, which does not. Errors are in standard deviations of the reference: the largest error of a mean, and
the median ratio of standard deviations (1 is right; below it intervals are too narrow). The rival is NumPyro's
own MCMC with the same model and settings as `nuts`, in the same run. --write keeps the table in
benchmarks/results/engines.json.
"""

import argparse
import functools
import shlex
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import numpyro  # noqa: E402
import numpyro.distributions as dist  # noqa: E402
from numpyro.infer import MCMC  # noqa: E402
from numpyro.infer import NUTS as RIVAL  # noqa: E402
from numpyro.infer.reparam import CircularReparam  # noqa: E402
from record import record, recorded  # noqa: E402

from dtprob.errors import InputError  # noqa: E402
from dtprob.inference import LATENTS_ONLY, NUTS, Posterior, resolve, summary  # noqa: E402
from dtprob.models.complex_normal import ComplexNormal  # noqa: E402

CHAINS = {"warmup": 500, "draws": 500, "chains": 2}
SETTINGS: dict[str, dict[str, Any]] = {
    "nuts": CHAINS,
    "blackjax_nuts": CHAINS,
    "smc": {"draws": 500, "chains": 2},
    "svi": {},
    "von_mises_em": {},
    "laplace": {},
    "ensemble": {},
    "exact": {},
}


def linear(x: Any, y: Any = None) -> None:
    """Twenty coefficients, known noise: the posterior is normal."""
    with numpyro.plate("column", x.shape[1]):
        weight = numpyro.sample("weight", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(x @ weight, 1.0), obs=y)


def logistic(x: Any, y: Any = None) -> None:
    """Ten coefficients with an unknown common scale, binary data."""
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("column", x.shape[1]):
        weight = numpyro.sample("weight", dist.Normal(0.0, scale))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Bernoulli(logits=x @ weight), obs=y)


def phases(x: Any, y: Any = None) -> None:
    """Phase errors of the paths of several links, with unknown concentration and noise power."""
    concentration = numpyro.sample("concentration", dist.LogNormal(0.5, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-2.0, 1.0))
    with numpyro.plate("link", x.shape[0], dim=-2):
        with numpyro.plate("path", x.shape[1], dim=-1):
            phase = numpyro.sample("phase", dist.VonMises(0.0, concentration))
        mean = jnp.einsum("lp,lpf->lf", jnp.exp(1j * phase), x)
        with numpyro.plate("subcarrier", x.shape[2], dim=-1):
            numpyro.sample("y", ComplexNormal(mean, noise), obs=y)


def regressors(rows: int, columns: int) -> np.ndarray:
    """Correlated columns."""
    random = np.random.default_rng(0)
    return random.normal(size=(rows, columns)) + 0.7 * random.normal(size=(rows, 1))


def responses(links: int, paths: int, subcarriers: int) -> np.ndarray:
    """What each path alone would give on each subcarrier."""
    random = np.random.default_rng(0)
    gain = random.normal(size=(2, links, paths)) / np.sqrt(2)
    delay = random.uniform(size=(links, paths, 1))
    return (gain[0] + 1j * gain[1])[..., None] * np.exp(-2j * np.pi * delay * np.arange(subcarriers))


MODELS: Mapping[str, tuple[Callable[..., None], np.ndarray]] = {
    "linear": (linear, regressors(100, 20)),
    "logistic": (logistic, regressors(200, 10)),
    "phases": (phases, responses(2, 3, 16)),
}


def main() -> None:
    """Run the benchmark and print its table."""
    options = arguments()
    rows: list[dict[str, Any]] = []
    for name in options.model:
        model, x = MODELS[name]
        first, second = (simulated(model, x, seed) for seed in (1, 2))
        reference = reference_of(model, second)
        for engine in options.engine:
            row = measured(engine, model, first, second, reference)
            rows += [{"model": name, **row}] if row else []
        if "nuts" in options.engine:
            rows.append({"model": name, **rival(model, first, second, reference)})
        for row in rows:
            if row["model"] == name:
                print(row, flush=True)
    if options.write:
        write(rows)


def arguments() -> argparse.Namespace:
    """Which engines and models."""
    parser = argparse.ArgumentParser(description="Cost and error of the engines.")
    parser.add_argument("--engine", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--model", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def simulated(model: Callable[..., None], x: np.ndarray, seed: int) -> dict[str, Any]:
    """Data from the prior."""
    trace = numpyro.handlers.trace(numpyro.handlers.seed(model, seed)).get_trace(x)
    return {"x": x, "y": np.asarray(trace["y"]["value"])}


def reference_of(model: Callable[..., None], data: dict[str, Any]) -> Posterior:
    """The closed form where there is one, else a long run."""
    try:
        return resolve("exact", draws=20_000)(jax.random.key(9), model, data, options=LATENTS_ONLY)
    except InputError:
        return NUTS(warmup=1000, draws=2000, chains=2)(jax.random.key(9), model, data, options=LATENTS_ONLY)


def measured(
    name: str, model: Callable[..., None], first: dict[str, Any], second: dict[str, Any], reference: Posterior
) -> dict[str, Any]:
    """A row of the table; nothing where the engine does not serve the model."""
    engine = resolve(name, **SETTINGS[name])
    model = functools.partial(model)  # another object, for which nothing is compiled yet
    try:
        cold, _ = timed(lambda: engine(jax.random.key(0), model, first, options=LATENTS_ONLY))
    except InputError:
        return {}
    warm, posterior = timed(lambda: engine(jax.random.key(1), model, second, options=LATENTS_ONLY))
    facts = {n: float(posterior.extra[n]) for n in ("log_evidence", "pareto_k") if n in posterior.extra}
    return {"engine": name, **seconds(cold, warm), **errors(posterior, reference), **facts}


def rival(
    model: Callable[..., None], first: dict[str, Any], second: dict[str, Any], reference: Posterior
) -> dict[str, Any]:
    """NumPyro's own loop, with angles as it advises: two helper coordinates each."""
    circular = {name: CircularReparam() for name in reference.circular}
    chains = MCMC(
        RIVAL(numpyro.handlers.reparam(model, config=circular)),
        num_warmup=CHAINS["warmup"],
        num_samples=CHAINS["draws"],
        num_chains=CHAINS["chains"],
        chain_method="sequential",
        progress_bar=False,
    )

    def run(data: dict[str, Any]) -> Posterior:
        chains.run(jax.random.key(0), **data)
        drawn = chains.get_samples(group_by_chain=True)
        draws = {name: np.asarray(drawn[name]) for name in reference.latent}
        return Posterior(draws, latent=reference.latent, circular=reference.circular)

    cold, _ = timed(lambda: run(first))
    warm, posterior = timed(lambda: run(second))
    return {"engine": "numpyro's own MCMC", **seconds(cold, warm), **errors(posterior, reference)}


def timed(function: Callable[[], Posterior]) -> tuple[float, Posterior]:
    """Processor time of a call, and its result."""
    begin = time.process_time()
    result = function()
    return time.process_time() - begin, result


def seconds(cold: float, warm: float) -> dict[str, float]:
    """Two processor times, rounded."""
    return {"seconds_first": round(cold, 2), "seconds_again": round(warm, 2)}


def errors(posterior: Posterior, reference: Posterior) -> dict[str, Any]:
    """Largest error of a mean in standard deviations, median ratio of these, and the smallest ESS."""
    found, known = summary(posterior), summary(reference)
    error = found["mean"] - known["mean"]
    error = error.where(known["kind"] == "linear", np.angle(np.exp(1j * error)))
    size = found["ess"].min() if posterior.chains > 1 else np.nan
    return {
        "worst_mean": round(float((error.abs() / known["sd"]).max()), 3),
        "sd_ratio": round(float((found["sd"] / known["sd"]).median()), 3),
        **({"least_ess": round(float(size))} if np.isfinite(size) else {}),
    }


def write(rows: list[dict[str, Any]]) -> None:
    """Keep the table; rows that were not run again stay."""
    done = {(row["model"], row["engine"]) for row in rows}
    kept = [row for row in recorded("engines").get("rows", []) if (row["model"], row["engine"]) not in done]
    table = [{name: _plain(value) for name, value in row.items()} for row in kept + rows]
    order = [*MODELS]
    figures = {
        "last_part": shlex.join(sys.argv[1:]),
        "settings": SETTINGS,
        "rows": sorted(table, key=lambda row: order.index(row["model"])),
    }
    what = "cost (processor seconds) and error (standard deviations) of the engines"
    command = "python benchmarks/bench_engines.py --write"
    record("engines", what, ("jax", "numpyro", "blackjax"), figures, command=command)


def _plain(value: Any) -> Any:
    """The value, or None where JSON has no such number."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


if __name__ == "__main__":
    main()
