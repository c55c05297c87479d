"""Environment and training slots per second: dtprob's compiled network against a plain NumPy PettingZoo environment.

    python benchmarks/bench_control.py [--environments 1000] [--slots 200] [--rounds 5] [--write]

The rival plays the same network one slot at a time, as PettingZoo environments do, with uniform numbers drawn in
blocks; both play ALOHA(1/2), in turns in one process, and both must deliver the same. Rates are per second of processor
time, of all threads together, so that other work on the machine hardly counts. "rbg" is the same with keys of JAX's
other generator. Training is COMA with members side by side; it has no rival here. The last lines say how the cost of a
slot grows with the number of devices.
--write keeps the figures in benchmarks/results/control.json.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from record import record

from dtprob.control import COMA, Budget, Environment, FramePolicy, aloha, evaluate, train
from dtprob.physical.multi_access import Network, PhysicalKernel

SENDS = 0.5
DEVICES = (4, 8, 16, 32, 64)


def main() -> None:
    """Run the benchmark and print its figures."""
    options = arguments()
    ours, theirs = compiled(Network.reference(), options), plain(Network.reference(), 20_000)
    compare(ours()[1], theirs()[1])
    other = compiled(Network.reference(), options, "rbg")
    rates = in_turns({"dtprob": ours, "dtprob_rbg": other, "numpy": theirs}, options.rounds)
    figures = {
        "environment_slots_per_processor_second": rates,
        "ratio": {name: rates[name] / rates["numpy"] for name in ("dtprob", "dtprob_rbg")},
        "training_slots_per_processor_second": training(options.members),
        "processor_microseconds_per_slot_by_devices": {
            str(k): 1e6 / in_turns({"dtprob": compiled(Network.pairs(k // 2), options)}, 3)["dtprob"]
            for k in DEVICES
        },
    }
    print(json.dumps(figures, indent=1))
    if options.write:
        write(options, figures)


def arguments() -> argparse.Namespace:
    """Size of the problem and number of rounds."""
    parser = argparse.ArgumentParser(description="Environment and training slots per second.")
    for name, default in (("environments", 1000), ("slots", 200), ("rounds", 5), ("members", 10)):
        parser.add_argument(f"--{name}", type=int, default=default)
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


class PlainNetwork(ParallelEnv):
    """The same network in plain NumPy, as one would write it for PettingZoo."""

    metadata: ClassVar[dict] = {"name": "plain_v0"}

    def __init__(self, network: Network) -> None:
        self.network = network
        self.possible_agents = [f"device_{number}" for number in range(network.devices)]
        self._seen = Box(0, 2000, (4,), np.int64)
        self._acts = Discrete(2)
        self._arrival = [row[0].cumsum().tolist() for row in network.arrival]
        self._reception = [row.cumsum().tolist() for row in network.reception]

    def observation_space(self, agent: str) -> Box:
        """Buffer, arrival, acknowledgement, slot."""
        del agent
        return self._seen

    def action_space(self, agent: str) -> Discrete:
        """Silence or sending."""
        del agent
        return self._acts

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Empty buffers."""
        del options
        self.random = np.random.default_rng(seed)
        self.uniform: list[list[float]] = []
        self.agents = list(self.possible_agents)
        self.buffer = [0] * len(self.agents)
        self.slot = 0
        return dict.fromkeys(self.agents, (0, 0, 0, 0)), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """One slot."""
        if not self.uniform:
            self.uniform = self.random.random((1000, 1 + len(self.agents) + len(self._arrival))).tolist()
        uniform = self.uniform.pop()
        buffer, agents, capacity = self.buffer, self.agents, self.network.capacity
        senders = [i for i, agent in enumerate(agents) if actions[agent] and buffer[i]]
        count = sum(uniform[0] >= edge for edge in self._reception[len(senders)])
        ack = [0] * len(agents)
        for i in sorted(senders, key=lambda i: uniform[1 + i])[:count]:
            ack[i] = 1
        arrival = [0] * len(agents)
        for number, (cluster, edges) in enumerate(zip(self.network.clusters, self._arrival, strict=True)):
            outcome = sum(uniform[1 + len(agents) + number] >= edge for edge in edges)
            for place, device in enumerate(reversed(cluster)):
                arrival[device] = outcome >> place & 1
        reward = 0.0
        for i in range(len(agents)):
            full = buffer[i] + arrival[i] - ack[i]
            reward += 50 if ack[i] else -50 if full > capacity else -1
            buffer[i] = min(full, capacity)
        self.slot += 1
        done = self.slot >= 2000
        seen = {agent: (buffer[i], arrival[i], ack[i], self.slot) for i, agent in enumerate(agents)}
        self.delivered = count
        return (
            seen,
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, done),
            {agent: {} for agent in agents},
        )


def plain(network: Network, slots: int) -> Callable[[], tuple[int, float]]:
    """Plays one plain environment; gives slots played and packets delivered per slot."""
    environment = PlainNetwork(network)
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


def training(members: int) -> float:
    """Training slots per second of processor time of COMA on the reference network, compilation apart."""
    environment, learner, budget = world(Network.reference()), COMA(), Budget(40_000)

    @eqx.filter_jit
    def fit(keys: jax.Array) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            return train(key, learner, FramePolicy(key, 4), environment, budget).reward[-1]

        return jax.vmap(one)(keys)

    keys = jax.random.split(jax.random.key(0), (3, members))
    jax.block_until_ready(fit(keys[0]))
    times: list[float] = []
    for own in keys[1:]:
        start = time.process_time()
        jax.block_until_ready(fit(own))
        times.append(time.process_time() - start)
    return members * budget.slots / float(np.median(times))


def write(options: argparse.Namespace, figures: dict) -> None:
    """Keep the figures."""
    settings = {k: v for k, v in vars(options).items() if k != "write"}
    what = "environment steps per second, and training of policies"
    record("control", what, ("jax", "numpy", "pettingzoo"), {"settings": settings, **figures})


if __name__ == "__main__":
    main()
