"""What a parameter's prior says of its sizes, and which parameters are refused."""

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from dtprob.effects import Parameter
from dtprob.errors import InputError


@pytest.mark.parametrize(
    ("prior", "null", "expected"),
    [
        (dist.HalfNormal(1.0), 0.0, True),
        (dist.Normal(0.0, 1.0), 0.0, False),
        (dist.HalfNormal(1.0).expand((3,)).to_event(1), 0.0, True),
        (dist.Uniform(0.0, 1.0), 0.0, True),
        (dist.Uniform(0.0, 1.0), 0.5, False),
        (dist.LogNormal(0.0, 1.0), 1.0, False),
        (dist.Beta(1.0, 5.0), 0.0, True),
        (dist.TruncatedNormal(0.0, 1.0, low=0.0), 0.0, True),
    ],
)
def test_one_sided(prior, null, expected):
    assert Parameter("p", prior, null).is_one_sided is expected


@pytest.mark.parametrize(
    ("prior", "expected"),
    [
        (dist.Normal(0.0, 2.0), 2.0),
        (dist.HalfNormal(2.0), 2.0),
        (dist.StudentT(3.0, 0.0, 2.0), 2.0 * np.sqrt(3.0)),
        (dist.StudentT(3.0, 3.0, 2.0), np.sqrt(12.0 + 9.0)),
        (dist.StudentT(2.0, 0.0, 2.0), 2.0 * 0.8164965809 / 0.6744897502),
        (
            dist.StudentT(jnp.array([1.0, 4.0]), 0.0, 2.0).to_event(1),
            [2.0 / 0.6744897502, 2.0 * np.sqrt(2.0)],
        ),
        (dist.Cauchy(0.0, 2.0), 2.0 / 0.6744897502),
        (dist.HalfCauchy(2.0), 2.0 / 0.6744897502),
        (dist.Laplace(0.0, 2.0), 2.0 * np.sqrt(2.0)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_how_far_a_prior_puts_a_size(prior, expected):
    """The root mean square, or a normal one's of the same median where there is none."""
    np.testing.assert_allclose(Parameter("p", prior).scale, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("prior", "null"),
    [
        (dist.Uniform(-3.0, 0.0), 0.0),
        (dist.Uniform(-3.0, 0.0).expand((2,)).to_event(1), 0.0),
        (dist.TruncatedNormal(0.0, 1.0, high=0.0), 0.0),
        (dist.Beta(5.0, 1.0), 1.0),
    ],
    ids=["uniform", "vector", "truncated", "share"],
)
def test_a_size_that_can_only_be_below_its_null_is_refused(prior, null):
    """It would be tested on both sides, and so be seen where its prior excludes it."""
    with pytest.raises(
        InputError, match=r"parameter db: .*got one that ends there\. Write the effect with the other sign"
    ):
        Parameter("db", prior, null)
    assert not Parameter("edge", prior, null, is_place=True).is_one_sided


def test_labels_are_one_for_each_entry():
    prior = dist.Normal(0.0, 1.0).expand([2]).to_event(1)
    assert Parameter("gain", prior, labels=("left", "right")).labels == ("left", "right")
    with pytest.raises(InputError, match="labels of parameter gain: expected 2, one for each entry, got 3"):
        Parameter("gain", prior, labels=("x", "y", "z"))


def test_a_unit_is_text():
    """No diagnosis ends in a report that cannot hold its unit."""
    with pytest.raises(InputError, match="unit of parameter gain: expected text, got None"):
        Parameter("gain", dist.Normal(0.0, 1.0), unit=None)  # pyright: ignore[reportArgumentType]
