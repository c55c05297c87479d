"""What must hold for each effect on channels; networks, labels and several transmitters have tests of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpyro import handlers

from dtprob.effects import FAMILIES, Rewriting, catalogue, labels, network, with_effects

OTHERS = {*network.FAMILIES, *labels.FAMILIES, "swapped_transmitters"}
# fmt: off
PINNED = {
    "phase_error", "receiver_displacement", "object_displacement", "material_mismatch",
    "missing_path", "blockage", "antenna_orientation", "antenna_pattern", "timing_offset",
    "carrier_frequency_offset", "doppler", "iq_imbalance", "frequency_response",
    "array_calibration", "mutual_coupling", "amplifier_nonlinearity", "interference",
    "colored_noise", "heavy_tailed_noise", "diffuse_scattering", "diffraction",
    "atmospheric_attenuation", "polarization_mismatch", "phase_noise", "gain_offset",
    "element_spacing", "quantization",
}
# fmt: on

NAMES = {
    "polarization_mismatch": ["rx", "tx"],
    "object_displacement": ["east", "slanted", "floor"],
    "material_mismatch": ["east", "slanted", "floor", "partition", "all_concrete", "all_brick"],
    "array_calibration": ["rx", "rx_0", "rx_1", "rx_2", "rx_3", "tx", "tx_0", "tx_1", "tx_2"],
    "missing_path": [
        *("line_of_sight", "reflection", "refraction", "order_1", "order_2", "east", "slanted", "floor"),
    ],
    "doppler": [None, "transmitter", "east", "slanted", "floor"],
    "interference": [*(f"band_{i}" for i in range(8)), *(f"time_{i}" for i in range(8))],
    "timing_offset": [None, "each_packet"],
    "amplifier_nonlinearity": [None, "phase", "wideband"],
}


@pytest.fixture(scope="module")
def effects(world):
    return {effect.name: effect for effect in catalogue(world.sites, world.data)}


def run(world, effect=None, parameters=None, data=None):
    """Values of all deterministic sites, and the log density of the observation."""
    data = world.data if data is None else data
    effects, given = ([], {}) if effect is None else ([effect], {effect.name: parameters})
    with (
        handlers.trace() as trace,
        Rewriting(None, effects, given, data),
        handlers.seed(rng_seed=0),
        handlers.substitute(data={"scale": jnp.asarray(1.05)}),
    ):
        world.model(**data)
    values = {name: m["value"] for name, m in trace.items() if m["type"] == "deterministic"}
    observed = trace["channel"]
    return values, observed["fn"].log_prob(data["channel"])


def field_of(world, effect, base):
    """A fixed standard normal field for a variance effect, nothing for others."""
    if effect.kind == "mean":
        return {}
    shape = effect.shape_of_field(base[effect.sites[0]], {**world.data, **base})
    return {"field": jax.random.normal(jax.random.key(7), shape)}


def pytest_generate_tests(metafunc):
    if "family" in metafunc.fixturenames:
        metafunc.parametrize("family", [name for name in FAMILIES if name not in OTHERS])


@pytest.fixture
def members(effects, family):
    found = [effect for effect in effects.values() if effect.family == family]
    assert found, f"the world offers no {family}"
    return found


@pytest.fixture(scope="module")
def base(world):
    return run(world)


def test_names_are_pinned(effects):
    assert {effect.family for effect in effects.values()} >= PINNED
    assert len({effect.family for effect in effects.values()}) >= 50
    for family, instances in NAMES.items():
        assert [e.instance for e in effects.values() if e.family == family] == instances


def test_is_described(members):
    for effect in members:
        assert len(effect.physics) > 15
        assert effect.physics[-1] == "."
        assert "\n" not in effect.physics
        assert effect.source
        assert all(p.unit for p in effect.parameters)


def test_priors_are_proper_and_hold_the_null(members):
    for effect in members:
        for p in effect.parameters:
            null = effect.null()[p.name]
            assert null.shape == p.shape
            assert np.all(np.isfinite(p.prior.log_prob(null)))
            assert np.all(p.prior.variance > 0)
            draws = p.prior.sample(jax.random.key(0), (200,))
            assert np.all(np.isfinite(draws))
            assert p.is_one_sided == bool(np.all(draws >= p.null))
        assert effect.kind == "mean" or effect.parameters[0].is_one_sided
        assert effect.dimension == sum(int(np.prod(p.shape)) for p in effect.parameters)


def test_null_changes_nothing(world, members, base):
    values, density = base
    for effect in members:
        changed, its_density = run(world, effect, {**effect.null(), **field_of(world, effect, values)})
        for name, value in values.items():
            assert changed[name].dtype == value.dtype
            assert changed[name].ndim == value.ndim
            same = np.broadcast_to(value, changed[name].shape)
            if name in effect.sites:
                assert np.array_equal(changed[name], same), (effect.name, name)
            else:  # what follows from it comes out of another program, which may round differently
                assert np.allclose(changed[name], same, rtol=1e-12, atol=0), (effect.name, name)
        assert np.allclose(its_density, density, rtol=1e-9, atol=0)


def test_only_named_sites_change_at_first_hand(world, members):
    for effect in members:
        assert set(effect.sites) <= set(world.sites)
        assert set(effect.requires) <= set(world.sites) | set(world.data)


def test_derivatives_at_the_null(world, members, base):
    """Forward derivatives agree with finite differences, and no entry of a size is without influence, places have none."""
    for effect in members:
        fixed = field_of(world, effect, base[0])
        null, restore = ravel_pytree(effect.null())
        scale, _ = ravel_pytree({p.name: jnp.sqrt(p.prior.variance) for p in effect.parameters})
        place, _ = ravel_pytree({p.name: jnp.full(p.shape, p.is_place) for p in effect.parameters})

        def at(z, restore=restore, scale=scale, null=null, fixed=fixed):
            return {**restore(null + z * scale), **fixed}

        def outcome(z, effect=effect, at=at):
            values, density = run(world, effect, at(z))
            channel = values["noiseless_channel"] * 1e4
            parts = channel.real, channel.imag, jnp.log(values["noise_power"]), density
            return jnp.concatenate([part.ravel() for part in parts])

        # Forward differences, because some parameters have no negative values.
        flat, step, direction = jnp.zeros(null.size), 1e-4, 1.0 + 0.3 * jnp.arange(null.size)
        zero = np.asarray(outcome(flat))
        columns = np.stack([(outcome(flat + step * row) - zero) / step for row in jnp.eye(flat.size)], axis=1)
        is_place = np.asarray(place, bool)
        size = np.linalg.svd(columns[:, ~is_place], compute_uv=False)
        assert size[-1] > 1e-5 * max(size[0], 1e-2), (effect.name, size)
        assert not columns[:, is_place].any(), effect.name
        one, two = (np.asarray(outcome(flat + k * step * direction)) for k in (1, 2))
        difference = (4 * one - 3 * zero - two) / (2 * step)
        exact = np.asarray(jax.jvp(outcome, (flat,), (direction,))[1])
        assert np.max(np.abs(difference - exact)) < 1e-3 * np.max(np.abs(exact)), effect.name


def test_extension_adds_its_parameters_and_nothing_else(world, members, base):
    for effect in members:
        data = {**world.data, "channel": None}
        seeded = handlers.seed(with_effects(world.model, [effect]), jax.random.key(3))
        plain = handlers.seed(world.model, jax.random.key(3))
        trace, before = handlers.trace(seeded).get_trace(**data), handlers.trace(plain).get_trace(**data)
        added = {f"{effect.name}.{p.name}" for p in effect.parameters}
        if effect.kind == "variance":
            added.add(f"{effect.name}.field")
            shape = effect.shape_of_field(base[0][effect.sites[0]], {**data, **base[0]})
            assert trace[f"{effect.name}.field"]["value"].shape == shape
        assert set(trace) - set(before) == added
        assert trace["channel"]["value"].shape == before["channel"]["value"].shape


def test_links_can_be_taken_apart(world, members, base):
    """Effects need no statistics over links, so a choice of links gives the same."""
    kept = np.array([2, 0, 2])  # as many as before, so that nothing is compiled anew
    part = {**world.data, "paths": world.data["paths"].take(kept), "channel": world.data["channel"][kept]}
    for effect in members:
        parameters = {p.name: p.prior.sample(jax.random.key(1)) for p in effect.parameters}
        fixed = field_of(world, effect, base[0])
        rows = {n: f[kept] if f.shape[0] == 3 else f for n, f in fixed.items()}
        whole = run(world, effect, {**parameters, **fixed})[1][kept]
        taken = run(world, effect, {**parameters, **rows}, part)[1]
        assert np.allclose(whole, taken, rtol=1e-6, atol=1e-6), effect.name


def test_all_together_compile_and_compose(world, effects, base):
    """One compiled program with every effect at a small size; an extension of an extension is one by both."""
    everything = list(effects.values())
    half = len(everything) // 2
    drawn = {"scale": jnp.asarray(1.05)}
    for effect in everything:
        for p in effect.parameters:
            drawn[f"{effect.name}.{p.name}"] = effect.null()[p.name] + 1e-3 * jnp.sqrt(p.prior.variance)
        drawn |= {f"{effect.name}.{n}": f for n, f in field_of(world, effect, base[0]).items()}

    def outcome(model, drawn):
        replaced = handlers.substitute(handlers.seed(model, 0), data=drawn)
        trace = handlers.trace(replaced).get_trace(**world.data)
        return trace["noiseless_channel"]["value"], trace["noise_power"]["value"]

    at_once = jax.jit(lambda drawn: outcome(with_effects(world.model, everything), drawn))(drawn)
    nested = with_effects(with_effects(world.model, everything[:half]), everything[half:])
    plain = outcome(world.model, drawn)
    for one, other, before in zip(at_once, outcome(nested, drawn), plain, strict=True):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-15)
        assert not np.allclose(one, np.broadcast_to(before, one.shape), rtol=1e-5, atol=0)


@pytest.mark.study
def test_single_precision_stays_single(world, effects):
    def single(x):
        kind = {np.dtype("float64"): np.float32, np.dtype("complex128"): np.complex64}
        return np.asarray(x).astype(kind.get(np.asarray(x).dtype, np.asarray(x).dtype))

    with jax.enable_x64(False):
        data = jax.tree.map(single, world.data)
        draws = {}
        for effect in effects.values():
            for p in effect.parameters:
                size = 1e-3 * float(np.max(np.sqrt(p.prior.variance)))
                draws[f"{effect.name}.{p.name}"] = np.full(p.shape, size, np.float32)
        extended = handlers.substitute(with_effects(world.model, list(effects.values())), data=draws)
        trace = handlers.trace(handlers.seed(extended, 0)).get_trace(**data)
        for name, message in trace.items():
            if message["type"] in ("deterministic", "sample"):
                assert message["value"].dtype in (np.float32, np.complex64), name
                assert np.all(np.isfinite(message["value"])), name
