"""Materials of the measured apartment from the links of all rooms but one, tried on the links of that room.

    DTPROB_DATA=... python benchmarks/apartment_rooms.py [--room NAME] [--write]

A link belongs to the room its tag stands in. The twin is that of examples/apartment/case.toml with walls as the data
set describes them (5 cm of concrete) and a dense tail (`diffuse_scattering`) beside the traced paths, of which each link
keeps the strongest. It is fitted twice to the other rooms, with materials as ITU-R P.2040 has them and with unknown
ones. The error of a held-out link is that of its traced channel after the best complex gain and delay, which say nothing
of materials. --write keeps the figures of each room in benchmarks/results/apartment_rooms.json.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from record import record, recorded

from dtprob.case import load_case
from dtprob.effects import catalogue, with_effects
from dtprob.inference import Posterior, fit
from dtprob.models.declaration import declare
from dtprob.raytracing.beyond import strongest
from dtprob.raytracing.field import frequency_response, path_gain, synthesize
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.phasor import phasor
from dtprob.workflow import prepare

CASE: Final = Path(__file__).parents[1] / "examples" / "apartment" / "case.toml"
ROOMS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "east": (7.2, 5.1, 9.3, 9.5),
    "middle": (4.65, 5.88, 7.2, 9.5),
    "west": (2.1, 5.88, 4.65, 9.5),
    "corner": (0.0, 6.54, 2.1, 9.5),
    "corridor": (2.0, 4.8, 7.2, 5.88),
    "bathroom": (0.0, 3.38, 2.0, 4.8),
}
"""x1, y1, x2, y2 on the floor plan, m; the kitchen and the hall hold anchors only."""
KEPT: Final = 40
DRAWS: Final = 200
SILENT: Final = 1.0
"""Noise on links that are held out, W: 110 dB above what any of them receives."""
LAGS: Final = np.linspace(-1.5e-9, 1.5e-9, 61)
"""About the rough delay of a link, s."""


class Errors(NamedTuple):
    """Squared error of each held-out link over its power."""

    before: Float[np.ndarray, " link"]
    after: Float[np.ndarray, "draw link"]


def main() -> None:
    """Calibrate without each room in turn, and print what that does to it."""
    parser = argparse.ArgumentParser(description="Calibration of the measured apartment, room by room.")
    parser.add_argument("--room", choices=ROOMS, help="this one only")
    parser.add_argument("--cache", type=Path, help="folder for traced paths")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    model, data = twin(options.cache)
    home = rooms_of(data["paths"])
    for name in (options.room,) if options.room else ROOMS:
        begin = time.process_time()
        errors, materials = without(model, data, home == name)
        found = summary(errors) | {"materials": materials}
        print(
            f"{name:9s} {json.dumps(found)}  {time.process_time() - begin:.0f} s of the processor",
            flush=True,
        )
        if options.write:
            write(name, found)


def twin(cache: Path | None) -> tuple[Any, dict[str, Any]]:
    """The model with a dense tail beside the paths, and its arguments, paths that hardly count left out."""
    case = load_case(CASE)
    if case.scene is None:
        raise SystemExit(f"{CASE} has no scene")
    scene = dataclasses.replace(case.scene, wall_material="concrete", wall_thickness=0.05)
    prepared = prepare(dataclasses.replace(case, scene=scene), need="fit", cache=cache, say=print)
    data = {**prepared.data, "paths": strongest(prepared.data["paths"], KEPT)}
    sites = declare(prepared.model, data, cluster="link").sites
    return with_effects(prepared.model, catalogue(sites, data, use=["diffuse_scattering"])), data


def rooms_of(paths: PathSet) -> np.ndarray:
    """Name of the room of each link's tag, the receiver."""
    place = np.asarray(paths.rx_position)[:, :2]
    names = np.full(len(place), "", dtype="U16")
    for name, (x1, y1, x2, y2) in ROOMS.items():
        names[np.all((place >= (x1, y1)) & (place <= (x2, y2)), axis=1)] = name
    if np.any(names == ""):
        raise SystemExit(f"no room holds {place[names == ''].tolist()}")
    return names


