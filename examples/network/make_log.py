"""Log a network of four devices under random access, before and after device 1 is disconnected.

Run `python examples/network/make_log.py`, then `dtprob diagnose examples/network/case.toml --out network`.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.data import NetworkLog, write
from dtprob.physical.multi_access import PhysicalKernel

CLUSTERS = ((0, 1), (2, 3))
NORMAL = [0.2, 0.4, 0.4, 0.0]  # no arrival, at the second device, at the first, at both
SILENT = [0.6, 0.0, 0.4, 0.0]
RECEPTION = [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0.8, 0.2, 0, 0], [1, 0, 0, 0, 0], [1, 0, 0, 0, 0]]


def log(key: jax.Array, slots: int, first_cluster: list[float]) -> NetworkLog:
    """One episode from empty buffers, the devices' common transmit probability drawn anew in every slot."""
    system = PhysicalKernel(CLUSTERS)
    arrival = jnp.log(jnp.array([[first_cluster], [NORMAL]]))
    parameters = {"log_arrival": arrival, "log_reception": jnp.log(jnp.array(RECEPTION))}

    def step(state, key):
        keys = jax.random.split(key, 3)
        action = jax.random.bernoulli(keys[0], jax.random.uniform(keys[1]), (4,)).astype(jnp.int32)
        after, slot = system.step(keys[2], parameters, state, action)
        return after, (state.buffer, action, slot.delivered, after.arrival)

    _, columns = jax.lax.scan(step, system.initial(), jax.random.split(key, slots))
    names = ("buffer", "action", "ack", "arrival")
    devices = {name: np.asarray(column) for name, column in zip(names, columns, strict=True)}
    return NetworkLog(episode=np.zeros(slots, int), slot=np.arange(slots), **devices)


if __name__ == "__main__":
    folder = Path(__file__).parent
    write(folder / "before.csv", log(jax.random.key(0), 600, NORMAL))
    write(folder / "after.csv", log(jax.random.key(1), 300, SILENT))
