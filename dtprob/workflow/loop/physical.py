"""The physical twin as the loop meets it: slots that are played under a policy, or come from a log."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol, final

import numpy as np
from jaxtyping import Float

from dtprob.data import NetworkLog, read
from dtprob.errors import InputError
from dtprob.usercode import load_object
from dtprob.workflow.loop.settings import TwinCase

type Rows = Mapping[str, np.ndarray]
"""The columns of a `NetworkLog`."""
type Chances = Float[np.ndarray, "phase device buffer arrival ack"]

COLUMNS = tuple(field.name for field in fields(NetworkLog))


class Physical(Protocol):
    """A network that slots can be had from."""

    def play(self, chances: Chances, slots: int, random: np.random.Generator) -> Rows:
        """The next slots, fewer where there are no more.

        Args:
            chances: of sending, of the policy that the devices follow.
            slots: how many.
            random: where the devices take their chances from.
        """
        ...

    def go_on(self, rows: Rows) -> None:
        """Go to where things stood after some slots, in a process of its own.

        Raises:
            InputError: it did something else this time.
        """
        ...


def connect(case: TwinCase, *, allow_code: bool = True) -> Physical:
    """The physical twin that a case names.

    Raises:
        InputError: code of the user's own that is not allowed or does not make an environment, a log that is none, or
            devices that the model does not have.
    """
    devices = case.kernel.devices
    if case.physical.log is not None:
        log = read(case.path.parent / case.physical.log, case.physical.options)
        if not isinstance(log, NetworkLog):
            got = type(log).__name__
            raise InputError(case.physical.log.name, "a network's log", got, "Give one row per slot")
        _check_devices(log.buffer.shape[1], devices)
        return LoggedNetwork({name: getattr(log, name) for name in COLUMNS})
    environment = _environment(case, allow_code=allow_code)
    _check_devices(len(environment.possible_agents), devices)
    return PlayedNetwork(environment, case.seed.value, case.kernel.capacity, replay=case.physical.replay)


def _environment(case: TwinCase, *, allow_code: bool) -> Any:
    name, options = str(case.physical.environment), dict(case.physical.options)
    if ":" in name:
        if not allow_code:
            expected = "an environment of dtprob, since --no-code is given"
            remedy = "Leave --no-code out if you trust this code"
            raise InputError(case.path.name, expected, f"the code {name}", remedy)
        make = load_object(name, case.path.parent)
    elif name == "multi_access":
        from dtprob.physical.multi_access.changing import changing_network as make  # noqa: PLC0415  (PettingZoo)
    else:
        expected = "'multi_access', or 'package.module:function'"
        raise InputError(f"{case.path.name} [physical] environment", expected, name, "Correct the name")
    try:
        environment = make(**options)
    except (TypeError, ValueError) as error:
        where = f"{case.path.name} [physical.options]"
        raise InputError(where, f"what {name} takes", str(error), "Correct the options") from None
    if not hasattr(environment, "possible_agents") or not hasattr(environment, "step"):
        got = type(environment).__name__
        raise InputError(name, "a PettingZoo ParallelEnv", got, "Let the function return one")
    return environment


def _check_devices(found: int, expected: int) -> None:
    if found != expected:
        remedy = "Put every device into one of the model's clusters"
        raise InputError("physical twin", f"{expected} devices, as in the model", str(found), remedy)


@final
class PlayedNetwork:
    """A PettingZoo environment whose devices act by chances.

    Args:
        environment: a `ParallelEnv`.
        seed: of its first episode.
        capacity: packets that a buffer holds.
        replay: see `PhysicalSection`.
    """

    def __init__(self, environment: Any, seed: int, capacity: int, *, replay: bool) -> None:
        self._environment, self._capacity, self._replay = environment, capacity, replay
        self._seed = seed
        self._agents: list[str] = list(environment.possible_agents)
        self._episode, self._slot = 0, 0
        self._seen = self._read(environment.reset(seed=seed)[0])

    def play(self, chances: Chances, slots: int, random: np.random.Generator) -> Rows:
        """See `Physical`."""
        device = np.arange(len(self._agents))
        rows = []
        for _ in range(slots):
            chance = chances[self._slot % len(chances)][device, *self._seen.T]
            rows.append(self._step((random.random(len(device)) < chance).astype(np.int64)))
        return _columns(rows, len(device))

    def go_on(self, rows: Rows) -> None:
        """See `Physical`."""
        if not self._replay:
            self._episode = int(rows["episode"][-1]) + 1 if len(rows["episode"]) else 0
            # another seed, or an environment that heeds it would have the same luck as in the first slots
            self._seen = self._read(self._environment.reset(seed=self._seed + len(rows["episode"]))[0])
            return
        again = _columns([self._step(action) for action in rows["action"]], len(self._agents))
        _check_same(again, rows, "Set replay = false in [physical] where luck cannot be repeated")

    def _step(self, action: np.ndarray) -> tuple[Any, ...]:
        """A slot: its row in the order of `COLUMNS`."""
        before, episode, slot = self._seen, self._episode, self._slot
        given = {agent: int(action[i]) for i, agent in enumerate(self._agents)}
        seen, _, terminated, truncated, _ = self._environment.step(given)
        after = self._read(seen)
        self._seen, self._slot = after, slot + 1
        if any(terminated.values()) or any(truncated.values()):
            self._episode, self._slot = episode + 1, 0
            self._seen = self._read(self._environment.reset()[0])
        return episode, slot, before[:, 0], action, after[:, 2], after[:, 1]

    def _read(self, seen: Mapping[str, Any]) -> np.ndarray:
        """Buffer, arrival and acknowledgement of each device."""
        try:
            table = np.stack([np.asarray(seen[agent]).reshape(-1)[:3] for agent in self._agents])
            valid = table.shape[1] == 3 and np.all((table >= 0) & (table <= [self._capacity, 1, 1]))
            # a share of the capacity is no number of packets
            valid = valid and np.all(table == np.round(table))
        except (KeyError, ValueError, TypeError) as error:
            table, valid = repr(error), False
        if not valid or isinstance(table, str):
            expected = (
                f"packets (0 to {self._capacity}), last arrival and acknowledgement (0 or 1) of each device"
            )
            remedy = "Let every agent see these three first"
            raise InputError("observation of the physical twin", expected, str(table), remedy)
        return table.astype(np.int64)


@final
class LoggedNetwork:
    """A log whose rows come one after the other.

    Args:
        rows: the log's columns.
    """

    def __init__(self, rows: Rows) -> None:
        self._rows, self._place = rows, 0

    def play(self, chances: Chances, slots: int, random: np.random.Generator) -> Rows:
        """See `Physical`; the log does not care for the policy."""
        del chances, random
        first, self._place = self._place, self._place + slots
        return {name: column[first : self._place] for name, column in self._rows.items()}

    def go_on(self, rows: Rows) -> None:
        """See `Physical`."""
        self._place = len(rows["slot"])
        first = {name: column[: self._place] for name, column in self._rows.items()}
        _check_same(first, rows, "Start anew without --resume, or give the same log")


def _columns(rows: list[tuple[Any, ...]], devices: int) -> Rows:
    if not rows:
        wide = np.zeros((0, devices), np.int64)
        return {name: wide if name not in {"episode", "slot"} else wide[:, 0] for name in COLUMNS}
    return {name: np.array(column) for name, column in zip(COLUMNS, zip(*rows, strict=True), strict=True)}


def _check_same(again: Rows, rows: Rows, remedy: str) -> None:
    for name in COLUMNS:
        if not np.array_equal(again[name], rows[name]):
            raise InputError("physical twin", f"the same {name} as before", "another", remedy)
