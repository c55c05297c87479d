"""Figures as SVG inside a page: real text, the page's fonts and colours, a description, no outside name."""

import hashlib
import io
import re
import warnings
from xml.etree import ElementTree as ET

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from dtprob.report.figures import STYLE
from dtprob.report.palette import LIGHT

_VARIABLES = {colour: f"var(--{name})" for name, colour in LIGHT.items()}
_FONT_FAMILY = re.compile(r"font-family: [^;]*;?\s*")
_NO_TEXT = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")
"""Signs that XML has no place for; a name of the user's may hold one."""
_REFERENCE = re.compile(r"#([\w-]+)")


def inline_svg(figure: Figure, alt: str) -> Markup:
    """A figure as an ``<svg>`` element to put into a page.

    Args:
        figure: the figure; drawing settles its layout.
        alt: what a reader who cannot see it needs to know.

    Returns:
        markup without scripts, outside references or XML namespaces; colours of the palette are CSS variables
        and ids do not clash with those of other figures.
    """
    buffer = io.StringIO()
    with mpl.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a page has fonts of its own
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text, alt = (_NO_TEXT.sub("\ufffd", one) for one in (buffer.getvalue(), alt))
    root = ET.fromstring(text)  # noqa: S314  (written two lines above)
    mark = hashlib.sha256((text + alt).encode()).hexdigest()[:8]
    _clean(root, _referenced(root), mark)
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": alt, "class": "chart"}
    return Markup(ET.tostring(root, encoding="unicode"))  # noqa: S704  (escaped by the serialiser)


def _referenced(root: ET.Element) -> set[str]:
    ids = {element.get("id") for element in root.iter()}
    return {
        found
        for element in root.iter()
        for _, value in element.items()
        for found in _REFERENCE.findall(value)
    } & ids


def _clean(element: ET.Element, kept: set[str], mark: str) -> None:
    element.tag = _local(element.tag)
    attributes = {_local(name): value for name, value in element.items()}
    if attributes.get("id") not in kept:
        attributes.pop("id", None)
    element.attrib = {name: _rewritten(name, value, kept, mark) for name, value in attributes.items()}
    element.tail = None
    for child in list(element):
        if _local(child.tag) in {"metadata", "style"} or (_local(child.tag) == "defs" and _is_style(child)):
            element.remove(child)
        else:
            _clean(child, kept, mark)
    if not (element.text or "").strip():
        element.text = None


def _is_style(defs: ET.Element) -> bool:
    return all(_local(child.tag) == "style" for child in defs)


def _rewritten(name: str, value: str, kept: set[str], mark: str) -> str:
    if name == "id":
        return f"{mark}-{value}"
    value = _REFERENCE.sub(lambda found: f"#{mark}-{found[1]}" if found[1] in kept else found[0], value)
    value = _FONT_FAMILY.sub("", value)
    for colour, variable in _VARIABLES.items():
        value = value.replace(colour, variable)
    return value


def _local(name: str) -> str:
    return name.rpartition("}")[2]
