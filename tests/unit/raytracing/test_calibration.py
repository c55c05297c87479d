"""Calibration on statistics: the statistics against the channel, the steps against closed forms, the materials found."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

from dtprob.errors import InputError
from dtprob.raytracing.calibration import (
    SCHEMES,
    Settings,
    calibrate,
    calibrate_runs,
    object_groups,
    phases,
    project,
)
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize
from dtprob.raytracing.paths import DIMENSIONS, NONE

TONES = np.arange(-7.5, 8) * 20e6
EPS, SIGMA = 5.31, 0.139


@pytest.fixture(scope="module")
def paths(box):
    """The eight shortest paths of each link: with all 25 the tests only take longer."""
    chosen = {
        name: getattr(box, name)[:, :8]
        for name, dims in DIMENSIONS.items()
        if dims[:2] == ("link", "path") and getattr(box, name) is not None
    }
    return eqx.tree_at(lambda paths: [getattr(paths, name) for name in chosen], box, list(chosen.values()))


@pytest.fixture(scope="module")
def array(paths):
    axis = (np.arange(3) - 1) * paths.wavelength / 2
    return jnp.asarray([[0.0, y, z] for y in axis for z in axis])


def measure(paths, array, angles, noise_power=0.0, *, permittivity=EPS, seed=0):
    """Channels of paths turned by `angles` (link, snapshot, path), in noise."""
    ones = jnp.ones(paths.n_object)
    gain = path_gain(paths, permittivity * ones, SIGMA * ones, law="half_space")
    h = synthesize(
        gain,
        frequency_response(paths, jnp.asarray(TONES)),
        steering(array, paths.arrival, paths.frequency, -1.0),
        steering(array, paths.departure, paths.frequency, 1.0),
        jnp.exp(1j * jnp.asarray(angles)),
    )
    random = np.random.default_rng(seed)
    noise = random.standard_normal((2, *h.shape))
    return np.asarray(h) + np.sqrt(noise_power / 2) * (noise[0] + 1j * noise[1])


def columns(paths, array):
    """b_p of the paths of each link, (link, path, entry), one by one."""
    ones = jnp.where(paths.mask, 1.0 + 0j, 0.0)
    parts = []
    for path in range(paths.n_path):
        only = ones * (jnp.arange(paths.n_path) == path)
        one = synthesize(
            only,
            frequency_response(paths, jnp.asarray(TONES)),
            steering(array, paths.arrival, paths.frequency, -1.0),
            steering(array, paths.departure, paths.frequency, 1.0),
        )
        parts.append(np.asarray(one).reshape(paths.n_link, -1))
    return np.stack(parts, axis=1)


def received(paths, noise_db=-20):
    gain = path_gain(paths, jnp.full(paths.n_object, EPS), jnp.full(paths.n_object, SIGMA), law="half_space")
    return float(jnp.mean(jnp.sum(jnp.abs(gain) ** 2, axis=1))) * 10 ** (noise_db / 10)


def test_statistics_are_inner_products_of_the_channel(paths, array):
    angles = np.random.default_rng(1).uniform(-3, 3, (paths.n_link, 2, paths.n_path))
    h = measure(paths, array, angles, received(paths))
    found = project(paths, TONES, h, rx_array=array, tx_array=array)
    b, flat = columns(paths, array), h.reshape(*h.shape[:2], -1)
    scale = np.max(np.abs(flat)) * b.shape[2]
    np.testing.assert_allclose(found.product, np.einsum("lpe,lse->lsp", b.conj(), flat), atol=1e-9 * scale)
    np.testing.assert_allclose(found.gram, np.einsum("lpe,lqe->lpq", b.conj(), b), atol=1e-9 * b.shape[2])
    np.testing.assert_allclose(found.energy, np.sum(np.abs(flat) ** 2, axis=2), rtol=1e-9)
    assert found.size == b.shape[2]


def test_powers_on_all_triples_agree_with_loops(paths, array):
    few = paths.take([1])
    angles = np.random.default_rng(1).uniform(-3, 3, (1, 2, few.n_path))
    h = measure(few, array, angles)
    power = project(few, TONES, h, rx_array=array, tx_array=array).power
    rx = np.asarray(steering(array, few.arrival, few.frequency, -1.0))[0]
    tx = np.asarray(steering(array, few.departure, few.frequency, 1.0))[0]
    tone = np.asarray(frequency_response(few, jnp.asarray(TONES)))[0]
    there = np.flatnonzero(np.asarray(few.mask)[0])
    right, normal, square = np.zeros(few.n_path), np.zeros((few.n_path, few.n_path)), 0.0
    for i in there:
        for j in there:
            for k in there:
                v = np.einsum("r,t,k->rtk", rx[j], tx[k], tone[i])
                measured = np.abs(np.einsum("rtk,srtk->s", v.conj(), h[0]) / v.size) ** 2
                each = np.zeros(few.n_path)
                for p in there:
                    b = np.einsum("r,t,k->rtk", rx[p], tx[p], tone[p])
                    each[p] = np.abs(np.vdot(b, v) / v.size) ** 2
                right += each * measured.mean()
                normal += np.outer(each, each)
                square += np.mean(measured**2)
    np.testing.assert_allclose(power.right[0], right, rtol=1e-9, atol=1e-12 * right.max())
    np.testing.assert_allclose(power.normal[0], normal, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(power.square[0], square, rtol=1e-9)


def random_field(key, paths=3, snapshots=4):
    parts = jax.random.normal(key, (2, 1, 5, paths))
    a = parts[0] + 1j * parts[1]
    h = jax.random.normal(jax.random.fold_in(key, 1), (2, 1, snapshots, 5))
    matched = jnp.einsum("lep,lse->lsp", a.conj(), h[0] + 1j * h[1])
    return phases.Field(matched, jnp.einsum("lep,leq->lpq", a.conj(), a), jnp.asarray(0.7))


def test_exact_updates_never_raise_the_free_energy():
    field = random_field(jax.random.key(3))
    state = phases.swept(field, phases.no_error(field), 1)
    energies = [phases.free_energy(field, state)]
    for _ in range(10):
        state = phases.swept(field, state, 1)
        energies.append(phases.free_energy(field, state))
    steps = np.diff(np.stack(energies), axis=0)
    assert np.all(steps <= 1e-9)
    assert np.any(steps < -1e-6)


def test_one_path_has_its_exact_posterior():
    """With a single path the mean field is exact: von Mises with the data's natural parameter added."""
    field = random_field(jax.random.key(5), paths=1, snapshots=1)
    found = phases.swept(field, phases.no_error(field), 1)
    eta = complex(field.concentration + 2 * field.matched[0, 0, 0])
    assert float(found.concentration[0, 0, 0]) == pytest.approx(abs(eta))
    assert complex(found.mean[0, 0, 0]) == pytest.approx(
        eta / abs(eta) * special.i1e(abs(eta)) / special.i0e(abs(eta))
    )
    # and the free energy is minus the log evidence
    snr, k0 = float(field.snr[0, 0]), float(field.concentration)

    def density(z):
        return np.exp(2 * np.real(np.exp(-1j * z) * complex(field.matched[0, 0, 0])) - snr + k0 * np.cos(z))

    evidence = integrate.quad(density, -np.pi, np.pi)[0] / (2 * np.pi * special.i0(k0))
    assert float(phases.free_energy(field, found)[0, 0]) == pytest.approx(-np.log(evidence), abs=1e-7)


