"""A posterior samples, goes to ArviZ, and comes back from disk as it was."""

import jax
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference import PointMass, Posterior, Sampler
from dtprob.inference.storage import from_datatree

KEY = jax.random.key(1)
RANDOM = np.random.default_rng(0)


def posterior():
    gain = RANDOM.normal(size=(2, 50, 3, 4)) + 1j * RANDOM.normal(size=(2, 50, 3, 4))
    return Posterior(
        draws={
            "level": RANDOM.normal(size=(2, 50)),
            "object_displacement[building_2].offset": RANDOM.normal(size=(2, 50, 3)),
            "phase": RANDOM.uniform(-3, 3, (2, 50, 1, 4)),
            "gain": gain,
            "rows": RANDOM.normal(size=(2, 50, 4, 4)),
        },
        sample_stats={"lp": RANDOM.normal(size=(2, 50)), "diverging": RANDOM.uniform(size=(2, 50)) < 0.1},
        log_likelihood={"h": RANDOM.normal(size=(2, 50, 6))},
        observed={"h": RANDOM.normal(size=6) + 1j},
        axes={
            "level": (),
            "object_displacement[building_2].offset": ("direction",),
            "phase": ("snapshot", "path"),
            "gain": ("snapshot", "path"),
            "rows": ("path", "path"),
            "h": ("link",),
        },
        latent=("level", "phase"),
        circular=("phase",),
        coords={"link": np.array([10, 20, 30, 40, 50, 60])},
        extra={"log_evidence": np.asarray(-3.5), "precision": np.eye(2)},
        provenance={"engine": "nuts", "key": ["threefry2x32", 0, 1]},
    )


def test_sample():
    made = posterior()
    drawn = made.sample(KEY, 30)
    assert drawn["gain"].shape == (30, 3, 4)
    assert len(np.unique(drawn["level"])) == 30
    np.testing.assert_array_equal(drawn["level"], made.sample(KEY, 30)["level"])
    assert made.sample(KEY, 500)["phase"].shape == (500, 1, 4)
    index = np.flatnonzero(made.flat("level") == drawn["level"][0])[0]
    np.testing.assert_array_equal(made.flat("gain")[index], drawn["gain"][0])
    with pytest.raises(InputError, match="number of draws"):
        made.sample(KEY, 0)


def test_a_site_without_entries_is_sampled_like_any_other():
    made = Posterior(draws={"level": np.zeros((2, 5)), "empty": np.zeros((2, 5, 0, 3))})
    assert made.flat("empty").shape == (10, 0, 3)
    assert made.sample(KEY, 4)["empty"].shape == (4, 0, 3)


def test_point_mass_is_the_same_kind_of_thing():
    point = PointMass({"x": np.arange(3.0), "s": 2.0})
    assert isinstance(point, Sampler)
    assert isinstance(posterior(), Sampler)
    drawn = point.sample(KEY, 4)
    np.testing.assert_array_equal(drawn["x"], np.tile(np.arange(3.0), (4, 1)))
    np.testing.assert_array_equal(drawn["s"], np.full(4, 2.0))


def test_draws_must_share_a_layout():
    with pytest.raises(InputError, match="one common number of chains and draws"):
        Posterior(draws={"a": np.zeros((2, 5)), "b": np.zeros((5, 2))})


def test_save_and_load_give_the_same(tmp_path):
    made = posterior()
    made.save(tmp_path / "p.nc")
    back = Posterior.load(tmp_path / "p.nc")
    for group in ("draws", "sample_stats", "log_likelihood", "observed", "extra", "coords"):
        before, after = getattr(made, group), getattr(back, group)
        assert set(before) == set(after)
        for name, value in before.items():
            assert after[name].dtype == value.dtype
            np.testing.assert_array_equal(after[name], value)
    assert (back.axes, back.circular, back.latent) == (made.axes, made.circular, made.latent)
    assert back.provenance == made.provenance


def test_names_with_slashes_come_back_from_disk(tmp_path):
    """As `numpyro.handlers.scope` makes them."""
    made = Posterior(
        draws={
            "room/gain": RANDOM.normal(size=(2, 5, 3)) + 1j,
            "room/level": RANDOM.normal(size=(2, 5)),
            "room.level": RANDOM.normal(size=(2, 5, 2)),
        },
        log_likelihood={"room/h": RANDOM.normal(size=(2, 5, 3))},
        axes={"room/gain": ("room/path",), "room/h": ("room/path",)},
        latent=("room/gain", "room/level"),
        coords={"room/path": np.arange(3) + 7},
        extra={"mode.room/level": np.asarray(1.0)},
    )
    made.save(tmp_path / "p.nc")
    back = Posterior.load(tmp_path / "p.nc")
    assert (back.latent, back.axes) == (made.latent, made.axes)
    for kind in ("draws", "log_likelihood", "coords", "extra"):
        expected, found = getattr(made, kind), getattr(back, kind)
        assert set(found) == set(expected)
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)


def test_dimensions_are_named_and_kept_apart():
    dims = {name: v.dims for name, v in posterior().to_datatree()["posterior"].data_vars.items()}
    assert dims["level"] == ("chain", "draw")
    assert dims["gain.real"] == dims["gain.imag"] == ("chain", "draw", "snapshot", "path")
    assert dims["phase"] == ("chain", "draw", "snapshot.1", "path")
    assert dims["rows"] == ("chain", "draw", "path", "path.2")


@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto:UserWarning")
def test_arviz_takes_the_tree():
    import arviz as az

    tree = posterior().to_datatree()
    assert "gain.real" in az.rhat(tree).data_vars
    assert float(az.ess(tree)["level"]) > 10
    table = az.summary(tree, var_names=["level", "phase"])
    assert len(table) == 5
    assert np.isfinite(az.loo(tree).elpd)
    assert tree["posterior"]["phase"].sel({"snapshot.1": 0, "path": 3}).shape == (2, 50)


@pytest.mark.filterwarnings("ignore:Matplotlib is building the font cache:UserWarning")
def test_arviz_plots_sites_with_axes():
    """Ranks are plotted by the values of the axes."""
    import arviz as az

    az.plot_rank(posterior().to_datatree(), var_names=["phase"], backend="none")


def test_an_axis_may_be_called_as_a_site_is():
    draws = {"path": RANDOM.normal(size=(2, 5)), "gain": RANDOM.normal(size=(2, 5, 3))}
    tree = Posterior(draws=draws, axes={"gain": ("path",)}, latent=("path", "gain")).to_datatree()
    assert tree["posterior"]["gain"].dims == ("chain", "draw", "path")


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "p.nc"
    posterior().save(path)
    before = path.read_bytes()
    monkeypatch.setattr("xarray.DataTree.to_netcdf", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        posterior().save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["p.nc"]


def test_what_is_no_posterior_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected an existing file, got none"):
        Posterior.load(tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("hello")
    with pytest.raises(InputError, match="expected NetCDF"):
        Posterior.load(tmp_path / "text.nc")
    tree = posterior().to_datatree()
    tree.attrs["format"] = "dtprob posterior 99"
    with pytest.raises(InputError, match="expected format 'dtprob posterior 1'"):
        from_datatree(tree)


def test_it_shows_itself_in_one_line():
    shown = repr(posterior())
    assert shown == "Posterior(nuts: 2 chains of 50; level (), phase (1, 4))"
