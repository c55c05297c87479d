"""A network that learns from few labels and many predictions: gradient descent on a corrected loss.

A tuned scheme weighs the correction anew at every step, by the gradients of the labelled samples' losses at
their labels and at their predictions. Source: Sifaou and Simeone, arXiv 2405.15415.
"""

from functools import partial
from typing import Any, Final, NamedTuple, final

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.errors import InputError
from dtprob.models.prediction_powered.neural import Neural
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.schemes import Mix, Scheme, named_scheme

_AT_ONCE: Final = 256
"""Labelled samples whose own gradients are held at a time."""


@final
class Taught(NamedTuple):
    """A trained network.

    Attributes:
        network: how it is asked.
        learned: what it learned.
        lam: weight of the correction at each step.
    """

    network: Neural
    learned: Any
    lam: Float[Array, " step"]

    def predict(self, x: Float[Array, "sample feature"]) -> Float[Array, "sample ..."]:
        """The network's labels of features."""
        return self.network.predict(self.learned, x)


class Rows(NamedTuple):
    """Samples in the network's units."""

    x: Float[Array, "sample feature"]
    label: Float[Array, "sample ..."]
    weight: Float[Array, " sample"]


class Groups(NamedTuple):
    """The three terms of a corrected loss: labelled samples, the same with predictions, unlabelled ones."""

    true: Rows
    predicted: Rows
    unlabelled: Rows


def teach(
    key: PRNGKeyArray, sample: Sample, network: Neural, scheme: str = "tuned_cppi", *, batch: int = 1024
) -> Taught:
    """Train a network on a scheme's corrected loss: all labelled samples and some of the others at every step.

    The samples are held in memory. Both losses of a network have gradients that are linear in the label, so
    that the predictions of several predictors are averaged.

    Args:
        key: typed JAX key, for initial parameters and for the unlabelled samples of each step.
        sample: as for `estimate`, with features.
        network: the network, its loss and its optimiser.
        scheme: one of the six.
        batch: unlabelled samples of a step; all of them where there are no more.

    Raises:
        InputError: an unknown scheme, no features, a batch below 1, or no predictions for a scheme that needs
            them.
    """
    chosen = named_scheme(scheme)
    if sample.features.shape[1] == 0 or batch < 1:
        got = f"{sample.features.shape[1]} features, batch {batch}"
        raise InputError(
            "student", "features, and a batch from 1", got, "Give x and x_unlabelled, or a batch"
        )
    if chosen.name != "erm" and not sample.has_predictions:
        remedy = "Give predictions of unlabelled samples, or use scheme erm"
        raise InputError("sample", "unlabelled samples with predictions", "none", remedy)
    x, y = jnp.asarray(sample.features), jnp.asarray(sample.y, float)
    weight = jnp.asarray(sample.labelled_weight)
    scales = network.scales(x, y, weight)
    groups = _groups(sample, Rows(x, y, weight), scales)
    keys = jax.random.split(key)
    parameters = network.init(keys[0], groups.true.x)
    parameters, lam = _descend(keys[1], network, chosen, groups, parameters, batch=batch)
    return Taught(network, (scales, parameters), lam)


def _groups(sample: Sample, true: Rows, scales: tuple[Array, Array, Array, Array]) -> Groups:
    def scaled(rows: Rows) -> Rows:
        return Rows((rows.x - scales[0]) / scales[1], (rows.label - scales[2]) / scales[3], rows.weight)

    predicted = true if sample.prediction is None else true._replace(label=jnp.asarray(sample.prediction))
    if not sample.has_predictions:
        return Groups(scaled(true), scaled(predicted), scaled(predicted))
    parts = zip(*((c.x, c.prediction[:, 0], c.weight) for c in sample.chunks(averaged=True)), strict=True)
    unlabelled = Rows(*(jnp.concatenate(part)[: sample.n_unlabelled] for part in parts))
    return Groups(scaled(true), scaled(predicted), scaled(unlabelled))


