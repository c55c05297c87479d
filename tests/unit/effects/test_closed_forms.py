"""Effects against results by hand, or against the same world built otherwise."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre

from dtprob.effects import Rewriting, catalogue
from dtprob.effects.array import _detour
from dtprob.effects.effect import Context
from dtprob.effects.noise import interference
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import SPECULAR
from dtprob.raytracing.pattern import field_vector

SPEED = 299_792_458.0
SHARED = {"path_phase": jnp.zeros((3, 1, 7)), "frequency_response": jnp.ones(17, complex)}


@pytest.fixture(scope="module")
def apply(world):
    """Function (name, parameters) -> values of all sites with that effect, or of the base model."""

    def run(name=None, data=None, **parameters):
        data = world.data if data is None else data
        chosen = [] if name is None else list(catalogue(world.sites, data, [name]))[:1]
        given = {e.name: {k: jnp.asarray(v, float) for k, v in parameters.items()} for e in chosen}
        with (
            handlers.trace() as trace,
            Rewriting(None, chosen, given, data),
            handlers.seed(rng_seed=0),
            handlers.substitute(data={"scale": jnp.ones(())}),
        ):
            world.model(**data)
        return {n: np.asarray(m["value"]) for n, m in trace.items() if m["type"] == "deterministic"}

    return run


def test_timing_offset_turns_subcarriers_in_proportion(world, apply):
    frequency = np.asarray(world.data["subcarrier_frequency"])
    ratio = apply("timing_offset", delay=3e-9)["noiseless_channel"] / apply()["noiseless_channel"]
    assert np.allclose(ratio, np.exp(-2j * np.pi * frequency * 3e-9), rtol=1e-9)


def test_carrier_frequency_offset_turns_snapshots_in_proportion(world, apply):
    time = np.asarray(world.data["snapshot_time"])[:, None, None, None]
    ratio = (
        apply("carrier_frequency_offset", frequency=70.0)["noiseless_channel"] / apply()["noiseless_channel"]
    )
    assert ratio.shape[1] == 8
    assert np.allclose(ratio, np.exp(2j * np.pi * 70.0 * time), rtol=1e-9)


def test_sampling_clock_offset_drifts(world, apply):
    time = np.asarray(world.data["snapshot_time"])[:, None, None, None]
    frequency = np.asarray(world.data["subcarrier_frequency"])
    ratio = apply("sampling_clock_offset", offset=1e-5)["noiseless_channel"] / apply()["noiseless_channel"]
    assert np.allclose(ratio, np.exp(-2j * np.pi * frequency * 1e-5 * time), rtol=1e-9)


MOVES = {
    "receiver_displacement": ("rx", [0.3, -0.2, 0.15]),
    "transmitter_displacement": ("tx", [-0.2, 0.25, 0.1]),
}


@pytest.mark.parametrize("name", list(MOVES))
def test_displaced_ends_agree_with_tracing_again(world, apply, trace_world, name):
    end, step = MOVES[name]
    again, mask = trace_world(**{end: np.array(step)}), np.asarray(world.data["paths"].mask)
    sites = apply(name, displacement=step)
    _compare(sites, again, mask)


@pytest.mark.parametrize(("index", "name"), [(0, "east"), (1, "slanted"), (2, "floor")])
def test_displaced_object_agrees_with_tracing_again(world, apply, trace_world, index, name):
    normal = {"east": [1.0, 0, 0], "slanted": [0.6, 0.8, 0], "floor": [0, 0, 1.0]}[name]
    planes = np.zeros((4, 3))
    planes[index] = 0.4 * np.array(normal)
    sites = apply(f"object_displacement[{name}]", displacement=[0.4])
    _compare(sites, trace_world(planes=planes), np.asarray(world.data["paths"].mask))


def _compare(sites, again, mask):
    """The rewritten geometry is that of the world traced with the thing moved, to rounding."""
    assert np.max(np.abs(sites["path_delay"] - np.asarray(again.delay))[mask]) < 1e-20
    assert np.allclose(sites["arrival"][mask], np.asarray(again.arrival)[mask], atol=1e-12)
    assert np.allclose(sites["departure"][mask], np.asarray(again.departure)[mask], atol=1e-12)


def test_displaced_path_keeps_the_free_space_law(world, apply):
    before, after = apply(), apply("receiver_displacement", displacement=[0.3, 0.0, 0.0])
    mask = np.asarray(world.data["paths"].mask)
    weakened = before["path_gain"][mask] / after["path_gain"][mask]
    assert np.allclose(weakened, (after["path_delay"] / before["path_delay"])[mask], rtol=1e-9)


@pytest.mark.parametrize("middle", [None, (0.0, 3.0, -1.0)])
def test_rotated_object_is_right_to_first_order(world, apply, middle):
    """A plane turned about a point, its object's middle if that is known: image the transmitter in the turned plane."""
    paths = world.data["paths"]
    at = (
        np.asarray(paths.mask)[..., None]
        & (np.asarray(paths.object) == 0)
        & (np.asarray(paths.interaction) == 1)
    )
    centre = np.asarray(paths.vertex)[at].mean(axis=0)
    data = world.data
    if middle is not None:
        centre = centre + middle
        centers = np.zeros((paths.n_object, 3))
        centers[0] = centre
        data = {**data, "paths": dataclasses.replace(paths, object_center=jnp.asarray(centers))}
    chosen = catalogue(world.sites, data, ["object_rotation[east]"])[0]
    errors = []
    for angle in (1e-3, 5e-4):
        turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        normal = turn @ np.array([1.0, 0, 0])
        tx, rx = np.asarray(paths.tx_position), np.asarray(paths.rx_position)
        image = tx - 2 * ((tx - centre) @ normal)[:, None] * normal
        exact = np.linalg.norm(rx - image, axis=1) / SPEED
        assert chosen.dimension == 2
        assert "(0.00 1.00 0.00), (0.00 0.00 1.00)" in chosen.physics
        found = apply("object_rotation[east]", data=data, rotation=[0.0, angle])["path_delay"][:, 1]
        errors.append(np.max(np.abs(found - exact)))
        assert errors[-1] < 0.05 * np.max(np.abs(exact - np.asarray(paths.delay)[:, 1]))
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize(
    ("name", "move"), [("doppler", "rx"), ("doppler[transmitter]", "tx"), ("doppler[slanted]", "planes")]
)
def test_doppler_agrees_with_moved_geometry(world, apply, trace_world, name, move):
    """Phase after a time t is that of the geometry moved by v t, to first order in v t."""
    velocity, time = (
        (np.array([0.3, -0.2, 0.1]), 7e-3) if move != "planes" else (np.array([0.6, 0.8, 0.0]), 7e-3)
    )
    step = velocity * time
    if move == "planes":
        step = np.zeros((4, 3))
        step[1] = velocity * time
    delay = np.asarray(trace_world(**{move: step}).delay) - np.asarray(world.data["paths"].delay)
    exact = -2 * np.pi * world.data["paths"].frequency * delay
    given = [1.0] if move == "planes" else velocity
    found = apply(name, velocity=given)["path_phase"]
    mask = np.asarray(world.data["paths"].mask)
    assert np.array_equal(found[:, 0], np.zeros_like(exact))
    assert np.allclose(found[:, -1][mask], exact[mask], rtol=2e-3, atol=1e-4)


