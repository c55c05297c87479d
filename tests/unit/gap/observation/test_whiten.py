"""Whitened rows: mean, covariance, score and information of every family against its density."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.distributions import ComplexStudentT
from dtprob.errors import InputError
from dtprob.gap.observation import discrete, whiten
from dtprob.gap.observation.likelihoods import COMPOUNDS, LIKELIHOODS, likelihood
from dtprob.models.complex_normal import ComplexNormal


def strong(value):
    """An array whose dtype, unlike a Python number's, wins over single precision."""
    return jnp.asarray(np.asarray(value))


LOGITS = jnp.array([0.3, -1.2, 0.8])
PROBABILITY = jax.nn.softmax(LOGITS)

WEIGHTS = strong([0.3, 0.7])
LOCATED = {"loc": strong(-0.3), "scale": strong(0.6)}
LOCATED_CHANGE = {"loc": strong(0.7), "scale": strong(0.4)}

# (family, make distribution, parameters, tangent)
FAMILIES = {
    "ComplexNormal": (
        ComplexNormal,
        {"loc": strong(0.4 - 1.1j), "variance": strong(1.7)},
        {"loc": strong(0.6 + 0.9j), "variance": strong(-0.8)},
    ),
    "ComplexStudentT": (
        ComplexStudentT,
        {"loc": strong(0.4 - 1.1j), "variance": strong(1.7), "tail": strong(0.0)},
        {"loc": strong(0.6 + 0.9j), "variance": strong(-0.8), "tail": strong(0.5)},
    ),
    "Normal": (
        dist.Normal,
        {"loc": strong(-0.3), "scale": strong(0.6)},
        {"loc": strong(0.7), "scale": strong(0.4)},
    ),
    "LogNormal": (
        dist.LogNormal,
        {"loc": strong(-0.3), "scale": strong(0.6)},
        {"loc": strong(0.7), "scale": strong(0.4)},
    ),
    "StudentT": (
        lambda loc, scale, df: dist.StudentT(df, loc, scale),
        {"loc": strong(-0.3), "scale": strong(0.6), "df": strong(5.0)},
        {"loc": strong(0.7), "scale": strong(0.4), "df": strong(1.5)},
    ),
    "BernoulliLogits": (
        lambda logits: dist.Bernoulli(logits=logits),
        {"logits": strong(0.9)},
        {"logits": strong(0.7)},
    ),
    "BernoulliProbs": (
        lambda probs: dist.Bernoulli(probs=probs),
        {"probs": strong(0.8)},
        {"probs": strong(0.3)},
    ),
    "Poisson": (dist.Poisson, {"rate": strong(2.3)}, {"rate": strong(0.6)}),
    "Laplace": (
        dist.Laplace,
        {"loc": strong(-0.3), "scale": strong(0.6)},
        {"loc": strong(0.7), "scale": strong(0.4)},
    ),
    "MultivariateNormal": (
        lambda loc, scale_tril: dist.MultivariateNormal(loc, scale_tril=scale_tril),
        {"loc": strong([0.4, -1.0, 0.2, 0.1]), "scale_tril": strong(np.tri(4) * [0.7, 0.5, 0.9, 1.2])},
        {
            "loc": strong([0.5, 0.3, -0.4, 0.2]),
            "scale_tril": strong(np.tri(4) * [[0.2], [-0.3], [0.6], [0.1]]),
        },
    ),
    "Exponential": (dist.Exponential, {"rate": strong(2.3)}, {"rate": strong(0.6)}),
    "Gamma": (
        dist.Gamma,
        {"concentration": strong(1.8), "rate": strong(0.7)},
        {"concentration": strong(0.5), "rate": strong(-0.4)},
    ),
    "Weibull": (
        dist.Weibull,
        {"scale": strong(1.8), "concentration": strong(2.4)},
        {"scale": strong(0.5), "concentration": strong(-0.4)},
    ),
    "Beta": (
        dist.Beta,
        {"concentration1": strong(3.2), "concentration0": strong(0.8)},
        {"concentration1": strong(0.5), "concentration0": strong(-0.3)},
    ),
    "VonMises": (
        dist.VonMises,
        {"loc": strong(2.8), "concentration": strong(3.1)},
        {"loc": strong(0.4), "concentration": strong(0.7)},
    ),
    "GammaPoisson": (
        dist.GammaPoisson,
        {"concentration": strong(2.6), "rate": strong(0.1)},
        {"concentration": strong(0.4), "rate": strong(-0.02)},
    ),
    "BinomialLogits": (
        lambda total_count, logits: dist.Binomial(jnp.asarray(total_count, int), logits=logits),
        {"total_count": strong(9.0), "logits": strong(0.9)},
        {"total_count": strong(0.0), "logits": strong(0.7)},
    ),
    "BinomialProbs": (
        lambda total_count, probs: dist.Binomial(jnp.asarray(total_count, int), probs=probs),
        {"total_count": strong(9.0), "probs": strong(0.8)},
        {"total_count": strong(0.0), "probs": strong(0.3)},
    ),
    "CategoricalLogits": (
        lambda logits: dist.Categorical(logits=logits),
        {"logits": LOGITS},
        {"logits": jnp.array([0.5, -0.2, 0.4])},
    ),
    "CategoricalProbs": (
        lambda probs: dist.Categorical(probs=probs),
        {"probs": PROBABILITY},
        {"probs": jnp.array([0.3, -0.1, -0.2])},
    ),
    "Logistic": (dist.Logistic, LOCATED, LOCATED_CHANGE),
    "Gumbel": (dist.Gumbel, LOCATED, LOCATED_CHANGE),
    "Cauchy": (dist.Cauchy, LOCATED, LOCATED_CHANGE),
    "HalfNormal": (dist.HalfNormal, {"scale": strong(0.6)}, {"scale": strong(0.4)}),
    "InverseGamma": (
        dist.InverseGamma,
        {"concentration": strong(1.8), "rate": strong(0.7)},
        {"concentration": strong(0.5), "rate": strong(-0.4)},
    ),
    "GeometricProbs": (dist.Geometric, {"probs": strong(0.3)}, {"probs": strong(0.2)}),
    "BetaBinomial": (
        lambda total_count, **p: dist.BetaBinomial(total_count=jnp.asarray(total_count, int), **p),
        {"concentration1": strong(3.2), "concentration0": strong(0.8), "total_count": strong(40.0)},
        {"concentration1": strong(0.5), "concentration0": strong(-0.3), "total_count": strong(0.0)},
    ),
    "ZeroInflated Poisson": (
        lambda gate, **p: dist.ZeroInflatedDistribution(dist.Poisson(**p), gate=gate),
        {"rate": strong(2.3), "gate": strong(0.2)},
        {"rate": strong(0.6), "gate": strong(0.3)},
    ),
    "ZeroInflated GammaPoisson": (
        lambda gate, **p: dist.ZeroInflatedDistribution(dist.GammaPoisson(**p), gate=gate),
        {"concentration": strong(2.6), "rate": strong(0.4), "gate": strong(0.2)},
        {"concentration": strong(0.4), "rate": strong(-0.1), "gate": strong(0.3)},
    ),
    **{
        f"Mixture {base.__name__}": (
            lambda log_weight, base=base, **p: dist.MixtureSameFamily(
                dist.Categorical(logits=log_weight), base(**p)
            ),
            {"loc": strong([-0.3, 2.0]), "scale": strong([0.6, 0.9]), "log_weight": jnp.log(WEIGHTS)},
            {"loc": strong([0.7, -0.4]), "scale": strong([0.4, 0.2]), "log_weight": strong([0.3, -0.2])},
        )
        for base in (dist.Normal, dist.LogNormal)
    },
    **{
        f"{side}Truncated {base.__name__}": (
            lambda made=made, base=base, bounds=tuple(bounds), **p: made(
                base(**{n: v for n, v in p.items() if n not in bounds}), **{n: p[n] for n in bounds}
            ),
            {**LOCATED, **bounds},
            {**LOCATED_CHANGE, **dict.fromkeys(bounds, strong(0.0))},
        )
        for side, made, bounds in (
            ("Left", dist.LeftTruncatedDistribution, {"low": strong(-0.5)}),
            ("Right", dist.RightTruncatedDistribution, {"high": strong(0.4)}),
            ("TwoSided", dist.TwoSidedTruncatedDistribution, {"low": strong(-0.8), "high": strong(1.1)}),
        )
        for base in (dist.Normal, dist.Logistic)
    },
}
COUNT = 100_000


