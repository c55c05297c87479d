"""The density that engines work on: a declared model on data, over a flat vector of real numbers.

Coordinates. A latent site is mapped to unconstrained reals by NumPyro's bijection for its support, and each
real is measured in units of its prior: zero at the prior's median, one unit a robust standard deviation. In
SI units a delay is 1e-9 and a frequency 1e9; no engine should have to learn that.

A circular site is its own coordinate, unwrapped: the density is periodic with period 2 pi and has no edge at
+-pi. This keeps one coordinate per angle, which is what an optimiser, a Hessian and an evidence need; a
two-dimensional embedding would add a radius with a density of its own, singular at the origin. That a
periodic density cannot be normalised over the reals matters to samplers only; see `dtprob.inference.winding`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray, Scalar
from numpyro import handlers
from numpyro.infer.util import compute_log_probs

from dtprob.errors import InputError, unknown_name
from dtprob.inference.circular import wrap
from dtprob.models.arguments import Model
from dtprob.models.declaration import Declaration, base_constraint
from dtprob.models.execution import trace_model

PRIOR_DRAWS = 64


class Inputs(NamedTuple):
    """The arrays that a compiled function of a target takes.

    Attributes:
        arrays: the array part of the data, by argument name.
        location: prior median of each coordinate before scaling, (dimension,); mean direction for angles,
            rad.
        scale: prior spread of each coordinate before scaling, (dimension,); one for angles.
    """

    arrays: dict[str, Any]
    location: Float[Array, " dimension"]
    scale: Float[Array, " dimension"]


class LogTerms(NamedTuple):
    """The log density's parts.

    Attributes:
        prior: log prior density of the constrained values.
        likelihood: log likelihood of the observed sites, and the factors.
        jacobian: log of the constrained volume per unit of the coordinates.
    """

    prior: Scalar
    likelihood: Scalar
    jacobian: Scalar


class Evaluation(NamedTuple):
    """A model run at one point: latent and deterministic values, pointwise log likelihood, log terms."""

    values: dict[str, Any]
    log_likelihood: dict[str, Any]
    terms: LogTerms


@dataclass(frozen=True)
class Coordinates:
    """Where a latent site lives in the flat vector, and the shape of its unconstrained value."""

    start: int
    stop: int
    shape: tuple[int, ...]
    is_circular: bool


@dataclass(frozen=True, eq=False)
class Target:
    """Log density of a declared model over a flat vector of reals; every method is a pure function.

    Attributes:
        model: the NumPyro model.
        declaration: its sites and axes.
        coordinates: for each latent site, its place in the vector, in the order of execution.
        static: the settings among the data, which are not arrays.
        circular: for each coordinate, whether it is an angle, (dimension,).
    """

    model: Model
    declaration: Declaration
    coordinates: Mapping[str, Coordinates]
    static: Mapping[str, Any]
    circular: np.ndarray
    _compiled: dict[Any, Callable[..., Any]] = field(default_factory=dict, repr=False)

    @property
    def dimension(self) -> int:
        """Length of the flat vector."""
        return len(self.circular)

    @property
    def angles(self) -> np.ndarray:
        """Indices of the coordinates that are angles."""
        return np.flatnonzero(self.circular)

    @property
    def linear(self) -> np.ndarray:
        """Indices of the coordinates that are not angles."""
        return np.flatnonzero(~self.circular)

    def compiled(self, function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
        """`function(self, *static, ...)` compiled, once per shape of its further arguments.

        Args:
            function: a module-level function whose first argument is a target.
            static: hashable settings.
        """
        handle = (function, static)
        if handle not in self._compiled:
            self._compiled[handle] = jax.jit(functools.partial(function, self, *static))
        return self._compiled[handle]

    def once(self, function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
        """As `compiled`, for what runs once in a fit: without the optimisation that takes longer than such a run.

        Inside another compiled function it is the function itself.
        """
        handle = (function, static, "once")
        if handle not in self._compiled:
            plain = functools.partial(function, self, *static)
            quick = jax.jit(plain, compiler_options={"xla_backend_optimization_level": 0})
            self._compiled[handle] = lambda *arguments: (plain if _is_traced(arguments) else quick)(
                *arguments
            )
        return self._compiled[handle]

    def data(self, inputs: Inputs) -> dict[str, Any]:
        """The model's arguments."""
        return eqx.combine(inputs.arrays, dict(self.static))

    def ravel(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " dimension"]:
        """Unconstrained values by site, before scaling, as one vector."""
        parts = [jnp.ravel(jnp.asarray(values[name], dtype=float)) for name in self.coordinates]
        return jnp.concatenate(parts) if parts else jnp.zeros(0)

    def unravel(self, vector: Float[Array, " dimension"]) -> dict[str, Float[Array, "..."]]:
        """Inverse of `ravel`."""
        return {name: vector[c.start : c.stop].reshape(c.shape) for name, c in self.coordinates.items()}

    def log_density(self, u: Float[Array, " dimension"], inputs: Inputs) -> Scalar:
        """Log density of the vector `u` with respect to the reals: the sum of the log terms."""
        return sum(self.log_terms(u, inputs), start=jnp.zeros(()))

    def log_terms(self, u: Float[Array, " dimension"], inputs: Inputs) -> LogTerms:
        """The parts of the log density at `u`."""
        return self.evaluate(u, inputs).terms

    def log_likelihood(self, u: Float[Array, " dimension"], inputs: Inputs) -> dict[str, Float[Array, "..."]]:
        """Log likelihood of each observation: for each observed site, an array of the site's batch shape."""
        return self.evaluate(u, inputs).log_likelihood

    def constrain(self, u: Float[Array, " dimension"], inputs: Inputs) -> dict[str, Array]:
        """Values of all latent and deterministic sites at `u`; angles in (-pi, pi]."""
        return self.evaluate(u, inputs).values

    def evaluate(self, u: Float[Array, " dimension"], inputs: Inputs) -> Evaluation:
        """Run the model at `u`."""
        free = self._free(u, inputs)
        log_probs, trace = self.trace(u, inputs)
        zero = jnp.zeros(())
        prior, likelihood = zero, zero
        jacobian = jnp.sum(jnp.log(inputs.scale), initial=0.0)
        pointwise: dict[str, Any] = {}
        for name, log_prob in log_probs.items():
            if name in free:
                prior += jnp.sum(log_prob)
                jacobian += _log_det(trace[name], free[name])
                continue
            likelihood += jnp.sum(log_prob)
            if name in self.declaration.observed:
                pointwise[name] = log_prob
        kept = (*self.declaration.latent, *self.declaration.deterministic)
        values = {name: trace[name]["value"] for name in self.declaration.sites if name in kept}
        return Evaluation(values, pointwise, LogTerms(prior, likelihood, jacobian))

    def trace(
        self, u: Float[Array, " dimension"], inputs: Inputs
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Log probability of each sample site, by entry, and NumPyro's trace of the model at `u`."""
        seeded = handlers.seed(self.model, jax.random.key(0))
        fixed = handlers.substitute(
            seeded, substitute_fn=functools.partial(_constrained, self._free(u, inputs))
        )
        return compute_log_probs(fixed, (), self.data(inputs), {}, sum_log_prob=False)

    def _free(self, u: Array, inputs: Inputs) -> dict[str, Array]:
        return self.unravel(inputs.location + inputs.scale * u)

    def prior_draw(
        self, key: PRNGKeyArray, inputs: Inputs, values: Mapping[str, Any] | None = None
    ) -> Float[Array, " dimension"]:
        """A point drawn from the prior, the sites in `values` fixed at those (constrained) values.

        An entry fixed on the edge of its support, where its coordinate is infinite, is drawn from the prior.
        """
        drawn = self.unconstrained(key, inputs, {})
        if not values:
            return drawn
        fixed = self.unconstrained(key, inputs, values)
        return jnp.where(jnp.isfinite(fixed), fixed, drawn)

    def prior_draws(
        self, key: PRNGKeyArray, inputs: Inputs, values: Mapping[str, Any]
    ) -> Float[Array, "draw dimension"]:
        """As many prior draws as an engine ever needs to start from."""
        keys = jax.random.split(key, PRIOR_DRAWS)
        return jax.vmap(lambda k: self.prior_draw(k, inputs, values))(keys)

    def prior_median(self, inputs: Inputs, values: Mapping[str, Any]) -> Float[Array, " dimension"]:
        """The prior's coordinate-wise median (mean direction for angles), the sites in `values` fixed."""
        median = jnp.zeros(self.dimension)
        if not values:
            return median
        fixed = self.unconstrained(jax.random.key(0), inputs, values)
        given = jnp.concatenate(
            [jnp.full(c.stop - c.start, n in values) for n, c in self.coordinates.items()]
        )
        return jnp.where(given & jnp.isfinite(fixed), fixed, median)

    def latent_values(self, values: Mapping[str, Any]) -> dict[str, Array]:
        """Those of `values` that belong to latent sites, as arrays of the sites' shapes.

        Raises:
            InputError: a name is no site of the model, or a shape does not fit.
        """
        latent = self.declaration.latent
        kept: dict[str, Array] = {}
        for name, value in values.items():
            if name not in self.declaration.sites:
                raise unknown_name("initial values", name, latent, "site")
            if name in latent:
                kept[name] = _shaped(name, value, latent[name].shape)
        return kept

    def unconstrained(
        self, key: PRNGKeyArray, inputs: Inputs, values: Mapping[str, Any]
    ) -> Float[Array, " dimension"]:
        """Coordinates of constrained values, infinite on the edge of a support; other sites drawn from the prior."""
        trace = trace_model(self.model, self.data(inputs), key, values)
        free = {name: free_value(trace[name]) for name in self.coordinates}
        return (self.ravel(free) - inputs.location) / inputs.scale


def _is_traced(arguments: tuple[Any, ...]) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments))