def test_material_of_one_object_only(apply):
    sites = apply("material_mismatch[slanted]", log_contrast=np.log(2.0), log_conductivity=np.log(3.0))
    assert np.allclose(sites["permittivity"], [4.0, 9.0, 4.0, 5.0])
    assert np.allclose(sites["conductivity"], [0.05, 0.06, 0.05, 0.02])


def test_material_of_all_objects_of_one_class(world, apply):
    sites = apply("material_mismatch[all_brick]", log_contrast=np.log(2.0), log_conductivity=np.log(3.0))
    before = apply()
    brick = np.array([False, True, False, True])
    assert np.allclose(sites["permittivity"], before["permittivity"] + brick * (before["permittivity"] - 1))
    assert np.allclose(sites["conductivity"], before["conductivity"] * np.where(brick, 3.0, 1.0))
    fitted = {**world.sites, "material_permittivity": world.sites["permittivity"]}
    names = [effect.name for effect in catalogue(fitted, world.data, ["material_mismatch"])]
    assert names == [f"material_mismatch[{name}]" for name in ("east", "slanted", "floor", "partition")]


def test_missing_path_and_blockage(world, apply):
    order = np.sum(np.asarray(world.data["paths"].interaction) != 0, axis=-1)
    before = apply()["path_gain"]
    gone = apply("missing_path[order_1]", fraction=1.0)["path_gain"]
    assert np.array_equal(gone, np.where(order == 1, 0.0, before))
    hidden = apply("blockage[line_of_sight]", loss=0.7)["path_gain"]
    assert np.allclose(hidden, np.where(order == 0, np.exp(-0.7), 1.0) * before)


