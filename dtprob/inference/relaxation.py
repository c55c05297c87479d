"""Expectations over independent angles of a log density that is affine in each angle's (cos z, sin z).

The class of models. Given everything else, the log joint density is affine in x_e = (cos z_e, sin z_e) for
each entry e of the circular latent sites, and couples entries at most in pairs:
    log p = c + sum_e l_e . x_e + 1/2 sum_{e != f} x_e . Q_ef x_f.
Gaussian observations of sums of phasors e^{j z_p} a_p are of this kind (|e^{j z}| = 1 makes the squares
constant), and so are von Mises priors and couplings cos(z_e - z_f).

l and Q come from derivatives of the model's density with respect to the angles: with t = d x / d z,
    d log p / d z_e = t_e . (l_e + sum_f Q_ef x_f),   d2 log p / d z_e d z_f = t_e . Q_ef t_f,
at angles 0 and pi / 2. They are found once for given other sites; the E-step then does not touch the data.

As a function of the other sites the expectation is a mean over points: under independent angles with mean
resultants R_e (cos mu_e, sin mu_e) it depends on these alone, so half the weight on each of mu_e +- arccos
R_e gives it. With signs from the columns of a Hadamard matrix, which are pairwise balanced, the mean over
its rows is exact.

Entries that are never coupled share a column ("colour"): those that differ along an axis that all circular
sites have and that separates, such as the link. What they share otherwise is their group.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from dtprob.errors import InputError
from dtprob.inference.coupling import angle_sites, separating_axes
from dtprob.inference.modes import objective_value
from dtprob.inference.target import Inputs, Target

_MOST_COLOURS = 256
_TRIALS = 3


class Layout(NamedTuple):
    """Which entries are coupled: those of one group.

    Attributes:
        table: the entry of each group and colour, (group, colour).
        signs: pairwise balanced signs for the colours, (row, colour).
    """

    table: Int[Array, "group colour"]
    signs: Float[Array, "row colour"]

    def flat(self, values: Float[Array, "group colour"]) -> Float[Array, " angle"]:
        """Values by group and colour in the order of the target's angles."""
        return jnp.zeros(values.size, values.dtype).at[self.table].set(values)


class Resultants(NamedTuple):
    """Independent distributions of angles by their mean resultants.

    Attributes:
        direction: mu, rad, (group, colour).
        length: R, between 0 and 1, (group, colour).
    """

    direction: Float[Array, "group colour"]
    length: Float[Array, "group colour"]

    @property
    def vector(self) -> Float[Array, "group colour 2"]:
        """The means of (cos z, sin z)."""
        unit = jnp.stack([jnp.cos(self.direction), jnp.sin(self.direction)], axis=-1)
        return self.length[..., None] * unit


class Quadratic(NamedTuple):
    """The log joint as a function of the angles' (cos z, sin z), other sites fixed.

    Attributes:
        constant: c, nats.
        linear: l.
        coupling: Q, zero between an entry and itself.
    """

    constant: Scalar
    linear: Float[Array, "group colour 2"]
    coupling: Float[Array, "group colour colour 2 2"]

    def parameter(self, mean: Float[Array, "group colour 2"]) -> Float[Array, "group colour 2"]:
        """Natural parameters eta = d E[log p] / d m."""
        return self.linear + jnp.einsum("gcdij,gdj->gci", self.coupling, mean)

    def expectation(self, mean: Float[Array, "group colour 2"]) -> Float[Array, " group"]:
        """Each group's part of E[log p]; the constant is left out, nats."""
        return 0.5 * jnp.sum(mean * (self.linear + self.parameter(mean)), axis=(1, 2))


def log_joint(
    target: Target, angles: Float[Array, " angle"], rest: Float[Array, " dimension"], inputs: Inputs
) -> Scalar:
    """Log of prior times likelihood at angles, the other coordinates taken from `rest`."""
    return -objective_value(target, "map", rest.at[target.angles].set(angles), inputs)


def expected_log_joint(
    target: Target, layout: Layout, angles: Resultants, rest: Float[Array, " dimension"], inputs: Inputs
) -> Scalar:
    """E[log p] over independent angles, as a function of the other sites; nats."""
    spread = jnp.arccos(jnp.clip(angles.length, 0.0, 1.0))

    def at(signs: Array) -> Array:
        return log_joint(target, layout.flat(angles.direction + signs * spread), rest, inputs)

    return jnp.mean(jax.vmap(at)(layout.signs))


