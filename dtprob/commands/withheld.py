"""`dtprob withheld`: cases whose cause is kept apart, their diagnoses, and the score of these."""

import importlib
import json
import multiprocessing
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from pebble import ProcessExpired, ProcessPool

from dtprob.commands.progress import Say, telling
from dtprob.edition import edition
from dtprob.errors import InputError, unknown_name
from dtprob.files import make_folder, sha256, write_text
from dtprob.sections import check_seed

TRACKS: Final = {
    "channel": "dtprob.physical.cases",
    "network": "dtprob.physical.multi_access.cases",
    "labels": "dtprob.physical.labels_cases",
    "custom": "dtprob.physical.custom_cases",
}
"""For each track, the module whose `TRACK` writes its cases and their key."""

_IDENTITY: Final = "identity.txt"
"""File that tells of which case, by which seed and which code the answers beside it are."""
_LIFE: Final = 32
"""Cases after which a worker is replaced, so that memory does not grow."""


def generate(
    track: str, count: int, seed: int, out: Path, *, kinds: Sequence[str], lambdas: Sequence[float]
) -> None:
    """Write cases/NNNN/ and, apart from them, key.json and truth/; whole cases of an earlier run are kept.

    Args:
        track: which kind of twin.
        count: number of cases.
        seed: from which everything is drawn.
        out: the folder.
        kinds: kinds of cases in turn.
        lambdas: information that an effect carries, drawn from these.

    Raises:
        InputError: an unknown track or kind, or a count, seed or lambda out of range.
    """
    if track not in TRACKS:
        raise unknown_name("--track", track, TRACKS, "track")
    if count < 1:
        raise InputError("--count", "a number from 1", str(count), "Correct it")
    check_seed(seed)
    make_folder(out)
    from dtprob.commands.run import session  # noqa: PLC0415  (heavy)

    with session() as say:
        module = importlib.import_module(TRACKS[track])
        say(f"making {count} cases")

        def progress(done: int, all_: int) -> None:
            if done % 10 == 0 or done == all_:
                say(f"{done} of {all_}")

        file = module.TRACK.generate(out, count, seed, kinds, lambdas, resume=True, progress=progress)
        say(f"done: {out / 'cases'}, and the key apart: {file}")


def run(
    cases: Path,
    out: Path,
    *,
    workers: int,
    seed: int | None,
    no_code: bool,
    rivals: bool,
    resume: bool,
) -> None:
    """Diagnose every CASES/NAME/case.toml into OUT/NAME/report.json; nothing but the cases is read.

    Args:
        cases: folder of the cases.
        out: folder of the answers.
        workers: processes at work.
        seed: instead of the cases' own.
        no_code: refuse cases that run code of their own.
        rivals: let rivals answer too, into OUT/NAME/rivals.json.
        resume: keep the answers that are there, where case, seed and dtprob's own code are what they were.

    Raises:
        InputError: no cases, a number of workers below 1, a seed below 0, or answers that are no folder, or that of the
            cases.
        RuntimeError: some cases could not be diagnosed; why lies in OUT/NAME/error.txt.
    """
    if workers < 1:
        raise InputError("--workers", "a number from 1", str(workers), "Correct it")
    found = sorted(path.parent.name for path in cases.glob("*/case.toml"))
    if not found:
        raise InputError(
            f"{cases}", "folders with a case.toml each", "none", "Name the folder that holds the cases"
        )
    if seed is not None:
        check_seed(seed)
    if out.resolve() == cases.resolve():
        expected = "a folder apart from the cases"
        raise InputError(f"--out {out}", expected, "that of the cases", "Choose another folder")
    make_folder(out)
    wanted = ("report.json", "rivals.json") if rivals else ("report.json",)
    jobs = [_Job(cases / n, out / n, wanted, seed=seed, no_code=no_code, resume=resume) for n in found]
    jobs = [job for job in jobs if any(not job.keeps(file) for file in wanted)]
    failed: list[str] = []
    with telling() as say:
        say(f"{len(jobs)} of {len(found)} cases to diagnose")
        for done, (name, error) in enumerate(_answers(jobs, workers, say), start=1):
            if error is not None:
                failed.append(name)
                write_text(out / name / "error.txt", f"{error}\n")
            say(f"{done} of {len(jobs)}")
    if failed:
        raise RuntimeError(
            f"{len(failed)} of {len(jobs)} cases failed, see error.txt of {', '.join(failed[:5])}"
        )