def test_losses_by_hand(world, apply):
    paths = world.data["paths"]
    before, length = apply()["path_gain"], np.asarray(paths.length)
    assert np.allclose(
        apply("atmospheric_attenuation", rate=0.02)["path_gain"], before * np.exp(-0.02 * length)
    )
    mask = np.asarray(paths.mask)
    ratio = apply("path_loss_exponent", excess=0.5)["path_gain"][mask] / before[mask]
    slope = np.polyfit(np.log(length[mask]), np.log(np.abs(ratio)), 1)[0]
    assert np.isclose(slope, -0.25)
    rough = apply("rough_surface[floor]", roughness=0.3)["path_gain"]
    cosine = np.abs(np.asarray(paths.departure)[:, 3, 2])
    assert np.allclose(rough[:, 3], before[:, 3] * np.exp(-0.3 * cosine**2))
    assert np.array_equal(rough[:, 0], before[:, 0])
    twice = apply("penetration[partition]", loss=0.2, phase=0.1)["path_gain"]
    assert np.allclose(twice[1, 6], before[1, 6] * np.exp(-0.2 + 0.1j))


@pytest.mark.parametrize("side", ["rx", "tx"])
def test_polarisation_crossed_by_a_right_angle(world, apply, side):
    import equinox as eqx

    paths = world.data["paths"]
    direction = paths.arrival if side == "rx" else paths.departure
    crossed = jnp.cross(direction, getattr(paths, f"{side}_field"))
    other = eqx.tree_at(lambda p: getattr(p, f"{side}_field"), paths, crossed)
    expected = path_gain(other, paths.permittivity, paths.conductivity)
    found = apply(f"polarization_mismatch[{side}]", rotation=np.pi / 2, ellipticity=0.0)["path_gain"]
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("side", ["rx", "tx"])
def test_array_geometry_agrees_with_other_positions(world, apply, side):
    positions = np.asarray(world.data[f"{side}_array"])
    wide = apply(data={**world.data, f"{side}_array": jnp.asarray(1.03 * positions)})
    found = apply(f"element_spacing[{side}]", scale=0.03)
    assert np.allclose(found[f"{side}_response"], wide[f"{side}_response"])

    effect = catalogue(world.sites, world.data, [f"antenna_orientation[{side}]"])[0]
    axis = np.array([0.0, 0.0, 1.0])  # visible for both arrays
    turned = positions @ Rotation.from_rotvec(2 * np.arctan(0.1) * axis).as_matrix().T
    given = np.zeros(effect.dimension)
    given[-1] = 0.2
    expected = apply(data={**world.data, f"{side}_array": jnp.asarray(turned)})
    found = apply(effect.name, rotation=given)
    assert np.allclose(found[f"{side}_response"], expected[f"{side}_response"])
    assert effect.dimension == {"rx": 3, "tx": 2}[side]  # nobody sees a line turn about itself


