"""Predictors of labels: what scikit-learn calls a regressor or classifier, and two in closed form.

A `JaxPredictor` is trained by a pure function of a weight per sample, so that the predictors of all folds are
one `vmap` over the masks that leave out a fold.
"""

import abc
from typing import Any, Final, Protocol, final, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

_DISTANCES: Final = 4_000_000
"""Distances between samples that are held at once."""


@runtime_checkable
class Trainable(Protocol):
    """Anything with the two methods of a scikit-learn estimator."""

    def fit(self, X: Any, y: Any, /) -> Any:
        """Learn from features (n, feature) and labels."""
        ...

    def predict(self, X: Any, /) -> Any:
        """Labels of features (m, feature)."""
        ...


class JaxPredictor(eqx.Module):
    """A predictor that is trained and asked by pure functions."""

    @abc.abstractmethod
    def train(
        self,
        key: PRNGKeyArray,
        x: Float[Array, "sample feature"],
        y: Float[Array, "sample ..."],
        weight: Float[Array, " sample"],
    ) -> Any:
        """What is learned, a pytree; samples of weight 0 must not matter."""

    @abc.abstractmethod
    def predict(self, learned: Any, x: Float[Array, "sample feature"]) -> Float[Array, "sample ..."]:
        """Predicted labels."""


@final
class Ridge(JaxPredictor):
    """Linear regression with an intercept and a penalty on the squared coefficients of standardised features.

    Attributes:
        penalty: weight of the penalty, in samples.
    """

    penalty: float = 1e-3

    def train(
        self,
        key: PRNGKeyArray,
        x: Float[Array, "sample feature"],
        y: Float[Array, "sample ..."],
        weight: Float[Array, " sample"],
    ) -> Any:
        """Location and scale of the features, intercept and coefficients."""
        del key
        location, scale = standard(x, weight)
        design = (x - location) / scale
        total = jnp.sum(weight)
        mean = jnp.tensordot(weight, y, 1) / total
        gram = (design * weight[:, None]).T @ design + self.penalty * jnp.eye(x.shape[1], dtype=x.dtype)
        moment = jnp.tensordot((design * weight[:, None]).T, y - mean, 1)
        return location, scale, mean, jnp.linalg.solve(gram, moment)

    def predict(self, learned: Any, x: Float[Array, "sample feature"]) -> Float[Array, "sample ..."]:
        """Intercept plus coefficients times standardised features."""
        location, scale, mean, coefficient = learned
        return mean + jnp.tensordot((x - location) / scale, coefficient, 1)


@final
class Neighbours(JaxPredictor):
    """The inverse-distance weighted mean label of the nearest samples, features in one common unit.

    Attributes:
        count: how many neighbours.
        power: of the distance in the weights.
    """

    count: int = eqx.field(static=True, default=3)
    power: float = 1.0

    def train(
        self,
        key: PRNGKeyArray,
        x: Float[Array, "sample feature"],
        y: Float[Array, "sample ..."],
        weight: Float[Array, " sample"],
    ) -> Any:
        """The samples themselves."""
        del key
        return x, y, weight

    def predict(self, learned: Any, x: Float[Array, "sample feature"]) -> Float[Array, "sample ..."]:
        """The weighted mean; the label itself at the place of a sample."""
        places, labels, weight = learned
        # about their middle: coordinates of a map are large beside what lies between places
        middle = weight @ places / jnp.sum(weight)
        x, places = x - middle, places - middle
        size = jnp.sum(places**2, axis=1)

        def nearest(row: Float[Array, " feature"]) -> Array:
            square = jnp.sum(row**2) + size - 2 * places @ row
            return jax.lax.top_k(-jnp.where(weight > 0, square, jnp.inf), min(self.count, len(places)))[1]

        index = jax.lax.map(nearest, x, batch_size=max(1, _DISTANCES // len(places)))
        away = jnp.sum((x[:, None] - places[index]) ** 2, axis=-1)
        reach, precision = jnp.max(jnp.where(weight > 0, size, 0.0)), jnp.finfo(x.dtype)
        floor = precision.eps**2 * reach + precision.tiny**0.5
        closeness = jnp.where(weight[index] > 0, (floor + away) ** (-self.power / 2), 0.0)
        share = closeness / jnp.sum(closeness, axis=1, keepdims=True)
        return jnp.sum(share.reshape(*share.shape, *[1] * (labels.ndim - 1)) * labels[index], axis=1)


def standard(
    x: Float[Array, "sample feature"], weight: Float[Array, " sample"]
) -> tuple[Float[Array, " feature"], Float[Array, " feature"]]:
    """Weighted mean and standard deviation of each feature, 1 where a feature does not vary."""
    total = jnp.sum(weight)
    location = weight @ x / total
    scale = jnp.sqrt(weight @ (x - location) ** 2 / total)
    return location, jnp.where(scale > 0, scale, 1.0)
