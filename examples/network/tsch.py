"""Watch a measured multi-hop network: how many attempts each node's hops take, in its own slots and in shared ones.

The set tsch_tum (tum-lkn/tschdata, GPL-3.0) is not part of dtprob; DTPROB_DATA names the folder that holds it. It has
only packets that reached the root, so the twin is one of the attempts of hops that succeeded: a table for each node,
learned in the first half of the log with dedicated slots (TDMA). The third quarter sets the threshold; the last
quarter, and the log with shared slots, are watched.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.data.location import measured_data
from dtprob.data.tsch_tum import ATTEMPTS, Hops, hops
from dtprob.inference.exact import Exact
from dtprob.models.dirichlet import log_draws
from dtprob.models.factored import Factor, Table, factored
from dtprob.twin.monitor import Monitor

WINDOW = 40  # hops
NODES = 16  # addresses from 0
MODEL = factored(
    [Factor("attempt", "attempt", ("node",), Table("log_attempt", {"node": NODES}, ATTEMPTS, 0.5))]
)


def windows(log: Hops, start: float, stop: float) -> dict[str, jax.Array]:
    """The hops between two shares of a log, in windows (episode, slot)."""
    first, last = (int(share * len(log.node)) for share in (start, stop))
    count = (last - first) // WINDOW
    chosen = slice(first, first + count * WINDOW)
    shape = (count, WINDOW)
    return {name: jnp.asarray(getattr(log, name)[chosen]).reshape(shape) for name in ("node", "attempt")}


def main() -> None:
    """Learn, calibrate, watch."""
    folder = measured_data("tsch_tum")
    dedicated, shared = (hops(folder / f"{name}_4-1-high_load.log.gz") for name in ("tdma", "shared"))
    posterior = Exact(draws=400)(jax.random.key(0), MODEL, windows(dedicated, 0.0, 0.5))
    draws = posterior.sample(jax.random.key(1), 400)
    table = np.full((NODES, ATTEMPTS), 0.5)
    fresh = {"log_attempt": log_draws(jax.random.key(2), jnp.asarray(table), table > 0, (400,))}
    monitor = Monitor(MODEL, draws, fresh, "surprise", rate=0.1)
    monitor = monitor.calibrated(windows(dedicated, 0.5, 0.75))
    for name, log, start in (
        ("dedicated slots, last quarter", dedicated, 0.75),
        ("shared slots", shared, 0.0),
    ):
        watch = monitor.watch(windows(log, start, 1.0))
        when = "never" if watch.detected is None else f"in window {watch.detected}"
        print(f"{name}: {watch.alarm.mean():.0%} of {len(watch.alarm)} windows alarm; change detected {when}")
    learned = np.exp(posterior.flat("log_attempt")).mean(axis=0)[:, 0]
    for node in np.unique(shared.node):
        first = np.mean(shared.attempt[shared.node == node] == 0)
        print(
            f"node {node}: first attempt succeeds in {learned[node]:.2f} of hops, in shared slots {first:.2f}"
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