@partial(jax.jit, static_argnums=(1, 2), static_argnames=("batch",))
def _descend(
    key: PRNGKeyArray, network: Neural, scheme: Scheme, groups: Groups, parameters: Any, *, batch: int
) -> tuple[Any, Float[Array, " step"]]:
    """The parameters after the last step, and lambda at each."""
    n, count = (jnp.asarray(float(len(rows.x))) for rows in (groups.true, groups.unlabelled))
    optimiser = network.optimiser

    def objective(candidate: Any, some: Rows, mix: Mix) -> Scalar:
        true, predicted, unlabelled = (
            jnp.mean(rows.weight * network.losses(candidate, rows.x, rows.label))
            for rows in (groups.true, groups.predicted, some)
        )
        return jnp.asarray(mix.true * true + mix.unlabelled * unlabelled - mix.predicted * predicted)

    def step(state: tuple[Any, Any], own: PRNGKeyArray) -> tuple[tuple[Any, Any], Array]:
        candidate, memory = state
        some = _some(own, groups.unlabelled, batch)
        tuned = per_step_lambda(network, candidate, groups) if scheme.is_tuned else scheme.lam
        lam = jnp.asarray(tuned, float)
        gradient = jax.grad(objective)(candidate, some, scheme.mix(n, count, lam))
        updates, memory = optimiser.update(gradient, memory, candidate)
        return (optax.apply_updates(candidate, updates), memory), lam

    keys = jax.random.split(key, network.steps)
    (parameters, _), lam = jax.lax.scan(step, (parameters, optimiser.init(parameters)), keys)
    return parameters, lam


def _some(key: PRNGKeyArray, rows: Rows, batch: int) -> Rows:
    count = len(rows.x)
    if batch >= count:
        return rows
    index = jax.random.randint(key, (batch,), 0, count)
    return Rows(*(part[index] for part in rows))


def per_step_lambda(network: Neural, parameters: Any, groups: Groups) -> Scalar:
    """The weight of the correction with the least mean square error of the step, in [0, 1].

    With g and f the gradients of the labelled samples' losses at labels and at predictions it is
    sum <g - mean g, f - mean f> / ((1 + n / N) sum |f - mean f|^2), each difference times its sample's weight.

    Args:
        network: what is trained.
        parameters: where the step starts.
        groups: the data in the network's units.
    """

    def own_gradient(x: Array, label: Array, weight: Array) -> Float[Array, " parameter"]:
        def loss(candidate: Any) -> Scalar:
            return weight * network.losses(candidate, x[None], label[None])[0]

        return ravel_pytree(jax.grad(loss)(parameters))[0]

    def of_sample(rows: tuple[Rows, Rows]) -> tuple[Array, Array]:
        g, f = (own_gradient(*row) for row in rows)
        return g @ f, f @ f

    def mean_gradient(rows: Rows) -> Float[Array, " parameter"]:
        def loss(candidate: Any) -> Scalar:
            return jnp.mean(rows.weight * network.losses(candidate, rows.x, rows.label))

        return ravel_pytree(jax.grad(loss)(parameters))[0]

    def offset(rows: Rows) -> Float[Array, " parameter"]:
        """Half the mean, or what stands for it where weights differ."""
        weight = rows.weight
        return mean_gradient(rows._replace(weight=weight * (weight - jnp.mean(weight**2) / 2)))

    n, count = len(groups.true.x), len(groups.unlabelled.x)
    cross, square = jax.lax.map(of_sample, (groups.true, groups.predicted), batch_size=min(n, _AT_ONCE))
    g, f = mean_gradient(groups.true), mean_gradient(groups.predicted)
    own, other = offset(groups.true), offset(groups.predicted)
    top, bottom = jnp.sum(cross) - n * (g @ other + f @ own), jnp.sum(square) - 2 * n * f @ other
    ratio = top / jnp.where(bottom > 0, (1 + n / count) * bottom, 1.0)
    return jnp.where(bottom > 0, jnp.clip(ratio, 0.0, 1.0), 0.0)
