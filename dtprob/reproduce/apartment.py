"""Real measurements, known causes: wrong twins of the measured apartment, and whether a diagnosis says what is wrong.

The honest twin has a gap too. It is diagnosed first, and what is found there is known from then on: part of every twin,
fitted with its other unknowns. Then each twin of `apartment_twins` is diagnosed on the same measurements. What counts is
the extra gap of a wrong one: its held-out loss less that of the honest twin on the same links, in nats. An answer is
right where it names an effect that undoes what was spoilt; its size is the share of the extra gap that it closes.
Where the answer is not right, the twin is diagnosed once more with nothing to name but what undoes it: what that wins
back on the same links is what the data know of the cause.
"""

import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from dtprob.case import load_case
from dtprob.data.uwb_apartment import read_links
from dtprob.gap.diagnose import diagnose
from dtprob.gap.diagnosis import Diagnosis
from dtprob.gap.settings import Settings
from dtprob.raytracing.paths import PathSet
from dtprob.reproduce.apartment_answers import (
    Answer,
    gaps,
    is_right,
    line,
    needs_cause,
    read,
    share,
    stored,
    summary,
)
from dtprob.reproduce.apartment_twins import LACKING, LINKS, TWINS, Twin, write_case
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress
from dtprob.workflow.prepare import Prepared, prepare

RUNS: Final = 1
SETTINGS: Final = Settings(
    replicates=100,
    site_replicates=19,
    polished=1,
    max_effects=1,
    folds=3,
    grid=24,
    starts=3,
    relevance=0.2,
    remainder=False,
)
"""Of every diagnosis: one effect, one refit freed from local optima, named where it closes a fifth: more is lacking."""
_SAME_PLACE: Final = 1e-3
_PLACE: Final = re.compile(r"(\w+)\[(transmitter|receiver)_(\d+)\]")
"""An effect of one end's place."""


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module. A run is another split of the links and other replicates."""
    found = progress.part(
        "what the honest twin lacks", lambda: {"known": np.array(lacking(key, progress.say), str)}
    )
    known = tuple(map(str, found["known"]))

    def one(twin: Twin, number: int, *, alone: bool = False) -> Answer:
        own = jax.random.fold_in(key, number)
        name = f"{'cause of twin' if alone else 'twin'} {twin.name}, run {number}"
        part = progress.part(name, lambda: stored(answer(twin, own, known, alone=alone, say=progress.say)))
        return read(part)

    answers = [{twin.name: one(twin, number) for twin in TWINS} for number in range(runs)]
    wrong = TWINS[1:]
    causes = [
        {t.name: one(t, number, alone=True) for t in wrong if needs_cause(t, a)}
        for number, a in enumerate(answers)
    ]
    extra = np.array([[gaps(a, twin.name)[0].sum() for twin in wrong] for a in answers])
    closed = np.array([[share(*gaps(a, twin.name)) for twin in wrong] for a in answers])
    undone = np.array(
        [[share(*gaps({**a, **c}, t.name)) for t in wrong] for a, c in zip(answers, causes, strict=True)]
    )
    x = np.arange(1.0, len(wrong) + 1)
    axis = Quantity("wrong twin, as numbered in the notes")
    panels = (
        Panel("extra gap", axis, Quantity("extra loss", "nats"), (Series.of_runs("extra", x, extra),)),
        Panel(
            "closed",
            axis,
            Quantity("share of the extra gap"),
            (Series.of_runs("closed", x, closed), Series.of_runs("closed by the cause alone", x, undone)),
        ),
    )
    notes = [line(i, twin, answers, causes) for i, twin in enumerate(TWINS)]
    first = f"known of every twin, since the honest one lacks it: {', '.join(known) or 'nothing'}"
    title = "Wrong twins of a measured apartment"
    return Figure("apartment", title, panels, runs, (first, *notes, summary(answers)))


def lacking(key: Array, say: Callable[[str], None] = lambda _: None) -> tuple[str, ...]:
    """What the diagnosis of the honest twin finds.

    Args:
        key: typed JAX key.
        say: receives one line at each stage.
    """
    with tempfile.TemporaryDirectory() as folder:
        prepared = _prepared(TWINS[0], Path(folder), (), LACKING, say)
        found = _diagnosed(prepared, key, SETTINGS, say)
    return found.causes[0].effects if found.causes else ()


def answer(
    twin: Twin,
    key: Array,
    known: Sequence[str] = (),
    *,
    alone: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> Answer:
    """Diagnose a twin.

    Args:
        twin: which.
        key: typed JAX key.
        known: what the honest twin lacks, by the names that effects have there; but what undoes the twin is no part of it.
        alone: whether the only candidates are what undoes the twin.
        say: receives one line at each stage.
    """
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        prepared = _prepared(twin, Path(folder), known, twin.undone_by if alone else None, say)
        if alone:
            kept = tuple(effect for effect in prepared.effects if is_right(twin, [effect.name]))
            prepared = replace(prepared, effects=kept)
        found = _diagnosed(prepared, key, SETTINGS, say)
        reached = _numbers(prepared.case.data.file, prepared.data["paths"])
    links = found.maps["links"]
    per_link = prepared.data["power"][0].size
    before = per_link * np.asarray(links["before"] + links["floor"])
    after = per_link * np.asarray(links["after"] + links["floor"]) if found.causes else before
    cause = found.causes[0] if found.causes else None
    inside = () if cause is None else tuple(names[-1] for names in cause.alias_class)
    named = "" if cause is None else cause.effects[0]
    return Answer(reached, before, after, found.verdict, named, inside, time.process_time() - start)


def _prepared(
    twin: Twin,
    folder: Path,
    known: Sequence[str],
    offered: Sequence[str] | None,
    say: Callable[[str], None],
) -> Prepared:
    """A twin's case, traced once: which links it reaches decides how what is known is called there."""
    if known:
        traced = prepare(load_case(write_case(twin, folder)), need="fit", cache=folder, say=say)
        reached = _numbers(traced.case.data.file, traced.data["paths"])
        known = renumbered(
            [name for name in known if not is_right(twin, [name])], traced.case.data.file, reached
        )
    case = load_case(write_case(twin, folder, known, offered))
    return prepare(case, need="diagnosis", cache=folder, say=say)


