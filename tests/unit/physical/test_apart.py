"""The truth knows nothing of the twin: not in its text, not in what it loads."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import dtprob.physical

ROOM = Path(dtprob.physical.__file__).parent
FORBIDDEN = ("dtprob.models", "dtprob.effects", "dtprob.inference", "dtprob.gap", "dtprob.raytracing.field")
CHANNEL_PART = sorted(path.stem for path in ROOM.glob("*.py"))


@pytest.mark.parametrize("name", CHANNEL_PART)
def test_no_file_imports_the_twin(name):
    tree = ast.parse((ROOM / f"{name}.py").read_text())
    named = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    named |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [module for module in named if module.startswith(FORBIDDEN)]


def test_loading_it_loads_neither_the_twin_nor_the_ray_tracer():
    unwanted = (*FORBIDDEN, "sionna", "mitsuba", "drjit")
    load = "import sys, dtprob.physical.cases, dtprob.physical.demo"
    code = f"{load}\nprint([name for name in sys.modules if name.startswith({unwanted!r})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
