"""What diagnoses of wrong twins answered, and how they are judged: by name, and by the extra gap that they close."""

import re
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.reproduce.apartment_twins import TWINS, Twin

_DRAWS: Final = 2000
_SCREEN: Final = re.compile(r"missing_object\[([-\d.]+)_([-\d.]+)_to_([-\d.]+)_([-\d.]+)\]")
_HALF_CELL: Final = 0.8
"""m; of the grid on which missing walls are looked for."""


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


def stored(found: Answer) -> dict[str, np.ndarray]:
    """As arrays, for the part of a figure."""
    return {name: np.asarray(value) for name, value in found._asdict().items()}


def read(part: Mapping[str, np.ndarray]) -> Answer:
    """From such arrays."""
    return Answer(
        link=part["link"],
        before=part["before"],
        after=part["after"],
        verdict=str(part["verdict"]),
        named=str(part["named"]),
        inside=tuple(map(str, part["inside"])),
        seconds=float(part["seconds"]),
    )


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


def needs_cause(twin: Twin, answers: Mapping[str, Answer]) -> bool:
    """Whether a second diagnosis, with its cause alone, is worth it: the extra gap stands and another effect was named."""
    named = is_right(twin, [answers[twin.name].named])
    return bool(twin.undone_by) and not named and _total(gaps(answers, twin.name)[0])[1] > 0


def is_right(twin: Twin, names: Sequence[str]) -> bool:
    """Whether one of these effects undoes what is wrong with a twin; of missing walls, one where the wall stands."""
    return any(
        (name in twin.undone_by or name.partition("[")[0] in twin.undone_by) and _is_there(twin, name)
        for name in names
    )


def _is_there(twin: Twin, name: str) -> bool:
    """Whether a screen runs along the wall that a twin lacks, at most half a cell beside it and beyond its ends."""
    found = _SCREEN.fullmatch(name)
    if twin.wall_ends is None or found is None:
        return True
    first, last = np.reshape([float(x) for x in found.groups()], (2, 2))
    start, stop = np.reshape(twin.wall_ends, (2, 2))
    middle, length = (first + last) / 2, float(np.linalg.norm(stop - start))
    along = (stop - start) / length
    place = float((middle - start) @ along)
    beside = float(np.linalg.norm(middle - start - place * along))
    is_parallel = abs(float((last - first) @ along)) > 0.5 * float(np.linalg.norm(last - first))
    return is_parallel and beside < _HALF_CELL and -_HALF_CELL < place < length + _HALF_CELL


def _total(extra: Float[np.ndarray, " link"]) -> tuple[float, float, float]:
    """Sum over links with its 90% interval by a bootstrap over links."""
    index = np.random.default_rng(0).integers(0, len(extra), (_DRAWS, len(extra)))
    low, high = np.quantile(extra[index].sum(axis=1), [0.05, 0.95])
    return float(extra.sum()), float(low), float(high)


def share(extra: Float[np.ndarray, " link"], won: Float[np.ndarray, " link"]) -> float:
    """Share of the extra gap that is won back; nan where the extra gap is not established."""
    total, low, _ = _total(extra)
    return float(won.sum()) / total if low > 0 else float("nan")


def line(
    number: int,
    twin: Twin,
    answers: Sequence[Mapping[str, Answer]],
    causes: Sequence[Mapping[str, Answer]],
) -> str:
    """What one twin brought, over runs."""
    found = [a[twin.name] for a in answers]
    named = ", ".join(dict.fromkeys(f.named or "nothing" for f in found))
    gap = ""
    if number:
        total, low, high = _total(np.mean([gaps(a, twin.name)[0] for a in answers], axis=0))
        part = np.mean([share(*gaps(a, twin.name)) for a in answers])
        closed = "not established" if np.isnan(part) else f"{part:.2f} of it closed"
        gap = f"extra gap {total:.1f} nats ({low:.1f} to {high:.1f}), {closed}; "
    right = ""
    if twin.undone_by:
        first = np.mean([is_right(twin, [f.named]) for f in found])
        inside = np.mean([is_right(twin, f.inside) for f in found])
        right = f"; right first {first:.2f}, inside the class {inside:.2f}{_alone(twin, answers, causes)}"
    verdicts = ", ".join(dict.fromkeys(f.verdict for f in found))
    seconds = np.mean([f.seconds for f in found])
    return (
        f"{number} {twin.name} ({twin.wrong}): {gap}{verdicts}, named {named}{right};"
        f" {len(found[0].link)} links, {seconds:.0f} s of processor time"
    )


def _alone(
    twin: Twin, answers: Sequence[Mapping[str, Answer]], causes: Sequence[Mapping[str, Answer]]
) -> str:
    """What the cause wins back where it is the only candidate."""
    pairs = [({**a, **c}, c[twin.name].named) for a, c in zip(answers, causes, strict=True) if twin.name in c]
    if not pairs:
        return ""
    part = np.mean([share(*gaps(found, twin.name)) for found, _ in pairs])
    named = ", ".join(dict.fromkeys(name or "nothing" for _, name in pairs))
    return f"; of its cause alone {named} is accepted and closes {part:.2f}"


def summary(answers: Sequence[Mapping[str, Answer]]) -> str:
    """How often the answer is right: of all twins that an effect undoes, and of those with an extra gap."""
    able = [(twin, a) for a in answers for twin in TWINS if twin.undone_by]
    seen = [(twin, a) for twin, a in able if _total(gaps(a, twin.name)[0])[1] > 0]

    def right(cases: Sequence[tuple[Twin, Mapping[str, Answer]]]) -> str:
        first = sum(is_right(twin, [a[twin.name].named]) for twin, a in cases)
        inside = sum(is_right(twin, a[twin.name].inside) for twin, a in cases)
        return f"right first in {first} of {len(cases)}, inside the class in {inside}"

    return f"{right(able)}; of those whose extra gap is established {right(seen)}"
