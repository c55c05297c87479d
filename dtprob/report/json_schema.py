"""What report.json holds, as types, and the check that a report keeps to them.

JSON has no infinity and no NaN: a number that the data do not determine, or that has no bound, is null. A
field that may be so says `Number` or `| None`; every other number must be there and be finite.
"""

import json
import math
from collections.abc import Mapping, Sequence
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    TypedDict,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from dtprob.errors import InputError, unknown_name
from dtprob.gap.vocabulary import Verdict

type Number = float | None
type Probability = Annotated[float, "0 to 1"]
type Range = tuple[float, float]
type BeforeAfter = tuple[Number, Number]

VERDICTS: tuple[str, ...] = get_args(Verdict.__value__)


class Interval(TypedDict):
    """A mean with its 90% interval; an end is null where the interval has none on that side."""

    mean: Number
    low: Number
    high: Number


class Meaning(TypedDict):
    """How a size x is told: as x, 100 x percent, the factor exp(x), or 1 - exp(-x), a share, in percent."""

    words: str
    told_as: Literal["number", "percent", "factor", "share"]


class Size(Interval):
    """The size of one parameter of an effect, in SI units; without `unit` the key ends in one: `delay_s`."""

    unit: NotRequired[str]
    meaning: NotRequired[Meaning]


class Strata(TypedDict):
    """The estimate of the cause's first size, each time without another part of the data."""

    estimate: list[Number]


class Share(TypedDict):
    """Shapley's part of one effect in what its set closes, with its interval; `own` is what no other could close."""

    effect: str
    mean: Number
    low: Number
    high: Number
    own: Number


class Cause(TypedDict):
    """A set of effects that may explain the gap; the data cannot tell the sets of `alias_class` apart."""

    effects: list[str]
    alias_class: list[list[str]]
    probability: Probability
    size: dict[str, Size]
    closed_fraction: Interval | None
    parameters: NotRequired[Number]
    shares: NotRequired[list[Share]]
    physics: NotRequired[str]
    strata: NotRequired[Strata]
    plausible: NotRequired[bool]


class Tried(TypedDict):
    """A set that was fitted in full: nats of evidence that it gains, and by which it is less likely than the named one."""

    effects: list[str]
    gain_nats: float
    behind_nats: float


class Site(TypedDict):
    """A site of the model, with its share of the gap; `family` says how it must change to close it.

    `moment` is what of an observation is wrong where its values are right, `whereabouts` where or along what.
    Where one group, position or reading brings most of what is wrong, `place` names it. What `spreads` moves nothing but
    how observations spread.
    """

    site: str
    p_value: Probability | None
    share: Number
    family: NotRequired[str]
    moment: NotRequired[str]
    whereabouts: NotRequired[str]
    place: NotRequired[str]
    spreads: NotRequired[bool]


class Coordinates(TypedDict):
    """A block of the data: for each axis its first and last coordinate; with its share of the gap.

    Where several blocks of one axis are told together `parts` holds each of them.
    """

    axes: dict[str, Range]
    parts: NotRequired[list[Range]]
    p_value: Probability | None
    share: Number


class Where(TypedDict):
    """Where the gap lies, over the model's sites and over the data's coordinates."""

    sites: list[Site]
    coordinates: list[Coordinates]


class Gap(TypedDict):
    """How far: held-out loss before and after the accepted cause; `floor` brackets the lowest possible.

    `own` are unknowns that each cluster has for itself, found from its own readings even where these are held out;
    `tolerated` says that there is a gap which only the user's tolerance calls none.
    """

    unit: str
    before: Number
    after: Number
    floor: tuple[Number, Number] | None
    in_user_terms: dict[str, BeforeAfter]
    own: NotRequired[list[str]]
    tolerated: NotRequired[bool]


class Unlisted(TypedDict):
    """The test for what is left after the accepted cause; `located` says how each of the sites is wrong.

    `called_for` names effects that scores call for beside as many as are looked for.
    """

    p_value: Probability | None
    sites: list[str]
    located: NotRequired[list[Site]]
    called_for: NotRequired[list[str]]


class Term(TypedDict):
    """A site and shape whose random weights are the model of what is left; `evidence` in nats, alone."""

    site: str
    shape: str
    weights: int
    per_cluster: bool
    evidence: float


class Calibration(TypedDict):
    """On data left out: share inside the 90% predictive interval, actual over predicted error.

    The first is null for discrete data, the second for outcomes of which there are a few, such as arrivals of packets.
    """

    coverage: Probability | None
    error_ratio: float | None


class Remainder(TypedDict):
    """What a model of the remainder at its site closes of what the causes leave, and predictions without and with it."""

    terms: list[Term]
    closed_fraction: Interval
    gain_nats: float
    before: Calibration
    after: Calibration


class Detectable(TypedDict):
    """The smallest size of an effect that would have been noticed nine times in ten; null where none would have been."""

    effect: str
    size: Number
    unit: NotRequired[str]
    parameter: NotRequired[str]
    meaning: NotRequired[Meaning]


class Candidate(TypedDict):
    """One line of the screening; an effect that a fitted parameter absorbs, or that nothing shows, has no statistic.

    Of an `opposite` one the data ask for the side of its size that its prior excludes; of one with `beyond` for so many
    times the size that its prior calls usual, its root mean square from the null. What `spreads` moves nothing but how
    observations spread, as noise does.
    """

    effect: str
    sites: list[str]
    z: Number
    p_value: Probability | None
    adjusted_p_value: Probability | None
    absorbed_by: NotRequired[str | None]
    opposite: NotRequired[bool]
    beyond: NotRequired[Number]
    kind: NotRequired[str]
    spreads: NotRequired[bool]


