"""The scores of several tracks of withheld cases in one table, each track and all of them together.

    dtprob withheld generate --track labels --count 300 --seed 7 --out study/labels       (and the other tracks)
    dtprob withheld run study/labels/cases --out study/labels/answers --workers 2 --resume
    python benchmarks/withheld.py study [--answers answers] [--name withheld] [--write]

Every folder below study with a key.json is a track. What a row means is said in docs/withheld.md. Printed as Markdown;
--write keeps it in results/NAME.json, the strata of each track beside it. Cases that rivals have answered too (`dtprob
withheld run ... --rivals`) make a second table, a column for each method.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from record import record

from dtprob.gap.withheld.answers import Answer
from dtprob.gap.withheld.score import rival_answers, score
from dtprob.gap.withheld.targets import against_targets


def main() -> None:
    """Read, print, and keep."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, help="folder with a folder for each track")
    parser.add_argument("--answers", default="answers", help="folder of the answers in that of a track")
    parser.add_argument("--name", default="withheld")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    keys = sorted(options.study.glob("*/key.json"))
    tracks = {file.parent.name: list(answered(file, options.answers)) for file in keys}
    every = [answer for said in tracks.values() for answer in said]
    lines = {"all": against_targets(every, {})} | {n: against_targets(a, {}) for n, a in tracks.items()}
    print(markdown(lines))
    methods = against_rivals(keys, options.answers)
    if methods:
        print(f"\n{markdown(methods)}")
    if options.write:
        strata = {file.parent.name: scored(file, options.answers)["strata"] for file in keys}
        seeds = {file.parent.name: read(file)["seed"] for file in keys}
        counts = {name: len(said) for name, said in tracks.items()}
        figures = {
            "cases": counts,
            "seeds": seeds,
            "targets": lines,
            "strata": strata,
            "beside rivals": methods,
        }
        record(options.name, "withheld cases of all tracks", ("dtprob", "jax", "numpyro"), figures)


def answered(key: Path, answers: str) -> Iterator[Answer]:
    """The answers of one track; cases that were not diagnosed are left out."""
    content, folder = read(key), key.parent / answers
    for case in content["cases"]:
        own = folder / case["name"]
        if (own / "report.json").is_file() or (own / "error.txt").is_file():
            report = read(own / "report.json") if (own / "report.json").is_file() else None
            seconds = read(own / "timing.json")["seconds"] if report is not None else None
            yield Answer(content["track"], case, report, seconds)


def against_rivals(keys: Sequence[Path], answers: str) -> dict[str, list[dict[str, Any]]]:
    """What each method reached on the cases of all tracks that the rivals answered too; empty where there are none."""
    every: dict[str, list[Answer]] = {}
    for key in keys:
        files = {str(a.truth["name"]): a for a in answered(key, answers)}
        rivals = {name: key.parent / answers / name / "rivals.json" for name in files}
        said = {name: read(file) for name, file in rivals.items() if file.is_file()}
        own = {name: files[name] for name in said}
        for method, found in {"diagnosis": own, **rival_answers(own, said)}.items():
            every.setdefault(method, []).extend(found.values())
    return {method: against_targets(found, {}) for method, found in every.items() if found}


def scored(key: Path, answers: str) -> dict[str, Any]:
    """The score of one track."""
    found = {str(a.truth["name"]): a for a in answered(key, answers)}
    seconds = {name: a.seconds for name, a in found.items() if a.seconds is not None}
    return score(read(key), {name: a.report for name, a in found.items()}, seconds=seconds)


def read(file: Path) -> dict[str, Any]:
    """A JSON file."""
    return json.loads(file.read_text(encoding="utf-8"))


def markdown(lines: Mapping[str, list[dict[str, Any]]]) -> str:
    """A row for each target, a column for all tracks and each."""
    found = {name: {row["name"]: row for row in rows} for name, rows in lines.items()}
    head = ["", "lambda from", "target", *lines]
    table = [head, ["---"] * len(head)]
    for row in next(iter(lines.values())):
        cells = [shown(found[name].get(row["name"])) for name in lines]
        span = f"{row['from_lambda']:g}" + ("" if row["to_lambda"] is None else f" to {row['to_lambda']:g}")
        table.append([row["name"], span, goal(**row["target"]), *cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in table)


def shown(row: Mapping[str, Any] | None) -> str:
    """What was found, with its interval."""
    if row is None:
        return ""
    found = f"{row['count']} of {row['of']}" if "count" in row else f"{row['value']:.3g} ({row['of']})"
    return found if row["low"] is None else f"{found}, {row['low']:.3g} to {row['high']:.3g}"


def goal(lowest: float | None, highest: float | None) -> str:
    """The limits."""
    if highest is None or highest == 1:
        return f"at least {lowest:g}"
    return f"{lowest:g} to {highest:g}" if lowest else f"at most {highest:g}"


if __name__ == "__main__":
    main()
