"""The predictor as a twin: its posterior in closed form, and the way in which it errs is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data import Labels
from dtprob.effects import catalogue
from dtprob.effects.effect import FIELD
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace, fit
from dtprob.models.declaration import declare
from dtprob.models.label_twin import label_twin, labelled_rows
from dtprob.testing import check_effect, check_model
from dtprob.workflow.prepare import prepare

SETTINGS = Settings(replicates=200, site_replicates=39, candidates=4, max_effects=2)


def rows(n=300, error=0.3, seed=0, wrong=None):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (n, 3))
    truth = np.sin(3 * x[:, 0]) + x[:, 1]
    prediction = truth if wrong is None else wrong(truth, x, rng)
    return {
        "x": jnp.asarray(x),
        "prediction": jnp.asarray(prediction),
        "y": truth + error * rng.normal(size=n),
    }


def test_model_and_effects_keep_their_contracts():
    data = rows(n=40)
    check_model(label_twin, data)
    effects = catalogue(declare(label_twin, data).sites, data)
    assert {e.family for e in effects} == {"regional_bias", "scale_bias", "label_noise", "stale_map"}
    for effect in effects:
        check_effect(effect, label_twin, data)


def test_a_stretched_label_is_what_it_is_whatever_is_asked_beside_it():
    data = rows(n=40)
    effect = next(e for e in catalogue(declare(label_twin, data).sites, data) if e.family == "scale_bias")
    stretch, size = effect.rewrites["predicted_label"], {"log_scale": 0.3, "offset": 0.1}
    middle = data["prediction"].mean()
    found = stretch(data["prediction"][:10], size, {})
    np.testing.assert_allclose(found, middle + (data["prediction"][:10] - middle) * np.exp(0.3) + 0.1)


@pytest.mark.parametrize("n", [30, 400])
def test_an_old_map_errs_alike_nearby(n):
    data = rows(n=n)
    effect = next(e for e in catalogue(declare(label_twin, data).sites, data) if e.family == "stale_map")
    size = effect.field_shape(data["prediction"], data)[1]

    def shift(field):
        moved = effect.rewrites["predicted_label"](data["prediction"], {"scale": 2.0, FIELD: field}, data)
        return moved - data["prediction"]

    weights = np.asarray(jax.jacobian(shift)(jnp.zeros((1, size))))[:, 0] / 2
    place = np.asarray(data["x"])[:, :2] / np.asarray(data["x"])[:, :2].std(0)
    wanted = np.exp(-np.linalg.norm(place[:, None] - place[None], axis=-1))
    found = weights @ weights.T
    exact = np.isclose(np.diag(found), 1.0, atol=1e-4)  # the points themselves
    assert exact.sum() >= min(n, 64)
    np.testing.assert_allclose(found[exact][:, exact], wanted[exact][:, exact], atol=1e-3)
    assert np.mean(np.abs(found - wanted)) < 0.03


def test_the_error_is_the_root_mean_square():
    data = rows()
    draws = fit(label_twin, data, engine="laplace", key=jax.random.key(0), draws=2000).draws[
        "error_deviation"
    ]
    rms = np.sqrt(np.mean((data["y"] - np.asarray(data["prediction"])) ** 2))
    assert np.mean(draws) == pytest.approx(rms, rel=0.01)
    assert np.std(draws) == pytest.approx(rms / np.sqrt(600), rel=0.1)


WRONG = {
    "regional_bias[x2_high]": lambda truth, x, _: truth - 0.5 * (x[:, 2] > 1 / 3),
    "scale_bias": lambda truth, _x, _rng: 0.6 * truth + 0.3,  # right at another level than the mean one
    "stale_map": lambda truth, x, rng: (
        truth + 0.5 * rng.normal(size=(4, 4))[tuple(np.floor(2 * x[:, :2] + 2).astype(int).T)]
    ),
}


@pytest.mark.study
@pytest.mark.parametrize("name", WRONG)
def test_how_the_predictor_errs_is_named(name):
    data = rows(wrong=WRONG[name])
    effects = catalogue(declare(label_twin, data).sites, data)
    found = diagnose(
        label_twin, data, effects, key=jax.random.key(1), engine=Laplace(draws=200), settings=SETTINGS
    )
    assert found.causes[0].effects == (name,)
    assert found.causes[0].closed_fraction.mean > 0.5


@pytest.mark.study
def test_a_map_out_of_date_does_not_stand_in_for_a_wrong_slope():
    """A field over places can follow a slope that the candidates lack; one curve of the prediction does so better."""
    data = rows(wrong=WRONG["scale_bias"])
    offered = catalogue(declare(label_twin, data).sites, data)
    effects = [e for e in offered if e.family != "scale_bias"]
    found = diagnose(
        label_twin, data, effects, key=jax.random.key(1), engine=Laplace(draws=200), settings=SETTINGS
    )
    assert found.verdict == "UNLISTED"
    assert found.sections["unlisted"]["sites"][0] == "predicted_label"


@pytest.mark.study
@pytest.mark.parametrize("family", ["regional_bias", "label_noise"])
def test_a_region_is_found_whose_edge_is_not_at_a_third(family):
    """Were the edge fixed, the labels between it and the third would look like an effect of its own."""
    data = rows(n=600, error=0.3)
    beyond = np.asarray(data["x"])[:, 2] > 0.2
    rng = np.random.default_rng(8)
    y = data["y"] + beyond * (0.9 * rng.normal(size=600) if family == "label_noise" else 0.5)
    data = {**data, "y": y}
    effects = catalogue(declare(label_twin, data).sites, data)
    found = diagnose(
        label_twin, data, effects, key=jax.random.key(1), engine=Laplace(draws=200), settings=SETTINGS
    )
    assert found.verdict == "LISTED"
    assert found.causes[0].effects == (f"{family}[x2_high]",)
    edge = next(size for size in found.causes[0].size if size.name == "from_quantile")
    assert edge.mean == pytest.approx(np.mean(~beyond), abs=0.015)


def test_regions_of_few_values_or_skewed_features_are_whole():
    """Weight 1 inside and 0 outside, but for a few samples at edges that may move."""
    rng = np.random.default_rng(3)
    x = np.stack(
        [
            rng.integers(1, 13, 600),
            np.where(rng.uniform(size=600) < 0.7, 0.0, rng.normal(size=600)),
            rng.lognormal(0, 3, 600),
            np.repeat(rng.uniform(size=100), 6),
        ],
        axis=1,
    )
    data = {"x": jnp.asarray(x), "prediction": jnp.asarray(rng.normal(size=600))}
    effects = catalogue(
        declare(label_twin, {**data, "y": data["prediction"]}).sites, data, use="regional_bias"
    )
    regions = [e for e in effects if (e.instance or "").endswith(("low", "middle", "high"))]
    assert {e.instance for e in regions if len(e.parameters) > 1} == {
        f"{feature}_{place}" for feature in ("x2", "x3") for place in ("low", "middle", "high")
    }
    for effect in regions:
        parameters = {**effect.null(), "bias": 1.0}
        moved = effect.rewrites["predicted_label"](data["prediction"], parameters, data) - data["prediction"]
        assert np.mean((np.asarray(moved) > 0.02) & (np.asarray(moved) < 0.98)) < 0.2
        assert np.max(moved) == pytest.approx(1.0, abs=0.01)


@pytest.mark.study
def test_a_predictor_without_bias_has_no_gap():
    data = rows(seed=5)
    effects = catalogue(declare(label_twin, data).sites, data)
    found = diagnose(
        label_twin, data, effects, key=jax.random.key(1), engine=Laplace(draws=200), settings=SETTINGS
    )
    assert found.verdict == "NO_GAP"


def test_maps_of_whole_decibels_are_numbers_like_others():
    """Else no effect could move them by less than one."""
    prediction, rng = np.arange(-90, -60), np.random.default_rng(0)
    data = {"x": np.zeros((30, 1)), "y": jnp.asarray(prediction + rng.normal(size=30))}
    whole, real = (
        Problem(label_twin, data | {"prediction": jnp.asarray(kind)}, [])
        for kind in (prediction, prediction.astype(float))
    )
    x = whole.prior_spread.middle
    shift = {"predicted_label": jnp.full((1, 30), 0.3)}
    np.testing.assert_allclose(x, real.prior_spread.middle)
    np.testing.assert_array_equal(*(np.asarray(one.compiled.shifted(x, shift, 1)) for one in (whole, real)))


def test_labelled_rows():
    x, y = np.arange(6.0).reshape(3, 2), np.array([1.0, np.nan, 3.0])
    data = Labels(x=x, y=np.nan_to_num(y), labelled=np.array([1, 0, 1]), prediction=np.array([1.0, 2.0, 2.5]))
    taken = labelled_rows(data)
    np.testing.assert_array_equal(taken["y"], [1.0, 3.0])
    np.testing.assert_array_equal(taken["x"], x[[0, 2]])
    without = Labels(x=x, y=np.nan_to_num(y), labelled=np.array([1, 0, 1]))
    with pytest.raises(InputError, match="expected a prediction of each row, got none"):
        labelled_rows(without)


def test_a_case(tmp_path):
    data = {name: np.asarray(value) for name, value in rows(n=60).items()}
    data["y"] = np.where(np.arange(60) < 40, data["y"], np.nan)
    np.savez(tmp_path / "labels.npz", **data)
    text = '[model]\nname = "label_twin"\n[data]\nfile = "labels.npz"\n[engine]\nname = "laplace"\n'
    (tmp_path / "case.toml").write_text(text)
    job = prepare(load_case(tmp_path / "case.toml"), need="diagnosis")
    assert job.data["y"].shape == (40,)
    assert "regional_bias[x2_high]" in {effect.name for effect in job.effects}


@pytest.mark.study
def test_several_effects_do_not_stand_in_for_a_floor():
    """Readings below a floor come out at it: regions together follow that, one curve of the prediction better."""
    data = rows(n=240)
    data = data | {
        "y": np.maximum(np.asarray(data["prediction"]), -0.3)
        + 0.3 * np.random.default_rng(4).normal(size=240)
    }
    effects = catalogue(declare(label_twin, data).sites, data)
    found = diagnose(label_twin, data, effects, key=jax.random.key(1), engine=Laplace(draws=200))
    assert found.verdict == "UNLISTED"
    assert "predicted_label" in found.sections["unlisted"]["sites"]
