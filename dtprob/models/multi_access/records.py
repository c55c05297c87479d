"""From a network's log to the arguments of the model, in windows that count as its episodes; and their counts."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dtprob.data import NetworkLog
from dtprob.data.network_rows import follows
from dtprob.errors import InputError
from dtprob.models.multi_access.clusters import Clusters

WINDOW = 20


def records(
    log: NetworkLog, *, clusters: Sequence[Sequence[int]], capacity: int = 1, window: int = WINDOW
) -> dict[str, Any]:
    """The arguments of `multi_access` from a log.

    Args:
        log: checked rows.
        clusters: the devices whose arrivals are drawn together.
        capacity: of each buffer, packets.
        window: slots that count as one episode; slots are independent given the state, so this is only how finely a
            diagnosis, a monitor or a held-out score looks.

    Returns:
        `sending`, `previous`, `acknowledged`, `preceded`, `valid`, `arrivals`, `deliveries`, `successes`, and `clusters` as
        `Clusters`. `preceded` is false in the first row of an episode that does not begin at slot 0: what came before it is
        not in the log.

    Raises:
        InputError: devices in the log and in the clusters that do not match, a window below 1, or a buffer that the
            capacity does not allow.
        TypeError: a window or capacity that is no whole number.
    """
    window, capacity = operator.index(window), operator.index(capacity)
    known = Clusters(tuple(clusters))
    devices = log.buffer.shape[1]
    if known.devices != devices:
        remedy = "Put every device of the log into one cluster"
        raise InputError("clusters", f"the {devices} devices of the log", f"{known.devices} devices", remedy)
    if window < 1:
        raise InputError("window", "1 slot or more", str(window), "Give a positive number")
    _check_capacity(log, capacity)
    row, place, episodes = _windows(log, window)
    columns = {
        "sending": (log.action > 0) & (log.buffer > 0),
        "previous": _slot_before(log, log.arrival) @ known.weight.T,
        "acknowledged": _slot_before(log, log.ack) @ known.weight.T,
        "preceded": follows(log) | (log.slot == 0),
        "valid": np.ones(len(log.slot), dtype=bool),
        "arrivals": log.arrival @ known.weight.T,
        "deliveries": log.ack.sum(axis=1),
        "successes": log.ack,
    }
    width = int(place.max()) + 1
    arguments: dict[str, Any] = {"clusters": known}
    for name, values in columns.items():
        kind = bool if values.dtype == bool else np.int32
        arguments[name] = np.zeros((episodes, width, *values.shape[1:]), kind)
        arguments[name][row, place] = values
    return arguments


def window_counts(arguments: Mapping[str, Any], *, memory: bool = False) -> dict[str, np.ndarray]:
    """How often each entry of the tables occurs in each window.

    Args:
        arguments: of the model.
        memory: whether arrivals depend on the cluster's last ones.

    Returns:
        `log_arrival` (episode, cluster, previous, outcome) and `log_reception` (episode, sender_count,
        delivery_count), which are all that the posterior of the tables depends on.
    """
    clusters: Clusters = arguments["clusters"]
    valid = np.asarray(arguments["valid"], bool)
    number = np.broadcast_to(np.arange(len(valid))[:, None], valid.shape)
    traced = valid & np.asarray(arguments.get("preceded", valid), bool)
    arrivals, previous = (np.asarray(arguments[name])[traced] for name in ("arrivals", "previous"))
    shape = clusters.arrival_allowed(memory=memory).shape
    arrival = np.zeros((len(valid), *shape))
    last = previous if memory else np.zeros_like(previous)
    place: Any = (number[traced][:, None], np.arange(shape[0]), last, arrivals)
    np.add.at(arrival, place, 1.0)
    episode = number[valid]
    senders = np.asarray(arguments["sending"])[valid].sum(axis=-1)
    reception = np.zeros((len(valid), clusters.devices + 1, clusters.devices + 1))
    np.add.at(reception, (episode, senders, np.asarray(arguments["deliveries"])[valid]), 1.0)
    return {"log_arrival": arrival, "log_reception": reception}


def priors(
    clusters: Clusters, concentration: float, *, memory: bool = False
) -> dict[str, Float[np.ndarray, "..."]]:
    """Dirichlet concentrations of the tables, 0 where an outcome cannot happen."""
    return {
        "log_arrival": np.where(clusters.arrival_allowed(memory=memory), concentration, 0.0),
        "log_reception": np.where(clusters.reception_allowed(), concentration, 0.0),
    }


def _slot_before(log: NetworkLog, values: Int[np.ndarray, "row device"]) -> Int[np.ndarray, "row device"]:
    """What each row's slot before it held, 0 at the start of an episode."""
    return np.where(follows(log)[:, None], np.roll(values, 1, axis=0), 0)


def _windows(log: NetworkLog, window: int) -> tuple[Int[np.ndarray, " row"], Int[np.ndarray, " row"], int]:
    """Window and place in it of each row, and the number of windows."""
    starts = np.flatnonzero(~follows(log))
    since = np.arange(len(log.slot)) - np.repeat(starts, np.diff(np.append(starts, len(log.slot))))
    place = since % window
    number = np.cumsum(place == 0) - 1
    return number, place, int(number[-1]) + 1


def _check_capacity(log: NetworkLog, capacity: int) -> None:
    if capacity < 1:
        raise InputError("capacity", "1 packet or more", str(capacity), "Give the capacity of the buffers")
    kept = log.buffer - log.ack
    after, inside = np.roll(log.buffer, -1, axis=0), np.append(follows(log)[1:], False)[:, None]
    lost = inside & (log.arrival > 0) & (after == kept)
    for bad, expected in (
        (log.buffer > capacity, f"at most {capacity}, the capacity"),
        (lost & (kept < capacity), f"no loss below {capacity} packets, the capacity"),
    ):
        if bad.any():
            row, device = (int(i) for i in np.argwhere(bad)[0])
            got = f"{log.buffer[row, device]} in slot {log.slot[row]} of episode {log.episode[row]}"
            raise InputError(
                f"buffer_{device}", expected, got, "Correct capacity in [model.options], or the log"
            )