def test_every_family_is_tested():
    tested = {family.split(" ")[0] for family in FAMILIES} | set(CENSORED)
    assert tested == {*LIKELIHOODS, *COMPOUNDS}


SLOW = {
    "BetaBinomial", "GammaPoisson", "Mixture LogNormal", "Mixture Normal", "RightTruncated Logistic",
    "TwoSidedTruncated Logistic", "ZeroInflated GammaPoisson",
}  # fmt: skip
TESTED = [pytest.param(family, marks=pytest.mark.study) if family in SLOW else family for family in FAMILIES]


def draws(family, n=COUNT):
    make, parameters, _ = FAMILIES[family]
    return make(**parameters).sample(jax.random.key(3), (n,))


def batch(family, values):
    make, parameters, _ = FAMILIES[family]
    return whiten.observation(make(**each(parameters, values)), values, "y")


def each(parameters, values):
    """The same parameters for every draw."""
    return {k: jnp.broadcast_to(v, (len(values), *jnp.shape(v))) for k, v in parameters.items()}


def tangent_of(family, values):
    return each(FAMILIES[family][2], values)


def expected_covariance(family, size):
    if family.startswith("Categorical"):  # one row per class; they sum to zero along sqrt(p)
        root = np.sqrt(np.asarray(PROBABILITY))
        return np.eye(size) - np.outer(root, root)
    if family == "MultivariateNormal":  # each product with the opposite entry is there twice, by halves
        twice = np.tile(np.eye(2), (2, 2)) / 2
        return np.block([[np.eye(12), np.zeros((12, 4))], [np.zeros((4, 12)), twice]])
    return np.eye(size)


