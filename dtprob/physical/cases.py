"""Withheld cases of ray-traced channels: data with something wrong in them, and the key apart.

Each case is a folder with `case.toml`, `channels.npz` and the twin's `paths.nc`. Truth and twin differ in
materials and noise level always, so that a case without any effect is no exact copy either. Sizes are set by
information: see `dtprob.physical.information` for what lambda means.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.files import atomic_write
from dtprob.physical.bench import Bench
from dtprob.physical.campaign import Plan, Site, describe, make_site
from dtprob.physical.case_files import write_case
from dtprob.physical.cells import touched
from dtprob.physical.choose import KINDS, LISTED, TAKEN_OUT, choose
from dtprob.physical.draws import FAMILIES
from dtprob.physical.impairment import Simulation, measure
from dtprob.physical.information import projected
from dtprob.physical.study import Order, Track

CONVENTION: Final = (
    "lambda is twice the expected gain in log-likelihood of the true effect, alone, over the base model with"
    " its free parameters fitted (materials per class with flat priors, and phases where the model has them);"
    " 2 |(I - P) d|^2 / s2 for a complex mean that differs by d; the number of parameters is not subtracted"
)


def track(plan: Plan) -> Track[Site]:
    """The track for campaigns of one plan."""
    return Track(
        name="channel",
        convention=CONVENTION,
        kinds=KINDS,
        usual=("null", "listed", "unlisted", "pair"),
        families=tuple(FAMILIES),
        listed=LISTED,
        plan=asdict(plan),
        campaign=lambda rng, _number, _families: make_site(rng, plan),
        case=partial(_case, plan),
    )


def _case(plan: Plan, out: Path, order: Order, site: Site) -> dict[str, Any]:
    """Measure and write one case; beside its record lies the noiseless channel with and without the effects."""
    choice = choose(order.rng, order.kind, site, order.lambda_, order.families)
    bench = site.bench
    effects = [one.record() for one in choice.effects]
    alias = {"name": choice.alias[0], "correlation": choice.alias[1]} if choice.alias else None
    left_out = order.left_out(choice.excluded, [*effects, alias], order.families, TAKEN_OUT)
    simulation = bench.simulate(*((one.impairment, one.size) for one in choice.effects))
    channel = measure(order.rng, simulation, bench.sounding)
    write_case(
        out / "cases" / order.name,
        site.paths,
        site.nominal,
        bench.sounding,
        channel,
        noise_power=site.recorded_noise,
        model=plan.model,
        phase=plan.phase,
        excluded=left_out,
        seed=order.index,
    )
    truth = f"truth/{order.name}.npz"
    with atomic_write(out / truth) as temporary:
        np.savez(temporary, base=bench.base.mean, noiseless=simulation.mean)
    return order.record(
        effects,
        left_out,
        alias,
        cells=_cells(bench, simulation, sum(one.lambda_ for one in choice.effects)),
        gap_db=_gap_db(simulation, bench.base),
        noise_power=simulation.noise.mean_power(channel.shape),
        thermal_noise_power=bench.noise_power,
        phase_concentration=site.concentration,
        materials=describe(site.setting.materials),
        truth=truth,
    )


def _cells(bench: Bench, simulation: Simulation, lambda_: float) -> dict[str, list[int]]:
    """What the effects touch: what they shift, once the twin is fitted, and where they change the power of the noise."""
    shape = bench.base.mean.shape
    shift = (simulation.mean - bench.base.mean).reshape(-1)
    left = projected(shift, bench.tangents, bench.noise_power, bench.precision)
    energy = (left[: shift.size] ** 2 + left[shift.size :] ** 2).reshape(shape) / bench.noise_power
    louder = np.broadcast_to(np.log(simulation.noise.level / bench.noise.level), shape)
    return touched(energy + louder**2, AXES, lambda_, ("link",))


def _gap_db(simulation: Simulation, base: Simulation) -> float | None:
    """Error of the base's mean over the channel's power, dB; None without any."""
    error = np.sum(np.abs(simulation.mean - base.mean) ** 2)
    return float(10 * np.log10(error / np.sum(np.abs(simulation.mean) ** 2))) if error > 0 else None


AXES: Final = ("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier")
TRACK: Final = track(Plan())
