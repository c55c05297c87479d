"""`dtprob reproduce`: a figure of the seed report, as numbers and as a picture."""

import importlib
import shutil
import time
from pathlib import Path

import jax

from dtprob.commands.run import session
from dtprob.edition import edition
from dtprob.errors import InputError, unknown_name
from dtprob.files import make_folder
from dtprob.reproduce import FIGURES
from dtprob.reproduce.figure import write
from dtprob.reproduce.progress import Progress
from dtprob.sections import check_seed


def run(figure: str, out: Path, *, runs: int | None, seed: int, resume: bool) -> None:
    """Make one figure: FIGURE.json, FIGURE.png.

    Args:
        figure: its name.
        out: the folder of the results.
        runs: how many runs the bands are over; the figure's own number by default.
        seed: where randomness starts.
        resume: go on with what an interrupted run left in ``out``.

    Raises:
        InputError: an unknown figure, runs or a seed out of range.
    """
    if figure not in FIGURES:
        raise unknown_name("figure", figure, FIGURES, "figure")
    if runs is not None and runs < 1:
        raise InputError("--runs", "a number from 1", str(runs), "Correct it")
    check_seed(seed)
    make_folder(out)
    with session() as say:
        module = importlib.import_module(FIGURES[figure])
        count = module.RUNS if runs is None else runs
        kept = f".{figure}-{count}-{seed}-"
        parts = out / f"{kept}{edition()}"
        others = [folder for folder in out.glob(f"{kept}*") if folder != parts]
        if not resume:
            shutil.rmtree(parts, ignore_errors=True)
        elif others and not parts.is_dir():
            say(f"beginning anew: what lies in {others[0].name} is by another state of dtprob")
        progress = Progress(say, parts)
        start = time.monotonic() - progress.spent()
        made = module.run(jax.random.key(seed), count, progress)
        command = f"dtprob reproduce {figure} --runs {count} --seed {seed}"
        files = write(made, out, seed=seed, command=command, seconds=time.monotonic() - start)
        progress.done()
        for note in made.notes:
            say(note)
        say(f"done: {files[0]}, {files[1]}")
