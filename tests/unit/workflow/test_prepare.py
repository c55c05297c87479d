"""From a CASE to model, data and effects: what binds to what, and what is refused."""

import re
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from numpyro.infer.util import log_density

from dtprob.case import SceneSection, load_case
from dtprob.data import ChannelData, read, write
from dtprob.effects.rewriting import effects_of
from dtprob.errors import InputError
from dtprob.raytracing import storage
from dtprob.workflow import prepare
from dtprob.workflow.scene import scene_files

DEMO = Path(__file__).parents[3] / "dtprob" / "data" / "demo"


@pytest.fixture
def folder(tmp_path) -> Path:
    """The first links of the recorded case."""
    data = read(DEMO / "channels.npz")
    assert isinstance(data, ChannelData)
    arrays = data.arrays()
    for name in ("channel", "rx_position", "tx_position"):
        arrays[name] = arrays[name][:5]
    write(tmp_path / "channels.npz", ChannelData(**arrays))
    storage.save(storage.load(DEMO / "paths.nc").take(np.arange(5)), tmp_path / "paths.nc")
    text = re.sub(r"^use = .*$", 'use = "all"', (DEMO / "case.toml").read_text(), flags=re.MULTILINE)
    (tmp_path / "case.toml").write_text(text)
    return tmp_path


def change(folder: Path, old: str, new: str) -> Path:
    path = folder / "case.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def test_arguments_of_a_ray_traced_model(folder):
    prepared = prepare(load_case(folder / "case.toml"), need="fit")
    assert prepared.model.__name__ == "ray_traced_channel"
    assert prepared.data["channel"].shape[0] == prepared.data["paths"].n_link == 5
    assert jnp.iscomplexobj(prepared.data["channel"])
    assert prepared.data["phase"] == "coherent"
    assert "rx_position" not in prepared.data
    assert prepared.effects == ()
    assert prepared.engine.name == "laplace"
    assert len(prepared.data_sha256) == 64


def test_a_model_on_statistics_of_the_data(folder):
    whole = prepare(load_case(folder / "case.toml"), need="fit")
    short = prepare(load_case(change(folder, "ray_traced_channel", "compressed_channel")), need="diagnosis")
    assert short.data["phase"] == "coherent"
    assert "channel" not in short.data
    assert "timing_offset" not in {effect.family for effect in short.effects}  # there is no delay to act on
    assert "material_mismatch" in {effect.family for effect in short.effects}
    differences = []
    for seed in range(2):
        trace = handlers.trace(handlers.seed(whole.model, seed)).get_trace(**whole.data)
        values = {n: m["value"] for n, m in trace.items() if m["type"] == "sample" and not m["is_observed"]}
        densities = [float(log_density(p.model, (), dict(p.data), values)[0]) for p in (whole, short)]
        differences.append(densities[0] - densities[1])
        scale = abs(densities[0])
    assert differences[0] == pytest.approx(differences[1], abs=1e-5 * scale)


def test_effects_by_name_and_without_some(folder):
    change(folder, 'use = "all"', 'use = ["timing_offset", "gain_offset"]\nexclude = ["gain_offset"]')
    prepared = prepare(load_case(folder / "case.toml"), need="diagnosis")
    assert {effect.family for effect in prepared.effects} == {"timing_offset"}


def test_families_that_nothing_allows_are_left_out_of_a_list_with_a_note(folder):
    change(folder, 'use = "all"', 'use = ["timing_offset", "arrival_rate_shift", "stale_map"]')
    told: list[str] = []
    prepared = prepare(load_case(folder / "case.toml"), need="diagnosis", say=told.append)
    assert {effect.family for effect in prepared.effects} == {"timing_offset"}
    [note] = [line for line in told if line.startswith("note")]
    assert note.endswith("arrival_rate_shift, stale_map")


@pytest.mark.parametrize("use", ['["arrival_rate_shift", "stale_map"]', '["timing_offset", "stale_mop"]'])
def test_a_list_of_which_nothing_is_allowed_and_an_unknown_name_are_refused(folder, use):
    change(folder, 'use = "all"', f"use = {use}")
    with pytest.raises(InputError, match="effect"):
        prepare(load_case(folder / "case.toml"), need="diagnosis")


@pytest.mark.parametrize("need", ["fit", "diagnosis"])
def test_an_unknown_effect_is_refused_before_the_data_are_read(folder, need):
    change(folder, 'use = "all"', 'use = ["timing_offset", "gain_ofset"]')
    told: list[str] = []
    with pytest.raises(InputError, match=r"case.toml \[effects\] use.*gain_offset"):
        prepare(load_case(folder / "case.toml"), need=need, say=told.append)
    assert not told