def _diagnosed(prepared: Prepared, key: Array, settings: Settings, say: Callable[[str], None]) -> Diagnosis:
    return diagnose(
        prepared.model,
        prepared.data,
        prepared.effects,
        key=key,
        engine=prepared.engine,
        settings=settings,
        say=say,
    )


def renumbered(names: Sequence[str], folder: Path, reached: Int[np.ndarray, " link"]) -> tuple[str, ...]:
    """Effects of one place by the number that it has among the ends of the links that a twin reaches.

    Args:
        names: of effects, places counted over all links.
        folder: of the twin's measured set.
        reached: numbers of the links.

    Returns:
        The names; without those of places that no link is left of.
    """
    links = {link.number: link for link in read_links(folder)}
    result: list[str] = []
    for name in names:
        parts = _PLACE.fullmatch(name)
        if parts is None:
            result.append(name)
            continue
        family, kind, number = parts.groups()
        end = "anchor" if kind == "transmitter" else "tag"
        before, after = (
            np.unique([getattr(links[n], end) for n in numbers], axis=0) for numbers in (LINKS, reached)
        )
        same = np.flatnonzero(np.abs(after - before[int(number)]).max(axis=1) < _SAME_PLACE)
        result += [f"{family}[{kind}_{same[0]}]"] if len(same) else []
    return tuple(result)


def _numbers(folder: Path, paths: PathSet) -> Int[np.ndarray, " link"]:
    """Numbers of the links that a twin reaches, in their order."""
    reached = np.concatenate([np.asarray(paths.tx_position), np.asarray(paths.rx_position)], axis=1)
    known = {link.number: np.array([*link.anchor, *link.tag]) for link in read_links(folder)}
    return np.array(
        [n for n in LINKS if np.any(np.abs(reached[:, [0, 1, 3, 4]] - known[n]).max(axis=1) < _SAME_PLACE)]
    )