@pytest.mark.study
def test_several_starts_are_at_least_as_good_as_each():
    field = random_field(jax.random.key(7), paths=5, snapshots=30)
    starts = phases.no_error(field), phases.reference(field)
    both = phases.free_energy(field, phases.best(field, starts, 30))
    each = [phases.free_energy(field, phases.swept(field, start, 30)) for start in starts]
    np.testing.assert_allclose(both, np.minimum(*each), atol=1e-9)
    assert np.any(np.abs(each[0] - each[1]) > 1e-3)


@pytest.mark.parametrize("kappa", [0.0, 1e-3, 0.3, 1.0, 7.0, 60.0, 900.0])
def test_concentration_is_the_inverse_of_the_resultant(kappa):
    found = phases.concentration_of(phases.resultant(jnp.asarray(kappa)))
    assert float(found) == pytest.approx(kappa, rel=1e-6, abs=1e-9)


def test_negative_resultants_give_no_concentration():
    assert float(phases.concentration_of(jnp.asarray(-0.2))) == 0.0


@pytest.fixture(scope="module")
def uniform_runs(paths, array):
    """Two runs of 20 snapshots with uniform phases."""
    shape = paths.n_link, 20, paths.n_path
    power = received(paths)
    runs = [
        project(
            paths,
            TONES,
            measure(paths, array, np.random.default_rng(s).uniform(-np.pi, np.pi, shape), power, seed=s),
            rx_array=array,
            tx_array=array,
        )
        for s in (0, 1)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *runs), power


