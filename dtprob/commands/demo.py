"""`dtprob demo`: the diagnosis of a recorded case that comes with the package."""

import shutil
from importlib import resources
from pathlib import Path

from dtprob.case import load_case
from dtprob.commands import diagnose
from dtprob.files import make_folder

FILES = ("case.toml", "channels.npz", "paths.nc", "truth.json")


def run(out: Path) -> None:
    """Copy the recorded case to ``out``/case and diagnose it into ``out``.

    Args:
        out: the folder of the results.
    """
    folder = out / "case"
    make_folder(folder)
    for name in FILES:
        with resources.as_file(resources.files("dtprob.data") / "demo" / name) as file:
            shutil.copyfile(file, folder / name)
    case = load_case(folder / "case.toml")
    diagnose.run(case, out, engine=None, seed=None, no_code=True, resume=False)
