"""Models that NumPyro takes and that are written unlike most: their log posterior here is NumPyro's own."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.distributions.transforms import AffineTransform
from numpyro.infer.util import potential_energy

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.density import terms_of
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.nulls import check_nulls
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.directions import surroundings, tangents

ROWS = 24
TIME = np.linspace(-1.0, 1.0, ROWS)
SEEN = np.arange(ROWS) % 5 > 0


def log_posterior(problem, x):
    return float(terms_of(problem, activate(problem, ()), x).sum())


@pytest.mark.parametrize("kind", [dist.LogNormal, dist.Gamma, dist.Weibull, dist.InverseGamma])
@pytest.mark.parametrize("hole", [0.0, -3.0])
def test_what_stands_in_a_masked_hole_does_not_matter(kind, hole):
    def model(seen, y=None):
        size = numpyro.sample("size", dist.LogNormal(0.0, 1.0))
        mean = numpyro.deterministic("mean", size + jnp.zeros(ROWS))
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", kind(mean, 1.5).mask(seen), obs=y)

    y = np.random.default_rng(0).uniform(0.5, 3.0, ROWS)
    found = [
        Problem(model, {"seen": jnp.asarray(SEEN), "y": jnp.asarray(np.where(SEEN, y, other))}, [])
        for other in (1.0, hole)
    ]
    fits = [fit(problem, np.zeros(1)) for problem in found]
    assert fits[1].converged
    assert fits[1].log_posterior == pytest.approx(fits[0].log_posterior)
    np.testing.assert_allclose(fits[1].x, fits[0].x, atol=1e-6)
    slopes = [problem.compiled.slope(np.array([0.3]), np.ones(ROWS)) for problem in found]
    np.testing.assert_allclose(*slopes)


def noisy(time, seen, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    mean = numpyro.deterministic("mean", level + 0 * time)
    with numpyro.plate("row", ROWS):
        numpyro.sample("y", dist.Normal(mean, 1.0).mask(seen), obs=y)


SLOPE = (Parameter("b", dist.Normal(0.0, 2.0)),)
OF_MEAN = Effect("tilt", {"mean": lambda v, p, c: v + p["b"] * c["time"]}, SLOPE)
OF_LAW = Effect(
    "tilt",
    {},
    SLOPE,
    distributions={"y": lambda fn, p, c: dist.Normal(fn.loc + p["b"] * c["time"], fn.scale)},
)


def masked_data(hole):
    y = 1 + 0.7 * TIME + np.random.default_rng(1).normal(size=ROWS)
    return {
        "time": jnp.asarray(TIME),
        "seen": jnp.asarray(SEEN),
        "y": jnp.asarray(np.where(SEEN, y, hole)),
    }


@pytest.mark.parametrize("hole", [0.0, 500.0])
def test_an_effect_on_a_law_keeps_the_mask(hole):
    fits = []
    for effect in (OF_MEAN, OF_LAW):
        problem = Problem(noisy, masked_data(hole), [effect]).with_live(["tilt"])
        fits.append(fit(problem, np.zeros(2), ["tilt"]))
    np.testing.assert_allclose(fits[1].x, fits[0].x, atol=1e-6)
    assert fits[1].log_posterior == pytest.approx(fits[0].log_posterior)


def test_an_effect_on_a_law_that_changes_it_at_its_null_is_refused():
    check_nulls(Problem(noisy, masked_data(500.0), [OF_LAW]))
    law = {"y": lambda fn, p, c: dist.Normal(fn.loc + 1.0 + p["b"], fn.scale)}
    moved = Effect("moved", {}, SLOPE, distributions=law)
    with pytest.raises(
        InputError, match="effect moved: expected the distribution of 'y' unchanged at its null"
    ):
        check_nulls(Problem(noisy, masked_data(500.0), [moved]))


def test_a_random_field_on_a_law_alone_is_refused():
    field = Effect(
        "field",
        {},
        (Parameter("scale", dist.HalfNormal(1.0)),),
        kind="variance",
        field_shape=lambda _, __: (ROWS,),
        distributions={"y": lambda fn, p, c: dist.Normal(fn.loc + p["scale"] * p[FIELD], fn.scale)},
    )
    with pytest.raises(
        InputError, match="effect field: expected a random field that acts on deterministic sites"
    ):
        check_nulls(Problem(noisy, masked_data(0.0), [field]))


def test_a_scaled_density_is_refused():
    def model(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 5.0))
        with numpyro.plate("row", ROWS), handlers.scale(scale=0.5):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    with pytest.raises(InputError, match=r"the scaled site 'y' \(numpyro.handlers.scale\)"):
        Problem(model, {"y": jnp.zeros(ROWS)}, [])


def test_sample_shape_counts_each_jacobian_once():
    def model(how, y=None):
        spread = (
            numpyro.sample("spread", dist.HalfNormal(1.0), sample_shape=(3,))
            if how
            else numpyro.sample("spread", dist.HalfNormal(1.0).expand([3]).to_event(1))
        )
        mean = numpyro.deterministic("mean", spread[jnp.arange(ROWS) % 3])
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)

    y = jnp.asarray(np.random.default_rng(2).uniform(0.2, 1.0, ROWS))
    at = np.array([0.3, -0.4, 0.7])
    found = [log_posterior(Problem(model, {"how": how, "y": y}, []), at) for how in (True, False)]
    own = -potential_energy(model, (True,), {"y": y}, {"spread": jnp.asarray(at)})
    np.testing.assert_allclose(found, float(own), rtol=1e-9)


@pytest.mark.parametrize("where", ["plate", "mask"])
def test_a_factor_may_stand_in_a_plate_or_under_a_mask(where):
    def model(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 5.0))
        context = numpyro.plate("extra", 3) if where == "plate" else handlers.mask(mask=jnp.asarray(True))
        with context:
            numpyro.factor("pull", -((level - 1.0) ** 2))
        mean = numpyro.deterministic("mean", level + jnp.zeros(ROWS))
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)

    data = {"y": jnp.linspace(0.0, 1.0, ROWS)}
    own = -potential_energy(model, (), data, {"level": jnp.asarray(0.4)})
    assert log_posterior(Problem(model, data, []), np.array([0.4])) == pytest.approx(float(own))


def test_a_transformed_unknown_of_unknown_spread():
    def model(y=None):
        spread = numpyro.sample("spread", dist.HalfNormal(1.0))
        moved = dist.TransformedDistribution(dist.Normal(0.0, spread), AffineTransform(1.0, 2.0))
        level = numpyro.sample("level", moved)
        mean = numpyro.deterministic("mean", level + jnp.zeros(ROWS))
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)

    data = {"y": jnp.linspace(0.0, 1.0, ROWS)}
    own = -potential_energy(model, (), data, {"spread": jnp.asarray(0.2), "level": jnp.asarray(0.4)})
    problem = Problem(model, data, [])
    x = np.zeros(2)
    for name, value in {"spread": 0.2, "level": 0.4}.items():
        x[problem.layout[name].index] = value
    assert log_posterior(problem, x) == pytest.approx(float(own))


@pytest.mark.study
def test_a_count_of_no_trials_says_nothing():
    total = np.where(np.arange(ROWS) % 6 == 0, 0, 12)

    def model(total, y=None):
        odds = numpyro.sample("odds", dist.Normal(0.0, 1.0))
        mean = numpyro.deterministic("mean", jax.nn.sigmoid(odds) + jnp.zeros(total.shape[0]))
        with numpyro.plate("row", total.shape[0]):
            numpyro.sample("y", dist.BetaBinomial(8 * mean, 8 * (1 - mean), total), obs=y)

    y = np.random.default_rng(3).integers(0, total + 1)
    whole = Problem(model, {"total": jnp.asarray(total), "y": jnp.asarray(y)}, [])
    tried = total > 0
    rest = Problem(model, {"total": jnp.asarray(total[tried]), "y": jnp.asarray(y[tried])}, [])
    fits = [fit(problem, np.zeros(1)) for problem in (whole, rest)]
    assert fits[0].log_posterior == pytest.approx(fits[1].log_posterior)
    np.testing.assert_allclose(fits[0].covariance, fits[1].covariance, rtol=1e-6)
    rows = np.asarray(whole.compiled.residual(np.zeros(1)))
    assert np.isfinite(rows).all()
    assert not rows[~tried].any()


@pytest.mark.study
def test_an_effect_on_a_censored_law_is_told_as_much_as_one_on_its_site():
    """Where readings are censored is told by the readings, not by an effect."""

    def model(time, censored, y=None):
        level = numpyro.sample("level", dist.Normal(-95.0, 5.0))
        mean = numpyro.deterministic("mean", level + 0 * time)
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", dist.LeftCensoredDistribution(dist.Normal(mean, 3.0), censored), obs=y)

    def steeper(fn, p, c):
        base = fn.base_dist
        return dist.LeftCensoredDistribution(
            dist.Normal(base.loc + p["b"] * c["time"], base.scale), fn.censored
        )

    of_law = Effect("law", {}, SLOPE, distributions={"y": steeper})
    raw = -95 + 3 * np.random.default_rng(4).normal(size=ROWS)
    data = {"time": TIME, "censored": raw <= -97.0, "y": np.maximum(raw, -97.0)}
    problem = Problem(model, {n: jnp.asarray(v) for n, v in data.items()}, [OF_MEAN, of_law])
    found = tangents(surroundings(problem, np.array([-95.0])), [OF_MEAN, of_law], problem.programs)
    information = np.einsum("cmi,cmi->i", found.columns, found.columns)
    assert information[0] > 0.5
    assert information[1] == pytest.approx(information[0], rel=1e-6)
