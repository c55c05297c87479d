"""The one run loop of all Markov chain engines: chunks, progress, checkpoint, resume.

Chains advance a bounded number of steps per call of one compiled function, the same for every length of
chunk, number of draws and interruption, and the draws go to the host.
The key of a step is folded from the run's key, the chain and the step's number, so a draw does not depend
on where chunks end, on an interruption, or on how many chains and draws there are.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference import checkpoint
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.chains import START, Chain, ChainMethod, Walk, advance, start
from dtprob.inference.engine import AbstractEngine, RunOptions, check_key
from dtprob.inference.enough import LOOK_EVERY, NEVER, Enough
from dtprob.inference.identity import identity
from dtprob.inference.kernel import Kernel
from dtprob.inference.modes import nowhere_finite, starting_points
from dtprob.inference.posterior import Posterior
from dtprob.inference.progress import Progress
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model

_EXPLORE_SHARE = 5
_RETRIES, _ANEW = 8, 1 << 20
"""How often chains look for another starting point where the density is not finite, and of which keys."""
_ROWS, _ENTRIES = (
    500,
    4_000_000,
)  # steps per call of the compiled function, and numbers of their positions, at most
_CHUNK, _MOST, _SOON = (
    100,
    1000,
    0.5,
)  # steps of the first chunk and of the longest one, and seconds to double it


@dataclass(frozen=True)
class Schedule:
    """How long a run is.

    Attributes:
        chains: number of chains.
        warmup: steps of each chain that are not kept.
        draws: steps of each chain that are.
        method: each chain by calls of its own, on as many cores as there are ("parallel"), or all in one program
            ("vectorized").
        initial: constrained values that the chains start from.
        enough: when to stop before all draws are made.
    """

    chains: int
    warmup: int
    draws: int
    method: ChainMethod
    initial: Mapping[str, Any] | None = None
    enough: Enough = NEVER

    @property
    def total(self) -> int:
        """All steps of a chain."""
        return self.warmup + self.draws

    def walk(self, target: Target, kernel_for: Callable[[int], Kernel], own: tuple[str, ...] = ()) -> Walk:
        """How the chains move; `own` as in `Walk`."""
        explore = self.warmup // _EXPLORE_SHARE if target.angles.size else 0
        return Walk(kernel_for(self.warmup), self.method, explore, self.warmup, own)


def run_chains(
    engine: AbstractEngine,
    kernel_for: Callable[[int], Kernel],
    schedule: Schedule,
    key: PRNGKeyArray,
    *,
    model: Model,
    data: Mapping[str, Any],
    options: RunOptions,
) -> Posterior:
    """Run a Markov chain kernel and return the posterior.

    Args:
        engine: who runs, for the provenance.
        kernel_for: warm-up length -> kernel.
        schedule: chains, warm-up, draws.
        key: typed JAX key.
        model: the NumPyro model.
        data: its arguments by name.
        options: progress, checkpoint, what to keep.

    Raises:
        InputError: see `build_target`; or the checkpoint is another run's.
    """
    check_key(key)
    target, inputs = build_target(model, data)
    walk = schedule.walk(target, kernel_for)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(schedule.chains))
    draws = Loop(target, inputs, walk, schedule, key, options, engine).run(keys)
    positions = draws.pop("position")
    return assemble(target, inputs, positions, engine=engine, key=key, options=options, stats=draws)


@dataclass
class Loop:
    """The host's side of a run: the only place with side effects.

    Attributes:
        target: what the chains are of.
        inputs: its arrays; those that `walk.own` names are stacked, one for each chain.
        walk: how they move.
        schedule: for how long.
        key: the run's key, for its identity.
        options: progress, checkpoint.
        engine: who runs.
    """

    target: Target
    inputs: Inputs
    walk: Walk
    schedule: Schedule
    key: PRNGKeyArray
    options: RunOptions
    engine: AbstractEngine

    def run(self, keys: PRNGKeyArray) -> dict[str, np.ndarray]:
        """All draws and statistics by name, (chain, draw, ...).

        Args:
            keys: of each chain.
        """
        wanted = self._wanted() if self.options.checkpoint else {}
        key_groups = self._grouped(keys)
        done, groups, kept = self._begin(key_groups, wanted)
        rows = self._rows(len(key_groups[0]))
        move = self.target.compiled(advance, self.walk, rows)
        move(groups[0], key_groups[0], done, done, self.inputs)  # no step: compiled before threads ask for it
        total, length, pace = self.schedule.total, self.options.chunk or _CHUNK, checkpoint.Pace()
        diverging = sum(int(block["diverging"].sum()) for block in kept)
        finished = done == total or self._is_enough(done, kept)
        with (
            ThreadPoolExecutor(min(len(groups), os.cpu_count() or 1)) as pool,
            Progress(self.engine.name, total, self.options.progress, self.options.status_file) as progress,
        ):
            while not finished:
                began, end = time.monotonic(), self._chunk_end(done, length)
                advanced = functools.partial(self._advance, move, rows, done, end)
                found = list(pool.map(advanced, groups, key_groups))
                groups = [group for group, _ in found]
                if done >= self.walk.warmup:
                    blocks = [_stacked(parts) for parts in zip(*(b for _, b in found), strict=True)]
                    diverging += sum(int(block["diverging"].sum()) for block in blocks)
                    kept += blocks
                done = end
                finished = done == total or self._is_enough(done, kept)
                if self.options.checkpoint and (finished or pace.is_due()):
                    pace.write(self.options.checkpoint, wanted, _snapshot(done, groups, kept))
                note = f"{diverging} diverging" if diverging else ""
                progress.report(done, "draws" if done > self.walk.warmup else "warmup", note)
                if self.options.chunk is None and time.monotonic() - began < _SOON:
                    length = min(2 * length, _MOST)
        return _joined(kept)

    def _rows(self, chains: int) -> int:
        """Steps per call for so many chains: enough that the call costs little beside them, in bounded memory."""
        return max(1, min(_ROWS, _ENTRIES // (chains * self.target.dimension)))

    def _grouped(self, stacked: Any) -> list[Any]:
        """What is stacked by chain, in the groups that a call of the compiled functions serves: one chain, or all."""
        together = self.walk.own or self.walk.method == "vectorized"
        size = len(jax.tree.leaves(stacked)[0]) if together else 1
        firsts = range(0, len(jax.tree.leaves(stacked)[0]), size)
        return [jax.tree.map(lambda x, first=first: x[first : first + size], stacked) for first in firsts]

    def _wanted(self) -> dict[str, Any]:
        """What a checkpoint must be of; it may have fewer draws."""
        return identity(self.target, self.inputs, self.engine, self.key, free=("draws",))

    def _advance(  # noqa: PLR0917
        self, move: Callable[..., Any], most: int, begin: int, end: int, chains: Chain, keys: PRNGKeyArray
    ) -> tuple[Chain, list[dict[str, np.ndarray]]]:
        """A group of chains after steps `begin` to `end`, and these steps' rows, by one program for every chunk."""
        blocks: list[dict[str, np.ndarray]] = []
        with jax.enable_x64(self.inputs.location.dtype == np.float64):  # a thread has a precision of its own
            for first in range(begin, end, most):
                rows = min(most, end - first)
                chains, block = move(chains, keys, first, first + rows, self.inputs)
                blocks.append({name: np.asarray(x)[:, :rows] for name, x in block.items()})
        return chains, blocks

    def _chunk_end(self, done: int, length: int) -> int:
        """The end of the chunk that begins after `done` steps: no chunk crosses a phase, or a look at the draws."""
        ends = [self.walk.warmup, self.schedule.total]
        if self.schedule.enough.ess:
            looks = max(done - self.walk.warmup, 0) // LOOK_EVERY + 1
            ends.append(self.walk.warmup + looks * LOOK_EVERY)
        return min(done + length, *(end for end in ends if end > done))

    def _is_enough(self, done: int, kept: list[dict[str, np.ndarray]]) -> bool:
        enough = self.schedule.enough
        if not enough.is_look(done - self.walk.warmup):
            return False
        return enough.reached(self.target, _joined(kept)["position"])

    def _begin(
        self, keys: list[PRNGKeyArray], wanted: Mapping[str, Any]
    ) -> tuple[int, list[Chain], list[dict[str, np.ndarray]]]:
        path = self.options.checkpoint
        begin = self.target.once(start, self.walk)
        if not self.options.resume or path is None or not path.exists():
            points = self._finite(keys)
            return 0, [begin(at, group, self.inputs) for at, group in zip(points, keys, strict=True)], []
        found = checkpoint.read(path, wanted)
        if found.done > self.schedule.total:
            expected, got = f"at most {self.schedule.total} steps", str(found.done)
            raise InputError(f"checkpoint {path}", expected, got, "Ask for as many draws as it has, or more")
        points = jax.ShapeDtypeStruct((len(keys[0]), self.target.dimension), jnp.zeros(0).dtype)
        like = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((self.schedule.chains, *x.shape[1:]), x.dtype),
            jax.eval_shape(begin, points, keys[0], self.inputs),
        )
        chains: Chain = checkpoint.restore(found.state, like, f"checkpoint {path}")
        return found.done, self._grouped(chains), [found.draws] if found.draws else []

    def _finite(self, keys: list[PRNGKeyArray]) -> list[Float[Array, "chain dimension"]]:
        """Starting points at which the density is finite, others tried where it is not."""
        density = self.target.once(_densities, self.walk)
        points = [np.asarray(self._starting_points(group)) for group in keys]
        for number in range(_RETRIES):
            fine = [np.isfinite(np.asarray(density(at, self.inputs))) for at in points]
            if all(one.all() for one in fine):
                return [jnp.asarray(at) for at in points]
            again = [jax.vmap(jax.random.fold_in, (0, None))(group, _ANEW + number) for group in keys]
            fresh = [np.asarray(self._starting_points(group)) for group in again]
            points = [np.where(f[:, None], at, new) for f, at, new in zip(fine, points, fresh, strict=True)]
        raise nowhere_finite(self.target)

    def _starting_points(self, keys: PRNGKeyArray) -> Float[Array, "chain dimension"]:
        """For each chain the initial values, or the best of a few prior draws."""
        values = self.target.latent_values(self.schedule.initial or {})
        starts = 1 if len(values) == len(self.target.coordinates) else 2

        def one(inputs: Inputs, key: PRNGKeyArray) -> Array:
            start_key = jax.random.fold_in(key, START)
            return starting_points(
                self.target, inputs, start_key, objective="density", values=values, starts=starts
            )

        if self.walk.own:
            return self.walk.over_chains(one, self.inputs, keys)[:, -1]
        return jnp.asarray(np.stack([np.asarray(one(self.inputs, key))[-1] for key in keys]))


def _densities(target: Target, walk: Walk, points: Array, inputs: Inputs) -> Float[Array, " chain"]:
    return walk.over_chains(lambda own, u: target.log_density(u, own), inputs, points)


def _snapshot(done: int, groups: Sequence[Chain], kept: list[dict[str, np.ndarray]]) -> checkpoint.Snapshot:
    """What a checkpoint holds of the chains and their draws so far."""
    state = [np.concatenate(leaves) for leaves in zip(*map(jax.tree.leaves, groups), strict=True)]
    return checkpoint.Snapshot(done, state, _joined(kept) if kept else {})


def _stacked(blocks: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The rows of all groups, chain after chain."""
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _joined(kept: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The blocks as one; the list then holds it alone."""
    kept[:] = [{name: np.concatenate([block[name] for block in kept], axis=1) for name in kept[0]}]
    return dict(kept[0])