def power_error(paths, found):
    def power(permittivity, conductivity):
        return jnp.sum(jnp.abs(path_gain(paths, permittivity, conductivity, law="half_space")) ** 2, axis=1)

    truth = power(jnp.full(paths.n_object, EPS), jnp.full(paths.n_object, SIGMA))
    return float(jnp.max(jnp.abs(power(found.permittivity, found.conductivity) / truth - 1)))


@pytest.mark.study
def test_aware_scheme_finds_the_material_where_the_oblivious_one_cannot(paths, uniform_runs):
    runs, power = uniform_runs
    error = {}
    for scheme in SCHEMES:
        settings = Settings(scheme, iterations=300, law="half_space")
        found = calibrate_runs(paths, runs, jnp.full(2, power), settings=settings)
        error[scheme] = power_error(paths, jax.tree.map(lambda leaf: leaf[0], found))
        assert found.loss.shape == (2, 300)
    assert error["aware"] < 0.02
    assert error["aware"] < 0.2 * error["oblivious"]
    assert error["aware"] <= error["uniform"] + 0.01


def test_runs_do_not_see_one_another(paths, uniform_runs):
    runs, power = uniform_runs
    settings = Settings(iterations=300, law="half_space")
    found, other = (
        calibrate_runs(paths, each, jnp.full(2, power), settings=settings)
        for each in (runs, jax.tree.map(lambda leaf: leaf[::-1], runs))
    )
    for one, turned in zip(found, other, strict=True):
        np.testing.assert_allclose(one, turned[::-1], rtol=1e-9)


@pytest.mark.study
def test_noise_power_and_a_common_phase_are_estimated(paths, array):
    shape = paths.n_link, 20, paths.n_path
    random = np.random.default_rng(4)
    angles = random.vonmises(0, 8.0, shape) + random.uniform(-np.pi, np.pi, (*shape[:2], 1))
    power = received(paths)
    statistics = project(
        paths, TONES, measure(paths, array, angles, power), rx_array=array, tx_array=array, powers=False
    )
    settings = Settings(iterations=300, estimate_noise=True, global_phase=True, law="half_space")
    found = calibrate(paths, statistics, 3 * power, settings=settings)
    np.testing.assert_allclose(found.noise_power, power, rtol=0.05)
    assert 4 < float(found.concentration) < 16
    assert power_error(paths, found) < 0.03


@pytest.mark.study
def test_groups_have_materials_of_their_own(paths, array):
    groups = np.asarray(paths.object_material)
    values = np.array([3.0, 8.0, 5.0])[groups % 3]
    angles = np.random.default_rng(2).uniform(-np.pi, np.pi, (paths.n_link, 20, paths.n_path))
    power = received(paths, -30)
    h = measure(paths, array, angles, power, permittivity=jnp.asarray(values))
    statistics = project(paths, TONES, h, rx_array=array, tx_array=array, powers=False)
    settings = Settings(iterations=600, law="half_space")
    found = calibrate(paths, statistics, power, settings=settings, groups=groups)
    met = np.unique(np.asarray(paths.object)[np.asarray(paths.interaction) != NONE])
    seen = np.isin(groups, groups[met])
    np.testing.assert_allclose(np.asarray(found.permittivity)[seen], values[seen], rtol=0.1)


