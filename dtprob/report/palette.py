"""The colours of pages and figures, by what they stand for.

Figures are drawn with `LIGHT`; on a page each of these colours becomes a CSS variable, so that a figure
follows the reader's light or dark theme.
"""

from collections.abc import Mapping

LIGHT: Mapping[str, str] = {
    "paper": "#ffffff",
    "panel": "#f5f6f8",
    "ink": "#1c2128",
    "muted": "#57606b",
    "line": "#d5d9df",
    "accent": "#0b5cad",
    "before": "#b3480f",
    "after": "#0e6bbf",
    "floor": "#dfe4ea",
    "good": "#1a6b3c",
    "found": "#0b5cac",
    "partly": "#8a5300",
    "unknown": "#8b1a55",
    "ramp0": "#eceff2",
    "ramp1": "#fbd9b5",
    "ramp2": "#f5a75f",
    "ramp3": "#d9691f",
    "ramp4": "#9c3709",
    "ramp5": "#551a02",
}

DARK: Mapping[str, str] = {
    "paper": "#14171b",
    "panel": "#1d2127",
    "ink": "#e8eaed",
    "muted": "#a3abb5",
    "line": "#363c45",
    "accent": "#79b8ff",
    "before": "#f0965a",
    "after": "#6cb2f7",
    "floor": "#323943",
    "good": "#6ccf94",
    "found": "#79b9ff",
    "partly": "#e6ad55",
    "unknown": "#f08fc0",
    "ramp0": "#2a3038",
    "ramp1": "#54290f",
    "ramp2": "#8f4212",
    "ramp3": "#cf6a24",
    "ramp4": "#f5a762",
    "ramp5": "#ffe3c4",
}

RAMP = tuple(LIGHT[f"ramp{index}"] for index in range(6))


def luminance(colour: str) -> float:
    """Relative luminance of an `#rrggbb` colour (WCAG 2.2)."""
    channels = (int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5))
    linear = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(first: str, second: str) -> float:
    """Contrast ratio of two `#rrggbb` colours (WCAG 2.2), from 1 to 21."""
    high, low = sorted((luminance(first), luminance(second)), reverse=True)
    return (high + 0.05) / (low + 0.05)