@pytest.mark.parametrize("side", ["rx", "tx"])
def test_elements_turn_with_their_array(world, apply, side):
    """The gain is that of a path set whose elements were turned from the start, pattern and polarisation too."""
    paths = world.data["paths"]
    direction = -jnp.asarray(paths.arrival) if side == "rx" else jnp.asarray(paths.departure)

    def fitted(orientation):
        field = field_vector(direction, pattern="dipole", polarization="V", orientation=orientation)
        told = (*paths.provenance, (f"{side}_pattern", "dipole"), (f"{side}_polarization", "V"))
        changed = dataclasses.replace(paths, provenance=told)
        return eqx.tree_at(lambda q: getattr(q, f"{side}_field"), changed, field)

    level = {**world.data, "paths": fitted((0.0, 0.0, 0.0))}
    effect = catalogue(world.sites, level, [f"antenna_orientation[{side}]"])[0]
    angle = 2 * np.arctan(0.1)  # about z, the last of the axes that the array can see
    given = np.zeros(effect.dimension)
    given[-1] = 0.2
    found = apply(effect.name, data=level, rotation=given)["path_gain"]
    expected = apply(data={**world.data, "paths": fitted((angle, 0.0, 0.0))})["path_gain"]
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    assert "path_gain" not in catalogue(world.sites, world.data, [effect.name])[0].rewrites


def mirrored(point, paths, link, path):
    """A point at the receiver, mirrored at the planes on the way back to the transmitter."""
    for step in reversed(range(paths.depth)):
        if np.asarray(paths.interaction)[link, path, step] == SPECULAR:
            normal, vertex = (np.asarray(v)[link, path, step] for v in (paths.normal, paths.vertex))
            point = point - 2 * ((point - vertex) @ normal) * normal
    return point


def test_near_field_is_the_distance_between_elements(world, apply):
    paths = world.data["paths"]
    rx, tx = (20 * np.asarray(world.data[name]) for name in ("rx_array", "tx_array"))
    data = {**world.data, "rx_array": jnp.asarray(rx), "tx_array": jnp.asarray(tx)}
    flat, found = apply(data=data), apply("near_field", data=data, share=1.0)
    frequency = np.asarray(world.data["subcarrier_frequency"])
    expected = np.zeros_like(flat["noiseless_channel"])
    for link, path in np.argwhere(np.asarray(paths.mask)):
        centre, start = (np.asarray(v)[link] for v in (paths.rx_position, paths.tx_position))
        images = np.stack([mirrored(centre + r, paths, link, path) for r in rx])
        distance = np.linalg.norm(images[:, None] - (start + tx), axis=-1)
        delay = np.asarray(paths.length)[link, path] / SPEED
        tone = np.exp(-2j * np.pi * (distance[..., None] / paths.wavelength + delay * frequency))
        expected[link] += flat["path_gain"][link, path] * tone

    def error(channel):
        return np.abs(channel - expected).max() / np.abs(expected).max()

    assert error(found["noiseless_channel"]) < 1e-6
    assert error(flat["noiseless_channel"]) > 1e-2


@pytest.mark.parametrize("missing", ["rx_array", "tx_array"])
def test_near_field_of_one_array_turns_its_elements_alone(build_world, apply, missing):
    own = "tx" if missing == "rx_array" else "rx"
    world = build_world(**{missing: None})
    (effect,) = catalogue(world.sites, world.data, ["near_field"])
    assert set(effect.requires) >= {f"{own}_array", "path_phase"}
    assert missing not in effect.requires
    values = {n: jnp.asarray(v) for n, v in apply(data=world.data).items()}
    context = Context(world.data, values)
    bent = effect.rewrites["noiseless_channel"](values["noiseless_channel"], {"share": 1.0}, context)
    assert bent.shape == values["noiseless_channel"].shape
    size = float(np.abs(bent - values["noiseless_channel"]).max() / np.abs(bent).max())
    assert 1e-6 < size < 0.1


def test_near_field_comes_before_what_acts_on_the_sum_of_the_paths(world):
    names = [e.name for e in catalogue(world.sites, world.data, "all")]
    assert names.index("near_field") < min(i for i, n in enumerate(names) if n.startswith("cable_delay"))


def test_near_field_of_paths_of_other_traces_has_their_own_length(world):
    paths = world.data["paths"]
    arrays = (jnp.asarray(world.data[name]) for name in ("rx_array", "tx_array"))
    detour = np.asarray(_detour(paths, *arrays))
    other = np.asarray(paths.beyond) > 0
    assert other.any()
    assert np.abs(detour[other]).max() < 2 * np.abs(detour[np.asarray(paths.mask)]).max()


