"""The losses whose minimiser is wanted: those of the usual estimators, or any function of the user's own.

A loss is l(theta, x, y) for one sample; theta is a flat vector. What is estimated is the minimiser of its
mean over the population. Every method here is a pure function of arrays.
"""

import abc
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Scalar

from dtprob.errors import InputError, unknown_name
from dtprob.models.prediction_powered.arrays import Values, namespace

type Link = Literal["identity", "logit", "log"]
type Parameters = Float[Values, " parameter"]
type Features = Float[Values, "sample feature"]
type Labels = Float[Values, "sample ..."]
type PerSample = Float[Values, " sample"]
type Gradients = Float[Values, "sample parameter"]
type Matrix = Float[Values, "parameter parameter"]


def _exp(eta: Values) -> Values:
    return namespace(eta).exp(eta)


def _softplus(eta: Values) -> Values:
    if namespace(eta) is jnp:
        return jax.nn.softplus(jnp.asarray(eta))  # engines differentiate it, also at 0
    return np.maximum(eta, 0.0) + np.log(1 + np.exp(-np.abs(eta)))


def _sigmoid(eta: Values) -> Values:
    small = _exp(-abs(eta))
    return namespace(eta).where(eta >= 0, 1.0, small) / (1 + small)


def _sigmoid_slope(eta: Values) -> Values:
    small = _exp(-abs(eta))
    return small / (1 + small) ** 2


_CUMULANT: Final[dict[str, Callable[[Values], Values]]] = {
    "identity": lambda eta: 0.5 * eta**2,
    "logit": _softplus,
    "log": _exp,
}
_MEAN: Final[dict[str, Callable[[Values], Values]]] = {
    "identity": lambda eta: eta,
    "logit": _sigmoid,
    "log": _exp,
}
_VARIANCE: Final[dict[str, Callable[[Values], Values]]] = {
    "identity": lambda eta: namespace(eta).ones_like(eta),
    "logit": _sigmoid_slope,
    "log": _exp,
}


class Traits(NamedTuple):
    """What a loss allows one to save.

    Attributes:
        linear_in_label: the gradient is affine in y and the second derivative free of it, so that predictions
            can be averaged before the gradient is taken.
        quadratic: the loss is quadratic in theta, so that one Newton step is exact.
        translation: theta only shifts the gradient, so that its covariances do not depend on theta.
        numpy: the methods take NumPy's arrays as well and then return such, so that nothing is compiled; only
            together with linear_in_label.
    """

    linear_in_label: bool = False
    quadratic: bool = False
    translation: bool = False
    numpy: bool = False


class AbstractLoss(eqx.Module):
    """A differentiable loss of a parameter vector on labelled samples."""

    @property
    @abc.abstractmethod
    def traits(self) -> Traits:
        """What the loss allows one to save."""

    @abc.abstractmethod
    def start(self, x: Features, y: Labels) -> Parameters:
        """A point from which to seek the minimiser."""

    @abc.abstractmethod
    def values(self, theta: Parameters, x: Features, y: Labels) -> PerSample:
        """The loss of each sample."""

    @abc.abstractmethod
    def gradients(self, theta: Parameters, x: Features, y: Labels) -> Gradients:
        """The gradient of each sample's loss in theta."""

    @abc.abstractmethod
    def hessian(self, theta: Parameters, x: Features, y: Labels, weight: PerSample) -> Matrix:
        """The weighted sum of the samples' second derivatives in theta."""


@final
class Mean(AbstractLoss):
    """Half the squared distance: its minimiser is the mean label, one parameter per entry of a label."""

    @property
    def traits(self) -> Traits:
        """Linear in the label, quadratic in theta."""
        return Traits(linear_in_label=True, quadratic=True, translation=True, numpy=True)

    def start(self, x: Features, y: Labels) -> Parameters:
        """The origin."""
        del x
        return namespace(y).zeros(_flat(y).shape[1], jnp.result_type(y, float))

    def values(self, theta: Parameters, x: Features, y: Labels) -> PerSample:
        """Half the squared distance of each label."""
        del x
        return 0.5 * ((theta - _flat(y)) ** 2).sum(axis=1)

    def gradients(self, theta: Parameters, x: Features, y: Labels) -> Gradients:
        """Theta minus the label."""
        del x
        return theta - _flat(y)

    def hessian(self, theta: Parameters, x: Features, y: Labels, weight: PerSample) -> Matrix:
        """The total weight times the identity."""
        del x, y
        return weight.sum() * namespace(theta).eye(len(theta), dtype=theta.dtype)


@final
class GeneralizedLinear(AbstractLoss):
    """Least squares, logistic and Poisson regression: cumulant(x theta) - y x theta.

    No intercept is added: give a column of ones.

    Attributes:
        link: "identity" (least squares), "logit" (logistic) or "log" (Poisson).
    """

    link: Link = eqx.field(static=True)

    @property
    def traits(self) -> Traits:
        """Linear in the label; quadratic when the link is the identity."""
        return Traits(linear_in_label=True, quadratic=self.link == "identity", numpy=True)

    def start(self, x: Features, y: Labels) -> Parameters:
        """The origin.

        Raises:
            InputError: labels with more than one entry, or no features.
        """
        check_scalar(y, "a regression")
        if x.shape[1] == 0:
            raise InputError("x", "features, for a regression", "none", "Give x, or use the loss mean")
        return namespace(x).zeros(x.shape[1], jnp.result_type(x, y, float))

    def values(self, theta: Parameters, x: Features, y: Labels) -> PerSample:
        """Negative log likelihood of each sample, up to a term without theta."""
        eta = x @ theta
        return _CUMULANT[self.link](eta) - y * eta

    def gradients(self, theta: Parameters, x: Features, y: Labels) -> Gradients:
        """(mean - y) x."""
        return (_MEAN[self.link](x @ theta) - y)[:, None] * x

    def hessian(self, theta: Parameters, x: Features, y: Labels, weight: PerSample) -> Matrix:
        """Sum of weight * variance * x x^T."""
        del y
        return (x * (weight * _VARIANCE[self.link](x @ theta))[:, None]).T @ x


