"""Names and numbers of a report as people say them: effects, sites, sizes, blocks of the data."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from dtprob.report.json_schema import Cause, Coordinates, Interval, Remainder, Site
from dtprob.report.units import (
    Scale,
    decimals_between,
    number,
    percent,
    scale_for,
    split_unit,
    with_unit,
)

_CAPITALS = {
    "iq": "I/Q",
    "ack": "ACK",
    "nmse": "NMSE",
    "rx": "receive",
    "tx": "transmit",
    "rsrp": "RSRP",
    "rss": "RSS",
    "rssi": "RSSI",
    "rtt": "RTT",
    "sinr": "SINR",
    "snr": "SNR",
    "csi": "CSI",
}
_SITES = {
    "path_share": "which paths there are",
    "path_gain": "path gains",
    "path_delay": "path delays",
    "path_phase": "path phases",
    "departure": "directions of departure",
    "arrival": "directions of arrival",
    "tx_response": "transmit antenna responses",
    "rx_response": "receive antenna responses",
    "noiseless_channel": "channel as a whole",
    "noise_power": "noise level",
    "channel": "measured channel",
    "arrival_logits": "probabilities of new packets",
    "reception_logits": "probabilities of reception",
    "device_advantage": "chances of each device to be heard",
    "predicted_label": "predicted labels",
    "label_deviation": "size of the labels' errors",
    "y": "readings",
}

_WAYS: Final = {
    "common": "by one amount for all",
    "smooth": "smoothly {rest}",
    "every": "in a cycle of {rest}",
    "ripple": "as a {whole}",
    **dict.fromkeys(("by", "along", "over", "beyond", "between", "near"), "{whole}"),
    **{part: f"from {part} to {{whole}}" for part in ("stretch", "block")},
    "product": "with the {whole}",
    "bend": "with a {whole}",
}
"""How a way of varying is told, by its first word."""

LEVEL = 0.05
_PARTS: Final = 4
"""Blocks told together that are named."""
_DIGITS: Final = 4
"""Digits of a number in the user's own terms, however little it changes."""


def words(name: str) -> str:
    """A code name as words: ``iq_imbalance`` is "I/Q imbalance", ``gain[rx_2]`` is "gain (rx 2)"."""
    stem, _, instance = name.partition("[")
    text = " ".join(_CAPITALS.get(word, word) for word in stem.split("_"))
    return f"{text} ({instance.removesuffix(']').replace('_', ' ')})" if instance else text


def site_words(site: str) -> str:
    """A site of a model as words."""
    return _SITES.get(site, words(site))


def located_words(site: Site) -> str:
    """What of a site must change: its values, or a moment of what is observed there: `spread of the range`."""
    what, _, whither = site.get("moment", "").partition(" ")
    values = site_words(site["site"])
    return " ".join([f"{what} of the {values}", *map(words, whither.split())]) if what else values


def place_words(site: Site) -> str:
    """` (most of it at access point 11)`, where one entry of a site stands out."""
    return _in_brackets(_foremost(site))


def whereabouts(site: Site) -> str:
    """The same, and along what or where a site is wrong: ` (along day by access point, most of it at access point 11)`."""
    there = [_pattern_words(site["whereabouts"])] if "whereabouts" in site else []
    return _in_brackets([*there, *_foremost(site)])


def _foremost(site: Site) -> list[str]:
    return [f"most of it at {site['place'].replace('_', ' ')}"] if "place" in site else []


def _in_brackets(told: Sequence[str]) -> str:
    return f" ({', '.join(told)})" if told else ""


def spoken(text: str, codes: Iterable[str]) -> str:
    """The text with code names (those with an underscore or an instance) replaced by words."""
    found = sorted((code for code in codes if "_" in code or "[" in code), key=len, reverse=True)
    pattern = "|".join(rf"(?<!\w){re.escape(code)}(?![\w\[])" for code in found)
    return re.sub(pattern, lambda match: site_words(match[0]), text) if found else text


def listing(items: Iterable[str], last: str = "and") -> str:
    """`a, b and c`."""
    texts = list(items)
    return f"{', '.join(texts[:-1])} {last} {texts[-1]}" if len(texts) > 1 else "".join(texts)


def together(effects: Iterable[str]) -> str:
    """A set of effects as words."""
    return listing(words(effect) for effect in effects)


def allowance(remainder: Remainder) -> str:
    """How a model of the remainder lets the twin vary: `it lets the deviation vary by segment`."""
    said: list[str] = []
    for term in remainder["terms"]:
        kind, _, pattern = term["shape"].partition(", ")
        subject = (
            f"spread of the {site_words(term['site'])}" if kind == "spread" else site_words(term["site"])
        )
        said.append(f"the {subject} vary {_varying(pattern)}")
    return f"it lets {listing(said)}"


