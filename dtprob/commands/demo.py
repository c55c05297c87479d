"""`dtprob demo`: the diagnosis of a recorded case that comes with the package."""

from importlib import resources
from pathlib import Path

from dtprob.case import load_case
from dtprob.commands import diagnose
from dtprob.errors import InputError
from dtprob.files import atomic_write, make_folder

FILES = ("case.toml", "channels.npz", "paths.nc", "truth.json")


def run(out: Path) -> None:
    """Copy the recorded case to ``out``/case and diagnose it into ``out``.

    Args:
        out: the folder of the results.

    Raises:
        InputError: a folder that cannot be written to, or has other files of these names.
    """
    folder, recorded = out / "case", resources.files("dtprob.data") / "demo"
    make_folder(folder)
    content = {folder / name: (recorded / name).read_bytes() for name in FILES}
    is_demo = all(file.exists() for file in content)  # of another version perhaps
    for file, whole in content.items():
        if not is_demo and file.exists() and file.read_bytes() != whole:
            raise InputError(f"{file}", "none, or the demo's", "another file", "Choose another folder")
    for file, whole in content.items():
        with atomic_write(file) as temporary:
            temporary.write_bytes(whole)
    diagnose.run(load_case(folder / "case.toml"), out, engine=None, seed=None, no_code=True, resume=False)
