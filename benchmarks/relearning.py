"""A network loses a device half-way: twins that learn again against one that was learned once.

    python benchmarks/relearning.py [--seeds 5] [--write]

The case is examples/network/twin.toml without its diagnosis: 4000 slots, and from slot 1500 on one device is silent, each
in turn. With each seed a twin learns and hands over a policy; from the alarm on one twin learns again and the other does
not, with the same luck before. Compared are the packets delivered per slot after the change, those that the last policy
delivers in the long run, exactly, and how far from that is what the twin foresees of it over 200 slots. The differences
are taken pair by pair, with their standard errors over seeds and devices.
--write keeps the table in benchmarks/results/relearning.json.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from record import record

from dtprob.case import SeedSection
from dtprob.control import Stateless, TablePolicy
from dtprob.physical.multi_access import Network, average, chain
from dtprob.twin.predict import predict
from dtprob.twin.rollout import throughput
from dtprob.workflow.loop import State, Twin, TwinCase, advance, begin, connect, finished, load_twin_case
from dtprob.workflow.loop.knowledge import known

CASE = Path(__file__).parents[1] / "examples" / "network" / "twin.toml"
CHANGE = 1500
MEASURES = ("delivered", "long_run", "prediction_error")


def main() -> None:
    """Run all twins and print the table."""
    parser = argparse.ArgumentParser(description="Twins that learn again against twins learned once.")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows = [row for seed in range(options.seeds) for row in pairs(seed)]
    found = means(rows)
    for name, value in found.items():
        print(name, value)
    if options.write:
        figures = {"rows": rows, "means": found}
        record("relearning", "twins that learn again against twins learned once", ["jax", "numpy"], figures)


def pairs(seed: int) -> list[dict[str, float]]:
    """A row for each device that falls silent: both twins that began alike."""
    case = dataclasses.replace(load_twin_case(CASE), seed=SeedSection(value=seed))
    first = run(variant(case, 0, relearn=True), begin(case), lambda state: state.phase == "monitor")
    rows: list[dict[str, float]] = []
    for device in range(Network.reference().devices):
        row: dict[str, float] = {"seed": seed, "device": device}
        for name, relearn in (("again", True), ("once", False)):
            own = variant(case, device, relearn=relearn)
            last = run(own, first, finished)
            row |= {f"{key}_{name}": value for key, value in judged(own, last, device).items()}
            if relearn:
                row["alarms"] = sum(bool(entry.get("alarm")) for entry in last.entries)
        print({key: round(value, 4) for key, value in row.items()}, flush=True)
        rows.append(row)
    return rows


def variant(case: TwinCase, device: int, *, relearn: bool) -> TwinCase:
    """The case with another device that falls silent."""
    loop = dataclasses.replace(case.loop, relearn=relearn, diagnose=0)
    physical = dataclasses.replace(case.physical, options={"disconnect": [[CHANGE, device]]})
    return dataclasses.replace(case, loop=loop, physical=physical)


def run(case: TwinCase, state: State, until: Callable[[State], bool]) -> State:
    """The loop's state once something holds."""
    twin = Twin(case, connect(case), lambda _: None)
    twin.physical.go_on(state.rows)
    with jax.enable_x64(False):
        while not until(state):
            state = advance(twin, state)
    return state


def judged(case: TwinCase, state: State, device: int) -> dict[str, float]:
    """The measures of a loop that is over."""
    network = chain(Network.reference().without(device))
    long_run = average(network, np.clip(state.policy, 1e-9, 1 - 1e-9)).throughput
    foreseen = predict(
        jax.random.key(case.seed.value),
        case.kernel,
        known(case, state, state.handed),
        policy=Stateless(TablePolicy(jnp.asarray(state.policy, jnp.result_type(float)))),
        metric=throughput,
        horizon=200,
        draws=100,
        episodes=4,
    ).mean
    delivered = float(state.rows["ack"][CHANGE:].sum(axis=1).mean())
    return {"delivered": delivered, "long_run": long_run, "prediction_error": abs(foreseen - long_run)}


def means(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """By measure: the mean of both twins, and of their difference with its standard error."""
    found: dict[str, dict[str, float]] = {}
    for name in MEASURES:
        again, once = (np.array([row[f"{name}_{twin}"] for row in rows]) for twin in ("again", "once"))
        apart = again - once
        error = apart.std(ddof=1) / np.sqrt(len(apart))
        values = {"again": again.mean(), "once": once.mean(), "difference": apart.mean(), "error": error}
        found[name] = {key: round(float(value), 4) for key, value in values.items()}
    return found


if __name__ == "__main__":
    main()
