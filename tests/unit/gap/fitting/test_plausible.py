"""Evidence with the scale of the prior mixed, against quadrature."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.distributions.transforms import AffineTransform
from scipy import integrate, special, stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.plausible import (
    SCALES,
    limits,
    log_bayes_factor,
    mixing_gain,
    nulls,
    scales,
    sides,
)
from dtprob.gap.model.problem import Problem


def quadrature(information, score, scale, low=-np.inf):
    """Evidence of a normal likelihood with a prior of mixed scale, over that of the null."""

    def integrand(size, width):
        prior = stats.norm(0, width).pdf(size) * (2 if low == 0 else 1)
        return np.exp(score * size - 0.5 * information * size**2) * prior

    def one(width):
        reach = 12 * width
        points = [score / information] if -reach < score / information < reach else None
        return integrate.quad(integrand, max(low, -reach), reach, args=(width,), points=points, limit=400)[0]

    return np.log(np.mean([one(s * scale) for s in SCALES]))


@pytest.mark.study
@pytest.mark.parametrize("score", [3.0, 0.0, -12.0])
@pytest.mark.parametrize("one_sided", [False, True])
def test_one_parameter(score, one_sided):
    found = log_bayes_factor(np.array([[9.0]]), np.array([score]), np.array([2.0]), one_sided=one_sided)
    expected = quadrature(9.0, score, 2.0, 0.0 if one_sided else -np.inf)
    assert found == pytest.approx(expected, abs=1e-6)


def test_several_parameters_that_share_a_scale():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    information, score, scale = root @ root.T * 20, rng.normal(size=3) * 5, np.array([0.1, 1.0, 3.0])
    covariance = [np.diag(s**2 * scale**2) for s in SCALES]
    # The score's density is N(0, J + J T J) with the effect and N(0, J) without it.
    without = stats.multivariate_normal(np.zeros(3), information).logpdf(score)
    ratio = [
        stats.multivariate_normal(np.zeros(3), information + information @ t @ information).logpdf(score)
        - without
        for t in covariance
    ]
    assert log_bayes_factor(information, score, scale) == pytest.approx(
        np.log(np.mean(np.exp(ratio))), abs=1e-8
    )


@pytest.mark.parametrize("one_sided", [False, True])
def test_the_gain_over_the_largest_scale(one_sided):
    information, score, scale = np.array([[50.0]]), np.array([9.0]), np.array([0.7])
    precision = information + np.diag(scale**-2.0)
    mode = np.linalg.solve(precision, score)
    found = mixing_gain(np.linalg.inv(precision), mode, scale, sides=np.array([one_sided]))
    mixed = log_bayes_factor(information, score, scale, one_sided=one_sided)
    widest = 0.5 * (score @ mode - np.log(1 + information[0, 0] * scale[0] ** 2))
    if one_sided:
        widest += np.log(2)  # the density of the prior at the mode is twice that of a normal one
    assert found == pytest.approx(mixed - widest, abs=1e-9)


def test_the_unit_of_a_parameter_does_not_matter():
    """Far from both ends of its range an effect costs the same whatever its largest plausible size."""
    costs = [log_bayes_factor(np.array([[1e4]]), np.array([1e3]), np.array([s])) for s in (1.0, 3.0, 10.0)]
    assert np.ptp(costs) < 0.1


def test_flat_sizes_of_an_effect():
    effect = Effect(
        "both",
        {"mean": lambda v, p, c: v},
        (
            Parameter("loss", dist.HalfNormal(0.3), null=0.0),
            Parameter("shift", dist.Normal(0.0, 2.0).expand([2]).to_event(1)),
        ),
    )
    np.testing.assert_allclose(scales(effect), [0.3, 2.0, 2.0])
    np.testing.assert_allclose(nulls(effect), 0.0)
    np.testing.assert_array_equal(sides(effect), [True, False, False])


@pytest.mark.parametrize("estimate", [0.02, 0.5])
def test_a_size_with_a_place_is_one_sided_as_one_without(estimate):
    covariance, scale = np.diag([0.3, 0.04]) ** 2, np.array([2.0, 0.5])
    places = np.array([False, True])
    sides = np.array([True, False])
    both = mixing_gain(covariance, np.array([estimate, 0.2]), scale, sides=sides, places=places)
    alone = mixing_gain(covariance[:1, :1], np.array([estimate]), scale[:1], sides=sides[:1])
    np.testing.assert_allclose(both, alone, rtol=1e-10)
    assert mixing_gain(covariance, np.array([estimate, 0.2]), scale, places=places) != pytest.approx(
        both, abs=0.03
    )


def test_the_prior_of_a_place_is_not_mixed():
    """Where sizes and places say nothing of one another, what is gained is what the sizes alone gain."""
    scale, estimate = np.array([2.0, 0.3, 0.05]), np.array([0.02, 0.1, -0.04])
    covariance = np.diag(np.array([0.01, 0.05, 0.03]) ** 2)
    places = np.array([False, False, True])
    both = mixing_gain(covariance, estimate, scale, places=places)
    sizes = mixing_gain(covariance[:2, :2], estimate[:2], scale[:2])
    np.testing.assert_allclose(both, sizes, rtol=1e-10)
    assert mixing_gain(covariance, estimate, scale) != pytest.approx(both, abs=0.1)
    np.testing.assert_allclose(
        mixing_gain(covariance, estimate, scale, places=~np.zeros(3, bool)), 0.0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("prior", "null", "scale"),
    [
        (dist.Normal(0.0, 8.0), 0.0, 8.0),
        (dist.Normal(0.0, 8.0).expand([3]).to_event(1), 0.0, 8.0),
        (dist.HalfNormal(8.0), 0.0, 8.0),
        (dist.StudentT(2.0, 0.0, 4.0), 0.0, 4.0 * stats.t.ppf(0.75, 2.0) / stats.norm.ppf(0.75)),
        (dist.Normal(10.0, 1.0), 0.0, np.sqrt(101.0)),
        (dist.Normal(10.0, 1.0), 10.0, 1.0),
        (dist.HalfCauchy(5.0), 0.0, 5.0 / stats.norm.ppf(0.75)),
        (dist.Exponential(0.5), 0.0, np.sqrt(8.0)),
        (dist.Uniform(20.0, 400.0), 210.0, 380.0 / np.sqrt(12.0)),
        (dist.LogNormal(np.log(8.0), 0.4), 0.0, 8.0 * np.exp(0.16)),
        (dist.Gamma(2.0, 0.5), 4.0, np.sqrt(8.0)),
    ],
)
def test_how_far_a_prior_puts_a_size(prior, null, scale):
    assert Parameter("p", prior, null).scale == pytest.approx(scale, rel=1e-3)


def test_a_place_is_as_far_as_its_prior_is_wide():
    assert Parameter("p", dist.Normal(10.0, 2.0), 0.0, is_place=True).scale == pytest.approx(2.0)


def test_how_far_a_prior_without_moments_puts_a_size():
    moved = dist.TransformedDistribution(dist.Normal(0.0, 1.0), AffineTransform(0.0, 8.0))
    assert float(Parameter("p", moved).scale) == pytest.approx(8.0, rel=0.05)
    assert float(Parameter("p", dist.Pareto(1.0, 1.5)).scale) == pytest.approx(
        2 ** (1 / 1.5) / 0.6745, rel=0.05
    )


@pytest.mark.parametrize("shift", [-1.0, 0.0, 0.5])
def test_evidence_of_sizes_that_cannot_be_below_their_null_is_exact(shift):
    """Of a size for each of 24 links: half of them, or nearly all, are pushed against the null."""
    per_link, scale = 5, 3.0
    y = np.random.default_rng(0).normal(shift, 1.0, (24, per_link))
    each = Effect(
        "each",
        {"m": lambda value, p, _: value + p["s"][:, None]},
        (Parameter("s", dist.HalfNormal(scale).expand([24]).to_event(1)),),
    )
    problem = Problem(readings, {"y": jnp.asarray(y)}, [each]).with_live(["each"])
    base, found = (fit(problem, problem.null(), names) for names in ((), ("each",)))
    u, widths = y.sum(axis=1), scale * SCALES[:, None]
    spread = 1 + widths**2 * per_link
    above = np.log(2) + stats.norm.logcdf(u * widths / np.sqrt(spread))
    exact = (0.5 * (widths**2 * u**2 / spread - np.log(spread)) + above).sum(axis=1)
    expected = special.logsumexp(exact) - np.log(len(SCALES))
    assert found.log_evidence - base.log_evidence == pytest.approx(expected, abs=1e-6)


def readings(y=None):
    with numpyro.plate("link", 24, dim=-2), numpyro.plate("row", 5, dim=-1):
        mean = numpyro.deterministic("m", jnp.zeros((24, 5)))
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def test_limits_of_sizes():
    effect = Effect(
        "both",
        {"mean": lambda v, p, c: v},
        (
            Parameter("loss", dist.HalfNormal(0.3)),
            Parameter("share", dist.Uniform(0.0, 1.0)),
            Parameter("shift", dist.Normal(0.0, 2.0).expand([2]).to_event(1)),
        ),
    )
    low, high = limits(effect)
    np.testing.assert_array_equal(low, [0, 0, -np.inf, -np.inf])
    np.testing.assert_array_equal(high, [np.inf, 1, np.inf, np.inf])
