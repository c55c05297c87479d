"""CASE files: what is right is read as written, what is wrong is named with the remedy."""

import dataclasses
import pickle
from pathlib import Path

import pytest

from dtprob.case import load_case
from dtprob.errors import InputError
from dtprob.usercode import load_object

FULL = """
[model]
name = "phase_error_channel"
[model.options]
materials = "shared"
[data]
file = "channels.npz"
reference = "earlier.npz"
phase = "per_packet"
cluster = "link"
[scene]
file = "simple_street_canyon"
frequency = 6.0e9
max_depth = 2
refraction = true
merge_shapes = false
[effects]
use = ["timing_offset", "gain_offset"]
exclude = ["gain_offset[tx_0]"]
known = ["timing_offset"]
[engine]
name = "nuts"
[engine.options]
draws = 100
[seed]
value = 7
"""

SHORT = '[model]\nname = "multi_access"\n[data]\nfile = "log.csv"\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "case.toml"
    path.write_text(text)
    return path


def test_everything_is_read(tmp_path):
    case = load_case(written(tmp_path, FULL))
    assert case.model.name == "phase_error_channel"
    assert case.model.options == {"materials": "shared"}
    assert case.data.file == tmp_path / "channels.npz"
    assert case.data.reference == tmp_path / "earlier.npz"
    assert (case.data.phase, case.data.cluster) == ("per_packet", "link")
    assert case.scene is not None
    assert (case.scene.file, case.scene.frequency, case.scene.max_depth) == ("simple_street_canyon", 6e9, 2)
    assert (case.scene.refraction, case.scene.diffraction, case.scene.merge_shapes) == (True, False, False)
    assert case.effects.use == ("timing_offset", "gain_offset")
    assert case.effects.exclude == ("gain_offset[tx_0]",)
    assert case.effects.known == ("timing_offset",)
    assert (case.engine.name, case.engine.options, case.seed.value) == ("nuts", {"draws": 100}, 7)
    assert case.user_code == ()
    assert pickle.loads(pickle.dumps(case)) == case


def test_defaults(tmp_path):
    case = load_case(written(tmp_path, SHORT))
    assert case.scene is None
    assert (case.effects.use, case.engine.name, case.seed.value) == ("all", "laplace", 0)
    assert (case.data.reference, case.data.phase, case.data.cluster) == (None, None, None)


def test_effort_of_a_diagnosis_can_be_said(tmp_path):
    from dtprob.gap.settings import Settings

    plain = load_case(written(tmp_path, SHORT)).diagnosis
    assert Settings(**dataclasses.asdict(plain)) == Settings()
    asked = "[diagnosis]\npolished = 0\nmax_effects = 1\ntolerance_db = 20\nrelevance = 0.5\n"
    case = load_case(written(tmp_path, f"{SHORT}{asked}"))
    assert (case.diagnosis.polished, case.diagnosis.max_effects, case.diagnosis.tolerance_db) == (0, 1, 20.0)
    assert case.diagnosis.relevance == 0.5
    with pytest.raises(InputError, match="a number from 0 to 1"):
        load_case(written(tmp_path, f"{SHORT}[diagnosis]\nrelevance = 2\n"))
    with pytest.raises(InputError, match="a whole number from 0"):
        load_case(written(tmp_path, f"{SHORT}[diagnosis]\ncandidates = -1\n"))


def test_what_a_trace_is_checked_with(tmp_path):
    scene = '[scene]\nfile = "munich"\nfrequency = 6e9\nstrongest = 8\ncheck_depth = 4\n'
    found = load_case(written(tmp_path, f"{SHORT}{scene}")).scene
    assert found is not None
    assert (found.strongest, found.check_depth, found.check_refraction) == (8, 4, False)
    with pytest.raises(InputError, match="a whole number from 1"):
        load_case(written(tmp_path, f"{SHORT}{scene}".replace("= 8", "= 0")))


def test_paths_of_scenes_are_relative_to_the_case(tmp_path):
    for name in ("room.xml", "sub/paths.nc"):
        case = load_case(written(tmp_path, f'{SHORT}[scene]\nfile = "{name}"\nfrequency = 6000000000\n'))
        assert case.scene is not None
        assert case.scene.file == str(tmp_path / name)
        assert isinstance(case.scene.frequency, float)