@final
class SmoothQuantile(AbstractLoss):
    """The check loss of a quantile, smoothed by a normal kernel so that it has two derivatives.

    Source: Fernandes, Guerre and Horta, Smoothing quantile regressions (2021). The unsmoothed quantile has an
    estimator of its own; this loss is for engines that need gradients.

    Attributes:
        level: which quantile, in (0, 1).
        bandwidth: standard deviation of the kernel, in the label's unit.
    """

    level: float = eqx.field(static=True)
    bandwidth: Float[Array, ""]

    @property
    def traits(self) -> Traits:
        """Nothing to save."""
        return Traits()

    def start(self, x: Features, y: Labels) -> Parameters:
        """The labels' own quantile.

        Raises:
            InputError: labels with more than one entry.
        """
        del x
        check_scalar(y, "a quantile")
        return jnp.quantile(y, self.level)[None]

    def values(self, theta: Parameters, x: Features, y: Labels) -> PerSample:
        """The smoothed check loss."""
        del x
        u = (theta[0] - y) / self.bandwidth
        smooth = u * jax.scipy.stats.norm.cdf(u) + jax.scipy.stats.norm.pdf(u)
        return self.bandwidth * (smooth - self.level * u)

    def gradients(self, theta: Parameters, x: Features, y: Labels) -> Gradients:
        """The smoothed indicator of y <= theta, minus the level."""
        del x
        return (jax.scipy.stats.norm.cdf((theta[0] - y) / self.bandwidth) - self.level)[:, None]

    def hessian(self, theta: Parameters, x: Features, y: Labels, weight: PerSample) -> Matrix:
        """The kernel estimate of the label's density at theta."""
        del x
        density = jax.scipy.stats.norm.pdf((theta[0] - y) / self.bandwidth) / self.bandwidth
        return jnp.sum(weight * density)[None, None]


@final
class CustomLoss(AbstractLoss):
    """Any twice differentiable loss.

    Attributes:
        function: `function(theta, x, y) -> scalar` for one sample; theta has the structure of `initial`.
        initial: parameters to start from, an array or a pytree of arrays.
    """

    function: Callable[[Any, Array, Array], Scalar] = eqx.field(static=True)
    initial: Any

    @property
    def traits(self) -> Traits:
        """Nothing to save."""
        return Traits()

    def one(self, theta: Parameters, x: Float[Values, " feature"], y: Float[Values, "..."]) -> Scalar:
        """The loss of one sample at a flat parameter vector."""
        return self.function(self.unravel(theta), jnp.asarray(x), jnp.asarray(y))

    def unravel(self, theta: Parameters) -> Any:
        """The parameters with the structure of `initial`."""
        return ravel_pytree(self.initial)[1](jnp.asarray(theta))

    def start(self, x: Features, y: Labels) -> Parameters:
        """The initial parameters, flat."""
        del x, y
        return jnp.asarray(ravel_pytree(self.initial)[0], float)

    def values(self, theta: Parameters, x: Features, y: Labels) -> PerSample:
        """The loss of each sample."""
        return jax.vmap(self.one, (None, 0, 0))(theta, x, y)

    def gradients(self, theta: Parameters, x: Features, y: Labels) -> Gradients:
        """By differentiation."""
        return jax.vmap(jax.grad(self.one), (None, 0, 0))(theta, x, y)

    def hessian(self, theta: Parameters, x: Features, y: Labels, weight: PerSample) -> Matrix:
        """By differentiation of the weighted sum."""
        return jax.hessian(lambda point: jnp.sum(weight * self.values(point, x, y)))(theta)


OLS: Final = GeneralizedLinear("identity")
LOGISTIC: Final = GeneralizedLinear("logit")
POISSON: Final = GeneralizedLinear("log")
MEAN: Final = Mean()

LOSSES: Final[dict[str, AbstractLoss]] = {"mean": MEAN, "ols": OLS, "logistic": LOGISTIC, "poisson": POISSON}
"""The losses that need no settings, by name."""


def named_loss(loss: str | AbstractLoss) -> AbstractLoss:
    """A loss from its name; a loss is returned as it is.

    Raises:
        InputError: no loss has that name, or it is neither.
    """
    if isinstance(loss, AbstractLoss):
        return loss
    if not isinstance(loss, str):
        got = f"an object of type {type(loss).__name__}"
        raise InputError("loss", "a name or a loss", got, "Wrap a function in CustomLoss")
    if loss not in LOSSES:
        raise unknown_name("loss", loss, LOSSES, "loss")
    return LOSSES[loss]


def check_scalar(y: Labels, purpose: str) -> None:
    """See that a label is one number.

    Raises:
        InputError: labels with an axis of entries, even of one.
    """
    if y.ndim != 1:
        remedy = "Take one entry at a time, as y[:, 0] with its predictions"
        raise InputError("y", f"labels of one number, for {purpose}", f"shape {y.shape}", remedy)


def _flat(y: Labels) -> Gradients:
    return y.reshape(y.shape[0], -1)
