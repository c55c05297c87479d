"""Withheld cases of models that users declare themselves: a regression on a table, and a state-space model.

Each case is a folder with `case.toml`, the data, and the user's model and effects as modules beside it; diagnosing it runs
that code. The campaigns' levels, exponents and errors are told to nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.files import atomic_write, write_text
from dtprob.physical import custom_fading as fading
from dtprob.physical import custom_path_loss as path_loss
from dtprob.physical.fault_cases import KINDS, Families, Setup, make_case
from dtprob.physical.gaussian import Vector
from dtprob.physical.study import Order, Track, case_end

FAMILIES: Final = tuple(dict.fromkeys([*path_loss.FAMILIES, *fading.FAMILIES]))
FOREIGN: Final = (*path_loss.FOREIGN, *fading.FOREIGN)
LISTED: Final = tuple(name for name in FAMILIES if name not in FOREIGN)
CONVENTION: Final = (
    "lambda is twice the divergence of the measurements' law from the nearest law of the twin, whose level, exponent and"
    " spread are fitted; exact for every size"
)
_CODE: Final = Path(__file__).parent / "user_code"


def _campaign(rng: np.random.Generator, number: int, families: Sequence[str]) -> Setup:
    """Campaigns with streets and with runs take turns, where both have one of the families."""
    kinds = [
        make
        for make, known in ((_streets, path_loss.FAMILIES), (_runs, fading.FAMILIES))
        if set(known) & set(families)
    ]
    return kinds[number % len(kinds)](rng, families)


def _streets(rng: np.random.Generator, families: Sequence[str]) -> Setup:
    made = path_loss.make_streets(rng)
    known = [name for name in path_loss.FAMILIES if name in families]
    drawn = Families(lambda rng, family: path_loss.draw(rng, family, made), known, path_loss.FOREIGN)
    more = {"level": made.level, "exponent": made.exponent, "error": made.error}
    return Setup(
        made.bench, drawn, partial(_write_streets, made), ("sample",), (), {"model": "path_loss", **more}
    )


def _runs(rng: np.random.Generator, families: Sequence[str]) -> Setup:
    made = fading.make_runs(rng)
    known = [name for name in fading.FAMILIES if name in families]
    drawn = Families(lambda rng, family: fading.draw(rng, family, made), known, fading.FOREIGN)
    names = ("level", "exponent", "correlation", "fading", "noise")
    more = {name: getattr(made, name) for name in names}
    return Setup(
        made.bench,
        drawn,
        partial(_write_runs, made),
        ("run", "step"),
        ("run",),
        {"model": "slow_fading", **more},
    )


def _case(out: Path, order: Order, setup: Setup) -> dict[str, Any]:
    """One case; of what can be wrong with slow fading no three faults can be told apart, so that triples are in streets."""
    if order.kind == "triple" and setup.more["model"] == "slow_fading":
        setup = _streets(np.random.default_rng([order.seed, order.index, 3]), order.families)
    return make_case(out, order, setup)


def _write_streets(
    made: path_loss.Streets, folder: Path, power: Vector, excluded: Sequence[str], seed: int
) -> None:
    """A table with a row per measurement."""
    segment = np.repeat(np.arange(path_loss.STREETS), path_loss.ROWS)
    columns = (made.place[..., 0], made.place[..., 1], made.minutes, segment, power)
    rows = np.column_stack([np.reshape(column, -1) for column in columns])
    with atomic_write(folder / "table.csv") as temporary:
        form = ["%.2f", "%.2f", "%.3f", "%d", "%.3f"]
        np.savetxt(
            temporary, rows, fmt=form, delimiter=",", header="east,north,time,segment,power", comments=""
        )
    options = f"\n[model.options]\nsegments = {path_loss.STREETS}\n"
    _write_code(folder, "path_loss", "table.csv", "segment", options=options, excluded=excluded, seed=seed)


def _write_runs(made: fading.Runs, folder: Path, power: Vector, excluded: Sequence[str], seed: int) -> None:
    """Arrays with a row per run."""
    with atomic_write(folder / "runs.npz") as temporary:
        np.savez(temporary, distance=made.distance, power=power)
    _write_code(folder, "slow_fading", "runs.npz", "run", options="", excluded=excluded, seed=seed)


def _write_code(
    folder: Path, name: str, data: str, cluster: str, *, options: str, excluded: Sequence[str], seed: int
) -> None:
    """The user's modules, and the CASE that names them."""
    for module in (name, f"{name}_effects"):
        write_text(folder / f"{module}.py", (_CODE / f"{module}.py.txt").read_text(encoding="utf-8"))
    text = f"""[model]
name = "{name}:{name}"
{options}
[data]
file = "{data}"
cluster = "{cluster}"

"""
    end = case_end(excluded, seed, f"{name}_effects:effects")
    write_text(folder / "case.toml", text + end)


TRACK: Final = Track(
    name="custom",
    convention=CONVENTION,
    kinds=KINDS,
    usual=KINDS,
    families=FAMILIES,
    listed=LISTED,
    plan={"streets": [path_loss.STREETS, path_loss.ROWS], "runs": [fading.RUNS, fading.STEPS]},
    campaign=_campaign,
    case=_case,
)
