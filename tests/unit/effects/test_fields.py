"""The random field of a variance effect counts once, whatever the model has around the site that it acts on."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.infer.util import log_density

from dtprob.effects import Effect, Parameter, with_effects

SCATTER = Effect(
    family="scatter",
    rewrites={"mean": lambda value, p, _: value + p["scale"] * p["field"]},
    parameters=(Parameter("scale", dist.HalfNormal(1.0)),),
    kind="variance",
)
GIVEN = {"scatter.field": jnp.linspace(-2.0, 2.0, 6), "scatter.scale": jnp.ones(())}
ITS_OWN = dist.Normal().log_prob(GIVEN["scatter.field"]).sum() + dist.HalfNormal().log_prob(1.0)


def mean():
    return numpyro.deterministic("mean", jnp.zeros(6))


@pytest.mark.parametrize(
    "context",
    [
        lambda: handlers.mask(mask=jnp.arange(6) < 3),
        lambda: handlers.mask(mask=False),
        lambda: handlers.scale(scale=10.0),
        lambda: numpyro.plate("part", 12, subsample_size=6),
    ],
    ids=["mask", "none", "scale", "part"],
)
def test_what_the_model_has_around_the_site_leaves_the_field_alone(context):
    def inside():
        with context():
            return mean()

    total, trace = log_density(handlers.seed(with_effects(inside, [SCATTER]), 0), (), {}, GIVEN)
    np.testing.assert_allclose(total, ITS_OWN, rtol=1e-6)
    np.testing.assert_array_equal(trace["mean"]["value"], GIVEN["scatter.field"])


@pytest.mark.parametrize(
    ("around", "times"), [(handlers.mask(mask=False), 0), (handlers.scale(scale=3.0), 3)]
)
def test_what_is_around_the_extended_model_holds_for_its_field(around, times):
    with around:
        total, _ = log_density(handlers.seed(with_effects(mean, [SCATTER]), 0), (), {}, GIVEN)
    np.testing.assert_allclose(total, times * ITS_OWN, rtol=1e-6)
