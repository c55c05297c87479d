"""Scenes from floor plans."""

import csv
import json

import numpy as np
import pytest

from dtprob.data.location import measured_data
from dtprob.errors import InputError
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.floorplan import Furniture, Surface, floorplan_scene, read_floorplan
from dtprob.raytracing.paths import REFRACTION, SPECULAR
from dtprob.raytracing.trace import trace

WALLS = np.array([[0, 0, 6, 0], [6, 0, 6, 4], [6, 4, 0, 4], [0, 4, 0, 0], [3, 0, 3, 4]], float)
CARRIER = 4e9


def table(**changes):
    return Furniture(
        **{
            "kind": "table",
            "polygon": np.array([[1, 3], [2, 3], [2, 3.5], [1, 3.5]]),
            "height": 0.75,
            **changes,
        }
    )


@pytest.mark.libllvm
def test_paths_of_two_rooms(rt):
    """One wall between the ends: direct ray through it, reflections of floor, ceiling and the four walls."""
    scene = floorplan_scene(
        WALLS, 2.5, CARRIER, wall=Surface("plasterboard", 0.05), furniture=[table(), table()][:1]
    )
    assert list(scene.objects) == [*(f"wall_{i}" for i in range(5)), "floor", "ceiling", "table_0"]
    tx, rx = np.array([[1.5, 1.7, 1.3]]), np.array([[4.6, 2.2, 1.1]])
    paths = trace(scene, tx, rx, max_depth=3, refraction=True, samples=100_000)
    code, item = np.asarray(paths.interaction[0]), np.asarray(paths.object[0])
    kinds = {
        tuple((int(c), paths.object_names[i]) for c, i in zip(codes, items, strict=True) if c)
        for codes, items, there in zip(code, item, paths.mask[0], strict=True)
        if there
    }
    through = (REFRACTION, "wall_4")
    assert (through,) in kinds
    for name in ("wall_0", "wall_2", "floor", "ceiling"):
        bounce = (SPECULAR, name)
        assert (bounce, through) in kinds or (through, bounce) in kinds
    assert ((SPECULAR, "wall_3"), through) in kinds
    assert (through, (SPECULAR, "wall_1")) in kinds
    gain = path_gain(paths, paths.permittivity, paths.conductivity)
    direct = np.flatnonzero(code.sum(1) == REFRACTION)[0]
    free = paths.wavelength / (4 * np.pi * np.linalg.norm(tx - rx))
    assert 0.3 * free < abs(gain[0, direct]) < free
    made = dict(zip(paths.object_names, np.asarray(paths.object_material), strict=True))
    assert paths.material_names[made["wall_3"]] == "plasterboard_50mm"
    assert paths.thickness[list(made).index("wall_3")] == pytest.approx(0.05)


@pytest.mark.libllvm
def test_furniture_is_closed_and_named_by_kind(rt):
    chairs = [table(kind="chair", polygon=np.array([[4, 1], [4.5, 1], [4.2, 1.6]])) for _ in range(2)]
    chairs[1] = table(kind="chair", polygon=chairs[0].polygon + 0.9)
    scene = floorplan_scene(
        WALLS, 2.5, CARRIER, furniture=[table(height=9.0), *chairs], floor=None, ceiling=None
    )
    assert [name for name in scene.objects if "wall" not in name] == ["table_0", "chair_0", "chair_1"]
    box = scene.objects["table_0"].mi_mesh.bbox()
    assert float(box.max.z) < 2.5
    paths = trace(
        scene,
        np.array([[1.5, 3.2, 1.0]]),
        np.array([[1.5, 1.0, 1.0]]),
        max_depth=0,
        samples=1,
        allow_empty=True,
    )
    assert not np.any(paths.mask)  # shut in a cupboard


@pytest.mark.libllvm
def test_surfaces_wall_by_wall(rt):
    surfaces = [Surface("concrete", 0.2)] * 4 + [Surface("glass", 0.01, name="window")]
    scene = floorplan_scene(WALLS, 2.5, CARRIER, wall=surfaces)
    assert scene.objects["wall_4"].radio_material.name == "window"
    assert float(scene.objects["wall_0"].radio_material.thickness[0]) == pytest.approx(0.2)


