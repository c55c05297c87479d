"""Wrong twins of the measured apartment: the measurements stay, what the twin believes about them is spoilt.

A wrong twin is a CASE beside a copy of the measured set in which one of the files that describe the flat says something
else: the floor plan, the table of links, the radio. `dtprob diagnose` reads it like any other case.
"""

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

from dtprob.data.location import measured_data
from dtprob.data.uwb_apartment import NAME, RESPONSES
from dtprob.files import write_text

LINKS: Final = (
    *(1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 16, 18, 19, 20, 21),
    *(22, 25, 27, 29, 33, 34, 35, 36, 37, 40, 42, 43, 44, 46, 48, 51, 52, 56),
)
"""Numbers of the measured links."""
CARRIER: Final = 3.9936e9
THICKNESS: Final = 0.05
"""Of the walls, in m, as the description of the set says."""


class Twin(NamedTuple):
    """What a twin believes wrongly, and the effects that undo it.

    Attributes:
        name: of the twin.
        wrong: in words.
        undone_by: families, or instances, any of which is right; empty where nothing is wrong.
        wall: number of the wall that the floor plan lacks.
        wall_ends: where it stands, (x, y, x, y) in m.
        anchor: for each anchor's number, the place (x, y) in m that the table of links gives instead.
        bandwidth: factor on the radio's bandwidth, and on its tap's inverse.
        scene: settings of [scene] that differ.
    """

    name: str
    wrong: str
    undone_by: tuple[str, ...] = ()
    wall: int | None = None
    wall_ends: tuple[float, float, float, float] | None = None
    anchor: Mapping[int, tuple[float, float]] = {}
    bandwidth: float = 1.0
    scene: Mapping[str, Any] = {}


TWINS: Final = (
    Twin("honest", "nothing on purpose"),
    Twin(
        "anchor_3",
        "anchor 3 stands 0.5 m too far east",
        ("transmitter_displacement[transmitter_7]",),
        anchor={3: (8.37, 5.61)},
    ),
    Twin(
        "swap_2_4",
        "anchors 2 and 4 are taken for one another",
        ("swapped_transmitters[4_5]",),
        anchor={2: (5.99, 5.37), 4: (7.76, 6.79)},
    ),
    Twin("depth", "one interaction at most", ("depth_cut_off",), scene={"max_depth": 1, "check_depth": 7}),
    Twin(
        "wall_13",
        "the wall at x = 4.7 m, 3.6 m long, is not there",
        ("missing_object",),
        wall=13,
        wall_ends=(4.652, 5.879, 4.652, 9.498),
    ),
    Twin("carrier", "the carrier is 4492.8 MHz", ("carrier_mismatch",), scene={"frequency": 4.4928e9}),
    Twin("bandwidth", "the bandwidth is 599 MHz", ("bandwidth_mismatch",), bandwidth=1.2),
    Twin(
        "opaque",
        "no wave passes a wall",
        ("refraction_off",),
        scene={"refraction": False, "check_refraction": True},
    ),
    Twin(
        "plaster",
        "walls are of plasterboard",
        ("material_mismatch[all_plasterboard_50mm]",),
        scene={"wall_material": "plasterboard"},
    ),
    Twin(
        "anchor_6",
        "anchor 6 stands 0.5 m too far south",
        ("transmitter_displacement[transmitter_3]",),
        anchor={6: (3.34, 1.85)},
    ),
    Twin(
        "swap_5_6",
        "anchors 5 and 6 are taken for one another",
        ("swapped_transmitters[2_3]",),
        anchor={5: (3.34, 2.35), 6: (3.15, 0.9)},
    ),
    Twin(
        "wall_5",
        "the wall at y = 4.8 m, 4.6 m long, is not there",
        ("missing_object",),
        wall=5,
        wall_ends=(4.652, 4.799, 9.301, 4.799),
    ),
    Twin(
        "anchor_5",
        "anchor 5 stands 0.5 m too far west",
        ("transmitter_displacement[transmitter_2]",),
        anchor={5: (2.65, 0.9)},
    ),
    Twin(
        "wall_2",
        "the wall at y = 3.4 m, 3.0 m long, is not there",
        ("missing_object",),
        wall=2,
        wall_ends=(0.002, 3.379, 3.022, 3.379),
    ),
)
"""The honest twin first."""