def score(answers: Path, key: Path) -> None:
    """Write ANSWERS/score.json and ANSWERS/score.html.

    Args:
        answers: folder of the answers.
        key: the key.json of the cases.

    Raises:
        InputError: no key, or answers that do not belong to it.
    """
    from dtprob.gap.withheld.score import check_key  # noqa: PLC0415  (heavy)
    from dtprob.gap.withheld.score import score as scored  # noqa: PLC0415
    from dtprob.report.score_page import render_score  # noqa: PLC0415

    content = _json(key)
    ended = ("report.json", "error.txt")  # without either the case was broken off
    there = [name for name in check_key(content) if any((answers / name / file).is_file() for file in ended)]
    files = ("report.json", "timing.json", "rivals.json")
    reports, timings, rivals = ({name: _optional(answers / name / file) for name in there} for file in files)
    seconds = {name: timing["seconds"] for name, timing in timings.items() if timing}
    result = scored(content, reports, {name: said for name, said in rivals.items() if said}, seconds)
    write_text(answers / "score.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    write_text(answers / "score.html", render_score(result))
    for stratum in result["strata"]:
        print(f"{stratum['kind']}, lambda {stratum['lambda']:g}: {stratum['cases']} cases")
        for name, rate in stratum["rates"].items():
            theirs = [
                f"{rival} {said['rates'][name]['count']}/{said['rates'][name]['of']}"
                for rival, said in stratum["rivals"].items()
                if name in said["rates"]
            ]
            beside = f"; {', '.join(theirs)}" if theirs else ""
            print(f"  {name}: {rate['count']}/{rate['of']} ({rate['low']:.3f} to {rate['high']:.3f}){beside}")
    print(f"done: {answers / 'score.html'}")


@dataclass(frozen=True)
class _Job:
    """A case for a worker, where its answers go, and which files are wanted."""

    case: Path
    folder: Path
    wanted: Sequence[str]
    seed: int | None
    no_code: bool
    resume: bool

    def keeps(self, file: str) -> bool:
        """Whether an answer is there already and is kept."""
        return self.resume and (self.folder / file).is_file() and self.is_same

    @property
    def is_same(self) -> bool:
        """Whether what lies in the folder is of the same case, seed and code."""
        identity = self.folder / _IDENTITY
        return identity.is_file() and identity.read_text(encoding="utf-8") == self.identity

    @cached_property
    def identity(self) -> str:
        """What the answers depend on, as text."""
        return f"dtprob {edition()}\nseed {self.seed}\ncase {sha256(self.case)}\n"


def _answers(jobs: Sequence[_Job], workers: int, say: Say) -> Iterator[tuple[str, str | None]]:
    """The name of each case as it ends, and why it failed if it did; a worker that dies takes its one case with it."""
    context = multiprocessing.get_context("spawn")
    with ProcessPool(max(min(workers, len(jobs)), 1), max_tasks=_LIFE, context=context) as pool:
        waiting: dict[Future[str | None], str] = {
            pool.schedule(_diagnose, args=[job]): job.case.name for job in jobs
        }
        try:
            for ended in as_completed(waiting):
                death = ended.exception()
                yield waiting[ended], ended.result() if death is None else _death(death)
        except BaseException:
            say("stopping")
            pool.stop()
            raise


def _death(error: BaseException) -> str:
    if isinstance(error, ProcessExpired):
        return f"its process ended with status {error.exitcode}: killed, or out of memory?"
    raise error


def _diagnose(job: _Job) -> str | None:
    """Diagnose a case in this process; says why if that fails."""
    from dtprob.xla import avoid_miscompilation  # noqa: PLC0415

    avoid_miscompilation()
    from dtprob.case import load_case  # noqa: PLC0415  (after the compiler is set right)
    from dtprob.commands.diagnose import answer, answer_of_rivals  # noqa: PLC0415
    from dtprob.commands.run import start_jax  # noqa: PLC0415

    start_jax()
    warnings.simplefilter("ignore")  # a report says itself what there is to note
    answers = {"report.json": answer, "rivals.json": answer_of_rivals}
    job.folder.mkdir(parents=True, exist_ok=True)
    todo = [file for file in job.wanted if not job.keeps(file)]
    gone = todo if job.is_same else (*answers, "timing.json")
    for file in (*gone, "error.txt"):
        (job.folder / file).unlink(missing_ok=True)  # what breaks off has no answer, not an older one
    write_text(job.folder / _IDENTITY, job.identity)
    try:
        case = load_case(job.case / "case.toml")
        for file in todo:
            answers[file](case, job.folder, seed=job.seed, no_code=job.no_code)
    except Exception as error:  # noqa: BLE001  (one bad case must not end the others)
        return f"{type(error).__name__}: {error}"
    (job.folder / "error.txt").unlink(missing_ok=True)
    return None


def _optional(file: Path) -> dict[str, Any] | None:
    return _json(file) if file.is_file() else None


def _json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise InputError(f"{file}", "a JSON file", reason, "Correct the path") from None
    except ValueError as error:
        raise InputError(f"{file}", "a JSON file", str(error), "Correct the path") from None
    if not isinstance(content, dict):
        raise InputError(f"{file}", "a JSON object", type(content).__name__, "Correct the path")
    return content
