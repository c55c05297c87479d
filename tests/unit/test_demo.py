"""The recorded case that comes with the package is whole and needs no ray tracer."""

import subprocess
import sys
from importlib import resources

from dtprob.case import load_case
from dtprob.commands.demo import FILES

PROGRAM = """
import sys
from pathlib import Path
from dtprob.case import load_case
from dtprob.workflow import prepare
prepared = prepare(load_case(Path(sys.argv[1])), need="diagnosis")
print(len(prepared.effects) > 20, bool({"sionna", "mitsuba", "drjit"} & set(sys.modules)))
"""


def test_the_files_are_there():
    folder = resources.files("dtprob.data") / "demo"
    for name in FILES:
        assert (folder / name).is_file()
    assert load_case(str(folder / "case.toml")).user_code == ()


def test_it_is_prepared_without_the_ray_tracer():
    case = resources.files("dtprob.data") / "demo" / "case.toml"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(case)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True", "False"]