def muted(data: Mapping[str, Any], links: np.ndarray) -> dict[str, Any]:
    """The arguments with so much noise on some links that they say nothing, in the shapes compiled before."""
    return {**data, "noise_power": jnp.where(jnp.asarray(links), SILENT, data["noise_power"])}


def without(model: Any, data: Mapping[str, Any], held: np.ndarray) -> tuple[Errors, dict[str, Any]]:
    """Errors on the links held out, and the materials that the others give."""
    posteriors = [
        calibrated(model, {**muted(data, held), "materials": kind}) for kind in ("known", "per_material")
    ]
    known, free = (posterior.sample(jax.random.key(1), DRAWS) for posterior in posteriors)
    paths: PathSet = data["paths"].take(held)
    rough, tones = jnp.asarray(data["rough_delay"])[held], data["subcarrier_frequency"]
    channel = jnp.asarray(data["channel"])[held].mean(axis=(1, 2, 3))

    @jax.jit
    def error(draw: Mapping[str, Array]) -> Array:
        gain = path_gain(paths, draw["permittivity"], draw["conductivity"])
        response = frequency_response(paths, tones)
        shape = synthesize(gain, response)[:, 0, 0, 0] * draw["frequency_response"]
        turn = phasor(-(rough[:, None, None] + LAGS[:, None]) * tones)
        match = jnp.abs(jnp.einsum("lk,lnk,lk->ln", jnp.conj(shape), jnp.conj(turn), channel)) ** 2
        best = match.max(axis=1) / jnp.sum(jnp.abs(shape) ** 2, axis=1)
        return 1 - best / jnp.sum(jnp.abs(channel) ** 2, axis=1)

    sites = ("permittivity", "conductivity", "frequency_response")
    before, after = (
        [error({s: draws[s][i] for s in sites}) for i in range(DRAWS)] for draws in (known, free)
    )
    return Errors(np.mean(before, axis=0), np.asarray(after)), materials_of(posteriors[1], paths)


def calibrated(model: Any, data: Mapping[str, Any]) -> Posterior:
    """The posterior of a model."""
    return fit(model, data, engine="laplace", key=jax.random.key(0), starts=1, draws=DRAWS)


def materials_of(posterior: Posterior, paths: PathSet) -> dict[str, Any]:
    """90% interval of each material's permittivity and conductivity, and the scene's own value."""
    first = [int(np.argmax(np.asarray(paths.object_material) == i)) for i in range(paths.n_material)]
    table: dict[str, Any] = {}
    for number, name in enumerate(paths.material_names):
        table[name] = {
            quantity: {
                "nominal": round(float(np.asarray(getattr(paths, quantity))[first[number]]), 4),
                "interval": [
                    round(float(v), 4)
                    for v in np.quantile(posterior.flat(f"material_{quantity}")[:, number], (0.05, 0.95))
                ],
            }
            for quantity in ("permittivity", "conductivity")
        }
    return table


def summary(errors: Errors) -> dict[str, Any]:
    """Mean error over links in dB, before and after, and what calibrating gains, with 90% intervals over draws."""
    before = 10 * np.log10(errors.before.mean())
    after = 10 * np.log10(errors.after.mean(axis=1))
    low, middle, high = np.quantile(after, (0.05, 0.5, 0.95))
    better = np.mean(errors.after.mean(axis=0) < errors.before)
    return {
        "links": len(errors.before),
        "before_db": round(float(before), 2),
        "after_db": {
            "median": round(float(middle), 2),
            "low": round(float(low), 2),
            "high": round(float(high), 2),
        },
        "links_better": round(float(better), 2),
    }


def write(room: str, found: Mapping[str, Any]) -> None:
    """Keep the figures of a room, beside those of the others."""
    rooms = recorded("apartment_rooms").get("rooms", {}) | {room: found}
    what = "channel error on the links of a room that calibration has not seen, dB of their power"
    figures = {"paths_per_link": KEPT, "draws": DRAWS, "rooms": rooms}
    command = "python benchmarks/apartment_rooms.py --write"
    record("apartment_rooms", what, ("jax", "numpyro", "sionna-rt"), figures, command=command)


if __name__ == "__main__":
    main()
