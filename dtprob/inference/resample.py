"""Data sets like the one observed: re-weighted, resampled by clusters, or with noise added anew."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.primitives import Messenger

from dtprob.errors import InputError
from dtprob.inference.phasors import is_gaussian
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model, model_name
from dtprob.models.declaration import Declaration, metadata, model

type Scheme = Literal["noise", "weights", "clusters", "none"]

WEIGHTS = "cluster_weight"


class Weighted:
    """A model whose observations count with the weights of their clusters, given as `cluster_weight`.

    Two of the same model are equal, so that what is compiled for one serves the other.
    """

    def __init__(self, base: Model, cluster: str) -> None:
        self.base, self.cluster = base, cluster
        self.__name__ = model_name(base)
        notes = metadata(base)
        model(axes=notes.axes, cluster=notes.cluster)(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Weighted) and (self.base, self.cluster) == (other.base, other.cluster)

    def __hash__(self) -> int:
        return hash((self.base, self.cluster))

    def __call__(self, cluster_weight: Float[Array, " cluster"], **data: Any) -> Any:
        """Run the model."""
        with _Weights(cluster_weight, self.cluster):
            return self.base(**data)


class _Weights(Messenger):
    """Scales the log probability of observed sites, entry by entry along one plate."""

    def __init__(self, weights: Float[Array, " cluster"], cluster: str) -> None:
        self.weights, self.cluster = weights, cluster
        super().__init__()

    def process_message(self, msg: dict[str, Any]) -> None:
        """Scale a site."""
        if msg["type"] != "sample" or not msg["is_observed"]:
            return
        for frame in msg["cond_indep_stack"]:
            if frame.name == self.cluster:
                weights = jnp.reshape(self.weights, (-1, *[1] * (-frame.dim - 1)))
                msg["scale"] = weights if msg.get("scale") is None else weights * msg["scale"]


def chosen_scheme(target: Target, wanted: Scheme | Literal["auto"], *, point: bool) -> Scheme:
    """The scheme itself; for "auto" noise where data are Gaussian and estimates points, else weights.

    Args:
        target: the model on the data.
        wanted: what was asked for.
        point: whether the members are single values.

    Raises:
        InputError: the model does not allow the scheme.
    """
    gaussian = is_gaussian(target) and all(s.argument for s in target.declaration.observed.values())
    scheme: Scheme = wanted if wanted != "auto" else ("noise" if gaussian and point else "weights")
    if scheme == "noise" and not gaussian:
        expected = "observed sites that are normal, each with an argument of the model as its value"
        got = ", ".join(f"{n!r} ({s.distribution})" for n, s in target.declaration.observed.items())
        what = f"ensemble with noise on model {target.declaration.name}"
        raise InputError(what, expected, got, 'Resample with "weights" or "clusters"')
    return scheme


def is_noise_unknown(target: Target, inputs: Inputs) -> bool:
    """Whether the variance of an observed site hangs on latent sites, which noise added to data makes larger than it is."""
    draws = target.once(Target.prior_draws)(jax.random.key(0), inputs, {})
    one, other = (target.once(_variances)(draws[k], inputs) for k in (0, 1))
    return any(not np.array_equal(one[name], other[name], equal_nan=True) for name in one)


def _variances(target: Target, u: Float[Array, " dimension"], inputs: Inputs) -> dict[str, Array]:
    _, trace = target.trace(u, inputs)
    return {name: jnp.asarray(trace[name]["fn"].variance) for name in target.declaration.observed}


def cluster_axis(declaration: Declaration) -> tuple[str, int]:
    """The plate of the model's independent clusters, and how many there are.

    Raises:
        InputError: no observed site lies in the plate, or one lies outside, which could not be resampled.
    """
    name, what = declaration.cluster, f"ensemble on model {declaration.name}"
    inside = [site for site in declaration.observed.values() if name in site.plates and name in site.axes]
    outside = [site.name for site in declaration.observed.values() if site not in inside]
    if inside and outside:
        remedy = "Put it into the plate, or resample with noise"
        raise InputError(
            what, f"every observed site in the plate {name!r}", f"{outside[0]!r} outside", remedy
        )
    if inside:
        return str(name), inside[0].shape[inside[0].axes.index(str(name))]
    expected = "a plate of independent clusters around an observed site"
    remedy = "Put the observations into a plate, or name one as the model's cluster"
    raise InputError(what, expected, str(name), remedy)


def cluster_weights(scheme: Scheme, key: PRNGKeyArray, count: int) -> Float[Array, " cluster"]:
    """A draw of weights with mean one: Dirichlet's (the Bayesian bootstrap) or counts (the bootstrap)."""
    if scheme == "weights":
        return count * jax.random.dirichlet(key, jnp.ones(count))
    if scheme == "clusters":
        return jnp.bincount(jax.random.randint(key, (count,), 0, count), length=count).astype(float)
    return jnp.ones(count)


def with_noise(
    target: Target, inputs: Inputs, fitted: Float[Array, " dimension"], key: PRNGKeyArray
) -> dict[str, Array]:
    """The observed data plus noise drawn from the model at fitted values, by argument name."""
    _, trace = target.trace(fitted, inputs)
    drawn: dict[str, Array] = {}
    for number, (name, site) in enumerate(target.declaration.observed.items()):
        fn, value = trace[name]["fn"], jnp.asarray(trace[name]["value"])
        noise = fn.sample(jax.random.fold_in(key, number)) - fn.mean
        drawn[str(site.argument)] = value + noise
    return drawn
