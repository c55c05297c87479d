"""Which effects are offered for which model and data, and how they are chosen."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import FAMILIES, Context, Effect, Parameter, catalogue, meaning, summaries, with_effects
from dtprob.errors import InputError
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import Site, declare, model
from dtprob.models.scene import AXES

USER = Effect(
    "mine", {"path_gain": lambda value, p, _: value * (1 + p["a"])}, (Parameter("a", dist.Normal()),)
)


def families(world):
    return {effect.family for effect in catalogue(world.sites, world.data)}


def test_every_family_says_what_it_is():
    lines = summaries()
    assert set(lines) == set(FAMILIES)
    assert all(line.endswith(".") and len(line) < 110 for line in lines.values())


def test_names_are_unique(world):
    names = [effect.name for effect in catalogue(world.sites, world.data)]
    assert len(set(names)) == len(names) > 130


def test_without_time_nothing_moves(build_world):
    offered = families(build_world(snapshot_time=None))
    assert not offered & {
        *(
            "doppler",
            "carrier_frequency_offset",
            "carrier_phase_drift",
            "sampling_clock_offset",
            "gain_drift",
        ),
    }
    assert "phase_noise" in offered


def test_single_antennas_have_no_array(build_world):
    world = build_world(rx_array=None, tx_array=None)
    offered = families(world)
    assert not offered & {
        *("array_calibration", "cable_delay", "mutual_coupling", "element_spacing", "antenna_orientation"),
        *("near_field", "angular_spread"),
    }
    assert "antenna_pattern" in offered
    assert [e.instance for e in catalogue(world.sites, world.data, "iq_imbalance")] == [None, "one_branch"]


def test_two_antennas_are_calibrated_once(build_world, world):
    pair = build_world(tx_array=world.data["tx_array"][:2])
    names = [e.name for e in catalogue(pair.sites, pair.data, ["array_calibration", "cable_delay"])]
    assert [name for name in names if "tx" in name] == ["array_calibration[tx]", "cable_delay[tx_1]"]


def test_effects_take_sites_for_what_the_models_mean_by_them():
    assert {name: axes for name, axes in AXES.items() if meaning._AXES.get(name, axes) != axes} == {}
    assert AXES.keys() - meaning._AXES.keys() == {"path_response"}  # which no effect rewrites


@numpyro.handlers.seed(rng_seed=0)
def _in_decibels(paths=None):
    numpyro.deterministic("path_gain", jnp.zeros((4, 5)))
    numpyro.deterministic("predicted_label", jnp.zeros(4))
    numpyro.deterministic("noiseless_channel", jnp.zeros((4, 5), complex))
    numpyro.sample("y", dist.Normal(jnp.zeros(4), 1.0), obs=jnp.zeros(4))


@pytest.mark.parametrize(
    "axes", [{"path_gain": ("link", "reading")}, {"path_gain": ("link", "path")}], ids=["readings", "real"]
)
def test_sites_that_mean_something_else_by_the_same_name_are_left_alone(axes):
    """A gain in dB of readings is no amplitude of paths; labels without predictions and features are no labels."""
    axes |= {"predicted_label": ("sample",)}
    declared = declare(model(axes=axes)(_in_decibels), {})
    assert catalogue(declared.sites, {"channel": np.ones((4, 5), complex)}) == ()


def test_one_subcarrier_has_no_band(build_world, world):
    offered = families(build_world(subcarrier_frequency=world.data["subcarrier_frequency"][:1]))
    assert not offered & {
        *("timing_offset", "frequency_response", "frequency_ripple", "iq_imbalance", "colored_noise"),
        *("cable_delay", "estimator_smoothing"),
    }
    assert {"carrier_phase", "amplifier_nonlinearity", "diffuse_scattering"} <= offered


def test_a_band_beside_the_carrier_has_no_mirror(build_world, world):
    shifted = build_world(subcarrier_frequency=world.data["subcarrier_frequency"] + 1e8)
    assert "iq_imbalance" not in families(shifted)
    assert [e.instance for e in catalogue(shifted.sites, shifted.data, "crosstalk")] == [None]


def test_packets_of_arbitrary_phase_have_no_common_one(world):
    data = {**world.data, "phase": "per_packet"}
    offered = {effect.family for effect in catalogue(world.sites, data)}
    assert not offered & {"carrier_phase", "phase_noise", "carrier_phase_drift", "carrier_frequency_offset"}
    assert {"phase_error", "timing_offset", "doppler"} <= offered


def test_known_noise_can_be_wrong_unknown_noise_cannot(build_world):
    assert "noise_level" not in families(build_world(noise_power=None))


def test_path_phases_of_the_model_are_no_effect(world):
    angle = Site(
        "z", "latent", (3, 1, 7), ("link", "snapshot", "path"), (), support=dist.constraints.circular
    )
    offered = {effect.family for effect in catalogue({**world.sites, "z": angle}, world.data)}
    assert "phase_error" not in offered


def test_powers_alone_offer_no_phases(world):
    names = ("permittivity", "conductivity", "path_share", "path_gain", "departure", "arrival")
    sites = {n: world.sites[n] for n in names}
    effects = catalogue(sites, world.data)
    offered = {effect.family for effect in effects}
    assert offered == {
        *("material_mismatch", "reflection_loss", "rough_surface", "penetration", "polarization_mismatch"),
        *("missing_path", "blockage", "shadowing", "path_gain_error", "atmospheric_attenuation"),
        *(
            "path_loss_exponent",
            "antenna_pattern",
            "missing_object",
            "depth_cut_off",
            "refraction_off",
            "wall_law",
        ),
    }
    assert all(p.name != "phase" for effect in effects for p in effect.parameters)


def test_other_models_get_nothing_they_cannot_use():
    def coin(y=None):
        numpyro.sample("y", dist.Bernoulli(logits=numpyro.deterministic("logit", 0.3)), obs=y)

    assert catalogue(declare(coin, {"y": 1}).sites, {"y": 1}) == ()


def test_choosing_by_name(world):
    def chosen(use):
        return [effect.name for effect in catalogue(world.sites, world.data, use)]

    assert chosen("timing_offset") == ["timing_offset", "timing_offset[each_packet]"]
    assert chosen(["doppler[floor]", "gain_offset", USER]) == ["doppler[floor]", "gain_offset", "mine"]
    assert chosen([]) == []


@pytest.mark.parametrize(
    ("use", "message"),
    [
        ("timing_ofset", "Did you mean 'timing_offset'"),
        ("doppler[flor]", r"Did you mean 'doppler\[floor\]'"),
        (["gain_offset", "gain_offset"], "gain_offset twice"),
        (
            [Effect("bad", {"tau": USER.rewrites["path_gain"]}, USER.parameters)],
            "effect bad: expected a site among",
        ),
    ],
)
def test_wrong_names_say_what_to_do(world, use, message):
    with pytest.raises(InputError, match=message):
        catalogue(world.sites, world.data, use)


def test_a_family_that_the_data_do_not_allow(build_world):
    world = build_world(snapshot_time=None)
    with pytest.raises(InputError, match="no doppler"):
        catalogue(world.sites, world.data, ["doppler"])


def in_order(first, *late):
    """The sites, some of which the model computes after all others."""
    return {n: s for n, s in first.items() if n not in late} | {n: first[n] for n in late}


@pytest.mark.parametrize(
    ("late", "families"),
    [
        (("noiseless_channel",), {"quantization", "error_vector_magnitude"}),
        (("path_delay",), {"bandwidth_mismatch"}),
        (("frequency_response",), {"extra_path", "diffuse_scattering"}),
    ],
)
def test_what_an_effect_looks_at_comes_before_what_it_rewrites(world, late, families):
    offered = {effect.family for effect in catalogue(in_order(world.sites, *late), world.data)}
    assert families <= {effect.family for effect in catalogue(world.sites, world.data)}
    assert not families & offered
    with pytest.raises(InputError, match="an effect that this model and data allow"):
        catalogue(in_order(world.sites, *late), world.data, min(families))


def test_what_effects_look_at_is_said(world):
    """Every site that a rewrite looks up is among what the effect says that it requires, or can be done without."""
    trace = numpyro.handlers.trace(numpyro.handlers.seed(world.model, 0)).get_trace(**world.data)
    values, looked_at = {n: m["value"] for n, m in trace.items() if n in world.sites}, set()

    class Watched(Context):
        def __getitem__(self, name):
            looked_at.add(name)
            return super().__getitem__(name)

    for effect in catalogue(world.sites, world.data):
        looked_at.clear()
        jax.eval_shape(lambda effect=effect: every_rewrite(effect, values, Watched(world.data, values)))
        optional = {"thickness", "path_gain", "receiver_gain", "receiver_delay"}
        assert looked_at & values.keys() <= {*effect.requires, *optional}, effect.name


def every_rewrite(effect, values, context):
    """The rewritten sites at the null."""
    parameters = effect.null()
    if effect.kind == "variance":
        shape = effect.field_shape or (lambda value, _: value.shape)
        parameters["field"] = jnp.zeros(shape(values[effect.sites[0]], context))
    return [rewrite(values[site], parameters, context) for site, rewrite in effect.rewrites.items()]


PHASES = ("phase_error", "phase_noise", "carrier_phase_drift")


def test_effects_on_phases_need_no_gains(world):
    """A model may turn the paths of a traced channel without a site for their gains."""

    @model(axes={**AXES, "channel": AXES["noiseless_channel"]}, cluster="link")
    def turned(paths, channel=None):
        phase = numpyro.deterministic("path_phase", jnp.zeros((3, 1, 7)))
        turns = jnp.exp(1j * phase)[:, :, None, None]
        gains = jnp.asarray(paths.mask, float)
        summed = jnp.einsum("lsrtp,lp->lsrt", turns, gains)[..., None] * jnp.ones(17)
        noiseless = numpyro.deterministic("noiseless_channel", summed)
        with numpyro.plate("link", 3, dim=-5):
            numpyro.sample("channel", ComplexNormal(noiseless, 1.0), obs=channel)

    def run(snapshot_time, **data):
        return turned(**data)

    data = {"paths": world.data["paths"], "channel": jnp.ones((3, 8, 1, 1, 17), complex)}
    sites = declare(turned, data).sites
    timed = {**data, "snapshot_time": world.data["snapshot_time"]}
    for effect in catalogue(sites, timed, PHASES):
        trace = numpyro.handlers.trace(numpyro.handlers.seed(with_effects(run, [effect]), 0)).get_trace(
            **timed
        )
        snapshots = 1 if effect.name == "phase_error" else 8
        assert trace["path_phase"]["value"].shape == (3, snapshots, 7)
