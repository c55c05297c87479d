"""What is done in each phase: from a state to the next, with an entry of the history that says what and why."""

from collections.abc import Callable
from typing import Final, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.control import (
    COMA,
    Budget,
    Environment,
    FramePolicy,
    collector,
    draw_pool,
    tabulate,
    train,
)
from dtprob.control.learner import check_trained
from dtprob.workflow.loop.diagnosis import diagnosed
from dtprob.workflow.loop.foresight import FEW, HORIZON, foresee, seldom_seen, shortfall
from dtprob.workflow.loop.knowledge import Watched, forget, known, summary, watch
from dtprob.workflow.loop.physical import Chances, Physical
from dtprob.workflow.loop.settings import TwinCase
from dtprob.workflow.loop.state import Entry, Phase, State

type Say = Callable[[str], None]

_HORIZON, _REDRAW, _POOL = 2000, 200, 256
_WINDOWS_AT_ONCE: Final = 5


class Twin(NamedTuple):
    """What every phase needs.

    Attributes:
        case: the settings.
        physical: the physical twin.
        say: tells the progress.
    """

    case: TwinCase
    physical: Physical
    say: Say


def collect(twin: Twin, state: State) -> State:
    """Play a policy that was trained to learn about what is not known."""
    case, loop = twin.case, twin.case.loop
    twin.say(f"round {state.round}: training a policy that collects")
    policy, gain = collector(
        _key(case, state),
        case.kernel,
        known(case, state),
        clusters=case.kernel.clusters.members,
        slots=loop.collect,
        budget=_budget(loop.training, loop.collect),
    )
    wanted = min(loop.collect, loop.slots - state.slots)
    after = _played(twin, state, np.asarray(policy.probability, float), wanted)
    why = "nothing is known yet" if state.round == 1 else "the network changed, and its draws disagree"
    entry = {"why": why, "expected_information": round(gain, 4), "unit": "nats per slot"}
    entry |= _throughput(after, state.slots)
    return _next(twin, state, after, "learn", entry)


def learn(twin: Twin, state: State) -> State:
    """The exact law of the tables, from the rows that count."""
    law = known(twin.case, state)
    entry = {
        "why": f"{state.slots - state.since} slots of the network as it is now",
        "learnt": summary(law, _key(twin.case, state)),
    }
    return _next(twin, state, state, "control", entry)


def control(twin: Twin, state: State) -> State:
    """Train a policy on draws of what was learned."""
    case, loop = twin.case, twin.case.loop
    first, second, third = jax.random.split(_key(case, state), 3)
    twin.say(f"round {state.round}: training a policy that delivers")
    pool = draw_pool(first, known(case, state), _POOL)
    kernel = case.kernel
    environment = Environment(kernel, pool, _HORIZON, _REDRAW)
    learner = COMA(caution=loop.caution or 0.0, capacity=kernel.capacity)
    start = FramePolicy(second, kernel.devices, capacity=kernel.capacity)
    trained = _train(third, learner, start, environment, _budget(loop.training, 20))
    check_trained(trained)
    policy = tabulate(trained.policy)
    after = state._replace(trained=np.asarray(policy.probability, float))
    entry = {"why": f"{_POOL} networks that may be, {loop.training} virtual slots"}
    return _next(twin, state, after, "hand_over", entry)


def hand_over(twin: Twin, state: State) -> State:
    """Give the devices the trained policy, if it is foreseen to deliver more than the one that they have."""
    key = _key(twin.case, state)
    old, new = (foresee(key, twin.case, state, policy) for policy in (state.policy, state.trained))
    better = new.mean > old.mean
    kept = new if better else old
    after = state._replace(
        policy=state.trained if better else state.policy,
        foreseen=kept.values.ravel(),
        handed=state.slots,
        watched=state.slots if state.watched < 0 else state.watched,
        changed=-1,
    )
    low, high = new.interval()
    seldom = seldom_seen(key, twin.case, state, state.trained)
    entry = {
        "why": f"foreseen over {HORIZON} slots: {new.mean:.3f} packets per slot, with the old one {old.mean:.3f}",
        "handed_over": better,
        "foreseen": {"mean": round(new.mean, 4), "low": round(low, 4), "high": round(high, 4)},
        "foreseen_with_old": round(old.mean, 4),
        "seldom_seen": {"rows_seen_fewer_times_than": FEW, "share_of_foreseen_slots": round(seldom, 4)},
    }
    return _next(twin, state, after, "monitor", entry)


