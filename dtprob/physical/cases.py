"""Withheld cases of ray-traced channels: data with something wrong in them, and the key apart.

Each case is a folder with `case.toml`, `channels.npz` and the twin's `paths.nc`. Truth and twin differ in
materials and noise level always, so that a case without any effect is no exact copy either. Sizes are set by
information: see `dtprob.physical.information` for what lambda means. Everything is drawn from the seed and
    the number of the case.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np

from dtprob.files import atomic_write
from dtprob.physical.campaign import Plan, Site, describe, make_site
from dtprob.physical.case_files import write_case
from dtprob.physical.choose import LISTED, Choice, Kind, choose
from dtprob.physical.draws import FAMILIES
from dtprob.physical.impairment import Simulation, measure
from dtprob.physical.key import checked, write_key

KINDS: Final[tuple[Kind, ...]] = ("null", "listed", "unlisted", "pair", "triple", "alias")
SHARED: Final = 8
"""Cases measured at one site, with the same positions, materials and noise."""
CONVENTION: Final = (
    "lambda is twice the expected gain in log-likelihood of the true effect, alone, over the base model with"
    " its free parameters fitted (materials per class with flat priors, and phases where the model has them);"
    " 2 |(I - P) d|^2 / s2 for a complex mean that differs by d; the number of parameters is not subtracted"
)


def generate_cases(
    out: Path,
    count: int,
    seed: int,
    kinds: Sequence[Kind] = ("null", "listed", "unlisted", "pair"),
    lambda_: float | Sequence[float] = (25.0, 100.0, 400.0),
    *,
    families: Sequence[str] = LISTED,
    plan: Plan | None = None,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write withheld cases and their key.

    Case i is of kind `kinds[i % len(kinds)]`; its lambda is drawn from those given.

    Args:
        out: folder; cases go to `cases/NNNN`, `key.json` and what is true of each case (`truth/NNNN.json` and
            `truth/NNNN.npz`, the noiseless channel with and without the effect) stay outside of `cases`.
        count: number of cases.
        seed: from which everything is drawn.
        kinds: "null" no effect, "listed" one effect, "unlisted" one effect whose family the case takes out of
            the library, or that never had an entry, "pair" and "triple" several effects that can be told
            apart, "alias" one effect that looks much like another of the library.
        lambda_: information that each effect carries alone.
        families: which effects may occur.
        plan: the campaigns.
        resume: keep the cases that are whole.
        progress: called with the number of cases done and `count`.

    Returns:
        The key's file.

    Raises:
        InputError: an unknown kind or family, or a lambda that no effect can reach.
    """
    plan = Plan() if plan is None else plan
    lambdas = checked(kinds, lambda_, families, known_kinds=KINDS, known_families=FAMILIES)
    (out / "truth").mkdir(parents=True, exist_ok=True)
    sites: dict[int, Site] = {}
    for index in range(count):
        if not (resume and _record(out, index).is_file()):
            number = index // SHARED
            if number not in sites:
                sites = {number: make_site(np.random.default_rng([seed, number, 0]), plan)}
            rng = np.random.default_rng([seed, index, 1])
            target = lambdas[int(rng.integers(len(lambdas)))]
            choice = choose(rng, kinds[index % len(kinds)], sites[number], target, families)
            _write(out, index, choice, rng=rng, site=sites[number], plan=plan)
        if progress:
            progress(index + 1, count)
    return write_key(out, count, seed, track="channel", convention=CONVENTION, plan=asdict(plan))


def _record(out: Path, index: int) -> Path:
    return out / "truth" / f"{index:04d}.json"


def _write(
    out: Path, index: int, choice: Choice, *, rng: np.random.Generator, site: Site, plan: Plan
) -> None:
    """Measure and write one case; its record comes last, as the sign that it is whole."""
    bench = site.bench
    simulation = bench.simulate(*((one.impairment, one.size) for one in choice.effects))
    channel = measure(rng, simulation, bench.sounding)
    name = f"{index:04d}"
    write_case(
        out / "cases" / name,
        site.paths,
        site.nominal,
        bench.sounding,
        channel,
        noise_power=site.recorded_noise,
        model=plan.model,
        phase=plan.phase,
        excluded=choice.excluded,
        seed=index,
    )
    with atomic_write(out / "truth" / f"{name}.npz") as temporary:
        np.savez(temporary, base=bench.base.mean, noiseless=simulation.mean)
    record = {
        "name": name,
        "kind": choice.kind,
        "lambda": choice.target,
        "effects": [one.record() for one in choice.effects],
        "excluded": list(choice.excluded),
        "alias": choice.alias and {"name": choice.alias[0], "correlation": choice.alias[1]},
        "gap_db": _gap_db(simulation, bench.base),
        "noise_power": simulation.noise.mean_power(channel.shape),
        "thermal_noise_power": bench.noise_power,
        "phase_concentration": site.concentration,
        "materials": describe(site.setting.materials),
        "truth": f"truth/{name}.npz",
    }
    with atomic_write(_record(out, index)) as temporary:
        temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")


def _gap_db(simulation: Simulation, base: Simulation) -> float | None:
    """Error of the base's mean over the channel's power, dB; None without any."""
    error = np.sum(np.abs(simulation.mean - base.mean) ** 2)
    return float(10 * np.log10(error / np.sum(np.abs(simulation.mean) ** 2))) if error > 0 else None
