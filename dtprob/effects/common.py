"""What the families of effects share: parameters, bases, and how to read a model's sites and data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from dtprob.effects.effect import Effect, Meaning, Parameter, Rewrite, ToldAs
from dtprob.effects.meaning import SiteLike, means
from dtprob.raytracing.paths import NONE, PathSet

type Sites = Mapping[str, SiteLike]
type Data = Mapping[str, Any]
type Family = Callable[[Sites, Data], Sequence[Effect]]

SIDES: Final = ("rx", "tx")
"""The two ends of a link."""
DIRECTIONS: Final = ("x", "y", "z")
"""Of the world's axes."""
COMPLEX: Final = ("real", "imaginary")
"""The entries of a complex number."""


def normal(
    name: str, scale: float, unit: str = "1", size: int | None = None, labels: tuple[str, ...] = ()
) -> Parameter:
    """A parameter that may take either sign, N(0, scale^2), one number or a vector of `size`, its entries labelled."""
    prior = dist.Normal(0.0, scale)
    whole = prior if size is None else prior.expand((size,)).to_event(1)
    return Parameter(name, whole, 0.0, unit, labels=labels)


def half_normal(name: str, scale: float, unit: str = "1") -> Parameter:
    """A parameter that is zero or more, |N(0, scale^2)|; its density at the null itself counts too."""
    return Parameter(name, dist.HalfNormal(scale, validate_args=False), 0.0, unit)


def told(parameter: Parameter, words: str, told_as: ToldAs = "number") -> Parameter:
    """The parameter with what its size means to people; see `Meaning`."""
    return replace(parameter, meaning=Meaning(words, told_as))


def place(name: str, tried: Float[np.ndarray, " n"], unit: str, *, centre: float, spread: float) -> Parameter:
    """Where an effect acts, N(centre, spread^2), looked for at the tried values."""
    prior = dist.Normal(centre, spread)
    return Parameter(name, prior, centre, unit, is_place=True, tried=tuple(tried.tolist()))


def offers(sites: Sites, *names: str) -> bool:
    """Whether the model computes all these sites, and means by them what the effects do; see `dtprob.effects.meaning`."""
    return all(
        name in sites and sites[name].kind == "deterministic" and means(sites[name], name) for name in names
    )


def of_model(sites: Sites, table: Mapping[str, Rewrite]) -> dict[str, Rewrite]:
    """Those of the rewrites whose site the model computes."""
    return {name: rewrite for name, rewrite in table.items() if offers(sites, name)}


def has_phase(sites: Sites) -> bool:
    """Whether the model computes a complex channel, not only powers."""
    return offers(sites, "noiseless_channel") and sites["noiseless_channel"].is_complex


def is_coherent(sites: Sites, data: Data) -> bool:
    """Whether the phase of one packet can be compared with that of another."""
    own = any(s.kind == "latent" and s.is_circular and "path" not in s.axes for s in sites.values())
    return has_phase(sites) and data.get("phase", "coherent") == "coherent" and not own


def reference_power(data: Data) -> Float[np.ndarray, " 1"] | None:
    """Mean square of the measured channel, the unit of what depends on the level; None without data.

    An array, since programs are compiled anew for another number but not for another array.
    """
    channel = data.get("channel")
    return None if channel is None else np.mean(np.abs(np.asarray(channel)) ** 2, keepdims=True).reshape(1)


@jax.jit
def phasor(phase: Float[Array, "*n"]) -> Complex[Array, "*n"]:
    """exp(j phase), exactly 1 at phase 0; told before it is broadcast, not once for each entry of what it turns."""
    return lax.optimization_barrier(lax.complex(jnp.cos(phase), jnp.sin(phase)))


def square(value: Complex[Array, "*n"]) -> Float[Array, "*n"]:
    """Squared magnitude, with a derivative at 0."""
    return jnp.real(value) ** 2 + jnp.imag(value) ** 2


def chain(context: Mapping[str, Any]) -> Complex[Array, "*link_snapshot_rx_tx_subcarrier"]:
    """What the devices' chains do to all paths alike, broadcastable to the channel."""
    factor = jnp.asarray(context["frequency_response"])
    if "receiver_gain" in context:
        factor = factor * context["receiver_gain"][:, None, None, None, None]
    if "receiver_delay" in context:
        turn = context["receiver_delay"][:, None] * jnp.asarray(context["subcarrier_frequency"])
        factor = factor * phasor(-2 * jnp.pi * turn)[:, None, None, None, :]
    return factor


def complex_of(pair: Float[Array, "*n 2"]) -> Complex[Array, "*n"]:
    """Real and imaginary part as one complex number."""
    return lax.complex(pair[..., 0], pair[..., 1])


@dataclass(frozen=True)
class Band:
    """The measured band, from the lowest to the highest subcarrier.

    Attributes:
        centre: Hz from the carrier.
        width: Hz.
        size: number of subcarriers.
    """

    centre: float
    width: float
    size: int

    def position(self, frequency: Float[Array, " subcarrier"]) -> Float[Array, " subcarrier"]:
        """Place in the band, -1 at its lower and 1 at its upper edge."""
        return (jnp.asarray(frequency) - self.centre) * (2.0 / self.width)


def band(data: Data) -> Band | None:
    """The band of the data, None with fewer than two subcarriers."""
    frequency = data.get("subcarrier_frequency")
    if frequency is None or np.size(frequency) < 2:
        return None
    values = np.asarray(frequency, dtype=float)
    low, high = float(values.min()), float(values.max())
    return Band((low + high) / 2, high - low, values.size)