REFUSED = {
    "shape": ({"walls": WALLS[:, :3]}, "ends of each wall"),
    "length": ({"walls": np.array([[1.0, 1, 1, 1]])}, r"walls \[0\] without length"),
    "height": ({"height": 0.0}, "positive height"),
    "walls": ({"wall": [Surface("wood", 0.1)]}, "one surface or 5 of them, got 1"),
    "convex": (
        {"furniture": [table(polygon=np.array([[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]]))]},
        "outline of table_0: expected a convex",
    ),
    "low": ({"furniture": [table(height=0.0)]}, "height of table_0"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_plans_that_make_no_scene(what):
    changes, text = REFUSED[what]
    arguments = {"walls": WALLS, "height": 2.5, "frequency": CARRIER, **changes}
    with pytest.raises(InputError, match=text):
        floorplan_scene(**arguments)


@pytest.mark.libllvm
def test_materials_that_do_not_exist(rt):
    for surface, text in (
        (Surface("conrete", 0.1), "Did you mean 'concrete'"),
        (Surface("wood", -0.1), "positive thickness"),
        (Surface("wood", 0.1, name="concrete_200mm"), "to be one material"),
        (Surface("floorboard", 0.1), "known at 4 GHz"),
    ):
        with pytest.raises(InputError, match=text):
            floorplan_scene(WALLS, 2.5, CARRIER, wall=surface)


def test_reading_a_plan(tmp_path):
    file = tmp_path / "plan.json"
    file.write_text(
        json.dumps({"walls_xyxy": WALLS.tolist(), "furniture": [{"kind": "bed", "polygon_m": [[0, 0]]}]})
    )
    plan = read_floorplan(file)
    assert np.array_equal(plan.walls, WALLS)
    assert [piece.kind for piece in plan.furniture] == ["bed"]
    file.write_text(file.read_text(), encoding="utf-8-sig")  # as some editors write
    assert np.array_equal(read_floorplan(file).walls, WALLS)
    for text in (
        "{",
        "[]",
        '{"walls": []}',
        '{"walls_xyxy": [["a"]]}',
        '{"walls_xyxy": [], "furniture": [{}]}',
    ):
        file.write_text(text)
        with pytest.raises(InputError, match="walls_xyxy"):
            read_floorplan(file)
    with pytest.raises(InputError, match="no such file"):
        read_floorplan(tmp_path / "absent.json")


@pytest.mark.libllvm
@pytest.mark.measured
def test_the_measured_flat(rt):
    try:
        folder = measured_data("uwb_apartment")
    except InputError as error:
        pytest.skip(str(error))
    plan = read_floorplan(folder / "floorplan.json")
    with (folder / "links.csv").open() as stream:
        rows = list(csv.DictReader(stream))[::6]
    rx, tx = (
        np.array([[float(r[f"{end}_x"]), float(r[f"{end}_y"]), 1.2] for r in rows])
        for end in ("anchor", "tag")
    )
    scene = floorplan_scene(
        plan.walls, 2.5, 3.9936e9, wall=Surface("concrete", 0.05), furniture=plan.furniture
    )
    assert len(scene.objects) == 21 + 2 + 9
    paths = trace(
        scene, tx, rx, max_depth=4, refraction=True, samples=200_000, frequency=3.9936e9, allow_empty=True
    )
    assert np.mean(np.any(paths.mask, axis=1)) > 0.9
    assert np.sum(np.asarray(paths.interaction) == REFRACTION) > 50
    gain = path_gain(paths, paths.permittivity, paths.conductivity)
    assert np.all(np.isfinite(gain))


@pytest.mark.libllvm
@pytest.mark.filterwarnings("error")
def test_a_scene_far_from_the_origin_is_told_of(rt):
    """At 1 km as many paths as at the origin; at 10 km the solver finds some twice, at 20 km most."""
    ends = np.array([[1.5, 1.7, 1.3]]), np.array([[2.6, 3.2, 1.1]])

    def count(offset):
        move = np.array([offset, 0.7 * offset])
        scene = floorplan_scene(WALLS[:4] + np.tile(move, 2), 2.5, CARRIER)
        paths = trace(scene, *(end + np.r_[move, 0] for end in ends), max_depth=2, samples=10_000)
        return int(paths.mask.sum())

    assert count(1e3) == count(0.0)
    with pytest.warns(RuntimeWarning, match=r"10 km from the origin to 0.6 mm.*move the scene to the origin"):
        assert count(1e4) > 0
    with pytest.raises(InputError, match=r"within 17 km.*got 20 km. Move the scene"):
        count(2e4)
