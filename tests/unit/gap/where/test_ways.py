"""Ways in which sites may be wrong are gathered from all that the data and the model tell."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.ways import ways
from dtprob.models.declaration import model


@model(axes={"level": ("episode", "slot", "device")}, cluster="episode")
def levels(sending, heard=None):
    at_rest = numpyro.sample("at_rest", dist.Normal(0.0, 1.0))
    level = numpyro.deterministic("level", at_rest + 0.5 * sending)
    episode, slot, device = (
        numpyro.plate(name, size, dim=i - 3)
        for i, (name, size) in enumerate(zip(("episode", "slot", "device"), sending.shape, strict=True))
    )
    with episode, slot, device:
        numpyro.sample("heard", dist.Normal(level, 1.0), obs=heard)


def test_what_happens_while_a_device_sends_is_among_them():
    rng = np.random.default_rng(0)
    sending = rng.random((20, 30, 3)) < 0.3
    data = {"sending": jnp.asarray(sending), "heard": jnp.asarray(rng.normal(size=sending.shape))}
    problem = Problem(levels, data, [], cluster="episode")
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(0), Settings(replicates=20))
    labels = {curve.label for _, curves in ways(problem, projection.origin, drawn).over for curve in curves}
    assert "stretch of slot by sending of each device" in labels
    assert "every 10 along episode and slot of device 1 with sending 1" in labels
    assert {"by value of sending", "by value of sending of all"} <= labels  # what groups tell by themselves