def legendre(x: Float[Array, "*n"], orders: Sequence[int]) -> Float[Array, "*n order"]:
    """Legendre polynomials P_order(x) on [-1, 1]."""
    columns = [
        jnp.polyval(jnp.asarray(np.polynomial.legendre.leg2poly(np.eye(order + 1)[order])[::-1]), x)
        for order in orders
    ]
    return jnp.stack(columns, axis=-1)


@dataclass(frozen=True)
class Clock:
    """When snapshots were taken.

    Attributes:
        start: time of the first, s.
        span: from the first to the last, s.
        step: median distance of neighbours, s.
    """

    start: float
    span: float
    step: float

    def elapsed(self, time: Float[Array, " snapshot"]) -> Float[Array, " snapshot"]:
        """Time since the first snapshot in s."""
        return jnp.asarray(time) - self.start


def clock(data: Data) -> Clock | None:
    """The clock of the data, None with fewer than two different snapshot times."""
    time = data.get("snapshot_time")
    if time is None or np.size(time) < 2:
        return None
    values = np.sort(np.asarray(time, dtype=float))
    span = float(values[-1] - values[0])
    return Clock(float(values[0]), span, float(np.median(np.diff(values))) or span) if span > 0 else None


def n_snapshot(sites: Sites) -> int:
    """Number of snapshots that the data hold."""
    observed = [s for s in sites.values() if s.kind == "observed" and "snapshot" in s.axes]
    return max((site.shape[site.axes.index("snapshot")] for site in observed), default=1)


def links_and_paths(phase: Float[Array, "link snapshot path"], context: Data) -> tuple[int, int]:
    """Numbers of links and paths in this run, by the gains if the model computes these: one phase may be for all."""
    links, _, paths = context["path_gain"][:, None].shape if "path_gain" in context else phase.shape
    return links, paths


def n_antenna(sites: Sites, side: str) -> int:
    """Number of antennas at one end, 1 where the model has no response for it."""
    name = f"{side}_response"
    return sites[name].shape[-1] if offers(sites, name) else 1


def array_of(data: Data, side: str) -> np.ndarray | None:
    """Element positions in m of the array at one end, None where there are fewer than two elements."""
    array = data.get(f"{side}_array")
    return np.asarray(array, dtype=float) if array is not None and np.shape(array)[0] > 1 else None


def positions(context: Data, side: str) -> Float[Array, "antenna 3"]:
    """Element positions in m at one end, its centre where no array is known."""
    array = context.get(f"{side}_array")
    return jnp.zeros((1, 3)) if array is None else jnp.asarray(array)


def touched_objects(data: Data) -> list[tuple[int, str]]:
    """Index and name of every object that an existing path meets, in the order of the scene."""
    paths: PathSet | None = data.get("paths")
    if paths is None:
        return []
    met = (np.asarray(paths.interaction) != NONE) & np.asarray(paths.mask)[..., None]
    found = np.unique(np.asarray(paths.object)[met])
    return [(int(index), paths.object_names[int(index)]) for index in found]


def meets(
    paths: PathSet, index: int | Int[Array, ""], codes: Sequence[int] = ()
) -> Bool[Array, "link path depth"]:
    """Which steps of which paths meet an object, by interactions among `codes` (any by default)."""
    interaction = jnp.asarray(paths.interaction)
    wanted = jnp.isin(interaction, jnp.asarray(codes)) if codes else interaction != NONE
    return wanted & (jnp.asarray(paths.object) == index) & jnp.asarray(paths.mask)[..., None]


def observable_basis(
    vectors: Float[np.ndarray, "n 3"], tolerance: float = 1e-3
) -> Float[np.ndarray, "rank 3"]:
    """Orthonormal directions that span `vectors`, along the axes of the world where these lie in the span.

    Args:
        vectors: what a displacement is seen through, one row each.
        tolerance: singular values below this share of the largest count as zero.
    """
    _, size, rows = np.linalg.svd(np.asarray(vectors, dtype=float).reshape(-1, 3), full_matrices=False)
    span = rows[size > tolerance * max(float(size.max(initial=0.0)), 1e-300)]
    projector, basis = span.T @ span, []
    for _ in range(len(span)):
        axis = int(np.argmax(np.round(np.diag(projector), 9)))
        direction = projector[axis] / np.linalg.norm(projector[axis])
        basis.append(direction)
        projector = projector - np.outer(direction, direction)
    return np.asarray(basis).reshape(-1, 3)


def along(basis: Float[np.ndarray, "rank 3"]) -> str:
    """The directions of a basis as text."""
    return ", ".join("(" + " ".join(f"{x:.2f}" for x in np.round(row, 2) + 0.0) + ")" for row in basis)


def axis_labels(basis: Float[np.ndarray, "rank 3"]) -> tuple[str, ...]:
    """Labels of the components along a basis: the world's axes where it is these; none, so indices, elsewhere."""
    return DIRECTIONS if len(basis) == len(DIRECTIONS) else ()


def each_antenna(count: int, side: str) -> list[tuple[int, str]]:
    """Index and instance name of every antenna of an array of more than two, as (3, "rx_3")."""
    return [(i, f"{side}_{i}") for i in range(count)] if count > 2 else []


def on_axis(vector: jax.Array, axis: str, axes: Sequence[str]) -> jax.Array:
    """A vector laid along one named axis of an array, with axes of size 1 elsewhere."""
    shape = [1] * len(axes)
    shape[list(axes).index(axis)] = vector.shape[0]
    return vector.reshape(shape)