def _shaped(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    try:
        return jnp.broadcast_to(jnp.asarray(value, dtype=float), shape)
    except ValueError:
        what, got = f"initial value of {name!r}", str(np.shape(value))
        raise InputError(what, f"shape {shape}", got, "Give one value per entry") from None


def _is_circular(message: Mapping[str, Any]) -> bool:
    return base_constraint(message["fn"].support) is dist.constraints.circular


def free_value(message: Mapping[str, Any]) -> Array:
    """The coordinates of a traced latent site, before scaling."""
    if _is_circular(message):
        return message["value"]
    return dist.biject_to(message["fn"].support).inv(message["value"])


def _constrained(free: Mapping[str, Array], message: dict[str, Any]) -> Array | None:
    """The value of a site from its unscaled coordinates; None leaves the site to the model."""
    if message["name"] not in free or message["type"] != "sample":
        return None
    value = free[message["name"]]
    index = message["infer"].get("_scan_current_index")
    if index is not None:
        value = value[index]
        _refuse_nested(message, value)
    return wrap(value) if _is_circular(message) else dist.biject_to(message["fn"].support)(value)


def _refuse_nested(message: Mapping[str, Any], value: Array) -> None:
    """Of scans within scans NumPyro gives each step the whole of the inner one's values, which would be broadcast.

    Raises:
        InputError: the value has more axes than one step of the site.
    """
    shape = message["fn"].shape(message["kwargs"].get("sample_shape", ()))
    one_step = shape if _is_circular(message) else dist.biject_to(message["fn"].support).inverse_shape(shape)
    if value.ndim > len(one_step):
        what, remedy = (
            f"site {message['name']!r}",
            "Scan once over all steps, or loop over the outer ones in Python",
        )
        raise InputError(what, "latent sites within one scan", "a scan within a scan", remedy)


def _log_det(message: Mapping[str, Any], free: Array) -> Scalar:
    if _is_circular(message):
        return jnp.zeros(())
    transform = dist.biject_to(message["fn"].support)
    return jnp.sum(transform.log_abs_det_jacobian(free, message["value"]))
