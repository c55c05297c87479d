"""`dtprob fit`: from a CASE to a posterior."""

import json
from pathlib import Path

from dtprob.case import Case
from dtprob.commands.run import Run, chosen, infer, prepare_case, session
from dtprob.files import write_text
from dtprob.workflow.identified import learnt
from dtprob.workflow.summary import entry_names, summarise, summarised


def run(case: Case, out: Path, *, engine: str | None, seed: int | None, no_code: bool, resume: bool) -> None:
    """Infer the parameters of a case's model: posterior.nc, then summary.json.

    Args:
        case: what to fit.
        out: the folder of the results.
        engine: instead of the case's.
        seed: instead of the case's.
        no_code: refuse a case that runs the user's own code.
        resume: continue from the checkpoint in ``out``.
    """
    with session() as say:
        job = Run(out, resume, not no_code, say)
        prepared = prepare_case(chosen(case, engine, seed), job, "fit", ("summary.json",))
        if prepared.case.data.reference is not None:
            say(f"fitting {prepared.case.data.file.name} alone: only a diagnosis learns from the reference")
        posterior = infer(prepared, prepared.data, out / "posterior.nc", job)
        if "reason" in posterior.provenance:
            say(f"{posterior.provenance['chosen']} was chosen: {posterior.provenance['reason']}")
        known = learnt(posterior, prepared.model, prepared.data, summarised(posterior))
        summary = summarise(posterior, known)
        summary["provenance"] |= prepared.provenance
        if names := entry_names(prepared.data):
            summary["names"] = names
        write_text(out / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        for warning in summary["warnings"]:
            say(warning)
        say(f"done: {out / 'posterior.nc'}, {out / 'summary.json'}")
