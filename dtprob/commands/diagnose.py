"""`dtprob diagnose`: from a CASE to a report of why data and twin differ."""

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from xarray import DataTree

from dtprob.case import Case
from dtprob.commands.run import Run, chosen, infer, prepare_case, session
from dtprob.edition import edition
from dtprob.files import atomic_write, write_text
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.withheld.rivals.compete import compete
from dtprob.inference import Posterior
from dtprob.report import render, to_json
from dtprob.workflow import Prepared
from dtprob.workflow.words import spelled

RESULTS = ("gap.nc", "report.html", "report.json")


def run(case: Case, out: Path, *, engine: str | None, seed: int | None, no_code: bool, resume: bool) -> None:
    """Find out why the data of a case differ from its twin: gap.nc, report.html, then report.json.

    Args:
        case: what to diagnose.
        out: the folder of the results.
        engine: instead of the case's.
        seed: instead of the case's.
        no_code: refuse a case that runs the user's own code.
        resume: keep what an earlier run of the same case left in ``out``: traced paths, the fit to the
            reference.
    """
    with session() as say:
        job = Run(out, resume, not no_code, say)
        report, gap = _diagnose(*_ready(chosen(case, engine, seed), job, RESULTS), job)
        write_diagnosis(out, report, gap, title=f"{case.data.file.name} against {case.model.name}")
        say(f"{report['verdict']}: {report.get('summary', '')}".rstrip(": "))
        say(f"done: {out / 'report.html'}")


def answer(case: Case, out: Path, *, seed: int | None, no_code: bool) -> None:
    """Diagnose a case without a word: timing.json with the seconds of CPU that it took, then report.json.

    Args:
        case: what to diagnose.
        out: the folder of the answer.
        seed: instead of the case's.
        no_code: refuse a case that runs the user's own code.
    """
    job = Run(out, resume=False, allow_code=not no_code, say=lambda _: None)
    prepared, reference = _ready(chosen(case, None, seed), job, RESULTS)
    began = time.process_time()
    report, _ = _diagnose(prepared, reference, job)
    write_text(out / "timing.json", json.dumps({"seconds": time.process_time() - began}))
    write_text(out / "report.json", to_json(report))


def answer_of_rivals(case: Case, out: Path, *, seed: int | None, no_code: bool) -> None:
    """What rivals say about the same case, into rivals.json.

    Args:
        case: what to diagnose.
        out: the folder of the answer; what the diagnosis has learned from reference data is taken from there.
        seed: instead of the case's.
        no_code: refuse a case that runs the user's own code.
    """
    job = Run(out, resume=True, allow_code=not no_code, say=lambda _: None)
    prepared, reference = _ready(chosen(case, None, seed), job, ())
    problem = Problem(prepared.model, prepared.data, prepared.effects, prepared.cluster, reference)
    found = compete(problem, jax.random.fold_in(prepared.key, 1), _settings(prepared))
    write_text(out / "rivals.json", json.dumps(found, indent=1))


def _ready(case: Case, job: Run, results: Sequence[str]) -> tuple[Prepared, Posterior | None]:
    """The case with its data read, and what the twin has learned from reference data."""
    prepared = prepare_case(case, job, "diagnosis", results)
    if prepared.reference is None:
        return prepared, None
    job.say("learning the twin from the reference data")
    return prepared, infer(prepared, prepared.reference, job.out / "reference.nc", job, latents_only=True)


def _settings(prepared: Prepared) -> Settings:
    """The effort that the case asks for."""
    return Settings(**dataclasses.asdict(prepared.case.diagnosis))


def _diagnose(prepared: Prepared, reference: Posterior | None, job: Run) -> tuple[dict[str, Any], DataTree]:
    """The content of report.json and of gap.nc."""
    count = len(prepared.effects)
    job.say(f"{count} candidate effect{'' if count == 1 else 's'}")
    diagnosis = diagnose(
        prepared.model,
        prepared.data,
        prepared.effects,
        key=prepared.key,
        engine=prepared.engine,
        cluster=prepared.cluster,
        settings=_settings(prepared),
        reference=reference,
        designs=prepared.designs,
        say=job.say,
    )
    report = diagnosis.to_report()
    words = prepared.case.data.words
    provenance = {**report.get("provenance", {}), "dtprob": edition(), **prepared.provenance}
    provenance |= {"words": {name: list(listed) for name, listed in words.items()}} if words else {}
    return spelled({**report, "provenance": provenance}, words), diagnosis.to_datatree()


def write_diagnosis(out: Path, report: Mapping[str, Any], gap: DataTree, *, title: str) -> None:
    """Write gap.nc, report.html and, last, report.json, which a page that cannot be drawn does not cost.

    Args:
        out: the folder.
        report: the content of report.json.
        gap: the content of gap.nc.
        title: what was diagnosed.
    """
    with atomic_write(out / "gap.nc") as temporary:
        gap.to_netcdf(temporary, engine="h5netcdf")
    text = to_json(report)
    try:
        write_text(out / "report.html", render(report, gap, title=title))
    except Exception:
        write_text(out / "report.json", text)
        raise
    write_text(out / "report.json", text)
