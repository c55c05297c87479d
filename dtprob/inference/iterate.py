"""The run loop of engines that carry one state from step to step: progress, checkpoint, resume.

Markov chains have a loop of their own (`dtprob.inference.run`), since they keep a draw of every step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.inference import checkpoint
from dtprob.inference.engine import AbstractEngine, RunOptions
from dtprob.inference.identity import identity
from dtprob.inference.progress import Progress
from dtprob.inference.target import Inputs, Target

type History = dict[str, np.ndarray]


@dataclass(frozen=True)
class Job:
    """A run.

    Attributes:
        engine: who runs.
        target: what it works on.
        inputs: the target's arrays.
        key: the run's key.
        options: progress and checkpoint.
        free: the engine's settings that an interrupted run may be continued with other values of.
    """

    engine: AbstractEngine
    target: Target
    inputs: Inputs
    key: PRNGKeyArray
    options: RunOptions
    free: Sequence[str] = ()


@dataclass(frozen=True)
class Steps[S]:
    """What a run does; each part depends on nothing but its arguments and the job.

    Attributes:
        begin: the state before the first step, a pytree of arrays without keys.
        step: the number of a step and the state before it -> the state after it, and what to record.
        finished: whether a state is the last one.
        most: bound on the steps.
        phase: what a step is called in the progress.
        note: a state -> what else to say.
    """

    begin: Callable[[], S]
    step: Callable[[int, S], tuple[S, dict[str, Any]]]
    finished: Callable[[S], bool]
    most: int
    phase: str
    note: Callable[[S], str]


def iterate[S](job: Job, steps: Steps[S]) -> tuple[S, History]:
    """The state after the last step, and what the steps recorded, each (step, ...).

    Raises:
        InputError: the checkpoint is another run's.
    """
    options = job.options
    wanted = (
        identity(job.target, job.inputs, job.engine, job.key, free=job.free) if options.checkpoint else {}
    )
    done, state, rows = _begin(job, steps, wanted)
    pace = checkpoint.Pace()
    with Progress(job.engine.name, steps.most, options.progress, options.status_file) as progress:
        while done < steps.most and not steps.finished(state):
            state, row = steps.step(done, state)
            rows.append({name: np.asarray(value)[None] for name, value in row.items()})
            done += 1
            last = done == steps.most or steps.finished(state)
            if options.checkpoint and (last or pace.is_due()):
                leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
                pace.write(options.checkpoint, wanted, checkpoint.Snapshot(done, leaves, _history(rows)))
            progress.report(done, steps.phase, steps.note(state))
    return state, _history(rows)


def _begin[S](job: Job, steps: Steps[S], wanted: dict[str, Any]) -> tuple[int, S, list[History]]:
    path = job.options.checkpoint
    if not job.options.resume or path is None or not path.exists():
        return 0, steps.begin(), []
    found = checkpoint.read(path, wanted)
    # The first state is made again, for its shape: it may take a search, whose choices eval_shape cannot follow.
    state = checkpoint.restore(found.state, steps.begin(), f"checkpoint {path}")
    return found.done, state, [found.draws] if found.draws else []


def _history(rows: list[History]) -> History:
    """The rows as one; the list then holds it alone."""
    if not rows:
        return {}
    rows[:] = [{name: np.concatenate([row[name] for row in rows]) for name in rows[0]}]
    return dict(rows[0])