BAD = {
    "section": (
        "[modle]\n",
        r"case\.toml: expected one of the sections .* got 'modle'\. Did you mean 'model'\?",
    ),
    "key": (
        f'{SHORT}[engine]\nnme = "nuts"\n',
        r"case\.toml \[engine\]: expected one of the keys .*'nme'\. Did you mean 'name'\? Settings stand under",
    ),
    "settings beside options": (
        f'{SHORT}[engine]\nname = "nuts"\ndraws = 100\n',
        r"got 'draws'\. Settings stand under \[engine\.options\]\.",
    ),
    "key far from all": (f"{SHORT}[seed]\nqqq = 1\n", r"got 'qqq'\. Use a valid key\."),
    "no model": ('[data]\nfile = "a.npz"\n', r"expected a section \[model\], got none"),
    "no data": ('[model]\nname = "a"\n', r"expected a section \[data\], got none"),
    "no name": ('[model]\n[data]\nfile = "a"\n', r"\[model\]: expected a key 'name', got none"),
    "text": (f"{SHORT}[engine]\nname = 3\n", r"case\.toml \[engine\] name: expected text, got 3"),
    "whole": (f"{SHORT}[seed]\nvalue = 1.5\n", r"\[seed\] value: expected a whole number from 0, got 1\.5"),
    "negative": (f"{SHORT}[seed]\nvalue = -1\n", "expected a whole number from 0, got -1"),
    "too large": (
        f"{SHORT}[seed]\nvalue = {2**63}\n",
        "expected a whole number from 0, got 9223372036854775808",
    ),
    "truth": (f"{SHORT}[seed]\nvalue = true\n", "expected a whole number from 0, got True"),
    "flag": (
        f'{SHORT}[scene]\nfile = "a"\nrefraction = "no"\n',
        r"refraction: expected true or false, got 'no'",
    ),
    "frequency": (
        f'{SHORT}[scene]\nfile = "a"\nfrequency = 0\n',
        "frequency: expected a positive number, got 0",
    ),
    "no frequency": (
        f'{SHORT}[scene]\nfile = "munich"\n',
        r"\[scene\]: expected a key 'frequency', got none",
    ),
    "phase": (
        '[model]\nname = "a"\n[data]\nfile = "a"\nphase = "x"\n',
        r"phase: expected one of coherent, per_packet, none, got 'x'",
    ),
    "use": (
        f"{SHORT}[effects]\nuse = [1]\n",
        r"use: expected 'all', a list of names, or 'module:name', got \[1\]",
    ),
    "exclude": (f'{SHORT}[effects]\nexclude = "a"\n', "exclude: expected a list of names, got 'a'"),
    "section as value": (f'engine = "nuts"\n{SHORT}', r"expected a section \[engine\], got 'nuts'"),
    "options": ('[model]\nname = "a"\noptions = 1\n', "options: expected a table of settings, got 1"),
    "toml": ("[model\n", r"expected a TOML file, got .*line 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_named(tmp_path, case):
    text, message = BAD[case]
    with pytest.raises(InputError, match=message) as caught:
        load_case(written(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml: expected a CASE file \(TOML\), got no such file"):
        load_case(tmp_path / "none.toml")


def test_a_folder_is_answered_with_the_file_inside(tmp_path):
    file = written(tmp_path, SHORT)
    with pytest.raises(InputError, match=rf"got a folder\. Name the file: {file}"):
        load_case(tmp_path)


def test_data_are_no_case(tmp_path):
    (tmp_path / "table.npz").write_bytes(b"PK\x03\xc4\xff")
    with pytest.raises(InputError, match=r"got no text\. Name the TOML file"):
        load_case(tmp_path / "table.npz")


def test_own_module_beside_the_case(tmp_path):
    for folder, value in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own_parts.py").write_text(f"VALUE = {value}\n")
        (tmp_path / folder / "own_model.py").write_text(
            "import own_parts\ndef model(): return own_parts.VALUE\n"
        )
    assert load_object("own_model:model", tmp_path / "a")() == 1
    assert load_object("own_parts:VALUE", tmp_path / "b") == 2
    assert load_object("json:dumps", tmp_path / "a")([1]) == "[1]"


def test_own_module_is_imported_without_a_trace_on_the_path(tmp_path):
    import sys

    before = list(sys.path)
    (tmp_path / "own_other.py").write_text("model = print\n")
    load_object("own_other:model", tmp_path)
    assert sys.path == before


def test_mistakes_in_own_modules_are_named(tmp_path):
    (tmp_path / "own_broken.py").write_text("1 / 0\n")
    (tmp_path / "own_named.py").write_text("def my_model(): ...\n")
    (tmp_path / "own_leaving.py").write_text("import sys\nsys.exit('no data.')\n")
    for name, message in {
        "own_absent:model": r"module own_absent: expected a module beside the CASE file \(own_absent\.py\)",
        "own_broken:model": "expected a module that runs, got ZeroDivisionError: division by zero",
        "own_leaving:model": "expected a module that runs, got SystemExit: no data. Correct",
        "own_named.py:model": r"Name the module without \.py: 'own_named:\.\.\.'",
        "own_named:mymodel": r"got 'mymodel'\. Did you mean 'my_model'\?",
        "own_named:": "expected 'package.module:function'",
        "../own_named:my_model": "expected 'package.module:function'",
    }.items():
        with pytest.raises(InputError, match=message):
            load_object(name, tmp_path)


def test_a_file_that_cannot_be_looked_at(tmp_path):
    with pytest.raises(InputError, match=r"expected a CASE file \(TOML\), got File name too long"):
        load_case(tmp_path / f"{'a' * 300}.toml")


def test_what_own_modules_import_is_from_beside_the_same_case(tmp_path):
    """In a process that meets one case after the other."""
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "own_model_here.py").write_text("from own_helper_here import NAME\n")
        (folder / "own_helper_here.py").write_text(f"NAME = {name!r}\n")
        assert load_object("own_model_here:NAME", folder) == name


def test_a_case_may_begin_with_a_mark_of_its_encoding_and_is_utf_8(tmp_path):
    text = '# Straße\n[model]\nname = "a:b"\n[data]\nfile = "t.csv"\n'
    for encoding in ("utf-8", "utf-8-sig"):
        (tmp_path / "case.toml").write_text(text, encoding=encoding)
        assert load_case(tmp_path / "case.toml").model.name == "a:b"
    for encoding in ("cp1252", "utf-16"):
        (tmp_path / "case.toml").write_text(text, encoding=encoding)
        with pytest.raises(InputError, match=r"in UTF-8, got another encoding .* Save it as UTF-8"):
            load_case(tmp_path / "case.toml")