@pytest.mark.parametrize("need", ["fit", "diagnosis"])
def test_known_effects_are_unknowns_of_the_model_and_no_candidates(folder, need):
    change(folder, 'use = "all"', 'use = ["timing_offset", "gain_offset"]\nknown = ["timing_offset"]')
    prepared = prepare(load_case(folder / "case.toml"), need=need)
    assert [effect.name for effect in effects_of(prepared.model)] == ["timing_offset"]
    assert "timing_offset" not in {effect.name for effect in prepared.effects}
    trace = handlers.trace(handlers.seed(prepared.model, 0)).get_trace(**prepared.data)
    assert trace["timing_offset.delay"]["type"] == "sample"


@pytest.mark.parametrize(
    ("name", "got"),
    [
        ("object_displacement", "one effect"),
        ("phase_error", "random field"),
        ("blockage[pole]", "anywhere"),
        ("timing", "effect families"),
    ],
)
def test_what_cannot_be_known_is_refused(folder, name, got):
    change(folder, 'use = "all"', f'use = "all"\nknown = ["{name}"]')
    with pytest.raises(InputError, match=got):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_options_and_phase_reach_the_model(folder):
    change(folder, "[data]", '[model.options]\nmaterials = "shared"\n[data]')
    change(folder, 'phase = "coherent"', 'phase = "per_packet"')
    data = prepare(load_case(folder / "case.toml"), need="fit").data
    assert (data["materials"], data["phase"]) == ("shared", "per_packet")


def tracing(folder, monkeypatch):
    """The scenes that are traced, all of which have the paths of the folder."""
    from dtprob.workflow import scene

    traced = []

    def fake_trace(section, data, say):
        traced.append(section.file)
        return storage.load(folder / "paths.nc")

    monkeypatch.setattr(scene, "_trace", fake_trace)
    return traced


def test_traced_paths_are_kept_for_the_next_run(folder, monkeypatch):
    change(folder, 'file = "paths.nc"', 'file = "simple_street_canyon"')
    traced = tracing(folder, monkeypatch)
    case = load_case(folder / "case.toml")
    first = prepare(case, need="fit", cache=folder / "out")
    second = prepare(case, need="fit", cache=folder / "out")
    assert traced == ["simple_street_canyon"]
    np.testing.assert_array_equal(first.data["paths"].delay, second.data["paths"].delay)
    change(folder, "merge_shapes = false", "merge_shapes = true")
    prepare(load_case(folder / "case.toml"), need="fit", cache=folder / "out")
    assert len(traced) == 2
    monkeypatch.setattr("dtprob.workflow.scene.edition", lambda: "another state of the code")
    prepare(load_case(folder / "case.toml"), need="fit", cache=folder / "out")
    assert len(traced) == 3


def test_a_scene_is_made_of_all_that_it_names(tmp_path):
    """In whatever order and encoding; a file that was overlooked could change, and its old paths were taken."""
    for name in ("first.ply", "second.ply", "third.ply"):
        (tmp_path / name).write_text("a house")
    shape = '<shape type="ply"><string {}/></shape>'
    first, second, third = (
        shape.format(text)
        for text in (
            'name="filename" value="first.ply"',
            'value="second.ply" name="filename"',
            'name="filename" value="third.ply"',
        )
    )
    (tmp_path / "more.xml").write_text(
        f'<scene version="2.1.0">{third}<include filename="more.xml"/></scene>'
    )
    whole = f'<!-- Straße --><scene version="2.1.0">{first}{second}<include filename="more.xml"/></scene>'
    text = f'<?xml version="1.0" encoding="iso-8859-1"?>{whole}'
    (tmp_path / "street.xml").write_bytes(text.encode("iso-8859-1"))
    found = scene_files(SceneSection(file=str(tmp_path / "street.xml"), frequency=6e9))
    assert {file.name for file in found} == {"street.xml", "first.ply", "second.ply", "more.xml", "third.ply"}
    (tmp_path / "street.xml").write_text("<scene")
    assert len(scene_files(SceneSection(file=str(tmp_path / "street.xml"), frequency=6e9))) == 1


def test_a_scene_whose_mesh_has_changed_is_traced_again(folder, monkeypatch):
    change(folder, 'file = "paths.nc"', 'file = "street.xml"')
    mesh = folder / "meshes" / "house.ply"
    mesh.parent.mkdir()
    mesh.write_text("a house")
    (folder / "street.xml").write_text(
        '<scene version="2.1.0"><shape type="ply"><string name="filename" value="meshes/house.ply"/></shape></scene>'
    )
    traced, said = tracing(folder, monkeypatch), []
    case = load_case(folder / "case.toml")
    first = prepare(case, need="fit", cache=folder / "out")
    assert (
        prepare(case, need="fit", cache=folder / "out", say=said.append).made_of_sha256
        == first.made_of_sha256
    )
    assert len(traced) == 1
    assert any("traced before" in line for line in said)
    mesh.write_text("a house that has moved")
    assert prepare(case, need="fit", cache=folder / "out").made_of_sha256 != first.made_of_sha256
    assert len(traced) == 2


