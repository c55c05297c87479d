"""Real measurements, known causes: wrong twins of the measured apartment, and whether a diagnosis says what is wrong.

Each twin of `apartment_twins` is diagnosed on the same measurements. The honest twin has a gap too, so what counts is
the extra gap of a wrong one: its held-out loss less that of the honest twin on the same links, in nats. An answer is
right where it names an effect that undoes what was spoilt; its size is the share of the extra gap that it closes.
"""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.case import load_case
from dtprob.data.uwb_apartment import read_links
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.raytracing.paths import PathSet
from dtprob.reproduce.apartment_twins import LINKS, TWINS, Twin, write_case
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress
from dtprob.workflow.prepare import prepare

RUNS: Final = 1
SETTINGS: Final = Settings(
    replicates=100, site_replicates=19, candidates=6, polished=0, max_effects=1, folds=3, grid=24, starts=1
)
"""Of every diagnosis: one effect, no freeing from local optima."""
_DRAWS: Final = 2000
_SAME_PLACE: Final = 1e-3


class Answer(NamedTuple):
    """A diagnosis, in arrays.

    Attributes:
        link: numbers of the links that the twin reaches.
        before: nats of each link left out, of the twin as it is.
        after: the same with the effect that was named, or `before` where none was.
        verdict: of the report.
        named: the effect, or "".
        inside: effects that the data cannot tell from it, itself included.
        seconds: of processor time.
    """

    link: Int[np.ndarray, " link"]
    before: Float[np.ndarray, " link"]
    after: Float[np.ndarray, " link"]
    verdict: str
    named: str
    inside: tuple[str, ...]
    seconds: float


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module. A run is another split of the links and other replicates."""

    def one(twin: Twin, number: int) -> Answer:
        own = jax.random.fold_in(key, number)
        part = progress.part(
            f"twin {twin.name}, run {number}", lambda: _stored(answer(twin, own, progress.say))
        )
        return _read(part)

    answers = [{twin.name: one(twin, number) for twin in TWINS} for number in range(runs)]
    wrong = TWINS[1:]
    extra = np.array([[gaps(a, twin.name)[0].sum() for twin in wrong] for a in answers])
    closed = np.array([[_share(*gaps(a, twin.name)) for twin in wrong] for a in answers])
    x = np.arange(1.0, len(wrong) + 1)
    axis = Quantity("wrong twin, as numbered in the notes")
    panels = (
        Panel("extra gap", axis, Quantity("extra loss", "nats"), (Series.of_runs("extra", x, extra),)),
        Panel("closed", axis, Quantity("share of the extra gap"), (Series.of_runs("closed", x, closed),)),
    )
    notes = [_line(i, twin, answers) for i, twin in enumerate(TWINS)]
    return Figure(
        "apartment", "Wrong twins of a measured apartment", panels, runs, (*notes, _summary(answers))
    )


def answer(twin: Twin, key: Array, say: Callable[[str], None] = lambda _: None) -> Answer:
    """Diagnose a twin.

    Args:
        twin: which.
        key: typed JAX key.
        say: receives one line at each stage.
    """
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        prepared = prepare(load_case(write_case(twin, Path(folder))), need="diagnosis", say=say)
        found = diagnose(
            prepared.model,
            prepared.data,
            prepared.effects,
            key=key,
            engine=prepared.engine,
            settings=SETTINGS,
            say=say,
        )
        reached = _numbers(prepared.case.data.file, prepared.data["paths"])
    links = found.maps["links"]
    per_link = prepared.data["channel"][0].size
    before = per_link * (np.asarray(links["before"]) + links.attrs["floor"])
    after = per_link * (np.asarray(links["after"]) + links.attrs["floor"]) if found.causes else before
    cause = found.causes[0] if found.causes else None
    inside = () if cause is None else tuple(names[-1] for names in cause.alias_class)
    named = "" if cause is None else cause.effects[0]
    return Answer(reached, before, after, found.verdict, named, inside, time.process_time() - start)


def gaps(
    answers: Mapping[str, Answer], name: str
) -> tuple[Float[np.ndarray, " link"], Float[np.ndarray, " link"]]:
    """What a twin loses against the honest one, and what its answer wins back, nats of each link that both reach.

    Args:
        answers: of all twins.
        name: of the twin.
    """
    honest, wrong = answers[TWINS[0].name], answers[name]
    _, first, second = np.intersect1d(honest.link, wrong.link, return_indices=True)
    return wrong.before[second] - honest.before[first], wrong.before[second] - wrong.after[second]


def is_right(twin: Twin, names: Sequence[str]) -> bool:
    """Whether one of these effects undoes what is wrong with a twin."""
    return any(name in twin.undone_by or name.partition("[")[0] in twin.undone_by for name in names)


def _numbers(folder: Path, paths: PathSet) -> Int[np.ndarray, " link"]:
    """Numbers of the links that a twin reaches, in their order."""
    reached = np.concatenate([np.asarray(paths.tx_position), np.asarray(paths.rx_position)], axis=1)
    known = {link.number: np.array([*link.anchor, *link.tag]) for link in read_links(folder)}
    return np.array(
        [n for n in LINKS if np.any(np.abs(reached[:, [0, 1, 3, 4]] - known[n]).max(axis=1) < _SAME_PLACE)]
    )


def _stored(found: Answer) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in found._asdict().items()}


def _read(part: Mapping[str, np.ndarray]) -> Answer:
    return Answer(
        link=part["link"],
        before=part["before"],
        after=part["after"],
        verdict=str(part["verdict"]),
        named=str(part["named"]),
        inside=tuple(map(str, part["inside"])),
        seconds=float(part["seconds"]),
    )


def _total(extra: Float[np.ndarray, " link"]) -> tuple[float, float, float]:
    """Sum over links with its 90% interval by a bootstrap over links."""
    index = np.random.default_rng(0).integers(0, len(extra), (_DRAWS, len(extra)))
    low, high = np.quantile(extra[index].sum(axis=1), [0.05, 0.95])
    return float(extra.sum()), float(low), float(high)


def _share(extra: Float[np.ndarray, " link"], won: Float[np.ndarray, " link"]) -> float:
    """Share of the extra gap that is won back; nan where the extra gap is not established."""
    total, low, _ = _total(extra)
    return float(won.sum()) / total if low > 0 else float("nan")


def _line(number: int, twin: Twin, answers: Sequence[Mapping[str, Answer]]) -> str:
    """What one twin brought, over runs."""
    found = [a[twin.name] for a in answers]
    named = ", ".join(dict.fromkeys(f.named or "nothing" for f in found))
    gap = ""
    if number:
        total, low, high = _total(np.mean([gaps(a, twin.name)[0] for a in answers], axis=0))
        share = np.mean([_share(*gaps(a, twin.name)) for a in answers])
        closed = "not established" if np.isnan(share) else f"{share:.2f} of it closed"
        gap = f"extra gap {total:.1f} nats ({low:.1f} to {high:.1f}), {closed}; "
    right = ""
    if twin.undone_by:
        first = np.mean([is_right(twin, [f.named]) for f in found])
        inside = np.mean([is_right(twin, f.inside) for f in found])
        right = f"; right first {first:.2f}, inside the class {inside:.2f}"
    verdicts = ", ".join(dict.fromkeys(f.verdict for f in found))
    seconds = np.mean([f.seconds for f in found])
    return (
        f"{number} {twin.name} ({twin.wrong}): {gap}{verdicts}, named {named}{right};"
        f" {len(found[0].link)} links, {seconds:.0f} s of processor time"
    )


def _summary(answers: Sequence[Mapping[str, Answer]]) -> str:
    """How often the answer is right: of all twins that an effect undoes, and of those with an extra gap."""
    able = [(twin, a) for a in answers for twin in TWINS if twin.undone_by]
    seen = [(twin, a) for twin, a in able if _total(gaps(a, twin.name)[0])[1] > 0]

    def right(cases: Sequence[tuple[Twin, Mapping[str, Answer]]]) -> str:
        first = sum(is_right(twin, [a[twin.name].named]) for twin, a in cases)
        inside = sum(is_right(twin, a[twin.name].inside) for twin, a in cases)
        return f"right first in {first} of {len(cases)}, inside the class in {inside}"

    return f"{right(able)}; of those whose extra gap is established {right(seen)}"
