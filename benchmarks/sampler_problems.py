"""The models that samplers are compared on, each on one data set: dtprob's, plain NumPyro's, and arrays for others."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer.reparam import CircularReparam
from scipy.constants import epsilon_0

from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.multi_access import Clusters, multi_access

PATHS, TONES, FREQUENCY = 8, 64, 6.0e9
TRUTH = {"permittivity": 5.31, "conductivity": 0.139, "concentration": 2.0}

type Draws = Mapping[str, Any]


class Ours(NamedTuple):
    """What an engine of dtprob is given.

    Attributes:
        model: the model.
        data: its arguments.
        quantities: of the draws by site, what is compared, (quantity, chain, draw).
        settings: of the engine, where it has no chains.
    """

    model: Callable[..., None]
    data: dict[str, Any]
    quantities: Callable[[Draws], np.ndarray]
    settings: Mapping[str, Any] = MappingProxyType({})


class Problem(NamedTuple):
    """A model on a data set.

    Attributes:
        ours: dtprob's engines, by name.
        naive: as the formulas stand, for plain NumPyro; angles as it advises, or they get stuck.
        given: its arguments.
        naive_quantities: as `quantities`, of its draws.
        arrays: what a rival in another environment needs.
    """

    ours: Mapping[str, Ours]
    naive: Callable[..., None]
    given: tuple[Any, ...]
    naive_quantities: Callable[[Draws], np.ndarray]
    arrays: dict[str, Any]


def channel(links: int) -> Problem:
    """Materials of a phase-error channel.

    Each link has 8 paths with random delays that 64 tones tell apart; gains follow Fresnel's law at one unknown
    permittivity and conductivity; phase errors, their concentration and the noise power are unknown.
    """
    data = _measured(links)
    known = {name: jnp.asarray(value) for name, value in data.items() if name != "y"}

    def materials(draws: Draws) -> np.ndarray:
        return np.stack([1 + np.asarray(draws["contrast"]), np.asarray(draws["conductivity"])])

    reduced = Ours(reduced_channel, _statistics(data), materials)
    return Problem(
        {"blackjax_nuts": reduced, "nuts": reduced},
        numpyro.handlers.reparam(naive_channel, config={"error": CircularReparam()}),
        (known, jnp.asarray(data["y"])),
        materials,
        data,
    )


def _measured(links: int) -> dict[str, Any]:
    """Data of the channel, and what is known of it."""
    random = np.random.default_rng(links)
    delay = np.sort(random.uniform(0, TONES / PATHS - 1.5, (links, PATHS))) + np.arange(PATHS) * TONES / PATHS
    columns = np.exp(-2j * np.pi * np.arange(TONES)[:, None] * delay[:, None] / TONES)
    base, cosine = random.uniform(0.3, 1.0, (links, PATHS)), random.uniform(0.2, 0.95, (links, PATHS))
    data: dict[str, Any] = {"columns": columns, "base": base, "cosine": cosine}
    data["loss_per_conductivity"] = 1 / (2 * np.pi * FREQUENCY * epsilon_0)
    error = random.vonmises(0.0, TRUTH["concentration"], (links, PATHS))
    weight = np.asarray(gain(TRUTH["permittivity"], TRUTH["conductivity"], data)) * np.exp(1j * error)
    clean = np.einsum("ltp,lp->lt", columns, weight)
    noise = 0.01 * float(np.mean(np.abs(clean) ** 2))
    drawn = random.normal(size=(2, *clean.shape)) * np.sqrt(noise / 2)
    return data | {"noise": noise, "y": clean + drawn[0] + 1j * drawn[1]}


def gain(permittivity: Any, conductivity: Any, data: Mapping[str, Any]) -> Any:
    """Gain of each path: Fresnel's coefficient of a half-space, across the plane of incidence."""
    eta = permittivity - 1j * conductivity * data["loss_per_conductivity"]
    root = jnp.sqrt(eta - 1 + data["cosine"] ** 2)
    return data["base"] * (data["cosine"] - root) / (data["cosine"] + root)


def unknowns(noise: Any) -> tuple[Any, Any, Any, Any]:
    """Concentration, permittivity, conductivity, noise power."""
    concentration: Any = numpyro.sample("concentration", dist.LogNormal(0.0, 1.5))
    contrast: Any = numpyro.sample("contrast", dist.LogNormal(jnp.log(4.0), 0.4))
    conductivity: Any = numpyro.sample("conductivity", dist.LogNormal(jnp.log(0.1), 1.0))
    return (
        concentration,
        1 + contrast,
        conductivity,
        numpyro.sample("noise", dist.LogNormal(jnp.log(noise), 0.1)),
    )


def naive_channel(data: Mapping[str, Any], y: Any) -> None:
    """As the formulas stand."""
    concentration, permittivity, conductivity, noise = unknowns(data["noise"])
    with numpyro.plate("link", len(data["base"]), dim=-2), numpyro.plate("path", PATHS, dim=-1):
        error: Any = numpyro.sample("error", dist.VonMises(0.0, concentration))
    weight = gain(permittivity, conductivity, data) * jnp.exp(1j * error)
    mean = jnp.einsum("ltp,lp->lt", data["columns"], weight)
    spread = jnp.sqrt(noise / 2)
    numpyro.sample("real", dist.Normal(mean.real, spread).to_event(2), obs=y.real)
    numpyro.sample("imaginary", dist.Normal(mean.imag, spread).to_event(2), obs=y.imag)