REFUSED = {
    "other model's phase": (
        ('name = "ray_traced_channel"', 'name = "phase_error_channel"'),
        r"\[data\] phase: expected coherent phases, which phase_error_channel assumes, got per_packet",
        ('phase = "coherent"', 'phase = "per_packet"'),
    ),
    "unknown effect": (('use = "all"', 'use = ["timing_ofset"]'), "Did you mean 'timing_offset'", None),
    "data as option": (
        ("[data]", "[model.options]\nchannel = 1\n[data]"),
        "expected one of the options",
        None,
    ),
    "paths are not there": (('file = "paths.nc"', 'file = "path.nc"'), "no such file", None),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(folder, case):
    first, message, second = REFUSED[case]
    change(folder, *first)
    if second:
        change(folder, *second)
    with pytest.raises(InputError, match=message):
        prepare(load_case(folder / "case.toml"), need="diagnosis")


def test_paths_of_other_positions_are_refused(folder):
    storage.save(storage.load(DEMO / "paths.nc").take(np.arange(5, 10)), folder / "paths.nc")
    with pytest.raises(InputError, match=r"to 1 mm, got 5 positions, that of link \d [\d.]+ m away"):
        prepare(load_case(folder / "case.toml"), need="fit")
    storage.save(storage.load(DEMO / "paths.nc").take(np.arange(4)), folder / "paths.nc")
    with pytest.raises(InputError, match="expected the 5 positions of the data, to 1 mm, got 4 positions"):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_frequencies_that_count_from_zero_are_refused(folder):
    arrays = dict(np.load(folder / "channels.npz"))
    carrier = storage.load(folder / "paths.nc").frequency
    np.savez(
        folder / "channels.npz", **arrays | {"subcarrier_frequency": arrays["subcarrier_frequency"] + carrier}
    )
    with pytest.raises(
        InputError, match=r"subcarrier_frequency: expected Hz from the carrier, .*Subtract the carrier"
    ):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_links_that_no_path_reaches(folder):
    """They are named, and left out only if the case asks for it."""
    paths = storage.load(DEMO / "paths.nc").take(np.arange(5))
    empty = eqx.tree_at(lambda p: p.mask, paths, paths.mask & (jnp.arange(5) != 3)[:, None])
    storage.save(empty, folder / "paths.nc")
    with pytest.raises(InputError, match=r"none for links 3\. .*skip_unreached = true"):
        prepare(load_case(folder / "case.toml"), need="fit")
    change(folder, "[scene]", "[scene]\nskip_unreached = true")
    said = []
    whole = ChannelData(**read(folder / "channels.npz").arrays())
    prepared = prepare(load_case(folder / "case.toml"), need="fit", say=said.append)
    assert "leaving out links that no path reaches: 3" in said
    assert prepared.data["paths"].n_link == 4
    np.testing.assert_array_equal(prepared.data["channel"], whole.channel[[0, 1, 2, 4]])


def test_a_ray_traced_model_needs_a_scene(folder):
    text = (folder / "case.toml").read_text()
    start, end = text.index("[scene]"), text.index("[effects]")
    (folder / "case.toml").write_text(text[:start] + text[end:])
    with pytest.raises(InputError, match=r"expected a section \[scene\] for ray_traced_channel, got none"):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_a_scene_beside_a_model_without_paths_is_refused(folder):
    change(folder, 'name = "ray_traced_channel"', 'name = "multi_access"')
    with pytest.raises(InputError, match=r"\[scene\]: expected a model that takes paths.* got multi_access"):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_a_scene_that_was_traced_at_another_carrier_is_refused(folder):
    change(folder, "frequency = 6000000000.0", "frequency = 6000.0")
    with pytest.raises(
        InputError, match=r"\[scene\] frequency: expected 6e\+09 Hz, the carrier of paths.nc, got 6000"
    ):
        prepare(load_case(folder / "case.toml"), need="fit")


def test_settings_that_a_traced_scene_does_without_are_told(folder):
    change(folder, "max_depth = 3", 'max_depth = 9\nrefraction = true\npolarization = "H"')
    said = []
    prepare(load_case(folder / "case.toml"), need="fit", say=said.append)
    note = "note: paths.nc was traced before: [scene] max_depth, refraction, polarization changes nothing"
    assert note in said


@pytest.mark.parametrize(
    ("options", "said"),
    [('materials = "per_objects"', "Did you mean 'per_object'"), ('phase = "Coherent"', "one of")],
)
def test_a_misspelt_option_is_no_other_model(folder, options, said):
    change(folder, "[data]", f"[model.options]\n{options}\n[data]")
    if options.startswith("phase"):
        change(folder, 'phase = "coherent"\n', "")
    prepared = prepare(load_case(folder / "case.toml"), need="fit")
    with pytest.raises(InputError, match=said):
        handlers.seed(prepared.model, 0)(**prepared.data)
