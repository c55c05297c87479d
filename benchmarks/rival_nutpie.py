"""The models of bench_nuts.py in PyMC, sampled by nutpie; run by that script in an environment of its own.

    python benchmarks/rival_nutpie.py MODEL data.npz draws.npz

MODEL is channel or multi-access. Writes the draws of what is compared, (quantity, chain, draw), and the processor and
wall seconds of sampling, and of compiling.
"""

import sys
import time
from typing import Any

import numpy as np
import nutpie  # pyright: ignore[reportMissingImports]
import pymc as pm  # pyright: ignore[reportMissingImports]
import pytensor.tensor as pt  # pyright: ignore[reportMissingImports]


def gain(permittivity: Any, conductivity: Any, data: Any) -> tuple[Any, Any]:
    """Real and imaginary part of each path's gain."""
    loss = conductivity * float(data["loss_per_conductivity"])
    real, imaginary = permittivity - 1 + data["cosine"] ** 2, -loss
    size = pt.sqrt(real**2 + imaginary**2)
    root_real = pt.sqrt((size + real) / 2)
    root_imaginary = imaginary / (2 * root_real)
    c = data["cosine"]
    top_real, bottom_real = c - root_real, c + root_real
    scale = data["base"] / (bottom_real**2 + root_imaginary**2)
    return (
        scale * (top_real * bottom_real - root_imaginary**2),
        -scale * root_imaginary * (bottom_real + top_real),
    )


def channel(data: Any) -> Any:
    """The model, written as the formulas stand."""
    with pm.Model() as model:
        concentration = pm.LogNormal("concentration", 0.0, 1.5)
        permittivity = 1 + pm.LogNormal("contrast", np.log(4.0), 0.4)
        conductivity = pm.LogNormal("conductivity", np.log(0.1), 1.0)
        noise = pm.LogNormal("noise", np.log(float(data["noise"])), 0.1)
        error = pm.VonMises("error", 0.0, concentration, shape=data["base"].shape)
        real, imaginary = gain(permittivity, conductivity, data)
        c, s = pt.cos(error), pt.sin(error)
        w_real, w_imaginary = real * c - imaginary * s, real * s + imaginary * c
        b_real, b_imaginary = data["columns"].real, data["columns"].imag
        mean_real = pt.sum(b_real * w_real[:, None] - b_imaginary * w_imaginary[:, None], axis=-1)
        mean_imaginary = pt.sum(b_real * w_imaginary[:, None] + b_imaginary * w_real[:, None], axis=-1)
        spread = pt.sqrt(noise / 2)
        pm.Normal("real", mean_real, spread, observed=data["y"].real)
        pm.Normal("imaginary", mean_imaginary, spread, observed=data["y"].imag)
    return model


def materials(posterior: Any) -> np.ndarray:
    """Permittivity and conductivity."""
    return np.stack([1 + posterior["contrast"].values, posterior["conductivity"].values])


def multi_access(data: Any) -> Any:
    """The tables, written as the formulas stand: slot by slot."""
    with pm.Model() as model:
        arrival = pm.Dirichlet("arrival", np.ones(4), shape=(2, 4))
        rows = [pm.Dirichlet(f"reception_{n}", np.ones(n + 1)) for n in range(1, 5)]
        padded = [pt.concatenate([row, np.zeros(4 - n)]) for n, row in enumerate(rows, start=1)]
        table = pt.stack([pt.as_tensor_variable(np.eye(5)[0]), *padded])
        for k in range(2):
            pm.Categorical(f"arrivals_{k}", arrival[k], observed=data["arrivals"][:, k])
        pm.Categorical("deliveries", table[data["senders"]], observed=data["deliveries"])
    return model


def tables(posterior: Any) -> np.ndarray:
    """The first entry of each row."""
    arrival = np.moveaxis(posterior["arrival"].values[..., 0], 2, 0)
    return np.stack([*arrival, *(posterior[f"reception_{n}"].values[..., 0] for n in range(1, 5))])


MODELS = {"channel": (channel, materials), "multi-access": (multi_access, tables)}


def main() -> None:
    """Compile, sample, write."""
    model, quantities = MODELS[sys.argv[1]]
    data = np.load(sys.argv[2])
    begin = time.process_time(), time.monotonic()
    compiled = nutpie.compile_pymc_model(model(data))
    middle = time.process_time(), time.monotonic()
    settings = {"tune": 500, "draws": 500, "chains": 2, "cores": 2, "progress_bar": False}
    trace = nutpie.sample(compiled, seed=1, **settings)
    end = time.process_time(), time.monotonic()
    np.savez(
        sys.argv[3],
        draws=quantities(trace.posterior),
        steps=trace.sample_stats["n_steps"].values.mean(),
        sampling=np.subtract(end, middle),
        compiling=np.subtract(middle, begin),
    )


if __name__ == "__main__":
    main()