_SWAPS: Final = tuple(
    f"swapped_transmitters[{a}_{b}]" for half in (range(4), range(4, 8)) for a, b in combinations(half, 2)
)
"""Of the anchors of one half of the flat: no tag was measured from both halves."""

EFFECTS: Final = (
    *("transmitter_displacement", "receiver_displacement", "scene_scale"),
    *("carrier_mismatch", "bandwidth_mismatch", "missing_object", "missing_path[line_of_sight]"),
    *("missing_path[reflection]", "polarization_mismatch", "wall_law", "depth_cut_off"),
    *_SWAPS,
)
"""Candidates of every twin. Another material of all walls joins them, and refraction_off where the twin lets nothing
through walls."""

TAIL_SPREAD: Final = 3.0
"""dB by which the tail of one link differs from another's."""

LACKING: Final = (
    *("polarization_mismatch", "missing_path[line_of_sight]", "missing_path[reflection]", "wall_law"),
    *("depth_cut_off", "missing_object"),
)
"""What the honest twin may be found to lack: things that have the same name in every twin. The campaign's own notes, of
places to a centimetre and whose they are, the carrier and the bandwidth, are believed there."""

LEFT_OUT: Final = ("receiver_displacement[each_link]", "transmitter_displacement[each_link]")
"""Random fields that imitate any error of the geometry: the honest twin calls for the first."""


def write_case(
    twin: Twin, folder: Path, known: Sequence[str] = (), offered: Sequence[str] | None = None
) -> Path:
    """Write a twin's CASE and its copy of the measured set; the name of the CASE.

    Args:
        twin: what is wrong with it.
        folder: receives case.toml and the folder of the set.
        known: effects that are made part of the twin.
        offered: the candidates; by default those of every twin.

    Raises:
        InputError: the measured set is not there.
    """
    source, target = measured_data(NAME), folder / NAME
    target.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / RESPONSES, target / RESPONSES)
    write_text(target / "links.csv", _links(source / "links.csv", twin))
    write_text(target / "floorplan.json", _plan(source / "floorplan.json", twin))
    write_text(target / "radio.json", _radio(source / "radio.json", twin))
    write_text(folder / "case.toml", _case(twin, known, offered))
    return folder / "case.toml"


def _links(source: Path, twin: Twin) -> str:
    with source.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        if int(row["anchor"]) in twin.anchor:
            row["anchor_x"], row["anchor_y"] = (f"{x:g}" for x in twin.anchor[int(row["anchor"])])
    return "\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows), ""])


def _plan(source: Path, twin: Twin) -> str:
    plan = json.loads(source.read_text())
    if twin.wall is not None:
        del plan["walls_xyxy"][twin.wall]
    return json.dumps(plan, indent=1)


def _radio(source: Path, twin: Twin) -> str:
    radio = json.loads(source.read_text())
    radio["bandwidth_hz"] *= twin.bandwidth
    radio["tap_s"] /= twin.bandwidth
    return json.dumps(radio, indent=1)


def _case(twin: Twin, known: Sequence[str], offered: Sequence[str] | None) -> str:
    scene = {
        "file": f"{NAME}/floorplan.json",
        "frequency": CARRIER,
        "max_depth": 7,
        "refraction": True,
        "merge_shapes": False,
        "skip_unreached": True,
        "device_height": 1.2,
        "ceiling_height": 2.6,
        "wall_material": "concrete",
        "wall_thickness": THICKNESS,
        "samples": 300_000,
        "strongest": 12,
        "check_depth": 8,
        **twin.scene,
    }
    if offered is None:
        walls = f"material_mismatch[all_{scene['wall_material']}_{1e3 * THICKNESS:g}mm]"
        offered = (*EFFECTS, walls) if scene["refraction"] else (*EFFECTS, walls, "refraction_off")
    left_out = [name for name in LEFT_OUT if name.partition("[")[0] in offered]
    scene["check_transmitters"] = any(name in _SWAPS for name in offered)
    sections: dict[str, Mapping[str, Any]] = {
        "model": {"name": "ultra_wideband_profile"},
        "model.options": {"tail_spread_db": TAIL_SPREAD},
        "data": {"file": NAME},
        "data.options": {"averages": 2, "level": "reported", "links": list(LINKS)},
        "scene": scene,
        "effects": {"use": list(offered), "exclude": left_out, "known": list(known)},
    }
    lines = [f"# A twin of the measured apartment; wrong: {twin.wrong}."]
    for name, content in sections.items():
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in content.items()), ""]
    return "\n".join(lines)
