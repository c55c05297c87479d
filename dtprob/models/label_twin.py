"""A predictor as the twin of what it labels: labels stray from its predictions by noise of one size, or so it claims.

Where they stray by more, in a region, by a factor, since the map it was made from is old, is the sim-to-real gap of
synthetic labels; a diagnosis finds it as it does for channels.
"""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.data import Labels
from dtprob.errors import InputError
from dtprob.models.declaration import model

_FLAT: Final = 0.01
_SHARE: Final = 0.1
"""Standard deviation over root mean square of predictions below which they do not vary, and what is taken then."""


@model(axes={"predicted_label": ("sample",), "label_deviation": ("sample",)}, cluster="sample")
def label_twin(
    x: Float[Array, "sample feature"],
    prediction: Float[Array, " sample"],
    *,
    y: Float[Array, " sample"] | None = None,
) -> jax.Array:
    """Labels as the predictor has them, with an error of unknown size that is the same everywhere.

    Args:
        x: features; only effects look at them.
        prediction: made without having seen these labels.
        y: true labels.

    Returns:
        The predicted labels.
    """
    del x
    deviation: Any = numpyro.sample("error_deviation", _size_of_errors(prediction))
    predicted: Any = numpyro.deterministic("predicted_label", prediction)
    spread: Any = numpyro.deterministic("label_deviation", jnp.broadcast_to(deviation, prediction.shape))
    with numpyro.plate("sample", prediction.shape[0]):
        numpyro.sample("y", dist.Normal(predicted, spread), obs=y)
    return predicted


def _size_of_errors(prediction: Float[Array, " sample"]) -> dist.Distribution:
    """Its prior: about a third of how much predictions vary; where they do not, anything about their own size."""
    spread = jnp.std(prediction)
    size = jnp.hypot(jnp.mean(prediction), spread)
    size = jnp.where(size > 0, size, 1.0)
    varies = spread > _FLAT * size
    unit = jnp.where(varies, spread, _SHARE * size)
    return dist.LogNormal(jnp.log(unit) - 1.0, jnp.where(varies, 1.5, 4.0))


def labelled_rows(data: Labels) -> dict[str, Any]:
    """The rows with a label, as arguments of the model; each counts alike, whatever its weight.

    Args:
        data: checked rows.

    Raises:
        InputError: there is no prediction to compare labels with.
    """
    if data.prediction is None:
        remedy = "Add the column prediction: what the twin says of each row, without having seen its label"
        raise InputError("labels", "a prediction of each row", "none", remedy)
    rows = data.labelled
    return {"x": data.x[rows], "prediction": data.prediction[rows], "y": data.y[rows]}