def monitor(twin: Twin, state: State) -> State:
    """Play the policy until the network changes or delivers less than foreseen, or the slots are used up."""
    loop = twin.case.loop
    after = _played(twin, state, state.policy, min(_WINDOWS_AT_ONCE * loop.window, loop.slots - state.slots))
    over = after.slots >= loop.slots or after.slots == state.slots
    seen = watch(twin.case, after) if after.slots - after.watched >= loop.window else None
    calls = seen is not None and seen.alarm is not None
    if seen is not None:
        after = after._replace(detector=seen.detector)
    # a log does not follow the policy
    short = None if twin.case.physical.log is not None else shortfall(after)
    if not over and not ((calls or short) and loop.relearn):
        return after._replace(step=state.step + 1)
    entry: Entry = {
        "why": "no slots are left",
        "alarm": calls,
        **_throughput(after, after.handed),
        **(short or {}),
    }
    phase: Phase = "done"
    if seen is not None and seen.alarm is not None:
        entry |= _alarm(seen, state.watched + (seen.alarm + 1) * loop.window)
        after = after._replace(changed=seen.changed)
        phase = "diagnose" if loop.relearn else "done"
    elif short and not over:
        after = after._replace(round=state.round + 1)
        phase = "learn"
    return _next(twin, state._replace(rows=_until(state, state.handed)), after, phase, entry)


def diagnose(twin: Twin, state: State) -> State:
    """Say why the network is another, play on until that can be told, and forget what does not hold any more."""
    case, loop = twin.case, twin.case.loop
    blame = watch(case, state).blame
    wanted = min(loop.diagnose - (state.slots - state.changed), loop.slots - state.slots)
    after = _played(twin, state, state.policy, wanted) if wanted > 0 else state
    entry: Entry = {"why": f"an alarm: from slot {state.changed} on"}
    if loop.diagnose > 0:
        twin.say("diagnosing the change")
        with jax.enable_x64(True):
            entry |= diagnosed(case, after, _key(case, state), twin.say)
    prior, gone = forget(case, after, blame)
    entry["forgotten"] = list(gone)
    after = after._replace(
        prior=prior, since=state.changed, watched=-1, detector=np.zeros(0), round=state.round + 1
    )
    return _next(twin, state, after, "collect" if after.slots < loop.slots else "done", entry)


PHASES: Final[dict[Phase, Callable[[Twin, State], State]]] = {
    "collect": collect,
    "learn": learn,
    "control": control,
    "hand_over": hand_over,
    "monitor": monitor,
    "diagnose": diagnose,
}

_train = eqx.filter_jit(train)


def _key(case: TwinCase, state: State) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.key(case.seed.value), state.step)


def _budget(slots: int, length: int) -> Budget:
    return Budget(slots, length=max(length, 2))


def _played(twin: Twin, state: State, policy: Chances, slots: int) -> State:
    """The state after some more slots."""
    random = np.random.default_rng([twin.case.seed.value, state.step])
    more = twin.physical.play(policy, slots, random)
    rows = {name: np.concatenate([column, more[name]]) for name, column in state.rows.items()}
    return state._replace(rows=rows)


def _until(state: State, last: int) -> dict[str, np.ndarray]:
    return {name: column[:last] for name, column in state.rows.items()}


def _throughput(state: State, first: int) -> Entry:
    ack = state.rows["ack"][first:]
    return {"throughput": round(float(ack.sum(axis=1).mean()), 4)} if len(ack) else {}


def _alarm(seen: Watched, slot: int) -> Entry:
    """What an alarm says."""
    top = max(seen.blame, key=lambda name: seen.blame[name])
    return {
        "why": f"the evidence for a change was enough at slot {slot}; most likely {top}, since slot {seen.changed}",
        "alarm_slot": slot,
        "changed_since": seen.changed,
        "factors": {name: round(value, 4) for name, value in seen.blame.items()},
    }


def _next(twin: Twin, state: State, after: State, phase: Phase, entry: Entry) -> State:
    """Turn to the next phase, with an entry about this one."""
    own = {"round": state.round, "phase": state.phase, "slots": [state.slots, after.slots]}
    twin.say(f"round {state.round}: {state.phase}: {entry['why']}")
    return after._replace(phase=phase, step=state.step + 1, entries=(*state.entries, {**own, **entry}))