def test_bad_input_is_named(paths, array):
    h = measure(paths, array, np.zeros((paths.n_link, 1, paths.n_path)))
    larger = jnp.concatenate([array, array + 1.0])
    for wrong, source in (
        ({"subcarrier_frequency": TONES[:-1]}, "subcarrier: expected the 15 of subcarrier_frequency, got 16"),
        ({"rx_array": larger}, "rx_antenna: expected the 18 of rx_array, got 9"),
        ({"tx_array": None}, "tx_antenna: expected the 1 of tx_array, got 9"),
        ({"paths": paths.take([0])}, "link: expected the 1 of the path set"),
        ({"channel": h[0]}, "all five"),
        (
            {"subcarrier_frequency": TONES + 3.5e9},
            "Hz from the carrier, 3.5e.09 Hz, got .* Subtract the carrier",
        ),
        ({"subcarrier_frequency": TONES * 1e9}, "above -3.5e.09 Hz, minus the carrier, got -1.5e.17 Hz"),
        ({"subcarrier_frequency": TONES / 1e9}, "different frequencies, got 16 within 0.3 Hz"),
    ):
        right = {"paths": paths, "subcarrier_frequency": TONES, "channel": h}
        with pytest.raises(InputError, match=source):
            project(**(right | {"rx_array": array, "tx_array": array} | wrong))
    with pytest.raises(InputError, match="finite"):
        project(paths, TONES, np.where(h == h[0, 0, 0, 0, 0], np.nan, h), rx_array=array, tx_array=array)
    statistics = project(paths, TONES, h, rx_array=array, tx_array=array, powers=False)
    with pytest.raises(InputError, match="powers=True"):
        calibrate(paths, statistics, 1e-9, settings=Settings("uniform"))
    with pytest.raises(InputError, match="positive"):
        calibrate(paths, statistics, 0.0)
    with pytest.raises(InputError, match="without gaps"):
        calibrate(paths, statistics, 1e-9, groups=np.full(paths.n_object, 3))
    with pytest.raises(InputError, match="Did you mean 'aware'"):
        Settings("awear")
    with pytest.raises(InputError, match="inside the range"):
        Settings(permittivity=1.0)
    with pytest.raises(InputError, match="iterations"):
        Settings(iterations=0)
    with pytest.raises(InputError, match="Project on the paths"):
        calibrate(paths.take([0]), statistics, 1e-9)


def test_groups_are_made_from_names(paths):
    first, second = paths.object_names[:2]
    groups = object_groups(paths, [[first, second]])
    assert groups[0] == groups[1]
    assert groups.max() + 1 == len(set(groups.tolist()))
    assert groups[2] not in groups[:2]
    with pytest.raises(InputError, match="object of a group"):
        object_groups(paths, [["no such wall"]])
    with pytest.raises(InputError, match="in two"):
        object_groups(paths, [[first], [first]])


@pytest.mark.parametrize("kappa", [1e-3, 0.3, 1.0, 7.0, 60.0, 400.0, 3000.0])
def test_concentration_in_single_precision(kappa):
    """The resultant of 3,000 is told to a fifth only by single precision; near 1 nothing is lost beside that."""
    with jax.enable_x64(False):
        found = phases.concentration_of(phases.resultant(jnp.asarray(kappa, jnp.float32)))
        assert found.dtype == jnp.float32
        assert np.isfinite(float(phases.concentration_of(jnp.asarray(1.0, jnp.float32))))
    assert float(found) == pytest.approx(kappa, rel=max(2e-3, 1e-4 * kappa))


@pytest.mark.study
def test_a_link_without_signal_spoils_no_calibration(paths, array):
    tones = jnp.linspace(-50e6, 50e6, 8)
    gain = path_gain(paths, paths.permittivity, paths.conductivity, law="half_space")
    channel = np.array(synthesize(gain, frequency_response(paths, tones)))
    power = float(np.mean(np.abs(channel) ** 2)) / 100
    channel[1] = 0.0
    heard = project(paths, tones, jnp.asarray(channel), powers=False)
    found = calibrate(paths, heard, power, settings=Settings("aware", iterations=20, law="half_space"))
    assert np.isfinite(found.permittivity).all()
    assert np.isfinite(found.loss).all()