def _pattern_words(pattern: str) -> str:
    """How a site family varies, its columns as words; brackets are places in columns, as in `x[2]`, not instances."""
    return " ".join(_CAPITALS.get(word, word) for word in pattern.replace("_", " ").split(" "))


def _varying(pattern: str) -> str:
    """How a site family varies, in words: `from link to link`, `as a ripple in time`, `at hour 3 to 5`."""
    first, _, rest = pattern.partition(" ")
    if first in _WAYS:
        return _WAYS[first].format(whole=_pattern_words(pattern), rest=_pattern_words(rest))
    if " times " in pattern:
        return f"with {_pattern_words(pattern)}"
    if re.search(r" \d", pattern):  # a place
        return f"at {_pattern_words(pattern)}"
    axes = [_pattern_words(axis) for axis in pattern.split(" x ")]
    if len(axes) == 1:
        return f"from {axes[0]} to {axes[0]}"
    return f"with every {listing(axes)} together"


def capital(text: str) -> str:
    """The text with a capital first letter."""
    return text[:1].upper() + text[1:]


def shares(interval: Interval) -> str:
    """An interval of shares: `88 to 97%`, or `−84 to 12%` of what may do harm."""
    return f"{percent(interval['low']).rstrip('%')} to {percent(interval['high'])}"


def significant[Located: (Site, Coordinates)](located: Iterable[Located]) -> list[Located]:
    """The sites or blocks whose share of the gap is hardly chance."""
    return [entry for entry in located if entry["p_value"] is not None and entry["p_value"] <= LEVEL]


def term(name: str) -> str:
    """What a number in the user's own terms is called."""
    stem = _stem_and_unit(name)[0]
    for ending, kind in (("_nmse", "NMSE"), ("_rmse", "root mean square")):
        if stem.endswith(ending):
            return f"{words(stem.removesuffix(ending))} error ({kind})"
    return words(stem)


def _stem_and_unit(name: str) -> tuple[str, str]:
    """Of `power_db_rmse` as of `power_rmse_db`: what is measured in dBm errs in dB."""
    stem, ending, _ = name.rpartition("_rmse")
    inner, unit = split_unit(stem) if ending and name.endswith("_rmse") else ("", "1")
    if unit == "1":
        return split_unit(name)
    return f"{inner}_rmse", "dB" if unit == "dBm" else unit


def user_terms(name: str, before: float | None, after: float | None) -> list[str]:
    """Numbers in the user's own terms before and after (where there is an after), in one unit.

    An error of a power in W stays one: in dBm it would be read as a level, or as an error in dB.
    """
    values = [before] if after is None else [before, after]
    stem, unit = _stem_and_unit(name)
    scale = Scale(1.0, unit) if unit == "W" and stem.endswith("_rmse") else scale_for(values, unit)
    shown = [scale(value) for value in values]
    decimals = 1 if unit == "dB" else decimals_between(shown[0], shown[-1])
    if decimals is not None and shown[0]:
        decimals = min(decimals, _DIGITS - 1 - math.floor(math.log10(abs(shown[0]))))
    return [with_unit(number(value, decimals), scale.unit) for value in shown]


def is_unchanged(name: str, before: float | None, after: float | None) -> bool:
    """Whether a number in the user's own terms hardly changes: by less than 0.1 dB, or a hundredth of itself."""
    if before is None or after is None:
        return False
    enough = 0.1 if _stem_and_unit(name)[1] == "dB" else 0.01 * abs(before)
    return abs(after - before) < enough


def detail(value: Any) -> str:
    """A value of an open entry of the report, as text on one line."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {detail(entry)}" for name, entry in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(detail(entry) for entry in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def block(entry: Coordinates) -> str:
    """A block of the data: `rx antenna 0 to 1, subcarrier 40 to 63`; of several `row 3, 7 to 9 and 40 more, together`."""
    if parts := entry.get("parts"):
        shown = [_span(*part) for part in parts[:_PARTS]]
        more = [f"{len(parts) - _PARTS} more"] if len(parts) > _PARTS else []
        return f"{listing(map(words, entry['axes']))} {listing([*shown, *more])}, together"
    return ", ".join(f"{words(axis)} {_span(*ends)}" for axis, ends in entry["axes"].items())


def _span(low: float, high: float) -> str:
    """`3`, or `7 to 9` on one line."""
    first, last = (f"{end:.0f}" if float(end).is_integer() else f"{end:.6g}" for end in (low, high))
    return first if low == high else f"{first}\u00a0to\u00a0{last}"


def aliases(cause: Cause) -> list[list[str]]:
    """The sets of effects that the data cannot tell from the cause, without the cause itself."""
    return [other for other in cause["alias_class"] if sorted(other) != sorted(cause["effects"])]
