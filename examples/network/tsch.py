"""Watch a measured multi-hop network: how many attempts each node's hops take, in its own slots and in shared ones.

The set tsch_tum (tum-lkn/tschdata, GPL-3.0) is not part of dtprob; DTPROB_DATA names the folder that holds it. It has
only packets that reached the root, so the twin is one of the attempts of hops that succeeded: a table for each node,
learned from every other window of the log with dedicated slots (TDMA). Half of the others set the threshold, for 10%
false alarms; the rest, and the log with shared slots, are watched.

What it shows: most nodes need more attempts in shared slots, yet the monitor alarms no more often there. Within the
dedicated log links change more from window to window than between the two kinds of access (the last quarter is far from
what the first half teaches), so a threshold that normal windows set must be high. Constant tables are not this network.
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

WINDOW = 100  # hops
NODES = 16  # addresses from 0
MODEL = factored(
    [Factor("attempt", "attempt", ("node",), Table("log_attempt", {"node": NODES}, ATTEMPTS, 0.5))]
)


type Windows = dict[str, jax.Array]


def windows(log: Hops) -> Windows:
    """The hops of a log in windows, (episode, slot)."""
    count = len(log.node) // WINDOW
    names = ("node", "attempt")
    return {n: jnp.asarray(getattr(log, n)[: count * WINDOW]).reshape(count, WINDOW) for n in names}


def part(log: Windows, chosen: slice) -> Windows:
    """Some windows."""
    return {name: values[chosen] for name, values in log.items()}


def watched(learn: Windows, calibrate: Windows) -> Monitor:
    """A monitor that knows some windows, its threshold set by others."""
    draws = Exact(draws=400)(jax.random.key(0), MODEL, learn).sample(jax.random.key(1), 400)
    prior = np.full((NODES, ATTEMPTS), 0.5)
    fresh = {"log_attempt": log_draws(jax.random.key(2), jnp.asarray(prior), prior > 0, (400,))}
    return Monitor(MODEL, draws, fresh, "evidence", rate=0.1).calibrated(calibrate)


def main() -> None:
    """Learn, calibrate, watch."""
    folder = measured_data("tsch_tum")
    logs = {name: hops(folder / f"{name}_4-1-high_load.log.gz") for name in ("tdma", "shared")}
    dedicated, shared = (windows(log) for log in logs.values())
    monitor = watched(part(dedicated, slice(0, None, 2)), part(dedicated, slice(1, None, 4)))
    quarter = len(dedicated["node"]) // 4
    early = watched(part(dedicated, slice(2 * quarter)), part(dedicated, slice(2 * quarter, 3 * quarter)))
    for name, judge, seen in (
        ("dedicated slots, windows between those learned", monitor, part(dedicated, slice(3, None, 4))),
        ("shared slots", monitor, shared),
        (
            "dedicated slots, last quarter by a twin of the first half",
            early,
            part(dedicated, slice(3 * quarter, None)),
        ),
    ):
        watch = judge.watch(seen)
        print(f"{name}: {watch.alarm.mean():.0%} of {len(watch.alarm)} windows alarm")
    for node in np.unique(logs["shared"].node):
        shares = [np.mean(log.attempt[log.node == node] == 0) for log in logs.values()]
        print(
            f"node {node}: first attempts succeed in {shares[0]:.2f} of hops, in shared slots {shares[1]:.2f}"
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