def quadratic(target: Target, layout: Layout, rest: Float[Array, " dimension"], inputs: Inputs) -> Quadratic:
    """The log joint's dependence on the angles, at given other sites."""
    table = layout.table
    zero = jnp.zeros(table.size, rest.dtype)
    settings = 0.5 * jnp.pi * jnp.asarray([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]], rest.dtype)
    signs = jnp.asarray([1.0, -1.0, -1.0, 1.0], rest.dtype)  # of t_e t_f at these settings, sin before cos
    slope = jax.grad(lambda z: log_joint(target, z, rest, inputs))

    def column(entries: Array) -> Array:
        own = zero.at[entries].set(1.0)

        def mixed(setting: Array) -> Array:
            point = jnp.where(own > 0, setting[1], setting[0])
            return jax.jvp(slope, (point,), (own,))[1]

        blocks = signs[:, None] * jax.vmap(mixed)(settings)
        blocks = jnp.where(own > 0, 0.0, blocks)[:, table].reshape(2, 2, *table.shape)
        return jnp.moveaxis(blocks[::-1, ::-1], (0, 1), (2, 3))

    coupling = jnp.moveaxis(jax.lax.map(column, table.T), 0, 2)
    at_zero, at_quarter = slope(zero)[table], slope(zero + 0.5 * jnp.pi)[table]
    total = jnp.stack([-at_quarter, at_zero], axis=-1)
    from_others = jnp.stack([coupling[..., 0, 1].sum(2), coupling[..., 1, 0].sum(2)], axis=-1)
    bare = Quadratic(jnp.zeros((), rest.dtype), total - from_others, coupling)
    here = jnp.broadcast_to(jnp.asarray([1.0, 0.0], rest.dtype), bare.linear.shape)
    return bare._replace(constant=log_joint(target, zero, rest, inputs) - jnp.sum(bare.expectation(here)))


def find_layout(target: Target, inputs: Inputs, key: PRNGKeyArray) -> Layout:
    """Find which entries are coupled, and check that the model is of the class above.

    Args:
        target: a target with circular sites.
        inputs: its arrays.
        key: typed JAX key, for the points at which the model is looked at.

    Raises:
        InputError: the model is not of the class, with the site at fault; or it has too many coupled entries.
    """
    axis_key, point_key = jax.random.split(key)
    table = _table(target, separating_axes(target, inputs, axis_key))
    colours = table.shape[1]
    if colours > _MOST_COLOURS:
        remedy = "Use nuts, or put what is independent into a plate"
        expected, got = f"at most {_MOST_COLOURS} angles that act on the same data", str(colours)
        raise InputError(f"von_mises_em on model {target.declaration.name}", expected, got, remedy)
    hadamard = scipy.linalg.hadamard(1 << colours.bit_length())
    layout = Layout(jnp.asarray(table), jnp.asarray(hadamard[:, 1 : colours + 1], dtype=float))
    _check_class(target, inputs, layout, point_key)
    return layout


def _table(target: Target, shared: list[str]) -> Int[np.ndarray, "group colour"]:
    """The angles, a row for each index over the shared axes."""
    parts: list[np.ndarray] = []
    start = 0
    for name in angle_sites(target):
        site = target.declaration.sites[name]
        index = start + np.arange(site.size).reshape(site.shape)
        index = np.moveaxis(index, [site.axes.index(axis) for axis in shared], range(len(shared)))
        groups = int(np.prod(index.shape[: len(shared)], dtype=int))
        parts.append(index.reshape(groups, -1))
        start += site.size
    return np.concatenate(parts, axis=1)


def _check_class(target: Target, inputs: Inputs, layout: Layout, key: PRNGKeyArray) -> None:
    rest_key, angle_key = jax.random.split(key)
    rest = 0.3 * jax.random.normal(rest_key, (target.dimension,))
    form = target.compiled(quadratic)(layout, rest, inputs)
    departure = target.compiled(_departure)(layout, form, rest, angle_key, inputs)
    if float(jnp.max(departure)) <= 100 * float(jnp.finfo(departure.dtype).eps) ** 0.5:
        return
    sizes = [target.declaration.sites[name].size for name in angle_sites(target)]
    worst = int(np.searchsorted(np.cumsum(sizes), int(jnp.argmax(departure)), side="right"))
    expected = "a log density affine in (cos z, sin z) of each angle z, with couplings of pairs at most"
    got = f"another dependence on {angle_sites(target)[worst]!r}"
    remedy = "Use nuts or another engine, or write the model with sums of phasors exp(j z)"
    raise InputError(f"von_mises_em on model {target.declaration.name}", expected, got, remedy)


def _departure(  # noqa: PLR0917
    target: Target, layout: Layout, form: Quadratic, rest: Array, key: PRNGKeyArray, inputs: Inputs
) -> Float[Array, " angle"]:
    """How far each entry's derivative at random angles is from the quadratic's, over what it can be."""
    size = 1 + jnp.abs(form.linear).sum(-1) + jnp.abs(form.coupling).sum((2, 3, 4))
    slope = jax.grad(lambda z: log_joint(target, z, rest, inputs))

    def look(key: PRNGKeyArray) -> Array:
        angles = jax.random.uniform(key, target.angles.shape, minval=-jnp.pi, maxval=jnp.pi)
        direction = angles[layout.table]
        eta = form.parameter(Resultants(direction, jnp.ones_like(direction)).vector)
        predicted = eta[..., 1] * jnp.cos(direction) - eta[..., 0] * jnp.sin(direction)
        found = slope(angles)
        return jnp.abs(layout.flat(predicted) - found) / layout.flat(size)

    departures = jax.lax.map(look, jax.random.split(key, _TRIALS))
    return jnp.nan_to_num(jnp.max(departures, axis=0), nan=jnp.inf)