@pytest.mark.parametrize("family", TESTED)
def test_residuals_have_mean_zero_and_unit_covariance(family):
    values = draws(family)
    rows = np.moveaxis(np.asarray(whiten.residual(batch(family, values), values)), 1, -1).reshape(-1, COUNT)
    expected = expected_covariance(family, len(rows))
    fourth = (rows[:, None] ** 2 * rows[None] ** 2).mean(-1)
    assert np.all(np.abs(rows.mean(1)) < 5 / np.sqrt(COUNT))
    assert np.all(np.abs(np.cov(rows) - expected) < 5 * np.sqrt(fourth / COUNT) + 1e-9)


@pytest.mark.parametrize("family", TESTED)
def test_score_is_the_slope_of_the_log_density(family):
    make, parameters, tangent = FAMILIES[family]
    values = draws(family, 50)
    score = jnp.sum(
        whiten.residual(batch(family, values), values)
        * whiten.shift(batch(family, values), tangent_of(family, values)),
        axis=(0, *range(2, values.ndim + 1)),
    )
    h = 1e-6 if family != "ComplexStudentT" else 1e-5

    def density(t):
        moved = {k: v + t * tangent[k] for k, v in parameters.items()}
        if family == "CategoricalProbs":
            return jnp.log(moved["probs"])[values]
        return make(**moved).log_prob(values)

    if family == "ComplexStudentT":  # one-sided in the tail
        slope = (4 * density(h) - density(2 * h) - 3 * density(0.0)) / (2 * h)
    else:
        slope = (density(h) - density(-h)) / (2 * h)
    np.testing.assert_allclose(score, slope, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("tail", [0.05, 0.4])
def test_score_of_heavy_tails_away_from_the_null(tail):
    parameters = {"loc": strong(0.4 - 1.1j), "variance": strong(1.7), "tail": strong(tail)}
    tangent = {"loc": strong(0.6 + 0.9j), "variance": strong(-0.8), "tail": strong(0.5)}
    values = ComplexStudentT(**parameters).sample(jax.random.key(0), (40,))
    wide = {k: jnp.broadcast_to(v, (40,)) for k, v in parameters.items()}
    observed = whiten.Observation("ComplexStudentT", wide)
    moved = {k: jnp.broadcast_to(v, (40,)) for k, v in tangent.items()}
    score = jnp.sum(whiten.residual(observed, values) * whiten.shift(observed, moved), axis=0)

    def density(t):
        return ComplexStudentT(**{k: v + t * tangent[k] for k, v in parameters.items()}).log_prob(values)

    np.testing.assert_allclose(score, jax.jacfwd(density)(0.0), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("tail", [0.0, 0.2])
def test_fisher_of_location_and_variance_under_heavy_tails(tail):
    parameters = {"loc": strong(0.4 - 1.1j), "variance": strong(1.7), "tail": strong(tail)}
    values = ComplexStudentT(**parameters).sample(jax.random.key(5), (COUNT,))
    wide = {k: jnp.broadcast_to(v, values.shape) for k, v in parameters.items()}
    rows = np.asarray(whiten.residual(whiten.Observation("ComplexStudentT", wide), values))[:3]
    fourth = (rows[:, None] ** 2 * rows[None] ** 2).mean(-1)
    assert np.all(np.abs(np.cov(rows) - np.eye(3)) < 5 * np.sqrt(fourth / COUNT))


@pytest.mark.parametrize("family", ["ComplexNormal", "StudentT", "CategoricalLogits"])
def test_information_is_the_variance_of_the_score(family):
    make, parameters, tangent = FAMILIES[family]
    values = draws(family, COUNT)
    one = values[:1]
    shift = np.asarray(whiten.shift(batch(family, one), tangent_of(family, one)))[:, 0]
    information = float(shift @ shift)
    score = np.asarray(
        jnp.sum(
            whiten.residual(batch(family, values), values) * jnp.asarray(shift).reshape(-1, 1),
            axis=0,
        )
    )
    spread = 5 * np.sqrt((score**4).mean() / COUNT)
    assert abs(score.var() - information) < spread
    if family not in ("ComplexStudentT", "CategoricalProbs"):  # minus the mean curvature, by differentiation

        def density(t):
            return jnp.mean(make(**{k: v + t * tangent[k] for k, v in parameters.items()}).log_prob(values))

        curvature = -float(jax.grad(jax.grad(density))(0.0))
        assert abs(curvature - information) < max(0.02 * information, spread)


def test_masked_entries_say_nothing():
    value = jnp.arange(4.0)
    mask = jnp.array([True, False, True, False])
    fn = dist.Normal(jnp.zeros(4), 2.0).mask(mask).to_event(1)
    observed = whiten.observation(fn, value, "y")
    rows = whiten.residual(observed, value)
    shift = whiten.shift(observed, {"loc": jnp.ones(4), "scale": jnp.ones(4)})
    density = whiten.log_prob(observed, value)
    assert np.all(np.asarray(rows)[:, ~np.asarray(mask)] == 0)
    assert np.all(np.asarray(shift)[:, ~np.asarray(mask)] == 0)
    np.testing.assert_allclose(density.sum(), fn.log_prob(value), rtol=1e-12)


def test_wrappers_are_looked_through():
    value = jnp.zeros((3, 2))
    fn = dist.Normal(jnp.array([1.0, 2.0]), 0.5).expand((3, 2)).to_event(2)
    observed = whiten.observation(fn, value, "y")
    assert observed.family == "Normal"
    np.testing.assert_allclose(observed.parameters["loc"], [[1.0, 2.0]] * 3)
    np.testing.assert_allclose(whiten.log_prob(observed, value).sum(), fn.log_prob(value), rtol=1e-12)


def test_samples_follow_the_observation():
    observed = whiten.Observation("Poisson", {"rate": jnp.full(20_000, 3.0)})
    values = whiten.sample(observed, jax.random.key(0))
    assert abs(float(values.mean()) - 3.0) < 5 * np.sqrt(3.0 / 20_000)


def test_unknown_distribution_is_refused_by_name():
    others = [
        dist.Pareto(1.0, 2.0),  # made of an exponential, a normal
        dist.TransformedDistribution(dist.Normal(), dist.transforms.ExpTransform()),
    ]
    for other in others:
        with pytest.raises(InputError, match=rf"observed site 'y'.*{type(other).__name__}"):
            whiten.observation(other, jnp.full((), 0.5), "y")


def test_what_can_be_observed_instead_is_told():
    with pytest.raises(InputError, match="Observe Binomial counts of the classes"):
        whiten.observation(dist.Multinomial(5, probs=jnp.ones(3) / 3), jnp.array([2, 2, 1]), "y")
    with pytest.raises(InputError, match="Observe Beta shares"):
        whiten.observation(dist.Dirichlet(jnp.ones(3)), jnp.ones(3) / 3, "y")


CENSORED = {
    "LeftCensored": (dist.LeftCensoredDistribution, np.maximum),
    "RightCensored": (dist.RightCensoredDistribution, np.minimum),
}
CENSORED_BASES = {
    "Normal": (dist.Normal, LOCATED, LOCATED_CHANGE, -0.1),
    "LogNormal": (dist.LogNormal, LOCATED, LOCATED_CHANGE, 0.9),
    "Logistic": (dist.Logistic, LOCATED, LOCATED_CHANGE, -0.1),
    "Exponential": (dist.Exponential, {"rate": strong(2.3)}, {"rate": strong(0.6)}, 0.4),
    "Weibull": (*FAMILIES["Weibull"], 1.5),
}


def censored(side, base, n):
    """So many readings, those beyond a limit at it, and what is observed."""
    make, clip = CENSORED[side]
    kind, parameters, _, limit = CENSORED_BASES[base]
    values = strong(clip(np.asarray(kind(**parameters).sample(jax.random.key(4), (n,))), limit))
    fn = make(kind(**each(parameters, values)), values == limit)
    return values, fn, whiten.observation(fn, values, "y")


@pytest.mark.parametrize(
    "base",
    ["Normal", *(pytest.param(base, marks=pytest.mark.study) for base in CENSORED_BASES if base != "Normal")],
)
@pytest.mark.parametrize("side", ["LeftCensored", pytest.param("RightCensored", marks=pytest.mark.study)])
def test_readings_beyond_a_limit(side, base):
    make, _ = CENSORED[side]
    kind, parameters, change, limit = CENSORED_BASES[base]
    values, fn, observed = censored(side, base, COUNT)
    assert observed.family == f"{side} {base}"
    rows = np.asarray(whiten.residual(observed, values))
    fourth = (rows[:, None] ** 2 * rows[None] ** 2).mean(-1)
    assert np.all(np.abs(rows.mean(1)) < 5 / np.sqrt(COUNT))
    assert np.all(np.abs(np.cov(rows) - np.eye(len(rows))) < 5 * np.sqrt(fourth / COUNT) + 1e-9)

    def density(t):
        moved = {k: v + t * change[k] for k, v in parameters.items()}
        return make(kind(**each(moved, values[:50])), values[:50] == limit).log_prob(values[:50])

    first = whiten.Observation(observed.family, {n: p[:50] for n, p in observed.parameters.items()})
    still = {"limit": jnp.zeros(50), "censored": jnp.zeros(50)}
    moved = whiten.shift(first, {**each(change, values[:50]), **still})
    score = (whiten.residual(first, values[:50]) * moved).sum(0)
    np.testing.assert_allclose(score, (density(1e-6) - density(-1e-6)) / 2e-6, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(whiten.log_prob(observed, values), fn.log_prob(values), rtol=1e-6)
    again = whiten.sample(observed, jax.random.key(8))
    share = np.mean(values == limit)
    assert abs(np.mean(again == limit) - share) < 5 * np.sqrt(2 * share * (1 - share) / COUNT)


def test_a_reading_far_beyond_its_limit_stays_finite():
    for loc in (40.0, -40.0):
        fn = dist.LeftCensoredDistribution(dist.Normal(jnp.full(2, loc), 1.0), jnp.array([True, False]))
        observed = whiten.observation(fn, jnp.array([0.0, 1.0]), "y")
        still = {n: jnp.zeros(2) for n in observed.parameters}
        assert np.all(np.isfinite(whiten.residual(observed, jnp.array([0.0, 1.0]))))
        assert np.all(np.isfinite(whiten.shift(observed, {**still, "loc": jnp.ones(2)})))


def test_rows_have_no_mean_where_each_reading_has_a_floor_of_its_own():
    """As each spreading factor has: whitened by what became of them, those beyond a high floor weighed too much."""
    rng = np.random.default_rng(0)
    level, floor = rng.normal(0.0, 1.0, COUNT), rng.choice([-2.0, -1.0, 0.0, 1.0], COUNT)
    values = np.maximum(level + rng.standard_normal(COUNT), floor)
    fn = dist.LeftCensoredDistribution(dist.Normal(jnp.asarray(level), 1.0), jnp.asarray(values == floor))
    rows = np.asarray(whiten.residual(whiten.observation(fn, jnp.asarray(values), "y"), jnp.asarray(values)))
    assert np.all(np.abs(rows.mean(1)) < 4 * rows.std(1) / np.sqrt(COUNT))
    assert np.all((rows.var(1) > 0.6) & (rows.var(1) < 1.05))


def test_limits_of_readings_that_were_not_censored():
    """The farthest limit of any; a reading beyond that had none."""
    values = jnp.array([-90.0, -100.0, -95.0, -101.0, -80.0])
    fn = dist.LeftCensoredDistribution(dist.Normal(jnp.zeros(5), 1.0), jnp.array([1, 1, 0, 0, 0]) == 1)
    limit = whiten.observation(fn, values, "y").parameters["limit"]
    np.testing.assert_array_equal(limit, [-90.0, -100.0, -100.0, -np.inf, -100.0])


def test_parts_of_a_mixture_that_share_a_scale():
    fn = dist.MixtureSameFamily(
        dist.Categorical(probs=jnp.array([0.3, 0.7])), dist.Normal(jnp.zeros((4, 2)), 1.0)
    )
    observed = whiten.observation(fn, jnp.arange(4.0), "y")
    assert {p.shape for p in observed.parameters.values()} == {(4, 2)}
    np.testing.assert_allclose(
        whiten.log_prob(observed, jnp.arange(4.0)), fn.log_prob(jnp.arange(4.0)), rtol=1e-6
    )


def test_mixtures_of_a_list_of_parts():
    weights = dist.Categorical(probs=jnp.array([0.3, 0.7]))
    parts = [dist.Normal(jnp.arange(4.0), 1.0), dist.Normal(-3.0, jnp.full(4, 2.0))]
    fn = dist.MixtureGeneral(weights, parts, support=dist.constraints.real)
    observed = whiten.observation(fn, jnp.arange(4.0), "y")
    assert observed.family == "Mixture Normal"
    np.testing.assert_allclose(
        whiten.log_prob(observed, jnp.arange(4.0)), fn.log_prob(jnp.arange(4.0)), rtol=1e-6
    )
    counted = dist.MixtureGeneral(weights, [parts[0], dist.Poisson(3.0)], support=dist.constraints.real)
    with pytest.raises(InputError, match="MixtureGeneral"):  # numbers and counts have no density in common
        whiten.observation(counted, jnp.arange(4.0), "y")


@pytest.mark.parametrize("means", [(0.05, 3.0, 400.0), pytest.param((3e5,), marks=pytest.mark.study)])
def test_information_on_the_spread_of_counts(means):
    """Against the sum over all counts."""
    mean, concentration = (a.ravel() for a in np.meshgrid(means, [0.3, 5.0, 200.0]))
    p = {"concentration": strong(concentration), "rate": strong(concentration / mean)}
    found = np.asarray(jax.jit(discrete.counts_spread)(p)) ** 2
    for m, c, information in zip(mean, concentration, found, strict=True):
        shape = stats.nbinom(c, c / (c + m))
        k = np.arange(0.0, int(shape.isf(1e-13)) + 10)
        whole = np.sum(shape.sf(k) / (c + k) ** 2) - m / (c * (c + m))
        assert information == pytest.approx(whole, rel=2e-3), (m, c)


@pytest.mark.parametrize(
    "fn",
    [
        dist.NegativeBinomial2(4.0, 2.5),
        dist.NegativeBinomial(5, probs=0.4),
        dist.NegativeBinomial(5, logits=0.4),
        dist.BetaProportion(0.7, 12.0),
        dist.Chi2(3.0),
    ],
    ids=lambda fn: type(fn).__name__,
)
def test_the_same_distribution_with_other_parameters(fn):
    value = strong(0.3 if isinstance(fn, dist.Beta) else 3.0)
    observed = whiten.observation(fn, value, "y")
    np.testing.assert_allclose(whiten.log_prob(observed, value), fn.log_prob(value), rtol=1e-6)


def test_entries_of_a_vector_have_its_density_together():
    values = draws("MultivariateNormal", 20)
    make, parameters, _ = FAMILIES["MultivariateNormal"]
    entries = whiten.log_prob(batch("MultivariateNormal", values), values)
    assert entries.shape == values.shape
    np.testing.assert_allclose(entries.sum(-1), make(**parameters).log_prob(values), rtol=1e-10)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_scores_of_vectors_of_any_length(size):
    rng = np.random.default_rng(size)
    root = strong(np.tril(0.3 * rng.normal(size=(size, size)), -1) + np.diag(rng.uniform(0.5, 1.5, size)))
    change = {
        "loc": strong(rng.normal(size=size)),
        "scale_tril": strong(np.tril(rng.normal(size=(size, size)))),
    }
    value = strong(rng.normal(size=(1, size)))
    fn = dist.MultivariateNormal(jnp.zeros((1, size)), scale_tril=root)
    observed = whiten.observation(fn, value, "y")
    score = jnp.sum(whiten.residual(observed, value) * whiten.shift(observed, each(change, value)))

    def density(t):
        moved = dist.MultivariateNormal(t * change["loc"], scale_tril=root + t * change["scale_tril"])
        return moved.log_prob(value[0])

    np.testing.assert_allclose(score, jax.grad(density)(0.0), rtol=1e-8)


def test_a_mask_of_whole_vectors():
    values, mask = draws("MultivariateNormal", 4), jnp.array([True, False, True, False])
    make, parameters, _ = FAMILIES["MultivariateNormal"]
    fn = make(**each(parameters, values)).mask(mask)
    density = whiten.log_prob(whiten.observation(fn, values, "y"), values)
    np.testing.assert_allclose(density.sum(-1), fn.log_prob(values), rtol=1e-10)


MOVES = [
    pytest.param(family, spread, marks=[pytest.mark.study] if family in SLOW else [])
    for family in FAMILIES
    for spread in (False, True)
    if (likelihood(family).respread if spread else likelihood(family).relocate) is not None
]


@pytest.mark.parametrize(("family", "spread"), MOVES)
def test_a_move_shifts_one_row_by_its_step(family, spread):
    values = draws(family, 1)
    observed = batch(family, values)
    if family == "ComplexStudentT":
        observed.parameters["tail"] = jnp.full(1, 0.3)
    like = jnp.zeros_like(values, float)
    step = 0.3 + 0.2 * jnp.arange(like.size).reshape(like.shape)

    def parameters(t):
        found = whiten.moved(observed, t * step, spread=spread)
        assert found is not None
        return found.parameters

    rows = np.asarray(whiten.shift(observed, jax.jvp(parameters, (0.0,), (1.0,))[1]))
    wanted = np.zeros_like(rows)
    wanted[whiten.location_rows(family, len(rows)) if spread else 0] = step
    np.testing.assert_allclose(rows, wanted, atol=1e-6)


def test_the_unit_of_steps_of_counts_is_near_the_root_of_their_information():
    mean, concentration = (
        a.ravel() for a in np.meshgrid(np.geomspace(1e-4, 1e5, 30), np.geomspace(0.1, 100, 10))
    )
    p = {"concentration": strong(concentration), "rate": strong(concentration / mean)}
    ratio = np.asarray(discrete.counts_spread_about(p) / jax.jit(discrete.counts_spread)(p))
    assert ratio.min() > 0.85
    assert ratio.max() < 1.7
    few, many = (
        mean < 2e-3 * np.minimum(concentration, 1.0),
        (mean > 1e3 * concentration) & (concentration > 1),
    )
    np.testing.assert_allclose(ratio[few | many], 1.0, atol=0.06)


def test_a_field_of_steps_of_counts_takes_them_in_that_unit():
    observed = batch("GammaPoisson", draws("GammaPoisson", 1))
    exact, about = (whiten.moved(observed, jnp.full(1, 0.3), spread=True, about=a) for a in (False, True))
    assert exact is not None
    assert about is not None
    before = observed.parameters["concentration"]
    grown = [jnp.log(after.parameters["concentration"] / before) for after in (exact, about)]
    ratio = discrete.counts_spread_about(observed.parameters) / discrete.counts_spread(observed.parameters)
    np.testing.assert_allclose(grown[0], grown[1] * ratio, rtol=1e-9)


def test_nothing_tried_says_nothing():
    value = jnp.array([0, 0, 3])
    for chance in ({"logits": jnp.array([0.3, 800.0, -800.0])}, {"probs": jnp.array([0.3, 0.9, 0.2])}):
        observed = whiten.observation(dist.Binomial(jnp.array([0, 0, 5]), **chance), value, "y")
        rows = np.asarray(whiten.residual(observed, value))
        assert np.all(rows[:, :2] == 0)
        assert np.all(np.isfinite(rows))
        assert np.all(np.asarray(whiten.log_prob(observed, value))[:1] == 0)


@pytest.mark.parametrize("logit", [-60.0, 60.0])
def test_certain_bernoulli_stays_finite(logit):
    value = jnp.array([float(logit > 0)])
    observed = whiten.observation(dist.Bernoulli(logits=jnp.array([logit])), value, "y")
    assert np.all(np.isfinite(whiten.residual(observed, value)))
    assert np.all(np.isfinite(whiten.shift(observed, {"logits": jnp.ones(1)})))


def test_kinds_of_a_known_distribution_are_known_and_ones_own_are_taken_by_their_density():
    cuts = jnp.array([-1.0, 0.5, 2.0])
    ordered = dist.OrderedLogistic(jnp.array([0.3, -0.2]), cuts)
    found = whiten.observation(ordered, jnp.array([1, 3]), "y")
    assert found.family == "CategoricalProbs"
    np.testing.assert_allclose(
        whiten.log_prob(found, jnp.array([1, 3])), ordered.log_prob(jnp.array([1, 3])), rtol=1e-5
    )

    class Scaled(dist.Normal):
        """Of another scale than what it is derived from."""

        def log_prob(self, value):
            return super().log_prob(value / 2) - jnp.log(2.0)

    found = whiten.observation(Scaled(0.0, 1.0), jnp.full(3, 2.0), "y")
    assert found.family.endswith("Scaled")
    np.testing.assert_allclose(whiten.log_prob(found, jnp.full(3, 2.0)), dist.Normal(0.0, 2.0).log_prob(2.0))


@pytest.mark.parametrize("concentration", [1e2, 1e4, 1e6, 1e9])
def test_a_sharp_direction_tells_of_its_concentration_as_a_normal_does_of_its_precision(concentration):
    parameters = {"loc": strong(0.0), "concentration": strong(concentration)}
    change = {"loc": strong(0.0), "concentration": strong(1.0)}
    root = float(likelihood("VonMises").shift(parameters, change)[1])
    assert root == pytest.approx((1 + 0.25 / concentration) / (np.sqrt(2) * concentration), rel=1e-4)


def test_a_masked_reading_tells_no_limit():
    """The filler of a hole lies below the floor, as -999 does."""
    value = jnp.array([-97.0, -90.0, -999.0, -95.0])
    fn = dist.LeftCensoredDistribution(dist.Normal(-92.0, 4.0), value <= -97.0).expand([4])
    seen = jnp.array([True, True, False, True])
    found = whiten.observation(fn.mask(seen), value, "y")
    np.testing.assert_allclose(found.parameters["farthest"], -97.0)
    assert found.parameters["limit"][1] == -97.0