def reduced_channel(data: Mapping[str, Any], root: Any, outside: Any, y: Any) -> None:
    """Through sufficient statistics, whole phases instead of errors."""
    concentration, permittivity, conductivity, noise = unknowns(data["noise"])
    found = gain(permittivity, conductivity, data)
    direction = jnp.arctan2(found.imag, found.real)
    with numpyro.plate("link", len(root), dim=-2), numpyro.plate("path", PATHS, dim=-1):
        phase: Any = numpyro.sample("phase", dist.VonMises(direction, concentration))
        weight = jnp.abs(found) * jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
        mean = jnp.sum(root * weight[:, None], axis=-1)
        numpyro.sample("y", ComplexNormal(mean, noise), obs=y)
    with numpyro.plate("links", len(root)):
        numpyro.sample("outside", dist.Gamma(float(TONES - PATHS), 1 / noise), obs=outside)


def _statistics(data: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `reduced_channel`."""
    basis, root = np.linalg.qr(data["columns"])
    y = np.einsum("ltp,lt->lp", basis.conj(), data["y"])
    outside = np.sum(np.abs(data["y"] - np.einsum("ltp,lp->lt", basis, y)) ** 2, axis=-1)
    known = {name: data[name] for name in ("base", "cosine", "loss_per_conductivity", "noise")}
    return {"data": known, "root": root, "outside": outside, "y": y}


def multi_access_log(slots: int) -> Problem:
    """Tables of a network of four devices in two clusters, from a log: joint arrivals, and deliveries given senders.

    Which senders are delivered is left out for everyone, since it tells nothing of the tables.
    """
    random = np.random.default_rng(slots)
    sending = random.random((1, slots, 4)) < 0.4
    senders = sending[0].sum(1)
    arrival = np.asarray([[0.6, 0.15, 0.15, 0.1], [0.4, 0.3, 0.1, 0.2]])
    arrivals = np.stack([random.choice(4, slots, p=row) for row in arrival], axis=1)
    reception = [1.0, 0.9, 0.5, 0.3, 0.15]
    deliveries = np.asarray([min(n, random.binomial(n, reception[n])) for n in senders])
    data = {
        "sending": sending,
        "previous": np.zeros((1, slots, 2), np.int32),
        "valid": np.ones((1, slots), bool),
        "clusters": Clusters(((0, 1), (2, 3))),
        "concentration": 1.0,
        "arrivals": arrivals[None],
        "deliveries": deliveries[None],
        "successes": _first_senders(sending, deliveries),
    }

    def ours(draws: Draws) -> np.ndarray:
        tables = np.exp(draws["log_arrival"])[:, :, :, 0], np.exp(draws["log_reception"])[:, :, 1:, :1]
        return np.stack([*np.moveaxis(tables[0], 2, 0)[..., 0], *np.moveaxis(tables[1][..., 0], 2, 0)])

    def theirs(draws: Draws) -> np.ndarray:
        rows = [np.asarray(draws["arrival"])[:, :, k, 0] for k in range(2)]
        return np.stack(rows + [np.asarray(draws[f"reception_{n}"])[..., 0] for n in range(1, 5)])

    arrays = {"senders": senders, "arrivals": arrivals, "deliveries": deliveries}
    given = tuple(jnp.asarray(value) for value in arrays.values())
    counts = {
        "arrivals": np.stack([np.bincount(column, minlength=4) for column in arrivals.T]),
        "deliveries": np.stack([np.bincount(deliveries[senders == n], minlength=5) for n in range(5)]),
    }
    reduced = Ours(reduced_multi_access, counts, theirs)
    engines = {
        "exact": Ours(multi_access, data, ours, {"draws": 1000}),
        "blackjax_nuts": reduced,
        "nuts": reduced,
    }
    return Problem(engines, naive_multi_access, given, theirs, arrays)


def _first_senders(sending: np.ndarray, deliveries: np.ndarray) -> np.ndarray:
    """Deliveries by device: of the senders the first ones."""
    return (sending & (np.cumsum(sending, axis=-1) <= deliveries[..., None])).astype(int)


def tables() -> tuple[Any, list[Any]]:
    """Probabilities of joint arrivals, (cluster, outcome), and of deliveries given one, two, ... senders."""
    with numpyro.plate("cluster", 2):
        arrival = numpyro.sample("arrival", dist.Dirichlet(jnp.ones(4)))
    return arrival, [numpyro.sample(f"reception_{n}", dist.Dirichlet(jnp.ones(n + 1))) for n in range(1, 5)]


def reduced_multi_access(arrivals: Any, deliveries: Any) -> None:
    """Through how often what occurred."""
    arrival, rows = tables()
    with numpyro.plate("clusters", 2):
        total = jnp.sum(arrivals, axis=-1)
        numpyro.sample("arrivals", dist.MultinomialProbs(arrival, total), obs=arrivals)
    for n, row in enumerate(rows, start=1):
        found = deliveries[n, : n + 1]
        numpyro.sample(f"deliveries_{n}", dist.MultinomialProbs(row, jnp.sum(found)), obs=found)


def naive_multi_access(senders: Any, arrivals: Any, deliveries: Any) -> None:
    """As the formulas stand: slot by slot."""
    arrival, rows = tables()
    table = jnp.stack([jnp.eye(5)[0], *(jnp.pad(row, (0, 4 - n)) for n, row in enumerate(rows, start=1))])
    with numpyro.plate("slot", len(senders)):
        for k in range(2):
            numpyro.sample(f"arrivals_{k}", dist.Categorical(probs=arrival[k]), obs=arrivals[:, k])
        numpyro.sample("deliveries", dist.Categorical(probs=table[senders]), obs=deliveries)


PROBLEMS: Mapping[str, Callable[[], Problem]] = {
    "channel, 10 links": lambda: channel(10),
    "channel, 50 links": lambda: channel(50),
    "multi-access, 5000 slots": lambda: multi_access_log(5000),
}
"""By name, what makes the problem."""
