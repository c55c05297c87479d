"""Environment and training slots per second: dtprob's compiled network against a plain NumPy PettingZoo environment.

    python benchmarks/bench_control.py [--environments 1000] [--slots 200] [--rounds 5] [--torch PYTHON] [--write]

The rival plays the same network one slot at a time, as PettingZoo environments do (plain_network.py); both play
ALOHA(1/2), in turns in one process, and both must deliver the same. Rates are per second of processor time, of all
threads together, so that other work on the machine hardly counts. "rbg" is the same with keys of JAX's other generator.
Training is COMA with members side by side. --torch names the interpreter of an environment with torch and pettingzoo
(dependency group `rivals`), in which the same COMA trains on the plain network (rival_torch.py), in turns with ours;
compilation is not counted. The last lines say how the cost of a slot grows with the number of devices.
--write keeps the figures in benchmarks/results/control.json.
"""

import argparse
import functools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from plain_network import PlainNetwork
from record import record

from dtprob.control import COMA, Budget, Environment, FramePolicy, aloha, evaluate, train
from dtprob.physical.multi_access import Network, PhysicalKernel

SENDS = 0.5
DEVICES = (4, 8, 16, 32, 64)
TRAINING = 40_000
"""Virtual slots of a training."""


def main() -> None:
    """Run the benchmark and print its figures."""
    options = arguments()
    ours, theirs = compiled(Network.reference(), options), plain(Network.reference(), 20_000)
    compare(ours()[1], theirs()[1])
    other = compiled(Network.reference(), options, "rbg")
    rates = in_turns({"dtprob": ours, "dtprob_rbg": other, "numpy": theirs}, options.rounds)
    figures: dict[str, Any] = {
        "settings": {k: v for k, v in vars(options).items() if k not in ("write", "torch")},
        "environment_slots_per_processor_second": rates,
        "ratio": {name: rates[name] / rates["numpy"] for name in ("dtprob", "dtprob_rbg")},
        **training(options),
        "processor_microseconds_per_slot_by_devices": {
            str(k): 1e6 / in_turns({"dtprob": compiled(Network.pairs(k // 2), options)}, 3)["dtprob"]
            for k in DEVICES
        },
    }
    print(json.dumps(figures, indent=1))
    if options.write:
        record(
            "control", "slots of a network per second, and COMA's", ["jax", "numpy", "pettingzoo"], figures
        )


def arguments() -> argparse.Namespace:
    """Size of the problem and number of rounds."""
    parser = argparse.ArgumentParser(description="Environment and training slots per second.")
    for name, default in (("environments", 1000), ("slots", 200), ("rounds", 5), ("members", 10)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--torch", metavar="PYTHON")
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def world(network: Network) -> Environment:
    """Episodes of 2000 slots of a network."""
    pool = {name: jnp.asarray(table, jnp.float32)[None] for name, table in network.parameters.items()}
    return Environment(PhysicalKernel.of(network), pool, horizon=2000)


def compiled(
    network: Network, options: argparse.Namespace, generator: str = "threefry2x32"
) -> Callable[[], tuple[int, float]]:
    """Plays many environments at once; gives slots played and packets delivered per slot."""
    environment, policy = world(network), aloha(network.devices, network.capacity, SENDS)
    keys = iter(jax.random.split(jax.random.key(0, impl=generator), 1000))

    def run() -> tuple[int, float]:
        got = evaluate(next(keys), environment, policy, options.slots, options.environments)
        return options.slots * options.environments, float(jnp.mean(got.throughput))

    run()
    return run


def plain(network: Network, slots: int) -> Callable[[], tuple[int, float]]:
    """Plays one plain environment; gives slots played and packets delivered per slot."""
    environment = PlainNetwork(network.clusters, network.capacity, network.arrival[:, 0], network.reception)
    seeds = iter(range(10**6))

    def run() -> tuple[int, float]:
        environment.reset(next(seeds))
        choice = (environment.random.random((slots, network.devices)) < SENDS).tolist()
        delivered = 0
        for row in choice:
            environment.step(dict(zip(environment.agents, row, strict=True)))
            delivered += environment.delivered
        return slots, delivered / slots

    return run


def compare(ours: float, theirs: float) -> None:
    """Stop unless both deliver the same to 3%."""
    print(f"delivered per slot: {ours:.4f} and {theirs:.4f}")
    if abs(ours / theirs - 1) > 0.03:
        sys.exit("the two do not play the same network")


def in_turns(runs: dict[str, Callable[[], tuple[int, float]]], rounds: int) -> dict[str, float]:
    """Median slots per second of processor time of each, in turn so that a busy machine slows all alike."""
    rates: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            start = time.process_time()
            slots, _ = run()
            rates[name].append(slots / (time.process_time() - start))
    return {name: float(np.median(values)) for name, values in rates.items()}


def training(options: argparse.Namespace) -> dict[str, Any]:
    """Training slots per second of processor time, in turns, and the reward that the trainings end with."""
    runs = {"dtprob": trainer(options.members)}
    if options.torch:
        runs["torch"] = functools.partial(torch_training, options.torch)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(options.rounds):
        for name, run in runs.items():
            found[name].append(run())
    middle = {name: np.median(values, axis=0).tolist() for name, values in found.items()}
    figures: dict[str, Any] = {
        "training_slots_per_processor_second": {name: value[0] for name, value in middle.items()},
        "reward_per_slot_at_the_end": {name: value[1] for name, value in middle.items()},
    }
    if options.torch:
        figures["training_ratio"] = middle["dtprob"][0] / middle["torch"][0]
    return figures


def trainer(members: int) -> Callable[[], tuple[float, float]]:
    """Trains members side by side; compiled before."""
    environment, learner, budget = world(Network.reference()), COMA(), Budget(TRAINING)
    last = budget.updates // 10

    @eqx.filter_jit
    def fit(keys: jax.Array) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            return train(key, learner, FramePolicy(key, 4), environment, budget).reward[-last:].mean()

        return jax.vmap(one)(keys)

    keys = iter(jax.random.split(jax.random.key(0), (100, members)))

    def run() -> tuple[float, float]:
        own, start = next(keys), time.process_time()
        reward = np.mean(fit(own))
        return members * budget.slots / (time.process_time() - start), float(reward)

    run()
    return run


def torch_training(interpreter: str) -> tuple[float, float]:
    """The rival's training, in its own environment."""
    network = Network.reference()
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "network.npz", Path(folder) / "found.npz"
        np.savez(
            given,
            clusters=network.clusters,
            capacity=network.capacity,
            arrival=network.arrival[:, 0],
            reception=network.reception,
        )
        script = Path(__file__).with_name("rival_torch.py")
        subprocess.run([interpreter, str(script), str(given), str(found), str(TRAINING)], check=True)
        with np.load(found) as file:
            rate, reward = file["training"]
            return float(rate), float(reward)


if __name__ == "__main__":
    main()
