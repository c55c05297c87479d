"""The page of a score: how often diagnoses of withheld cases were right."""

from collections.abc import Mapping
from typing import Any

from dtprob.report.page import environment
from dtprob.report.palette import DARK, LIGHT


def render_score(score: Mapping[str, Any]) -> str:
    """The page of a score, as self-contained HTML.

    Args:
        score: the content of score.json, from `dtprob.gap.withheld.score`.

    Returns:
        the text of an HTML file: no script, no request.
    """
    return environment().get_template("score.html.jinja").render(score=score, light=LIGHT, dark=DARK)
