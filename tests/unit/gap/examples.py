"""Small models, data drawn from them, and effects on their sites."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.model.observed import Observed
from dtprob.models.arguments import split_static
from dtprob.models.complex_normal import ComplexNormal

SIGMA = 0.5
N_LINK, N_SAMPLE = 12, 8
PLACES = tuple(np.linspace(-2.0, 2.0, 21).tolist())
WIDTH = 0.15


def line(x, y=None):
    """Straight line with known noise over links and samples."""
    level = numpyro.deterministic("level", numpyro.sample("a", dist.Normal(0.0, 2.0)))
    slope = numpyro.deterministic("slope", numpyro.sample("b", dist.Normal(0.0, 3.0)))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", level + slope * x)
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def hierarchy(x, y=None):
    """Line whose level is each link's own."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", x.shape[0], dim=-2):
        offset = numpyro.sample("offset", dist.Normal(0.0, 1.0))
        with numpyro.plate("sample", x.shape[1], dim=-1):
            mean = numpyro.deterministic("mean", offset + slope * x)
            numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def seconds(x, y=None):
    """A delay in seconds beside a gain of order one."""
    delay = numpyro.sample("delay", dist.Normal(0.0, 1e-9))
    gain = numpyro.sample("gain", dist.Normal(0.0, 2.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", gain + 1e9 * delay * x)
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


def spread(x, y=None):
    """Line with unknown noise."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", slope * x)
        numpyro.sample("y", dist.Normal(mean, scale), obs=y)


def logistic(x, y=None):
    """Successes of a logistic line."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", 0.3 + slope * x)
        numpyro.sample("y", dist.Bernoulli(logits=mean), obs=y)


def counts(x, y=None):
    """Poisson counts with a log-linear rate."""
    slope = numpyro.sample("b", dist.Normal(0.0, 1.0))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", 1.0 + slope * x)
        numpyro.sample("y", dist.Poisson(jnp.exp(mean)), obs=y)


def labels(x, y=None):
    """One of three classes."""
    slope = numpyro.sample("b", dist.Normal(0.0, 2.0).expand([3]).to_event(1))
    with numpyro.plate("link", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        mean = numpyro.deterministic("mean", slope * x[..., None])
        numpyro.sample("y", dist.Categorical(logits=mean), obs=y)


def tone(x, y=None):
    """A complex tone; its phase is each link's own."""
    gain = numpyro.sample("gain", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("link", x.shape[0], dim=-2):
        phase = numpyro.sample("phase", dist.VonMises(0.0, 1e-3))
        with numpyro.plate("sample", x.shape[1], dim=-1):
            turn = numpyro.deterministic("mean", 0.7 * x)
            field = numpyro.deterministic("field", gain * jnp.exp(1j * (turn + phase)))
            numpyro.sample("y", ComplexNormal(field, SIGMA**2), obs=y)


MODELS = {
    "line": (line, {"a": 0.7, "b": -1.2}),
    "hierarchy": (hierarchy, {"b": -1.2}),
    "seconds": (seconds, {"delay": -0.8e-9, "gain": 1.4}),
    "spread": (spread, {"b": -1.2, "scale": 0.6}),
    "logistic": (logistic, {"b": 0.9}),
    "counts": (counts, {"b": 0.5}),
    "labels": (labels, {"b": np.array([0.4, -0.8, 0.1])}),
    "tone": (tone, {"gain": 1.3}),
}


def inputs(seed=0, n_link=N_LINK, n_sample=N_SAMPLE):
    """Regressors (link, sample)."""
    return np.random.default_rng(seed).normal(size=(n_link, n_sample))


def draw(name, seed=1, shift=0.0, x=None):
    """Data of a model at its values, with `shift` added to the site "mean"; seed 0 is that of the inputs."""
    assert seed, "the noise would be the inputs once more"
    rng, (_, values) = np.random.default_rng(seed), MODELS[name]
    x = inputs() if x is None else x
    noise = rng.normal(size=x.shape)
    match name:
        case "line":
            y = values["a"] + values["b"] * x + shift + SIGMA * noise
        case "hierarchy":
            y = rng.normal(size=(len(x), 1)) + values["b"] * x + shift + SIGMA * noise
        case "seconds":
            y = values["gain"] + 1e9 * values["delay"] * x + shift + SIGMA * noise
        case "spread":
            y = values["b"] * x + shift + values["scale"] * noise
        case "logistic":
            y = rng.uniform(size=x.shape) < 1 / (1 + np.exp(-(0.3 + values["b"] * x + shift)))
        case "counts":
            y = rng.poisson(np.exp(1.0 + values["b"] * x + shift))
        case "labels":
            logits = values["b"] * x[..., None] + shift
            y = np.argmax(logits + rng.gumbel(size=logits.shape), axis=-1)
        case _:
            phase = rng.uniform(-np.pi, np.pi, (len(x), 1))
            noise = (noise + 1j * rng.normal(size=x.shape)) * np.sqrt(0.5)
            y = values["gain"] * np.exp(1j * (0.7 * x + shift + phase)) + SIGMA * noise
    y = np.asarray(y, int) if name in ("counts", "labels", "logistic") else y
    return {"x": jnp.asarray(x), "y": jnp.asarray(y)}


def _column(value, shape):
    return value[..., None] if jnp.ndim(value) < len(shape) else value


def bend(scale=1.0):
    """Adds c x^2 to the mean."""

    def rewrite(value, p, context):
        return value + p["c"] * _column(context["x"] ** 2, value.shape)

    return Effect("bend", {"mean": rewrite}, (Parameter("c", dist.Normal(0.0, scale)),))


def ripple(name="ripple", frequency=3.0):
    """Adds c sin(f x) to the mean."""

    def rewrite(value, p, context):
        return value + p["c"] * _column(jnp.sin(frequency * context["x"]), value.shape)

    return Effect(name, {"mean": rewrite}, (Parameter("c", dist.Normal(0.0, 1.0)),))


def pair():
    """Two parameters at once: a cubic and a cosine."""

    def rewrite(value, p, context):
        x = context["x"]
        return value + _column(p["c"][0] * x**3 / 3 + p["c"][1] * jnp.cos(2 * x), value.shape)

    return Effect("pair", {"mean": rewrite}, (Parameter("c", dist.Normal(0.0, 1.0).expand([2]).to_event(1)),))


def saturation():
    """Takes c |x| away from the mean; c is never negative."""

    def rewrite(value, p, context):
        return value - p["c"] * _column(jnp.abs(context["x"]), value.shape)

    return Effect("saturation", {"mean": rewrite}, (Parameter("c", dist.HalfNormal(1.0)),))


def jitter():
    """Random level of each link."""

    def rewrite(value, p, context):
        return value + p["size"] * p["field"]

    return Effect(
        "jitter",
        {"mean": rewrite},
        (Parameter("size", dist.HalfNormal(1.0)),),
        kind="variance",
        field_shape=lambda value, context: (value.shape[0], *(1,) * (value.ndim - 1)),
    )


def bump(prior=None):
    """Raises the mean by c around some x, which the data tell."""
    prior = dist.Normal(0.0, 2.0) if prior is None else prior

    def rewrite(value, p, context):
        return value + p["c"] * jnp.exp(-0.5 * ((context["x"] - p["at"]) / WIDTH) ** 2)

    at = Parameter("at", dist.Normal(0.0, 1.2), is_place=True, tried=PLACES)
    return Effect("bump", {"mean": rewrite}, (Parameter("c", prior), at))


def gusty():
    """Moves the mean around some x, that the data tell, by a random height for each link."""

    def rewrite(value, p, context):
        near = jnp.exp(-0.5 * ((context["x"] - p["at"]) / WIDTH) ** 2)
        return value + p["height"] * p["field"] * near

    at = Parameter("at", dist.Normal(0.0, 1.2), is_place=True, tried=PLACES)
    return Effect(
        "gusty",
        {"mean": rewrite},
        (Parameter("height", dist.HalfNormal(2.0, validate_args=False)), at),
        kind="variance",
        field_shape=lambda value, _: (value.shape[0], *(1,) * (value.ndim - 1)),
    )


def raised(x, at, size):
    """What a bump adds."""
    return size * np.exp(-0.5 * ((x - at) / WIDTH) ** 2)


def use(problem, data):
    """Put other data of the same shapes into a compiled problem."""
    problem.data, problem.arrays = dict(data), split_static(data)[0]
    problem.programs._arrays = problem.arrays
    problem.compiled.arrays = problem.compiled.arrays._replace(data=problem.arrays)
    problem.observed = Observed(problem._declared, problem.arrays)
    return problem


def of_access_points(x, access_point, y=None):
    """A line with noise; what `access_point` says has no part in it."""
    slope = numpyro.sample("slope", dist.Normal(0.0, 10.0))
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    mean = numpyro.deterministic("mean", level + slope * x)
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("reading", x.shape[0]):
        numpyro.sample("y", dist.Normal(mean, noise), obs=y)