def test_a_material_that_no_path_touches_keeps_the_value_of_the_scene(paths, array):
    first, other = 0, 4
    met = np.any((np.asarray(paths.object) == other) & (np.asarray(paths.interaction) != NONE), axis=-1)
    heard = eqx.tree_at(lambda paths: paths.mask, paths, paths.mask & ~met)
    h = measure(heard, array, np.zeros((paths.n_link, 1, paths.n_path)))
    statistics = project(heard, TONES, h, rx_array=array, tx_array=array)
    settings = Settings("oblivious", iterations=3)
    groups = np.where(np.arange(paths.n_object) == other, 1, 0)
    with pytest.warns(RuntimeWarning, match=f"no path touches the material of {paths.object_names[other]},"):
        found = calibrate(heard, statistics, 1e-9, settings=settings, groups=groups)
    for name in ("permittivity", "conductivity"):
        value, nominal = getattr(found, name), getattr(paths, name)
        assert value[other] == nominal[other]
        assert value[first] == value[first + 1] != nominal[first]
    together = calibrate(heard, statistics, 1e-9, settings=settings)
    assert np.ptp(np.asarray(together.permittivity)) == 0


@pytest.mark.parametrize("power", [np.ones(2), np.ones((3, 1, 1)), -1.0])
def test_noise_powers_that_do_not_fit(paths, array, power):
    h = measure(paths, array, np.zeros((paths.n_link, 1, paths.n_path)))
    statistics = project(paths, TONES, h, rx_array=array, tx_array=array)
    with pytest.raises(InputError, match="noise_power: expected"):
        calibrate(paths, statistics, power)


@pytest.mark.parametrize("scheme", ["aware", "oblivious"])
def test_a_phase_common_to_the_paths_of_a_snapshot_changes_nothing(paths, array, scheme):
    random = np.random.default_rng(6)
    shape = paths.n_link, 4, paths.n_path
    h = measure(paths, array, random.vonmises(0, 8.0, shape), received(paths))
    turned = h * np.exp(1j * random.uniform(-np.pi, np.pi, (*shape[:2], 1, 1, 1)))
    settings = Settings(scheme, iterations=30, concentration=1.0, global_phase=True, law="half_space")
    found, again = (
        calibrate(
            paths,
            project(paths, TONES, each, rx_array=array, tx_array=array, powers=False),
            received(paths),
            settings=settings,
        )
        for each in (h, turned)
    )
    for one, other in zip(found, again, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_exact_phases_and_many_materials_are_found_from_several_starts(paths, array):
    """From a concentration of 1 alone the phases take up what the materials of all objects should, and stay there."""
    power = received(paths)
    h = measure(paths, array, np.zeros((paths.n_link, 4, paths.n_path)), power)[
        :, :, :, 4:5
    ]  # the element at the centre
    statistics = project(paths, TONES, h, rx_array=array, powers=False)
    groups, error = np.arange(paths.n_object), {}
    for starts in (1.0, Settings().concentration):
        settings = Settings(iterations=200, concentration=starts, law="half_space")
        error[starts] = power_error(
            paths, calibrate(paths, statistics, power, settings=settings, groups=groups)
        )
    one, several = error.values()
    assert several < 0.03
    assert one > 10 * several


def test_settings_that_would_have_no_effect_are_refused():
    with pytest.raises(InputError, match="scheme with noise"):
        Settings("uniform", estimate_noise=True)
    with pytest.raises(InputError, match="one value that is kept"):
        Settings(fixed_concentration=True)
    with pytest.raises(InputError, match="inside the range"):
        Settings(concentration=())
    assert Settings(concentration=2.0, fixed_concentration=True).starts == (2.0,)


def test_the_oblivious_scheme_estimates_noise(paths, array):
    power = received(paths)
    h = measure(paths, array, np.zeros((paths.n_link, 4, paths.n_path)), power)
    statistics = project(paths, TONES, h, rx_array=array, tx_array=array, powers=False)
    settings = Settings("oblivious", iterations=200, estimate_noise=True, law="half_space")
    found = calibrate(paths, statistics, 3 * power, settings=settings)
    np.testing.assert_allclose(found.noise_power, power, rtol=0.1)