def test_a_vertical_cut_is_a_sum_of_zonal_harmonics(world, apply):
    paths = world.data["paths"]
    given = np.array([0.3, -0.2, 0.1, 0.05, -0.04, 0.03, 0.02])
    found = apply("antenna_pattern[rx_vertical_cut]", log_gain=given)["path_gain"]
    z = np.asarray(paths.arrival)[..., 2]
    log_gain = sum(g * np.sqrt(2 * n + 1) * eval_legendre(n, z) for n, g in enumerate(given))
    assert np.allclose(found, apply()["path_gain"] * np.exp(log_gain))


def test_coupling_of_neighbours_on_a_line(apply):
    before = apply()["tx_response"]
    found = apply("mutual_coupling[tx]", coupling=[0.1, -0.05])["tx_response"]
    c = 0.1 - 0.05j
    matrix = np.array([[1, c, 0], [c, 1, c], [0, c, 1]])
    assert np.allclose(found, before @ matrix.T)


def test_elements_at_one_place_couple_too(build_world):
    """As the two polarisations of an antenna do."""
    world = build_world(tx_array=np.zeros((2, 3)), rx_array=np.zeros((4, 3)))
    pair, four = catalogue(world.sites, world.data, "mutual_coupling")[::-1]
    assert [e.parameters[0].shape for e in (pair, four)] == [(2,), (2,)]
    context = Context(world.data, {})
    moved = pair.rewrites["tx_response"](
        jnp.array([[1.0 + 0j, 2.0]]), {"coupling": jnp.array([0.1, 0.0])}, context
    )
    np.testing.assert_allclose(moved, [[1.2, 2.1]])


def test_calibration_and_cable_of_one_element(world, apply):
    before = apply()
    found = apply("array_calibration[rx_2]", fraction=0.3, phase=-0.4)["rx_response"]
    assert np.allclose(found[..., 2], before["rx_response"][..., 2] * 0.7 * np.exp(-0.4j))
    assert np.array_equal(found[..., [0, 1, 3]], before["rx_response"][..., [0, 1, 3]])
    assert not apply("array_calibration[rx_2]", fraction=1.0, phase=0.0)["rx_response"][..., 2].any()
    ratio = apply("cable_delay[tx_1]", delay=2e-9)["noiseless_channel"] / before["noiseless_channel"]
    turn = np.exp(-2j * np.pi * np.asarray(world.data["subcarrier_frequency"]) * 2e-9)
    assert np.allclose(ratio[:, :, :, 1], turn)
    assert np.allclose(ratio[:, :, :, [0, 2]], 1.0)


def test_iq_imbalance_mixes_mirror_subcarriers(apply):
    before, g, phi = apply()["noiseless_channel"], 0.1, 0.06
    mu = np.cos(phi / 2) + 1j * g * np.sin(phi / 2)
    nu = g * np.cos(phi / 2) - 1j * np.sin(phi / 2)
    found = apply("iq_imbalance", amplitude=g, phase=phi)["noiseless_channel"]
    assert np.allclose(found, mu * before + nu * np.conj(before[..., ::-1]))


def test_one_branch_leaves_the_other_as_it_is(apply):
    """What is real in time passes, with a share that leaks into the other branch; what is imaginary grows by 1 + g."""
    before, g, phi = apply()["noiseless_channel"], 0.1, 0.06
    mirrored = np.conj(before[..., ::-1])
    real, imaginary = (before + mirrored) / 2, (before - mirrored) / 2
    found = apply("iq_imbalance[one_branch]", amplitude=g, phase=phi)["noiseless_channel"]
    expected = real * (1 - 1j * (1 + g) * np.sin(phi)) + imaginary * (1 + g) * np.cos(phi)
    assert np.allclose(found, expected)


def test_compression_saturates(world, apply):
    before = apply()["noiseless_channel"]
    power = np.mean(np.abs(np.asarray(world.data["channel"])) ** 2)
    level = np.abs(before) ** 2 / power
    found = apply("amplifier_nonlinearity", compression=0.2, log_knee=0.0)["noiseless_channel"]
    assert np.allclose(found, before / (1 + 0.2 * level))
    sharper = apply("amplifier_nonlinearity", compression=0.2, log_knee=np.log(2))["noiseless_channel"]
    assert np.allclose(sharper, before / (1 + 0.2 * level**2))