class Nuisance(Interval):
    """A parameter of the twin that was fitted; `contraction` is 1 - posterior variance / prior variance."""

    name: str
    unit: NotRequired[str]
    contraction: NotRequired[Number]


class Fit(TypedDict):
    """The fit of the twin that the diagnosis started from."""

    nuisances: list[Nuisance]
    converged: bool
    n_clusters: NotRequired[int]
    n_observations: NotRequired[int]
    warnings: NotRequired[list[str]]


class Report(TypedDict):
    """The content of report.json; `causes` is sorted by falling probability and every interval is 90%."""

    verdict: Verdict
    summary: NotRequired[str]
    causes: list[Cause]
    tried: NotRequired[list[Tried]]
    where: Where
    gap: Gap
    unlisted: Unlisted
    remainder: NotRequired[Remainder | None]
    next_measurement: str | dict[str, Any] | None
    detectable: list[Detectable]
    screening: NotRequired[list[Candidate]]
    fit: NotRequired[Fit]
    provenance: dict[str, Any]


def is_quiet(report: Report) -> bool:
    """Whether there is nothing to tell of a gap: none was found, not even one that a tolerance calls none."""
    return report["verdict"] == "NO_GAP" and not report["gap"].get("tolerated", False)


def validate(report: Mapping[str, Any]) -> Report:
    """Check that a report has the fields and types of `Report`, finite numbers and sorted causes.

    Args:
        report: the report, of plain Python values as `json` reads them.

    Returns:
        the same report, typed.

    Raises:
        InputError: naming the first entry at fault, for example ``report.causes[0].probability``.
    """
    _check(report, Report, "report")
    checked = cast("Report", report)
    probabilities = [cause["probability"] for cause in checked["causes"]]
    if probabilities != sorted(probabilities, reverse=True):
        raise InputError(
            "report.causes", "falling probabilities", str(probabilities), "Sort the causes by probability"
        )
    return checked


def to_json(report: Mapping[str, Any]) -> str:
    """The text of report.json: checked by `validate`, indented, no NaN or Infinity, a newline at the end."""
    return json.dumps(validate(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _check(value: Any, kind: Any, where: str) -> None:
    kind = getattr(kind, "__value__", kind)
    origin, arguments = get_origin(kind), get_args(kind)
    if is_typeddict(kind):
        _check_record(value, kind, where)
    elif origin is Literal:
        if value not in arguments:
            raise unknown_name(where, str(value), arguments, "value")
    elif origin is Annotated:
        _check(value, arguments[0], where)
        if not 0 <= value <= 1:
            raise _wrong(where, f"a number from {arguments[1]}", value)
    elif origin in (Union, UnionType):
        _check_union(value, arguments, where)
    elif origin in (list, tuple, dict):
        _check_collection(value, origin, arguments, where)
    else:
        _check_plain(value, kind, where)


def _check_record(value: Any, kind: Any, where: str) -> None:
    _need(value, dict, where)
    hints = get_type_hints(kind)
    for name in value:
        if name not in hints:
            raise unknown_name(where, str(name), hints, "key")
    for name in hints:
        if name in value:
            _check(value[name], hints[name], f"{where}.{name}")
        elif name in kind.__required_keys__:
            raise InputError(where, f"the key '{name}'", f"the keys {', '.join(value)}", f"Add '{name}'")
    low, high = value.get("low"), value.get("high")
    if low is not None and high is not None and low > high:
        raise _wrong(where, "low <= high", f"low {low} and high {high}")


def _check_union(value: Any, kinds: Sequence[Any], where: str) -> None:
    if value is None and NoneType in kinds:
        return
    errors: list[InputError] = []
    for kind in kinds:
        try:
            _check(value, kind, where)
        except InputError as error:
            if kind is not NoneType:
                errors.append(error)
        else:
            return
    raise max(errors, key=lambda error: len(error.what))  # the alternative that came furthest


def _check_collection(value: Any, origin: type, kinds: Sequence[Any], where: str) -> None:
    if origin is dict:
        _need(value, dict, where)
        for name, entry in value.items():
            _need(name, str, f"key of {where}")
            _check(entry, kinds[1], f"{where}.{name}")
        return
    _need(value, (list, tuple), where)
    if origin is tuple and len(value) != len(kinds):
        raise _wrong(where, f"{len(kinds)} numbers", f"{len(value)} of them")
    for index, entry in enumerate(value):
        _check(entry, kinds[index if origin is tuple else 0], f"{where}[{index}]")


def _check_plain(value: Any, kind: Any, where: str) -> None:
    if kind is Any:
        _check_open(value, where)
        return
    if kind is not bool and isinstance(value, bool):
        raise _wrong(where, _NAMES[kind], value)
    _need(value, (int, float) if kind is float else kind, where)
    if kind is float and not math.isfinite(value):
        raise _wrong(where, "a finite number", value)


def _check_open(value: Any, where: str) -> None:
    """Anything that JSON can hold."""
    if isinstance(value, dict):
        _check(value, dict[str, Any], where)
    elif isinstance(value, list | tuple):
        _check(value, list[Any], where)
    elif isinstance(value, float):
        _check(value, float, where)
    elif value is not None:
        _need(value, (str, int), where)


_NAMES = {
    dict: "a mapping",
    (list, tuple): "a list",
    str: "text",
    bool: "true or false",
    int: "a whole number",
    (int, float): "a number",
    float: "a number",
    (str, int): "a value that JSON can hold",
    NoneType: "null",
}


def _need(value: Any, kind: Any, where: str) -> None:
    if not isinstance(value, kind):
        raise _wrong(where, _NAMES[kind], f"{type(value).__name__} {value!r}"[:120])


def _wrong(where: str, expected: str, got: object) -> InputError:
    return InputError(where, expected, str(got), "Correct this entry; it must be a plain Python value")
