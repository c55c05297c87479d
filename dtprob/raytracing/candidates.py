"""Room for the solver's candidate paths: what it has no room for is lost, and it does not say so.

sionna-rt tells candidates apart by a table of their hashes, common to all targets of a call. Of two that share an
entry the later one is dropped, as if it had been seen before: a table of a million entries, which is what the solver
takes, loses one path in ten once it is a tenth full, strong paths like weak ones. Here the table is larger, targets
that would fill it are searched in smaller groups, and what still does not fit is said.
"""

import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from jaxtyping import Int

TABLE: Final = 33_554_393
"""Entries of the table: the largest prime below 2^25, which with its copies takes 0.4 GB."""

_CROWDED: Final = TABLE // 500
"""Candidates from which on targets are searched in smaller groups: about as large a share of the paths is lost."""

_LOSING: Final = TABLE // 100
"""Candidates of a single target from which on the loss is said."""

_SPARE: Final = 0.8
"""Share of the room that the next group is expected to take: some targets have more candidates than others."""

_LANES: Final = 30_000_000
"""Rays times depth times targets that one call of the solver may hold, about 1 GB."""


class CandidateCount:
    """How many candidates the last call of a solver found, which its paths do not tell."""

    def __init__(self, solver: Any) -> None:
        self.found = 0
        self._generate: Callable[..., Any] = getattr(solver, "_candidate_generator", _no_generator)
        if self._generate is not _no_generator:
            solver._candidate_generator = self  # noqa: SLF001 (no public way to see that candidates were dropped)

    def __call__(self, **arguments: Any) -> Any:
        """Find candidates as the solver would, and count them."""
        buffer = self._generate(**arguments)
        self.found = int(np.asarray(buffer.paths_counter).reshape(-1)[0])
        return buffer


def _no_generator(**_: Any) -> None:
    """Stands for the generator of a solver that keeps it elsewhere."""


@contextmanager
def large_table() -> Generator[None]:
    """Solve with a table of `TABLE` entries per source inside the context, as sionna-rt ships it outside."""
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator  # noqa: PLC0415

    original = SBCandidateGenerator.MIN_SPEC_COUNT_SIZE
    SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = TABLE
    try:
        yield
    finally:
        SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = original


def in_groups[T](
    search: Callable[[int, Int[np.ndarray, " some"]], tuple[T, int]],
    targets: Sequence[Int[np.ndarray, " target"]],
    *,
    depth: int,
    samples: int,
    max_paths: int,
) -> Generator[tuple[Int[np.ndarray, " some"], T]]:
    """Search the paths to many targets, so few at a time that no candidates are dropped. Warns where one is too many.

    How many go together follows from the most candidates that a target has had so far.

    Args:
        search: what finds the paths from the source of a number to some targets, and how many candidates there were.
        targets: numbers of the targets of each source.
        depth: most interactions on a path.
        samples: rays shot from the source.
        max_paths: room for candidates in a call of `search`.

    Yields:
        the targets of a group and what was found for them, in order.
    """
    most, room = max(1, _LANES // (max(depth, 1) * samples)), max(min(max_paths - 1, _CROWDED), 1)
    expected = seen = _SPARE * room / most
    for source, all_ in enumerate(targets):
        start = 0
        while start < len(all_):
            group = all_[start : start + max(int(_SPARE * room / expected), 1)]
            found, candidates = search(source, group)
            each = candidates / len(group)
            if candidates >= room and len(group) > 1:
                expected = 2 * each if candidates >= max_paths - 1 else each  # not all were counted
                continue
            _warn(candidates, max_paths)
            expected = seen = max(seen, each)
            start += len(group)
            yield group, found


def _warn(candidates: int, max_paths: int) -> None:
    if candidates >= max_paths - 1:
        text = f"the solver had room for {max_paths} candidate paths of a link and dropped the others; raise max_paths."
        warnings.warn(text, RuntimeWarning, stacklevel=4)
    elif candidates >= _LOSING:
        share = f"about {100 * candidates / TABLE:.0f}% of its paths are lost to shared entries in the solver's table"
        text = (
            f"a link has {candidates} candidate paths: {share}; lower max_depth, or trace without refraction."
        )
        warnings.warn(text, RuntimeWarning, stacklevel=4)
