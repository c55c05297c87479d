"""Neural predictors, of Equinox, Flax or plain functions, trained for all folds at once."""

from collections.abc import Callable
from typing import Any, Literal, Self, final

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.models.prediction_powered.predictors import JaxPredictor, standard

type Init = Callable[[PRNGKeyArray, Array], Any]
type Apply = Callable[[Any, Array], Array]


@final
class Neural(JaxPredictor):
    """A network trained by Adam on all samples at once, with a cosine decay of the step size.

    Attributes:
        init: `init(key, x)` gives parameters, with features x (sample, feature) as an example.
        apply: `apply(parameters, x)` gives outputs (sample, *label) for features (sample, feature).
        loss: "squared", or "logistic" for labels from 0 to 1, whose predictions are then probabilities.
        steps: of Adam.
        step_size: of its first step.
        decay: weight decay (AdamW).
    """

    init: Init = eqx.field(static=True)
    apply: Apply = eqx.field(static=True)
    loss: Literal["squared", "logistic"] = eqx.field(static=True, default="squared")
    steps: int = eqx.field(static=True, default=500)
    step_size: float = 1e-2
    decay: float = 1e-4

    @classmethod
    def of_equinox(cls, build: Callable[[PRNGKeyArray], Any], **settings: Any) -> Self:
        """From a function that builds an Equinox module for one sample from a key.

        A module that gives outputs of shape (1,) predicts scalar labels. Floating-point arrays are trained; whole numbers
        and the like are those of one key for all folds.
        """

        def init(key: PRNGKeyArray, x: Array) -> Any:
            del x
            return eqx.filter(build(key), eqx.is_inexact_array)

        static = eqx.filter(build(jax.random.key(0)), eqx.is_inexact_array, inverse=True)

        def apply(parameters: Any, x: Array) -> Array:
            module = eqx.combine(parameters, static)
            return jax.vmap(module)(x)

        return cls(init, apply, **settings)

    @classmethod
    def of_flax(cls, module: Any, **settings: Any) -> Self:
        """From a Flax Linen module that takes features (sample, feature)."""
        return cls(module.init, module.apply, **settings)

    def train(
        self,
        key: PRNGKeyArray,
        x: Float[Array, "sample feature"],
        y: Float[Array, "sample ..."],
        weight: Float[Array, " sample"],
    ) -> Any:
        """Location and scale of features and labels, and the parameters after the last step."""
        scales = self.scales(x, y, weight)
        inputs = (x - scales[0]) / scales[1]
        targets = (y - scales[2]) / scales[3]
        parameters, optimiser = self.init(key, inputs), self.optimiser

        def objective(candidate: Any) -> Scalar:
            return jnp.sum(weight * self.losses(candidate, inputs, targets)) / jnp.sum(weight)

        def step(state: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
            parameters, memory = state
            updates, memory = optimiser.update(jax.grad(objective)(parameters), memory, parameters)
            return (optax.apply_updates(parameters, updates), memory), None

        (parameters, _), _ = jax.lax.scan(
            step, (parameters, optimiser.init(parameters)), None, length=self.steps
        )
        return scales, parameters

    def predict(self, learned: Any, x: Float[Array, "sample feature"]) -> Float[Array, "sample ..."]:
        """The network's output in the labels' unit; a probability with the logistic loss."""
        scales, parameters = learned
        output = self._output(parameters, (x - scales[0]) / scales[1], jnp.shape(scales[2]))
        return jax.nn.sigmoid(output) if self.loss == "logistic" else output * scales[3] + scales[2]

    def scales(
        self,
        x: Float[Array, "sample feature"],
        y: Float[Array, "sample ..."],
        weight: Float[Array, " sample"],
    ) -> tuple[Array, Array, Array, Array]:
        """Location and scale of features and of labels; probabilities are left as they are."""
        if self.loss == "logistic":
            return *standard(x, weight), jnp.zeros(y.shape[1:], y.dtype), jnp.ones(y.shape[1:], y.dtype)
        location, scale = standard(y.reshape(len(y), -1), weight)
        return *standard(x, weight), location.reshape(y.shape[1:]), scale.reshape(y.shape[1:])

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with weight decay and the cosine decay of its step size."""
        schedule = optax.cosine_decay_schedule(self.step_size, self.steps)
        return optax.adamw(schedule, weight_decay=self.decay)

    def _output(self, parameters: Any, x: Float[Array, "sample feature"], label: tuple[int, ...]) -> Array:
        return self.apply(parameters, x).reshape(len(x), *label)

    def losses(
        self, parameters: Any, x: Float[Array, "sample feature"], y: Float[Array, "sample ..."]
    ) -> Float[Array, " sample"]:
        """The loss of each sample, features and labels scaled."""
        output = self._output(parameters, x, y.shape[1:])
        squared = (output - y) ** 2
        each = jax.nn.softplus(output) - y * output if self.loss == "logistic" else squared
        return each.reshape(len(x), -1).sum(axis=1)
