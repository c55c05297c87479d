"""The loop: phase after phase, each from a state to the next."""

from typing import Any

from dtprob.edition import edition
from dtprob.workflow.loop.phases import PHASES, Twin
from dtprob.workflow.loop.settings import TwinCase
from dtprob.workflow.loop.state import State


def advance(twin: Twin, state: State) -> State:
    """Do what comes next; of monitoring, some windows.

    Args:
        twin: case, physical twin, and where to tell the progress.
        state: one that is not finished.
    """
    return PHASES[state.phase](twin, state)


def finished(state: State) -> bool:
    """Whether the slots are used up."""
    return state.phase == "done"


def history(case: TwinCase, state: State) -> dict[str, Any]:
    """The content of history.json: what was done, learnt, handed over, and why.

    Args:
        case: the settings.
        state: so far.
    """
    return {
        "case": case.path.name,
        "model": case.model.name,
        "physical": case.physical.environment or str(case.physical.log),
        "seed": case.seed.value,
        "dtprob": edition(),
        "finished": finished(state),
        "slots": state.slots,
        "rounds": state.round,
        "throughput": _mean(state),
        "entries": list(state.entries),
    }


def _mean(state: State) -> float | None:
    """Packets delivered per slot since the beginning."""
    return float(state.rows["ack"].sum(axis=1).mean()) if state.slots else None
