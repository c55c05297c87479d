"""`dtprob twin run`: the phases of a network's twin in turn, against a physical twin."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

from dtprob.commands.run import session
from dtprob.control import TablePolicy, export
from dtprob.data import NetworkLog, write
from dtprob.files import check_apart, make_folder, write_text
from dtprob.sections import check_seed
from dtprob.workflow.loop import (
    State,
    Twin,
    TwinCase,
    advance,
    begin,
    connect,
    finished,
    history,
    load,
    load_twin_case,
    save,
)

RESULTS = ("history.json", "policy.json", "log.csv")
_STATE = "state.npz"
_ROW = re.compile(r"\[([^][{}]*)\]")
"""A list of numbers or names, which is read more easily on one line."""


def run(twin_case: Path, out: Path, *, seed: int | None, no_code: bool, resume: bool) -> None:
    """Collect, learn, control, hand over, monitor, and on an alarm diagnose and begin again.

    After every phase `out` has history.json, policy.json (the policy that the devices follow), log.csv, and state.npz,
    from which an interrupted run goes on.

    Args:
        twin_case: the CASE file.
        out: the folder of the results.
        seed: instead of the case's.
        no_code: refuse a case that runs the user's own code.
        resume: go on with what an interrupted run left in ``out``.

    Raises:
        InputError: a case, a log, an environment or a state that cannot be used; or a folder where a result would take the
            place of what is read.
    """
    case = load_twin_case(twin_case)
    if seed is not None:
        case = replace(case, seed=replace(case.seed, value=check_seed(seed)))
    make_folder(out)
    check_apart(out, (*RESULTS, _STATE), case.files)
    with session() as say, jax.enable_x64(False):
        if case.user_code and not no_code:
            say(f"this case runs code of its own: {', '.join(case.user_code)}")
        twin = Twin(case, connect(case, allow_code=not no_code), say)
        state = _start(case, out, resume=resume)
        if state.slots:
            twin.physical.go_on(state.rows)
            say(f"going on in round {state.round} at slot {state.slots}: {state.phase}")
            _write(case, state, out)  # the run may have ended between the state and what people read of it
        while not finished(state):
            state = advance(twin, state)
            _write(case, state, out)
        done = history(case, state)
        say(f"done: {out / 'history.json'}: {state.slots} slots, {done['throughput']:.4f} packets per slot")


def _start(case: TwinCase, out: Path, *, resume: bool) -> State:
    """The state that was left, or the first one; results of an earlier run are gone then."""
    if resume and (out / _STATE).is_file():
        return load(case, out / _STATE)
    for name in (*RESULTS, _STATE):
        (out / name).unlink(missing_ok=True)
    return begin(case)


def _write(case: TwinCase, state: State, out: Path) -> None:
    """The state first, then what people read of it."""
    save(state, case, out / _STATE)
    text = json.dumps(history(case, state), indent=1, allow_nan=False)
    write_text(out / "history.json", _ROW.sub(lambda row: f"[{' '.join(row[1].split())}]", text) + "\n")
    export.save(TablePolicy(jnp.asarray(state.policy)), out / "policy.json")
    if state.slots:
        write(out / "log.csv", NetworkLog(**state.rows))
