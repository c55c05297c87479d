"""Sizes of accepted causes: engines agree, beside random fields too."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.confirm import _sizes, confirm
from dtprob.inference import NUTS, Laplace
from dtprob.models.declaration import model

LINKS, READINGS = 40, 6


@model(axes={"expected": ("link", "reading")}, cluster="link")
def levels(group, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    expected = numpyro.deterministic("expected", level + 0.0 * group)
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        numpyro.sample("y", dist.Normal(expected, 1.0), obs=y)


OFFSET = Effect(
    "offset",
    {"expected": lambda value, p, context: value + p["by"] * context["group"]},
    (Parameter("by", dist.Normal(0.0, 5.0)),),
)
SHADOWING = Effect(
    "shadowing",
    {"expected": lambda value, p, context: value + p["scale"] * p[FIELD]},
    (Parameter("scale", dist.HalfNormal(3.0)),),
    kind="variance",
    field_shape=lambda value, context: (value.shape[0], 1),
)


@pytest.mark.study
def test_a_sampler_draws_the_accepted_fields_too():
    """Without them links were independent readings, and the interval of the offset half as wide."""
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(LINKS)[:, None] % 2, READINGS, axis=1).astype(float)
    y = 3.0 * group + 1.5 * rng.normal(size=(LINKS, 1)) + rng.normal(size=group.shape)
    problem = Problem(levels, {"group": jnp.asarray(group), "y": jnp.asarray(y)}, [OFFSET, SHADOWING])
    base = fit_base(problem, jax.random.key(0))
    names = ["offset", "shadowing"]
    wider = problem.with_live(names)
    found = fit(wider, wider.translate(base.x, problem), names)
    widths = []
    for engine in (Laplace(), NUTS(draws=500, warmup=500)):
        sizes, _ = confirm(wider, found, [OFFSET, SHADOWING], jax.random.key(1), engine)
        offset = next(size for size in sizes if size.name.startswith("offset"))
        widths.append(offset.high - offset.low)
    np.testing.assert_allclose(widths[1], widths[0], rtol=0.25)


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        ((), ["gain_0_Np", "gain_1_Np", "gain_2_Np"]),
        (("x", "y", "z"), ["gain_x_Np", "gain_y_Np", "gain_z_Np"]),
    ],
)
def test_entries_are_called_as_the_parameter_says(labels, names):
    """Three entries are three directions only where they are said to be."""
    prior = dist.Normal(0.0, 1.0).expand([3]).to_event(1)
    found = _sizes(Parameter("gain", prior, unit="Np", labels=labels), np.zeros((8, 3)), prefix="")
    assert [one.name for one in found] == names


def same_everywhere(place, deviation, y=None):
    """One level at all places, known deviation."""
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    with numpyro.plate("row", len(place)):
        mean = numpyro.deterministic("mean", level + 0.0 * place)
        numpyro.sample("y", dist.Normal(mean, deviation), obs=y)


@pytest.mark.study
def test_sizes_stay_within_what_their_priors_allow():
    """A share that data push to its whole, and a loss that they push against its null, as a sampler finds them."""
    rng = np.random.default_rng(1)
    group = np.arange(60) % 3
    y = 1.25 * (group == 1) - 0.4 * (group == 2) + rng.normal(size=60)
    effect = Effect(
        "both",
        {
            "mean": lambda value, p, context: (
                value + p["share"] * (context["place"] == 1) + p["loss"] * (context["place"] == 2)
            )
        },
        (Parameter("share", dist.Uniform(0.0, 1.0)), Parameter("loss", dist.HalfNormal(3.0))),
    )
    data = {"place": jnp.asarray(group), "deviation": jnp.asarray(1.0), "y": jnp.asarray(y)}
    problem = Problem(same_everywhere, data, [effect]).with_live(["both"])
    found = fit(problem, problem.null(), ["both"])
    normal, exact = (
        {size.name: size for size in confirm(problem, found, [effect], jax.random.key(0), engine)[0]}
        for engine in (Laplace(draws=4000), NUTS(warmup=500, draws=1500, chains=2))
    )
    assert normal["share"].high <= 1.0
    for name in ("share", "loss"):
        for end in ("low", "mean", "high"):
            assert getattr(normal[name], end) == pytest.approx(getattr(exact[name], end), abs=0.1)


@pytest.mark.parametrize("since", [20.3, 41.7, 55.2])
def test_the_interval_of_a_step_is_what_the_data_tell(since):
    """No reading changes with the day of a step, moved a little; its interval was its prior's, 12 to 62 of 60 days."""

    rng = np.random.default_rng(2)
    day = np.sort(rng.uniform(0.0, 60.0, 240))
    y = 1.0 - 2.0 * (day >= since) + 2.0 * rng.normal(size=240)
    at = Parameter(
        "since", dist.Normal(40.0, 15.0), null=40.0, is_place=True, tried=tuple(np.arange(1.0, 60.0))
    )
    drop = Effect(
        "drop",
        {"mean": lambda value, p, context: value - p["loss"] * (context["place"] >= p["since"])},
        (Parameter("loss", dist.HalfNormal(5.0)), at),
    )
    # the exact posterior: the level and the loss integrated out on a grid of losses
    days = np.linspace(0.0, 80.0, 1601)
    losses = np.linspace(0.0, 6.0, 301)
    after = day >= days[:, None]
    count, total = after.sum(1)[:, None], (after @ y)[:, None]
    variance = 4.0 / len(y)  # the level's prior is flat beside it
    square = (y**2).sum() + 2 * losses * total + losses**2 * count
    mean = y.mean() + losses * count / len(y)
    log_density = (
        mean**2 / variance - square / 4.0 - (losses / 5.0) ** 2 - ((days[:, None] - 40.0) / 15.0) ** 2
    ) / 2
    density = np.exp(log_density - log_density.max()).sum(1)
    exact = np.interp([0.05, 0.95], np.cumsum(density) / density.sum(), days)
    data = {"place": jnp.asarray(day), "deviation": jnp.asarray(2.0), "y": jnp.asarray(y)}
    problem = Problem(same_everywhere, data, [drop]).with_live(["drop"])
    start = problem.null()
    start[problem.layout.of(drop)] = 2.0, days[density.argmax()]
    found = fit(problem, start, ["drop"])
    start[problem.layout.of(drop)] = found.x[problem.layout.of(drop)][0], days[density.argmax()]
    sizes, _ = confirm(problem, replace(found, x=start), [drop], jax.random.key(0), Laplace(draws=4000))
    told = next(size for size in sizes if size.name == "since")
    np.testing.assert_allclose([told.low, told.high], exact, atol=0.1 * (exact[1] - exact[0]) + 0.2)
