"""Where the figures of benchmarks are kept: results/NAME.json, with what it takes to repeat them."""

import datetime as dt
import json
import platform
import re
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def recorded(name: str) -> dict[str, Any]:
    """What was kept under a name; nothing before the first time."""
    file = RESULTS / f"{name}.json"
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def record(
    name: str,
    benchmark: str,
    packages: Sequence[str],
    figures: dict[str, Any],
    *,
    command: str | None = None,
) -> None:
    """Keep figures.

    Args:
        name: of the file, without `.json`.
        benchmark: what was measured, in words.
        packages: whose versions matter.
        figures: what was found, by name.
        command: what makes them; by default this call's, paths to other places left out.
    """
    script = Path(sys.argv[0]).name
    arguments = ["PATH" if Path(a).is_absolute() else a for a in sys.argv[1:]]
    result = {
        "benchmark": benchmark,
        "command": command or shlex.join(["python", f"benchmarks/{script}", *arguments]),
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, 2 shared CPU cores, no GPU",
        "versions": {package: version(package) for package in packages},
        **figures,
    }
    RESULTS.mkdir(exist_ok=True)
    text = _short_lists(json.dumps(result, indent=1))
    (RESULTS / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    print(f"written to benchmarks/results/{name}.json")


def _short_lists(text: str) -> str:
    """The JSON with each list of plain values on one line."""
    return re.sub(r"\[([^\[\]{}]*)\]", lambda found: f"[{' '.join(found[1].split())}]", text)
