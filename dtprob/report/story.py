"""A verdict in plain words: what was found, what it means for the twin, what to do."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from dtprob.gap.vocabulary import UNSEEN
from dtprob.report.advice import advice, worth_telling
from dtprob.report.closest import beyond, closest, values_are_wrong
from dtprob.report.json_schema import Cause, Report, is_quiet
from dtprob.report.names import (
    LEVEL,
    aliases,
    capital,
    is_unchanged,
    listing,
    located_words,
    shares,
    significant,
    spoken,
    term,
    together,
    user_terms,
    whereabouts,
    words,
)
from dtprob.report.next_step import LEAVE_OUT, changed, copies, decides, left_over, next_step, rivals
from dtprob.report.quiet import nearest, nearly, nothing_found
from dtprob.report.sizes import size_reading
from dtprob.report.units import percent

_NAMING = ("LISTED", "LISTED_WITH_REMAINDER")
"""Verdicts that name a cause."""
_SPELT = 3
"""Effects that could not be judged up to which they are named, not counted."""


@dataclass(frozen=True)
class Story:
    """A verdict as the page tells it; the tone is the name of a colour."""

    label: str
    tone: str
    headline: str
    meaning: str
    action: str


def tell(report: Report) -> Story:
    """The story of a report's verdict; its headline is the report's own summary where it has one."""
    story = _without_copies(_STORIES[report["verdict"]](report), report)
    headline = (
        _sentences(spoken(report["summary"], _codes(report))) if "summary" in report else story.headline
    )
    return replace(story, headline=headline, meaning=f"{story.meaning}{_unjudged(report)}")


def _without_copies(story: Story, report: Report) -> Story:
    """The story whose first step is to leave readings out that are in the data twice: they make gaps of their own."""
    if not copies(report):
        return story
    rest = "" if is_quiet(report) else f" Should a gap remain, {story.action[:1].lower()}{story.action[1:]}"
    return replace(story, action=f"{LEAVE_OUT}{rest}")


def _sentences(text: str) -> str:
    """The text with a capital after each full stop: a code name may have stood there."""
    return ". ".join(map(capital, text.split(". ")))


def _codes(report: Report) -> set[str]:
    """All names of effects, sites and axes that the report holds."""
    sets = [effects for cause in report["causes"] for effects in (cause["effects"], *cause["alias_class"])]
    screened = report.get("screening", [])
    located = [*(site["site"] for site in report["where"]["sites"]), *report["unlisted"]["sites"]]
    return {
        *(effect for effects in sets for effect in effects),
        *(row["effect"] for row in screened),
        *(site for row in screened for site in row["sites"]),
        *located,
        *(axis for block in report["where"]["coordinates"] for axis in block["axes"]),
    }


def _no_gap(report: Report) -> Story:
    if not is_quiet(report):
        return _tolerated(report)
    near, candidate = nearly(report), nearest(report)
    open_questions = [
        *([] if near is None else [f"the {located_words(near)} are right"]),
        *([] if candidate is None else [f"{words(candidate['effect'])} is there"]),
    ]
    asked = " and whether ".join(open_questions)
    doubt = f" More data of the same kind would tell whether {asked}." if asked else ""
    return Story(
        "No gap found",
        "good",
        "Nothing found: the twin agrees with the data.",
        nothing_found(report),
        f"Nothing to change in the twin.{doubt}",
    )


def _unjudged(report: Report) -> str:
    """Which effects could not be judged, and why; of those that were named all the same nothing is said."""
    named = set(report["causes"][0]["effects"]) if report["verdict"] in _NAMING else set[str]()
    rows = [
        row for row in report.get("screening", []) if row.get("absorbed_by") and row["effect"] not in named
    ]
    told = ""
    for is_unseen in (False, True):
        names = [words(row["effect"]) for row in rows if (row.get("absorbed_by") == UNSEEN) == is_unseen]
        if names:
            who = capital(listing(names)) if len(names) <= _SPELT else f"{len(names)} listed effects"
            them = "it" if len(names) == 1 else "them"
            unseen = f"nothing that was observed depends on {them}"
            why = unseen if is_unseen else "fitted parameters of the twin take up the same change"
            told += f" {who} could not be judged, because {why}."
    return told


def _tolerated(report: Report) -> Story:
    terms = report["gap"]["in_user_terms"]
    errors = listing(f"{term(name)} {user_terms(name, *pair)[0]}" for name, pair in terms.items())
    best = f" What closes most of it: {together(report['causes'][0]['effects'])}." if report["causes"] else ""
    return Story(
        "No gap that matters",
        "good",
        "A gap was found, but it is within the tolerance.",
        f"The difference between twin and data is more than chance{_seat(report)}, but predictions err by no more than "
        f"you said does not matter: {errors}.{best}",
        "Nothing to change in the twin for this tolerance.",
    )


def _listed(report: Report) -> Story:
    cause = report["causes"][0]
    called_for, p_value = report["unlisted"].get("called_for", []), report["unlisted"]["p_value"]
    if report["unlisted"]["sites"]:
        rest = "What is left is not chance, but small beside the cause."
    elif called_for:
        rest = f"The data call for one more effect, {together(called_for)}, which is small beside the cause."
    elif p_value is not None and p_value < LEVEL:
        rest = "What is left may be more than chance, which the share allows for."
    else:
        rest = "What is left is no more than chance."
    return Story(
        "Cause found",
        "found",
        f"The gap comes from {_named(cause)}.",
        f"{_closing(cause)} {rest}{_matters(report)}{_looks_alike(cause)}{_opposite(report)}",
        _change(cause),
    )


def _remainder(report: Report) -> Story:
    cause = report["causes"][0]
    if not report["unlisted"]["sites"]:  # as many effects as are looked for have been named
        return Story(
            "Causes found, perhaps not all",
            "partly",
            f"Part of the gap comes from {_named(cause)}. Others may be there.",
            f"{_closing(cause)} No more effects were looked for, and one more is called for."
            f"{_matters(report)}{_looks_alike(cause)}",
            f"{_change(cause)} Then diagnose again with more effects at once (max_effects).",
        )
    return Story(
        "Cause found, but something is left",
        "partly",
        f"Part of the gap comes from {_named(cause)}. No known effect explains the rest.",
        f"{_closing(cause)} What is left is real{_seat(report)}.{_matters(report)}{_looks_alike(cause)}{_opposite(report)}",
        f"{_change(cause)} The twin will be closer but not right.",
    )


def _unlisted(report: Report) -> Story:
    left = left_over(report)
    look = (
        "Look for physics that the twin lacks where the gap lies, and declare it as a new effect."
        if not left or values_are_wrong(report)
        else "The values that the twin computes show nothing wrong; what it says of its errors does. Look for what "
        f"could {changed(left[:2])}, or declare errors that are so."
    )
    real = f"The difference between twin and data is real{_seat(report)}"
    if not report.get("screening"):
        headline = "There is a gap; no effects were given that could explain it."
        return Story("Cause unknown", "unknown", headline, f"{real}.", look)
    return Story(
        "Cause unknown",
        "unknown",
        "There is a gap, and none of the known effects explains it.",
        f"{real}, but no effect on the list accounts for it: something remains with the best of them, too.",
        f"{closest(report)}Do not add a listed effect: it would hide the problem, not solve it. {look}{_opposite(report)}"
        f"{beyond(report)}",
    )


def _opposite(report: Report) -> str:
    """Which effects the data ask for with the sign that their priors exclude; beside a cause those asked for more."""
    rows = sorted(report.get("screening", []), key=lambda row: row["z"] or 0.0)
    named = set(report["causes"][0]["effects"]) if report["verdict"] in _NAMING else set[str]()
    least = max((row["z"] or 0.0 for row in rows if row["effect"] in named), default=0.0)
    asked = [words(row["effect"]) for row in rows if row.get("opposite") and -(row["z"] or 0.0) > least]
    if not asked:
        return ""
    more, its = " even more" * bool(named), "its size is" if len(asked) == 1 else "their sizes are"
    return (
        f" The data ask{more} for the opposite of {listing(asked[:3])}: look whether {its} of the right sign."
    )


def _undetermined(report: Report) -> Story:
    names = [together(effects) for effects in rivals(report)]
    step = next_step(report)
    resolves, more = decides(report["next_measurement"])
    wait = f" {f'First: {step[:1].lower()}{step[1:]}' if resolves else step}" if step else ""
    if len(names) > 1:
        told = listing(names, "from") if len(names) == 2 else f"apart {listing(names)}"
        headline = f"There is a gap, but the data cannot tell {told}."
        meaning = "The gap is real, and none of these explanations can be ruled out. Choosing one now would be a guess."
    else:
        signs = f"signs of {names[0]}" if names else "signs of a gap"
        headline = f"There are {signs}, but the data do not confirm them."
        held = (
            "did not hold on data that its fit had left out" if names else "is not enough to name an effect"
        )
        meaning = (
            f"What was found {held}. It may be chance, or an effect too small for this amount of data"
            f"{'; more data of the same kind would decide' * more}."
        )
    return Story("Cause undecided", "partly", headline, meaning, f"Do not change the twin yet.{wait}")


def _named(cause: Cause) -> str:
    """`one effect: timing offset`, or so."""
    count = len(cause["effects"])
    same = ", or what looks the same in these data" if aliases(cause) else ""
    return f"{_COUNTS.get(count, str(count))} effect{'s' * (count > 1)}: {together(cause['effects'])}{same}"


def _matters(report: Report) -> str:
    """That a cause is sure and yet hardly changes what the user looks at, where that is so."""
    terms = report["gap"]["in_user_terms"]
    if not terms or not all(is_unchanged(name, *pair) for name, pair in terms.items()):
        return ""
    return f" It is sure but small: it hardly changes the {listing(map(term, terms))}."


def _looks_alike(cause: Cause) -> str:
    """Which effects cannot be told apart; what both sides share is left out."""
    pairs: list[str] = []
    for other in aliases(cause):
        mine = [effect for effect in cause["effects"] if effect not in other] or cause["effects"]
        theirs = [effect for effect in other if effect not in cause["effects"]] or other
        pairs.append(f"{together(mine)} from {together(theirs)}")
    return f" These data cannot tell {listing(pairs, 'or')}." if pairs else ""


def _closing(cause: Cause) -> str:
    closed = cause["closed_fraction"]
    if closed is None or closed["mean"] is None:
        return "How much of the gap this closes could not be established."
    return (
        f"Added to the twin, this closes {percent(closed['mean'])} of the gap "
        f"(90% interval {shares(closed)}), judged on data left out when its size was fitted."
    )


def _change(cause: Cause) -> str:
    changes = "; ".join(advice(effect, cause["size"]) for effect in cause["effects"])
    sizes = [size_reading(*item) for item in worth_telling(cause["effects"], cause["size"]).items()]
    if len(sizes) == 1:
        estimate = f" Estimate: {sizes[0][0]} {sizes[0][1]}."
    else:
        shown = listing(f"{label} {value.mean_with_unit}" for label, value in sizes[:4]) if sizes else ""
        estimate = f" Estimates: {shown}." if 1 < len(sizes) <= 4 else ""
    return f"{capital(changes)}.{estimate}"


def _seat(report: Report) -> str:
    """` and lies in the path delays (along time, most of it at link 3)`, where the remainder or the gap was located."""
    left = left_over(report) or significant(report["where"]["sites"])[:1]
    if not left:
        return ""
    first = f"{located_words(left[0])}{whereabouts(left[0])}"
    return f" and lies in the {listing([first, *map(located_words, left[1:2])])}"


_COUNTS = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five"}
_STORIES: Mapping[str, Callable[[Report], Story]] = {
    "NO_GAP": _no_gap,
    "LISTED": _listed,
    "LISTED_WITH_REMAINDER": _remainder,
    "UNLISTED": _unlisted,
    "UNDETERMINED": _undetermined,
}
