"""A small ray-traced world with exact geometry, and a channel model with all sites that effects touch."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import declare, model
from dtprob.models.scene import AXES
from dtprob.raytracing import field
from dtprob.raytracing.beyond import with_all
from dtprob.raytracing.geometry import unfold
from dtprob.raytracing.paths import NONE, REFRACTION, SPECULAR, PathSet, validate

FREQUENCY = 3.0e9
SPEED = 299_792_458.0
SIZES = ("snapshot_time", "rx_array", "tx_array", "subcarrier_frequency")
CHANNEL_AXES = ("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier")

# Objects: planes by a point and a unit normal.
POINT = np.array([[10.0, 0, 0], [0, 8.0, 0], [0, 0, 0.0], [2.5, 0, 0]])
NORMAL = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [0, 0, 1.0], [1.0, 0, 0]])
NAMES = ("east", "slanted", "floor", "partition")
TX = np.array([[0.0, 0.0, 2.0]] * 3)
RX = np.array([[5.0, 1.0, 1.5], [6.0, -2.0, 1.2], [4.0, 2.0, 1.8]])

S, R = SPECULAR, REFRACTION
# (interactions, objects) of the paths that could exist; a path through the partition, others around it.
KINDS = [
    ((NONE, NONE), (0, 0)),
    ((S, NONE), (0, 0)),
    ((S, NONE), (1, 0)),
    ((S, NONE), (2, 0)),
    ((S, S), (2, 0)),
    ((S, S), (1, 2)),
    ((R, S), (3, 0)),
]
MASK = np.array([[1, 1, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 0, 1], [1, 1, 0, 1, 1, 1, 1]], bool)
# Masked paths that other traces would find: a passage through the partition, a path of two reflections.
BEYOND = np.array([[0, 0, 0, 0, 0, 0, 2], [0, 0, 0, 0, 0, 1, 0], [0] * 7])
THERE = MASK | (BEYOND > 0)


def trace(rx: Any = 0.0, tx: Any = 0.0, planes: Any = 0.0) -> PathSet:
    """The path set by the image method in double precision, ends and planes displaced by so much, m."""
    n_link, n_path = MASK.shape
    code = np.broadcast_to([kind[0] for kind in KINDS], (n_link, n_path, 2))
    objects = np.broadcast_to([kind[1] for kind in KINDS], (n_link, n_path, 2))
    normal = NORMAL[objects].reshape(-1, 2, 3)
    point = (POINT + planes)[objects].reshape(-1, 2, 3)
    tx, rx = TX + np.asarray(tx), RX + np.asarray(rx)
    each_tx, each_rx = np.repeat(tx, n_path, axis=0), np.repeat(rx, n_path, axis=0)
    exact = unfold(each_tx, each_rx, code.reshape(-1, 2), normal, point)
    shape = (n_link, n_path)
    length, arrival, departure = (
        exact.length.reshape(shape),
        exact.arrival.reshape(*shape, 3),
        exact.departure,
    )
    departure, delay = departure.reshape(*shape, 3), length / SPEED
    up = np.array([0.1, 0.2, 1.0])

    def across(k):
        vector = up - np.sum(up * k, -1, keepdims=True) * k
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)

    return validate(
        PathSet(
            delay=jnp.asarray(delay),
            carrier_phasor=jnp.exp(-2j * np.pi * np.mod(FREQUENCY * delay, 1.0)),
            departure=jnp.asarray(departure),
            arrival=jnp.asarray(arrival),
            mask=jnp.asarray(MASK),
            interaction=jnp.asarray(np.where(THERE[..., None], code, NONE)),
            object=jnp.asarray(np.where(THERE[..., None], objects, 0)),
            vertex=jnp.asarray(exact.vertex.reshape(*shape, 2, 3)),
            normal=jnp.asarray(normal.reshape(*shape, 2, 3)),
            length=jnp.asarray(length),
            tx_field=jnp.asarray(across(departure)),
            rx_field=jnp.asarray(across(arrival)),
            rx_position=jnp.asarray(rx),
            tx_position=jnp.asarray(tx),
            object_material=jnp.asarray([0, 1, 0, 1]),
            permittivity=jnp.asarray([4.0, 5.0, 4.0, 5.0]),
            conductivity=jnp.asarray([0.05, 0.02, 0.05, 0.02]),
            thickness=jnp.full(4, 0.1),
            frequency=FREQUENCY,
            object_names=NAMES,
            material_names=("concrete", "brick"),
            beyond=jnp.asarray(BEYOND),
            beyond_names=("depth", "refraction"),
        )
    )


@jax.jit
def _gain(paths, permittivity, conductivity, thickness):
    return field.path_gain(with_all(paths), permittivity, conductivity, thickness=thickness)


@jax.jit
def _sum(gain, delay, phase, responses, subcarrier_frequency):
    rx, tx, response = responses
    tone = jnp.exp(-2j * jnp.pi * (FREQUENCY + subcarrier_frequency) * delay[..., None]) * response
    weight = gain[:, None] * jnp.exp(1j * phase)
    return jnp.einsum("lsp,lpr,lpt,lpk->lsrtk", weight, rx, tx, tone)


@model(
    axes={**AXES, "thickness": ("object",)},
    cluster="link",
)
def world_channel(
    paths,
    subcarrier_frequency,
    *,
    rx_array=None,
    tx_array=None,
    noise_power=None,
    snapshot_time=None,
    channel=None,
):
    """h = sum_p a_p exp(-j 2 pi (f_c + f_k) tau_p) times the array responses, each factor a site."""
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.1))
    permittivity = numpyro.deterministic("permittivity", 1.0 + scale * (paths.permittivity - 1.0))
    conductivity = numpyro.deterministic("conductivity", paths.conductivity)
    thickness = numpyro.deterministic("thickness", paths.thickness)
    gain = _gain(paths, permittivity, conductivity, thickness)
    if paths.beyond_names:
        gain = gain * numpyro.deterministic("path_share", paths.mask.astype(float))
    gain = numpyro.deterministic("path_gain", gain)
    delay = numpyro.deterministic("path_delay", paths.delay)
    departure = numpyro.deterministic("departure", paths.departure)
    arrival = numpyro.deterministic("arrival", paths.arrival)
    phase = numpyro.deterministic("path_phase", jnp.zeros((delay.shape[0], 1, delay.shape[1])))
    per_metre = 2j * jnp.pi / paths.wavelength
    one = jnp.zeros((1, 3))
    tx_array, rx_array = one if tx_array is None else tx_array, one if rx_array is None else rx_array
    tx = numpyro.deterministic("tx_response", jnp.exp(per_metre * departure @ tx_array.T))
    rx = numpyro.deterministic("rx_response", jnp.exp(-per_metre * arrival @ rx_array.T))
    response = numpyro.deterministic("frequency_response", jnp.ones(subcarrier_frequency.shape[0], complex))
    noiseless = _sum(gain, delay, phase, (rx, tx, response), subcarrier_frequency)
    noiseless = numpyro.deterministic("noiseless_channel", noiseless)
    level = 1e-9 if noise_power is None else noise_power
    noise = numpyro.deterministic("noise_power", jnp.full((1, 1, 1, 1, 1), level))
    snapshots = 1 if snapshot_time is None else snapshot_time.shape[0]
    shape = (delay.shape[0], snapshots, rx_array.shape[0], tx_array.shape[0], subcarrier_frequency.shape[0])
    loc = jnp.broadcast_to(noiseless, shape)
    with numpyro.plate("link", shape[0], dim=-5):
        numpyro.sample("channel", ComplexNormal(loc, noise), obs=channel)
    return noiseless


@dataclass(frozen=True)
class World:
    """The model, its data and its sites."""

    model: Any
    data: dict[str, Any]
    sites: Any


def build(**changes: Any) -> World:
    """The world with some of the data replaced, and with any channel of the right shape."""
    half = 0.5 * SPEED / FREQUENCY
    data = {
        "paths": trace(),
        "subcarrier_frequency": 2.0e6 * (jnp.arange(17) - 8.0),
        "rx_array": half / 2 * jnp.asarray([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]),
        "tx_array": half * jnp.asarray([[0.0, -1, 0], [0, 0, 0], [0, 1, 0]]),
        "noise_power": 1e-9,
        "snapshot_time": 1e-3 * jnp.arange(8.0),
    }
    data |= changes
    shape = [3, *(1 if data[name] is None else len(data[name]) for name in SIZES)]
    data["channel"] = 1e-3 * jax.random.normal(jax.random.key(0), shape, complex)
    return World(world_channel, data, declare(world_channel, data).sites)


def drawn() -> World:
    """The world with everything in it: two arrays, a band, snapshots in time, a drawn channel."""
    full = build()
    data = {**full.data, "channel": None}
    seeded = numpyro.handlers.seed(world_channel, jax.random.key(0))
    data["channel"] = numpyro.handlers.trace(seeded).get_trace(**data)["channel"]["value"]
    return World(full.model, data, full.sites)