def test_noise_by_hand(world, apply):
    before, signal = apply()["noise_power"], np.abs(apply()["noiseless_channel"]) ** 2
    quantized = apply("quantization", ratio=1e-3)["noise_power"]
    assert np.allclose(quantized, before + 1e-3 * signal.mean(axis=(2, 3, 4), keepdims=True))
    assert np.allclose(apply("error_vector_magnitude", ratio=1e-3)["noise_power"], before + 1e-3 * signal)
    jammed = apply("interference[band_7]", excess=2.0)["noise_power"].ravel() / before.ravel()
    assert np.array_equal(jammed, np.where(np.arange(17) >= 14, 3.0, 1.0))
    burst = apply("interference[time_0]", excess=2.0)["noise_power"].ravel() / before.ravel()
    assert np.array_equal(burst, np.where(np.arange(8) < 1, 3.0, 1.0))
    count = np.shape(apply()["noiseless_channel"])[2]
    each = np.linspace(-0.4, 0.6, count)
    uneven = apply("noise_imbalance[rx]", log_power=each)["noise_power"] / before
    assert np.allclose(uneven[:, :, :, 0, 0], np.exp(each))  # the first chain, too


@pytest.mark.study
def test_interference_reaches_the_lowest_subcarrier_however_its_place_is_rounded(world):
    rng = np.random.default_rng(0)
    for _ in range(50):
        frequency = rng.uniform(-2e7, 2e7) + 1e5 / 3 * np.arange(int(rng.integers(16, 300)))
        data = {"subcarrier_frequency": jnp.asarray(frequency)}
        first = next(e for e in interference(world.sites, data) if e.instance == "band_0")
        raised = first.rewrites["noise_power"](jnp.ones((1, 1, len(frequency), 1, 1)), {"excess": 1.0}, data)
        assert np.ravel(raised)[0] == 2.0


def test_extra_path_is_a_radar_echo(world, apply):
    paths = world.data["paths"]
    added = (
        apply("extra_path[floor]", scattering=[0.5, 0.0])["noiseless_channel"] - apply()["noiseless_channel"]
    )
    at = (
        np.asarray(paths.mask)[..., None]
        & (np.asarray(paths.object) == 2)
        & (np.asarray(paths.interaction) == 1)
    )
    point = np.asarray(paths.vertex)[at].mean(axis=0)
    first = np.linalg.norm(point - np.asarray(paths.tx_position), axis=1)
    second = np.linalg.norm(np.asarray(paths.rx_position) - point, axis=1)
    size = paths.wavelength * 0.5 / ((4 * np.pi) ** 1.5 * first * second)
    assert np.allclose(np.abs(added), size[:, None, None, None, None])
    slope = np.diff(np.unwrap(np.angle(added[:, 0, 0, 0])), axis=-1)
    assert np.allclose(slope, -2 * np.pi * 2e6 * ((first + second) / SPEED)[:, None])


def test_an_echo_off_any_point_differs_by_the_gain_of_each_link(world):
    paths, context = world.data["paths"], {**world.data, **SHARED}
    of_floor, anywhere = (
        catalogue(world.sites, world.data, [f"extra_path[{n}]"])[0] for n in ("floor", "anywhere")
    )
    value = jnp.zeros((3, 1, 4, 3, 17), complex)
    field = np.random.default_rng(0).normal(size=anywhere.shape_of_field(value, context))
    on_floor = np.asarray(paths.mask)[..., None] & (np.asarray(paths.object) == 2)
    point = np.asarray(paths.vertex)[on_floor & (np.asarray(paths.interaction) == SPECULAR)].mean(axis=0)
    given = {"scale": jnp.asarray(0.5), "field": jnp.asarray(field), **dict(zip("xyz", point, strict=True))}
    added = anywhere.rewrites["noiseless_channel"](value, given, context)
    fixed = of_floor.rewrites["noiseless_channel"](value, {"scattering": jnp.asarray([1.0, 0.0])}, context)
    ratio = np.asarray(added / fixed)
    gain = 0.5 * np.abs(field[..., 0] + 1j * field[..., 1]) / np.sqrt(2)
    np.testing.assert_allclose(np.abs(ratio), np.broadcast_to(gain, ratio.shape), rtol=1e-6)
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1, :1, :1, :1], ratio.shape), rtol=1e-6)


