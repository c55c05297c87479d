"""Path sets on disk."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from dtprob.errors import InputError
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.storage import load, save

READ = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.storage import load
paths = load(sys.argv[1])
print(repr(complex(path_gain(paths, paths.permittivity, paths.conductivity)[0, 0])))
loaded = {"sionna", "mitsuba", "drjit"} & set(sys.modules)
sys.exit(f"{loaded} imported" if loaded else 0)
"""


@pytest.fixture
def stored(box, tmp_path):
    save(box, tmp_path / "paths.nc")
    return tmp_path / "paths.nc"


def test_round_trip(box, stored):
    again = load(stored)
    assert jax.tree.structure(again) == jax.tree.structure(box)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(box), strict=True):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)


def test_complex_fields_and_what_need_not_be_there(box, tmp_path):
    middle = jnp.arange(21.0).reshape(7, 3)
    scattering = jnp.full(7, 0.3)
    other = dataclasses.replace(
        box, tx_field=box.tx_field * (1 + 2j), scattering=scattering, object_center=middle
    )
    save(other, tmp_path / "p.nc")
    again = load(tmp_path / "p.nc")
    assert np.array_equal(again.tx_field, other.tx_field)
    assert np.array_equal(again.scattering, other.scattering)
    assert np.array_equal(again.object_center, middle)


def test_readable_without_the_ray_tracer(box, stored):
    done = subprocess.run([sys.executable, "-c", READ, stored], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    here = complex(path_gain(box, box.permittivity, box.conductivity)[0, 0])
    assert complex(done.stdout) == pytest.approx(here, rel=1e-12)


def test_no_object_of_python_inside(stored):
    with xr.open_dataset(stored, engine="h5netcdf") as data:
        assert data.attrs["format"] == "dtprob.paths"
        assert data["object_name"].dtype.kind in "OUT"
        assert all(variable.dtype.kind in "fiu" for name, variable in data.items() if "name" not in name)


def test_an_invalid_set_leaves_the_old_file(box, stored):
    before = stored.read_bytes()
    with pytest.raises(InputError):
        save(dataclasses.replace(box, length=jnp.full_like(box.length, jnp.nan)), stored)
    assert stored.read_bytes() == before
    assert [file.name for file in stored.parent.iterdir()] == ["paths.nc"]


def test_what_is_no_path_set(stored, tmp_path):
    text, other, later, short = (tmp_path / f"{name}.nc" for name in ("text", "other", "later", "short"))
    text.write_text("not a file of this kind")
    xr.Dataset({"x": 1.0}).to_netcdf(other, engine="h5netcdf")
    with xr.open_dataset(stored, engine="h5netcdf") as data:
        data.load().assign_attrs(format_version=99).to_netcdf(later, engine="h5netcdf")
        data.load().drop_vars("delay").to_netcdf(short, engine="h5netcdf")
    cases = {
        text: "a NetCDF file",
        other: "format 'dtprob.paths', got format 'none'",
        later: "format_version 1, got format_version 99",
        short: "an array 'delay'",
        tmp_path / "absent.nc": "no such file",
    }
    for file, message in cases.items():
        with pytest.raises(InputError, match=message):
            load(file)


@pytest.mark.parametrize(
    ("lost", "attributes", "message"),
    [
        ("object_name", {}, "'object_name', got none"),
        ("material_name", {}, "'material_name', got none"),
        ("frequency", {}, "'frequency', got none"),
        ("provenance", {}, "'provenance', got none"),
        ("", {"frequency": "6 GHz"}, "a frequency in Hz, and"),
        ("", {"provenance": "{"}, "provenance in JSON"),
    ],
)
def test_a_set_that_lacks_what_describes_it_is_named(stored, tmp_path, lost, attributes, message):
    with xr.open_dataset(stored, engine="h5netcdf") as opened:
        data = opened.load().drop_vars([lost], errors="ignore").assign_attrs(attributes)
    data.attrs.pop(lost, None)
    data.to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=message):
        load(tmp_path / "other.nc")
