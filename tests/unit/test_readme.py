"""What the README says is executed."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from dtprob.case import parse_case
from dtprob.cli import COMMANDS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.parametrize("block", blocks("python"))
def test_python_runs(block, capsys):
    names: dict[str, object] = {}
    exec(compile(block, "README.md", "exec"), names)  # noqa: S102  (our own text)
    numbers, verdict = capsys.readouterr().out.splitlines()
    mean, spread = map(float, numbers.split())
    np.testing.assert_allclose(mean, 3.0, atol=3 * spread)  # 2.8 without the shadow
    assert 0.01 < spread < 0.2
    assert f"# {verdict}" in block.splitlines()


def test_cases_are_cases():
    assert blocks("toml")
    for block in blocks("toml"):
        parse_case(tomllib.loads(block), Path("README.toml"))


def test_named_commands_and_targets_exist():
    assert set(re.findall(r"`?dtprob (\w+)", TEXT)) <= {*COMMANDS, "needs"}
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"^    make (\w+)", TEXT, re.MULTILINE)) <= set(targets)