def test_an_echo_of_random_phase_hardly_turns_as_its_point_moves_by_half_a_wavelength(world):
    anywhere = catalogue(world.sites, world.data, ["extra_path[anywhere]"])[0]
    value, context = jnp.zeros((3, 1, 4, 3, 17), complex), {**world.data, **SHARED}
    shape, half = anywhere.shape_of_field(value, context), world.data["paths"].wavelength / 2

    def added(x):
        given = {"scale": jnp.asarray(1.0), "field": jnp.ones(shape), "x": x, "y": -3.0, "z": 2.5}
        return anywhere.rewrites["noiseless_channel"](value, given, context)

    there = added(4.0)
    assert np.abs(added(4.0 + half) - there).max() < 0.2 * np.abs(there).max()


def test_places_off_which_an_echo_is_looked_for_cover_the_links(world):
    effect = catalogue(world.sites, world.data, ["extra_path[anywhere]"])[0]
    paths = world.data["paths"]
    ends = np.concatenate([np.asarray(paths.tx_position), np.asarray(paths.rx_position)])
    step = SPEED / 2 / np.ptp(np.asarray(world.data["subcarrier_frequency"]))
    for i, parameter in enumerate(effect.fitted):
        assert parameter.tried[0] <= ends[:, i].min()
        assert parameter.tried[-1] > ends[:, i].max() - step
    assert effect.is_looked_for


def test_diffraction_reaches_obstructed_links_only(world):
    effect = catalogue(world.sites, world.data, ["diffraction"])[0]
    value = jnp.zeros((3, 1, 4, 3, 17), complex)
    context = {**world.data, **SHARED}
    shape = effect.shape_of_field(value, context)
    given = {"scale": jnp.asarray(1.0), "field": jnp.ones(shape)}
    added = np.abs(effect.rewrites["noiseless_channel"](value, given, context))
    assert np.all(added[[0, 2]] == 0)
    assert np.all(added[1] > 0)


def test_diffuse_tail_has_the_stated_power(world):
    import jax

    effect = catalogue(world.sites, world.data, ["diffuse_scattering"])[0]
    value, paths = jnp.zeros((3, 1, 4, 3, 17), complex), world.data["paths"]
    shape = effect.shape_of_field(value, world.data)
    power = 0.0
    for key in jax.random.split(jax.random.key(0), 50):
        given = {"scale": jnp.asarray(0.3), "field": jax.random.normal(key, shape)}
        tail = effect.rewrites["noiseless_channel"](value, given, {**world.data, **SHARED})
        power = power + np.mean(np.abs(tail) ** 2, axis=(1, 2, 3, 4)) / 50
    free = paths.wavelength / (4 * np.pi * np.asarray(paths.length))
    expected = 0.09 * np.sum(np.where(np.asarray(paths.mask), free**2, 0.0), axis=1)
    assert np.allclose(power, expected, rtol=0.15)


def test_added_paths_get_what_all_paths_share(world):
    """Gain, delay, phase and response of a receiver act on an added path as on the traced ones."""
    effect = catalogue(world.sites, world.data, ["extra_path[floor]"])[0]
    value, given = jnp.zeros((3, 1, 4, 3, 17), complex), {"scattering": jnp.asarray([0.3, 0.1])}
    frequency = np.asarray(world.data["subcarrier_frequency"])
    plain = effect.rewrites["noiseless_channel"](value, given, {**world.data, **SHARED})
    receiver = {
        "path_phase": 0.4 + SHARED["path_phase"],
        "frequency_response": 0.5j * SHARED["frequency_response"],
        "receiver_gain": jnp.asarray([1.0, 2.0, 3.0]),
        "receiver_delay": jnp.asarray([0.0, 1e-9, 2e-9]),
    }
    found = effect.rewrites["noiseless_channel"](value, given, {**world.data, **receiver})
    expected = (
        0.5j
        * np.exp(0.4j)
        * np.array([1, 2, 3])[:, None]
        * np.exp(-2j * np.pi * np.array([0, 1e-9, 2e-9])[:, None] * frequency)
    )
    assert np.allclose(found, plain * expected[:, None, None, None])
