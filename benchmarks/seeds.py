"""Whether a verdict depends on the seed of the diagnosis.

    dtprob withheld generate --track labels --count 20 --seed 3 --out study/labels
    python benchmarks/seeds.py study --out answers [--seeds 20] [--write]

Every case below study is diagnosed with the seeds 0, 1, ..., from which a diagnosis draws its starting points, bootstraps
and folds. A case is the same over the seeds if the verdict is, and the first cause too. Answers are kept, and a run
continues where another one ended. --write keeps the table in results/seeds.json.
"""

import argparse
import json
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from record import record

from dtprob.case import load_case
from dtprob.commands.diagnose import answer
from dtprob.commands.run import start_jax
from dtprob.gap.withheld.rates import Rate


def main() -> None:
    """Diagnose, and print which cases differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, help="folder with cases at any depth")
    parser.add_argument("--out", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    start_jax()
    warnings.simplefilter("ignore")  # a report says itself what there is to note
    found = {}
    for file in sorted(options.study.rglob("case.toml")):
        name = str(file.parent.relative_to(options.study))
        found[name] = Counter(
            said(file, options.out / name / str(seed), seed) for seed in range(options.seeds)
        )
        print(name, line(found[name]), flush=True)
    figures = {"seeds": options.seeds, "cases": len(found), **shares(found), "differ": differing(found)}
    print(json.dumps(figures, indent=1))
    if options.write:
        record("seeds", "verdicts of the same cases over seeds", ("dtprob", "jax", "numpyro"), figures)


def said(case: Path, out: Path, seed: int) -> tuple[str, str]:
    """Verdict and first cause with one seed."""
    if not (out / "report.json").is_file():
        out.mkdir(parents=True, exist_ok=True)
        answer(load_case(case), out, seed=seed, no_code=False)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    causes = report["causes"]
    return report["verdict"], " + ".join(sorted(causes[0]["effects"])) if causes else ""


def shares(found: dict[str, Counter[tuple[str, str]]]) -> dict[str, Any]:
    """Share of cases without any difference, and of diagnoses that say what most say of their case."""
    verdicts = {name: Counter(verdict for verdict, _ in many.elements()) for name, many in found.items()}
    usual = sum(max(many.values()) for many in verdicts.values())
    return {
        "same verdict in every diagnosis": Rate(
            sum(len(many) == 1 for many in verdicts.values()), len(found)
        ).to_dict(),
        "same verdict and cause in every diagnosis": Rate(
            sum(len(many) == 1 for many in found.values()), len(found)
        ).to_dict(),
        "diagnoses with the usual verdict of their case": usual
        / sum(many.total() for many in verdicts.values()),
    }


def differing(found: dict[str, Counter[tuple[str, str]]]) -> dict[str, str]:
    """What is said of the cases of which not always the same is said."""
    return {name: line(many) for name, many in found.items() if len(many) > 1}


def line(many: Counter[tuple[str, str]]) -> str:
    """Each answer with how often it was given."""
    return "; ".join(f"{count} {verdict} {cause}".strip() for (verdict, cause), count in many.most_common())


if __name__ == "__main__":
    main()
