"""What `dtprob list` shows."""

import inspect
import json

from dtprob.effects import summaries
from dtprob.inference.fit import ENGINES
from dtprob.workflow.models import MODELS


def run(what: str, *, json: bool) -> None:
    """Print the names that a CASE can use, with one line each.

    Args:
        what: "models", "engines" or "effects".
        json: as a list of objects with `name` and `summary`.
    """
    entries = names(what)
    if json:
        print(_to_json(entries))
        return
    width = max(map(len, entries))
    for name, summary in entries.items():
        print(f"{name:<{width}}  {summary}")


def names(what: str) -> dict[str, str]:
    """The names of models, engines or effects, each with one line that says what it is."""
    if what == "models":
        return {name: _first_line(entry.load()) for name, entry in MODELS.items()}
    if what == "engines":
        return {name: _first_line(engine) for name, engine in ENGINES.items()}
    return summaries()


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").split("\n", maxsplit=1)[0]


def _to_json(entries: dict[str, str]) -> str:
    return json.dumps([{"name": name, "summary": summary} for name, summary in entries.items()], indent=2)
