"""What the commands that run a CASE share: the session, the overrides, the fit with its checkpoint."""

import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, Literal

import jax

from dtprob.case import Case, EngineSection
from dtprob.commands.cache import keep_compiled
from dtprob.commands.progress import Say, telling
from dtprob.edition import edition
from dtprob.errors import InputError
from dtprob.files import check_apart, make_folder, sha256, write_text
from dtprob.inference import LATENTS_ONLY, Posterior, RunOptions
from dtprob.sections import check_seed
from dtprob.workflow import Prepared, prepare

_BESIDE: Final = (".nc", ".identity", ".begun", ".checkpoint", ".status.json")
"""How the files of a posterior end, and those that lie beside it while it is made."""


_PARTS: Final = ("dtprob", "engine or setting of it", "case", "data file", "code of its own or scene")
"""What a posterior depends on."""


@dataclass(frozen=True)
class Run:
    """Where a command writes, and how.

    Attributes:
        out: the folder of the results.
        resume: continue what an interrupted run left there.
        allow_code: whether the user's own code may run.
        say: tells the progress.
    """

    out: Path
    resume: bool
    allow_code: bool
    say: Say


def start_jax() -> None:
    """Double precision, and compiled programs kept between commands."""
    jax.config.update("jax_enable_x64", True)
    keep_compiled()


@contextmanager
def session() -> Generator[Say]:
    """Double precision, progress, and warnings told as plain lines, for the time of one command."""
    start_jax()
    with telling() as say, warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: say(f"note: {message}")
        yield say


def chosen(case: Case, engine: str | None, seed: int | None) -> Case:
    """The case with what the command line says instead; another engine has its own default settings."""
    if engine is not None:
        same = engine == case.engine.name
        case = replace(case, engine=case.engine if same else EngineSection(name=engine))
    if seed is not None:
        case = replace(case, seed=replace(case.seed, value=check_seed(seed)))
    return case


def prepare_case(case: Case, run: Run, need: Literal["fit", "diagnosis"], results: Sequence[str]) -> Prepared:
    """Everything ready to run; results of an earlier run in the same folder are gone.

    Args:
        case: the CASE.
        run: where to write.
        need: what is going to be done.
        results: the names of the files that will be written.

    Raises:
        InputError: see ``dtprob.workflow.prepare``, or a folder that cannot be written to, or where a result would take the
            place of what the case reads.
    """
    if case.user_code and run.allow_code:
        run.say(f"this case runs code of its own: {', '.join(case.user_code)}")
    make_folder(run.out)
    posterior = "posterior" if need == "fit" else "reference"
    check_apart(run.out, (*results, *(posterior + end for end in _BESIDE)), case.files)
    prepared = prepare(case, need=need, allow_code=run.allow_code, cache=run.out, say=run.say)
    for name in results:
        (run.out / name).unlink(missing_ok=True)
    return prepared


def infer(
    prepared: Prepared, data: Mapping[str, Any], file: Path, run: Run, *, latents_only: bool = False
) -> Posterior:
    """The posterior given some data, kept in a file so that an interrupted run need not begin again.

    Args:
        prepared: model, engine and key.
        data: the model's arguments.
        file: where to keep the posterior; beside it lie, while it is being made, a checkpoint and a status.
        run: whether to resume, and how to tell the progress.
        latents_only: keep draws of what is unknown, and nothing that has an entry for each row of the data.

    Raises:
        InputError: a checkpoint to resume from that another run left.
    """
    identity, own = file.with_suffix(".identity"), _identity(prepared, file)
    if run.resume and file.is_file() and _read(identity) == own:
        run.say(f"{file.name} is there already")
        return Posterior.load(file)
    checkpoint, status, begun = (file.with_suffix(end) for end in (".checkpoint", ".status.json", ".begun"))
    resume = run.resume and checkpoint.is_file()
    if resume and _read(begun) != own:
        raise InputError(
            f"{checkpoint}",
            "a run of the same case by the same state of dtprob",
            f"another {_first_difference(_read(begun) or '', own)}",
            "Give what it was begun with, or leave out --resume to begin anew",
        )
    if not resume:
        checkpoint.unlink(missing_ok=True)  # else it would pass for one of the run that is begun now
    write_text(begun, own)
    options = replace(
        LATENTS_ONLY if latents_only else RunOptions(),
        progress=True,
        status_file=status,
        checkpoint=checkpoint,
        resume=resume,
    )
    for earlier in (identity, file):  # what breaks off leaves no posterior of another run
        earlier.unlink(missing_ok=True)
    run.say(f"fitting with {prepared.engine.name}")
    posterior = prepared.engine(prepared.key, prepared.model, data, options=options)
    posterior.save(file)
    write_text(identity, own)
    for temporary in (checkpoint, status, begun):
        temporary.unlink(missing_ok=True)
    return posterior


def _identity(prepared: Prepared, file: Path) -> str:
    """What a kept posterior depends on, a line for each of `_PARTS`."""
    reference = prepared.case.data.reference
    data = prepared.data_sha256 if file.stem == "posterior" or not reference else sha256(reference)
    parts = (edition(), repr(prepared.engine), repr(prepared.case), data, prepared.made_of_sha256)
    return "".join(f"{part}\n" for part in parts)


def _first_difference(begun: str, own: str) -> str:
    """The first part in which two identities differ."""
    pairs = zip_longest(begun.splitlines(), own.splitlines())
    return next(name for name, (one, other) in zip(_PARTS, pairs, strict=False) if one != other)


def _read(file: Path) -> str | None:
    return file.read_text(encoding="utf-8") if file.is_file() else None
