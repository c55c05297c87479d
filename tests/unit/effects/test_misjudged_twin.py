"""Effects that undo a wrong twin, against the twin as it should have been."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

from dtprob.effects import Rewriting, catalogue, with_effects
from dtprob.errors import InputError
from dtprob.raytracing.beyond import only, strongest, with_all, with_beyond
from dtprob.raytracing.field import path_gain
from dtprob.testing import check_effect
from tests import small_world

PLACES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, -0.5, 0.3]])


def sites_of(world, name=None, also=None, **parameters):
    """Values of all sites of the world with an effect, or without one; `also` gives latent sites."""
    chosen = [] if name is None else list(catalogue(world.sites, world.data, [name]))
    given = {e.name: {k: jnp.asarray(v, float) for k, v in parameters.items()} for e in chosen}
    with (
        handlers.trace() as trace,
        Rewriting(None, chosen, given, world.data),
        handlers.seed(rng_seed=0),
        handlers.substitute(data={"scale": jnp.ones(()), **(also or {})}),
    ):
        world.model(**world.data)
    return {n: np.asarray(m["value"]) for n, m in trace.items() if m["type"] == "deterministic"}


def gain(paths, **options):
    return np.asarray(path_gain(paths, paths.permittivity, paths.conductivity, **options))


def plain(paths):
    """A path set without paths of other traces."""
    values = {n: getattr(paths, n) for n in paths.__dataclass_fields__}
    return type(paths)(**{**values, "beyond": None, "beyond_names": ()})


@pytest.mark.parametrize(("name", "there"), [("depth_cut_off", (1, 5)), ("refraction_off", (0, 6))])
def test_a_cut_off_path_comes_back_whole(world, name, there):
    full = eqx.tree_at(lambda p: p.mask, world.data["paths"], jnp.asarray(small_world.THERE))
    change = sites_of(world, name, share=1.0)["path_gain"] - sites_of(world)["path_gain"]
    assert np.flatnonzero(change.ravel()).tolist() == [there[0] * 7 + there[1]]
    np.testing.assert_allclose(change[there], gain(full)[there], rtol=1e-6)


def test_what_is_known_of_reflections_holds_for_paths_of_another_trace(world):
    """A cut-off path of two reflections comes back as weak as the twin's other reflections are known to be."""
    (known,) = catalogue(world.sites, world.data, ["missing_path[reflection]"])
    extended = dataclasses.replace(world, model=with_effects(world.model, [known]))
    weak = {"missing_path[reflection].fraction": jnp.asarray(0.75)}
    plain_gain = sites_of(world, "depth_cut_off", share=1.0)["path_gain"]
    found = sites_of(extended, "depth_cut_off", also=weak, share=1.0)["path_gain"]
    np.testing.assert_allclose(found[1, 5], 0.25 * plain_gain[1, 5], rtol=1e-6)
    assert abs(plain_gain[1, 5]) > 0


def test_the_other_law_of_a_wall(world):
    full = sites_of(world, "wall_law[half_space]", share=1.0)["path_gain"]
    np.testing.assert_allclose(full, gain(world.data["paths"], law="half_space"), rtol=1e-5, atol=1e-12)
    halves = {**world.data, "law": "half_space"}
    assert [e.name for e in catalogue(world.sites, halves, "wall_law")] == ["wall_law[slab]"]


def test_the_right_carrier_turns_the_paths_as_a_new_trace_would(world):
    offset = 2e8
    moved = sites_of(world, "carrier_mismatch", offset=offset)
    base = sites_of(world)
    turn = moved["path_phase"][:, 0] - base["path_phase"][:, 0]
    np.testing.assert_allclose(turn, -2 * np.pi * offset * base["path_delay"], rtol=1e-5)
    ratio = moved["path_gain"][small_world.MASK] / base["path_gain"][small_world.MASK]
    np.testing.assert_allclose(ratio, 3.0 / 3.2, rtol=1e-6)


def test_the_right_bandwidth_is_that_of_data_on_other_subcarriers(world):
    wider = dataclasses.replace(
        world, data={**world.data, "subcarrier_frequency": 1.1 * world.data["subcarrier_frequency"]}
    )
    found = sites_of(world, "bandwidth_mismatch", scale=0.1)["noiseless_channel"]
    expected = sites_of(wider)["noiseless_channel"]
    assert np.abs(expected - sites_of(world)["noiseless_channel"]).max() > 1e-2 * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.fixture(scope="module")
def two_places():
    """A world with transmitters at two places, which knows the paths from either to all receivers."""
    paths = plain(small_world.trace(tx=PLACES))
    low, high = np.unique(np.asarray(paths.tx_position), axis=0)
    for number, place in enumerate((low, high)):
        other = plain(small_world.trace(tx=place - small_world.TX))
        paths = with_beyond(paths, f"transmitter_{number}", other, 7)
    return small_world.build(paths=paths)


def test_swapped_transmitters_get_each_others_paths(two_places):
    exchanged = PLACES[[2, 2, 0]]
    expected = small_world.build(paths=plain(small_world.trace(tx=exchanged)))
    found = sites_of(two_places, "swapped_transmitters", share=1.0)["noiseless_channel"]
    truth = sites_of(expected)["noiseless_channel"]
    wrong = sites_of(two_places)["noiseless_channel"]
    assert np.abs(wrong - truth).max() > 0.1 * np.abs(truth).max()
    np.testing.assert_allclose(found, truth, atol=1e-5 * np.abs(truth).max())


