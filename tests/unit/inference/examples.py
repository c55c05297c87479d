"""Small models that several tests share, so that what is compiled for one serves the others."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from dtprob.models.complex_normal import ComplexNormal


def normal(noise, y=None):
    """Conjugate: the posterior of `level` is normal."""
    level = numpyro.sample("level", dist.Normal(1.0, 3.0))
    with numpyro.plate("row", 12):
        numpyro.sample("y", dist.Normal(level, noise), obs=y)


def normal_data(seed=0):
    return {"noise": 1.5, "y": np.random.default_rng(seed).normal(2.0, 1.5, 12)}


def normal_posterior(data):
    """(mean, standard deviation, log evidence) of `level`."""
    y, noise = data["y"], data["noise"]
    precision = 1 / 9 + len(y) / noise**2
    mean = (1 / 9 + y.sum() / noise**2) / precision
    covariance = noise**2 * np.eye(len(y)) + 9.0
    residual = y - 1.0
    log_det = np.linalg.slogdet(2 * np.pi * covariance)[1]
    return mean, precision**-0.5, -0.5 * (residual @ np.linalg.solve(covariance, residual) + log_det)


def logistic(x, y=None):
    """Logistic regression with a hierarchical scale."""
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.3))
    with numpyro.plate("feature", x.shape[1]):
        weight = numpyro.sample("weight", dist.Normal(0.0, scale))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Bernoulli(logits=x @ weight), obs=y)


def logistic_data(rows=60, features=3):
    random = np.random.default_rng(1)
    x = random.normal(size=(rows, features))
    chance = 1 / (1 + np.exp(-x @ np.linspace(-1.5, 1.5, features)))
    return {"x": x, "y": (random.uniform(size=rows) < chance).astype(int)}


def at_the_cut(y=None):
    """An angle whose posterior lies across +-pi, and one that the data say nothing of."""
    angle = numpyro.sample("angle", dist.VonMises(0.0, 0.05))
    numpyro.sample("free", dist.VonMises(0.0, 1e-3))
    with numpyro.plate("row", 15):
        numpyro.sample("y", dist.VonMises(angle, 3.0), obs=y)


def at_the_cut_data():
    return {"y": np.angle(np.exp(1j * np.random.default_rng(2).normal(np.pi, 0.6, 15)))}


def spread_angles(y=None):
    """Angles with an unknown common concentration, which von Mises EM finds step by step."""
    concentration = numpyro.sample("concentration", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("angle", 3, dim=-1):
        angle = numpyro.sample("direction", dist.VonMises(0.0, concentration))
        with numpyro.plate("row", 15, dim=-2):
            numpyro.sample("y", dist.VonMises(angle, 1.0), obs=y)


def spread_angles_data():
    return {"y": at_the_cut_data()["y"][:, None] + np.asarray([0.0, 1.0, 2.0])}


def phase_errors(response, concentration, noise, h=None):
    """A channel whose paths have phase errors: h = sum_p e^{j z_p} a_p + noise, a_p of shape (frequency,)."""
    links, paths, frequencies = response.shape
    with numpyro.plate("link", links, dim=-2):
        with numpyro.plate("path", paths, dim=-1):
            phase = numpyro.sample("phase", dist.VonMises(0.0, concentration))
        mean = jnp.einsum("lp,lpf->lf", jnp.exp(1j * phase), response)
        with numpyro.plate("frequency", frequencies, dim=-1):
            numpyro.sample("h", ComplexNormal(mean, noise), obs=h)


def phase_errors_data(links=6, paths=3, *, frequencies=12, concentration=2.0, noise=0.1, seed=3, spread=1.0):
    """Data of `phase_errors`; a small `spread` of the delays makes the paths hard to resolve."""
    random = np.random.default_rng(seed)
    gain = random.normal(size=(2, links, paths)) / np.sqrt(2)
    delay = spread * random.uniform(size=(links, paths, 1))
    response = (gain[0] + 1j * gain[1])[..., None] * np.exp(-2j * np.pi * delay * np.arange(frequencies))
    phase = random.vonmises(0.0, concentration, (links, paths))
    parts = random.normal(size=(2, links, frequencies)) * np.sqrt(noise / 2)
    h = np.einsum("lp,lpf->lf", np.exp(1j * phase), response) + parts[0] + 1j * parts[1]
    return {"response": response, "concentration": concentration, "noise": noise, "h": h}, phase