def test_one_transmitter_of_several_stands_elsewhere(two_places):
    names = [e.name for e in catalogue(two_places.sites, two_places.data, "transmitter_displacement")]
    assert names == [
        *("transmitter_displacement", "transmitter_displacement[each_link]"),
        "transmitter_displacement[transmitter_0]",
    ]
    shift = np.array([0.02, -0.03, 0.01])
    moved = PLACES + shift * np.array([[1.0], [1.0], [0.0]])
    found = sites_of(two_places, "transmitter_displacement[transmitter_0]", displacement=shift)["path_delay"]
    mask = np.asarray(two_places.data["paths"].mask)
    expected = np.asarray(small_world.trace(tx=moved).delay)[small_world.MASK]
    np.testing.assert_allclose(found[mask], expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["swapped_transmitters", "transmitter_displacement"])
def test_effects_of_places_keep_the_contract(two_places, name):
    for effect in catalogue(two_places.sites, two_places.data, name):
        check_effect(effect, two_places.model, two_places.data)


def test_a_missing_wall_weakens_what_crosses_it(world):
    offered = catalogue(world.sites, world.data, "missing_object")
    assert 5 < len(offered) < 100
    base = sites_of(world)["path_gain"]
    directs = []
    for effect in offered:
        x1, y1, x2, y2 = map(float, effect.instance.replace("_to_", "_").split("_"))
        weakened = sites_of(world, effect.name, loss=0.5, phase=0.0)["path_gain"][:, 0]
        for link in (0, 2):  # in line of sight
            tx, rx = small_world.TX[link, :2], small_world.RX[link, :2]
            along = (x1 - tx[0]) / (rx[0] - tx[0]) if x1 == x2 else (y1 - tx[1]) / (rx[1] - tx[1])
            point = tx + along * (rx - tx)
            low, high = sorted((y1, y2)) if x1 == x2 else sorted((x1, x2))
            inside = 0 < along < 1 and low + 0.06 < point[1 if x1 == x2 else 0] < high - 0.06
            edge = 0 < along < 1 and min(abs(point[1 if x1 == x2 else 0] - e) for e in (low, high)) <= 0.06
            if not edge:
                expected = base[link, 0] * (np.exp(-0.5) if inside else 1.0)
                np.testing.assert_allclose(weakened[link], expected, rtol=1e-5)
                directs.append(inside)
    assert any(directs)
    assert not all(directs)


def test_the_strongest_paths_are_kept():
    paths = plain(small_world.trace())
    fewer = strongest(paths, 3)
    power = np.sort(np.abs(gain(paths)) ** 2, axis=1)[:, ::-1]
    np.testing.assert_allclose(np.abs(gain(fewer)) ** 2, power[:, :3], rtol=1e-6)
    with pytest.raises(InputError, match="1 path per link"):
        strongest(paths, 0)


def test_another_trace_adds_only_what_is_new():
    paths = plain(small_world.trace())
    whole = eqx.tree_at(lambda p: p.mask, plain(small_world.trace()), jnp.asarray(small_world.THERE))
    joined = with_beyond(paths, "more", whole, 4)
    np.testing.assert_allclose(gain(joined)[:, :7], gain(paths))
    assert not gain(joined)[:, 7:].any()
    assert int(np.sum(np.asarray(only(joined, "more")))) == 2
    np.testing.assert_allclose(
        np.sort(np.abs(gain(with_all(joined))[joined.beyond > 0])),
        np.sort(np.abs(gain(whole)[small_world.BEYOND > 0])),
        rtol=1e-6,
    )
    halves = joined.take([2, 0])
    assert np.asarray(halves.beyond).sum(axis=1).tolist() == [0, 1]
    with pytest.raises(InputError, match="each once"):
        with_beyond(joined, "more", whole, 4)
    with pytest.raises(InputError, match="more"):
        only(joined, "mor")


def test_a_path_that_comes_a_rounding_error_later_is_known():
    """Also where half a picosecond lies between."""
    paths, later = plain(small_world.trace()), 1e-12 * np.nextafter(100.5, 101)
    paths, whole = (
        eqx.tree_at(lambda p: p.delay, paths, paths.delay.at[0, 0].set(delay))
        for delay in (1e-12 * np.nextafter(100.5, 100), later)
    )
    assert not np.any(only(with_beyond(paths, "again", whole, 4), "again"))
    moved = eqx.tree_at(lambda p: p.delay, paths, paths.delay.at[0, 0].set(later + 2e-12))
    assert int(np.sum(np.asarray(only(with_beyond(paths, "again", moved, 4), "again")))) == 1


def test_paths_of_other_traces_survive_a_file(tmp_path):
    from dtprob.raytracing import storage

    paths = small_world.trace()
    storage.save(paths, tmp_path / "paths.nc")
    again = storage.load(tmp_path / "paths.nc")
    assert again.beyond_names == ("depth", "refraction")
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), again.beyond, paths.beyond))
