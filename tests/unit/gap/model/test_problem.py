"""A model as functions of one flat vector, against its own density, derivatives and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer.reparam import LocScaleReparam
from numpyro.infer.util import log_density, potential_energy

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.directions import surroundings, tangents
from dtprob.inference.posterior import PointMass
from tests.unit.gap.examples import MODELS, bend, draw, jitter, line, pair, ripple, seconds

EFFECTS = (bend(), pair(), jitter())


@pytest.fixture(scope="module", params=[n for n in MODELS if n not in ("seconds", "logistic")])
def case(request):
    """A problem and a point near the truth, circular and local coordinates included."""
    problem = Problem(MODELS[request.param][0], draw(request.param), EFFECTS)
    x = 0.3 * np.random.default_rng(2).normal(size=problem.dimension)
    return request.param, problem, x


def _slope(problem, x):
    """Gradient of the log prior."""
    return problem.compiled.prior(x, np.zeros((0, problem.dimension)))[0]


def test_density_is_the_models(case):
    name, problem, x = case
    likelihood, prior, local = problem.compiled.evaluate(x)
    values = {n: problem.layout.part(jnp.asarray(x), n) for n in problem.declaration.latent}
    if name == "tone":  # angles stay unwrapped
        constrained = {**values, "gain": jnp.exp(values["gain"])}
        density = log_density(problem.model, (), dict(problem.data), constrained)[0] + values["gain"]
        expected = jnp.squeeze(density)
    else:
        expected = -potential_energy(problem.model, (), dict(problem.data), values)
    np.testing.assert_allclose(likelihood.sum() + prior + local.sum(), expected, rtol=1e-10)
    np.testing.assert_allclose(problem.compiled.profile(x[None])[0], expected, rtol=1e-10)


def test_columns_and_residuals_give_the_score_of_each_cluster(case):
    _, problem, x = case
    score = jnp.einsum(
        "cmk,cm->ck", problem.compiled.linearised(x, np.eye(len(x)))[1], problem.compiled.residual(x)
    )
    slope = jax.jacrev(lambda v: problem.compiled.terms(v, problem.compiled.arrays)[0])(jnp.asarray(x))
    np.testing.assert_allclose(score, slope, rtol=1e-8, atol=1e-8 * float(jnp.abs(slope).max()))


def test_columns_are_linear_in_the_basis(case):
    _, problem, x = case
    basis = np.random.default_rng(3).normal(size=(3, len(x)))
    whole = np.asarray(problem.compiled.linearised(x, np.eye(len(x)))[1])
    np.testing.assert_allclose(
        problem.compiled.linearised(x, basis)[1], whole @ basis.T, rtol=1e-8, atol=1e-9 * np.abs(whole).max()
    )


def test_site_gradient_is_the_slope_along_each_site(case):
    _, problem, x = case
    gradient = problem.compiled.site_gradient(x, problem.compiled.residual(x)[None])
    for site, shape in problem.float_sites.items():
        rng = np.random.default_rng(4)
        delta = rng.normal(size=shape.shape).astype(shape.dtype)
        if np.iscomplexobj(delta):
            delta = delta + 1j * rng.normal(size=shape.shape)
        h = 1e-5
        up, down = problem.compiled.shifted(x, {site: np.stack([h * delta, -h * delta])}, 2).sum(1)
        slope = float(np.sum(np.real(np.asarray(gradient[site][0]) * delta)))
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-6, atol=1e-6)


def test_site_shift_is_the_transpose_of_site_gradient(case):
    _, problem, x = case
    rng = np.random.default_rng(5)
    rows = jnp.asarray(rng.normal(size=problem.rows.gather.shape))
    gradient = problem.compiled.site_gradient(x, rows[None])
    for site, shape in problem.float_sites.items():
        delta = rng.normal(size=(2, *shape.shape)).astype(shape.dtype)
        shift = problem.compiled.site_shift(x, {site: delta})
        forward = np.einsum("cm,cmn->n", rows, shift)
        back = np.real(np.asarray(gradient[site][0])[None] * delta).reshape(2, -1).sum(1)
        np.testing.assert_allclose(forward, back, rtol=1e-8, atol=1e-8)


def test_tangents_without_compilation_equal_those_of_live_effects(case):
    name, problem, x = case
    means = [e for e in problem.effects if e.kind == "mean"]
    found = tangents(surroundings(problem, x), means, problem.programs)
    if name not in ("line", "tone", "labels"):
        return
    live = problem.with_live([e.name for e in means])
    point = live.translate(x, problem)
    for effect, group in zip(found.effects, found.groups, strict=True):
        index = np.concatenate([b.index[0] for b in live.blocks_of(effect.name)])
        expected = live.compiled.linearised(point, np.eye(live.dimension)[index])[1]
        np.testing.assert_allclose(found.columns[..., group], expected, rtol=1e-8, atol=1e-9)


def test_field_energy_is_the_sum_of_squared_link_scores(case):
    name, problem, x = case
    rows = jnp.asarray(np.random.default_rng(6).normal(size=(3, *problem.rows.gather.shape)))
    gradients = problem.compiled.site_gradient(x, rows)
    around = surroundings(problem, x).grown()
    energy = problem.programs.field_energy(around, gradients, problem.effects)["jitter"][:, 0]
    scores = np.asarray(gradients["mean"]).reshape(3, len(draw(name)["x"]), -1).sum(-1)
    np.testing.assert_allclose(energy, (scores**2).sum(-1), rtol=1e-8, atol=1e-20)


def test_replicates_are_drawn_at_the_point(case):
    _, problem, x = case
    rows, values = problem.compiled.replicate(x, jax.random.split(jax.random.key(0), 300))
    size = np.asarray(rows).std()
    assert np.abs(np.asarray(rows).mean(0)).max() < 6 * size / np.sqrt(300) + 0.35
    assert abs(float(rows.mean())) < 6 * size / np.sqrt(rows.size)
    assert values["y"].shape == (300, *problem.data["y"].shape)


def test_prior_slopes(case):
    _, problem, x = case

    def density(v):
        _, prior, local = problem.compiled.terms(v, problem.compiled.arrays)
        return prior + local.sum()

    gradient = jax.grad(density)(jnp.asarray(x))
    scale = float(jnp.abs(gradient).max())
    np.testing.assert_allclose(
        _slope(problem, x),
        gradient,
        rtol=1e-9,
        atol=1e-12 * scale,
    )
    curvature = -jax.hessian(density)(jnp.asarray(x))
    np.testing.assert_allclose(
        problem.compiled.prior(x, np.eye(len(x)))[1],
        curvature,
        rtol=1e-8,
        atol=1e-12 * float(jnp.abs(curvature).max()),
    )


def test_misses_are_sums_over_each_cluster():
    problem = Problem(line, draw("line"), EFFECTS)
    x = problem.start({"a": 0.7, "b": -1.2})
    (missed,) = problem.compiled.misses(x).values()
    data = problem.data
    np.testing.assert_allclose(missed.count, data["y"].shape[1])
    np.testing.assert_allclose(missed.error, ((data["y"] - 0.7 + 1.2 * data["x"]) ** 2).sum(1), rtol=1e-12)
    assert not missed.signal.any()  # of real readings an error relative to these says nothing


def test_a_reference_takes_the_place_of_the_prior():
    rng = np.random.default_rng(0)
    mean, spread = np.array([0.7, -1.2]), np.array([0.02, 0.05])

    class Draws:
        def sample(self, key, n):
            del key
            a, b = mean[:, None] + spread[:, None] * rng.normal(size=(2, n))
            return {"a": a, "b": b}

    problem = Problem(line, draw("line"), EFFECTS, None, Draws())
    precision = np.diag(problem.compiled.prior(problem.null(), np.eye(2))[1])
    np.testing.assert_allclose(precision, spread**-2.0, rtol=0.2)
    slope = _slope(problem, problem.start({"a": mean[0], "b": mean[1]}))
    assert np.all(np.abs(slope) < 0.2 / spread)


def test_programs_serve_every_reference():
    texts = set()
    for at in (0.7, 0.9):
        problem = Problem(line, draw("line"), EFFECTS, None, PointMass({"a": at, "b": -1.2}))
        compiled = problem.compiled
        texts.add(jax.jit(compiled.terms).lower(problem.null(), compiled.arrays).as_text())
    assert len(texts) == 1


def test_a_line_of_any_length_is_the_points_of_it():
    problem = Problem(line, draw("line"), EFFECTS)
    points = np.repeat(problem.null()[None], 150, axis=0) + np.linspace(0, 1, 150)[:, None]
    one_by_one = [sum(term.sum() for term in problem.compiled.evaluate(x)) for x in points]
    np.testing.assert_allclose(problem.compiled.profile(points), one_by_one, rtol=1e-12)


def test_prior_draws_trace_the_model_once():
    runs = []

    def counted(x, y=None):
        runs.append(1)
        return line(x, y)

    problem = Problem(counted, draw("line"), EFFECTS)
    first = problem.prior_draws(jax.random.key(0), 5)
    known = len(runs)
    np.testing.assert_array_equal(problem.prior_draws(jax.random.key(0), 5), first)
    assert len(runs) == known


def test_an_exact_reference_is_accepted():
    problem = Problem(line, draw("line"), EFFECTS, None, PointMass({"a": 0.7, "b": -1.2}))
    x = problem.start({"a": 0.7, "b": -1.2})
    sd = np.diag(problem.compiled.prior(x, np.eye(2))[1]) ** -0.5
    assert np.all(sd < 1e-4)
    assert np.all(np.abs(_slope(problem, x)) * sd < 1e-3)


def test_a_reference_keeps_its_precision_in_seconds():
    mean, sd = np.array([-0.8e-9, 1.4]), np.array([1e-11, 0.01])
    draws = mean[:, None] + sd[:, None] * np.random.default_rng(0).normal(size=(2, 1000))

    class Draws:
        def sample(self, key, n):
            del key
            return {"delay": draws[0, :n], "gain": draws[1, :n]}

    problem = Problem(seconds, draw("seconds"), EFFECTS, None, Draws())
    found = np.diag(problem.compiled.prior(problem.null(), np.eye(2))[1]) ** -0.5
    np.testing.assert_allclose(found, sd, rtol=0.1)


def test_translation_keeps_what_both_know():
    problem = Problem(line, draw("line"), EFFECTS)
    wide = problem.with_live(["bend", "jitter"])
    point = wide.translate(np.array([0.7, -1.2]), problem)
    assert wide.dimension == 2 + 1 + 12
    np.testing.assert_array_equal(problem.translate(point, wide), [0.7, -1.2])
    np.testing.assert_allclose(
        wide.compiled.evaluate(point)[0], problem.compiled.evaluate(np.array([0.7, -1.2]))[0], rtol=1e-12
    )
    assert wide.with_live(["bend"]) is wide


def test_an_absent_site_is_named():
    lost = Effect("lost", {"gain": lambda v, p, c: v + p["c"]}, (Parameter("c", dist.Normal(0.0, 1.0)),))
    with pytest.raises(InputError, match=r"effect lost.*level, b, slope, mean|effect lost"):
        Problem(line, draw("line"), [lost, ripple()])


def test_an_effect_that_looks_at_its_own_site_is_refused_before_anything_is_fitted():
    rewrite = {"mean": lambda value, p, context: value + p["size"] * context["mean"]}
    greedy = Effect("greedy", rewrite, (Parameter("size", dist.Normal()),))
    problem = Problem(line, draw("line"), [greedy])
    with pytest.raises(InputError, match=r"effect greedy.*its own site, which is its first argument"):
        _ = problem.float_sites


def with_parameter(x, y=None):
    level = numpyro.param("level", 0.0) + numpyro.sample("offset", dist.Normal())
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


def with_class(x, y=None):
    level = numpyro.sample("class", dist.Bernoulli(0.5)) + numpyro.sample("offset", dist.Normal())
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


def with_part(x, y):
    level = numpyro.sample("offset", dist.Normal())
    with numpyro.plate("row", len(x), subsample_size=3) as rows:
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y[rows])


def with_learned_centring(x, y=None):
    with numpyro.handlers.reparam(config={"level": LocScaleReparam()}):
        level = numpyro.sample("level", dist.Normal(numpyro.sample("offset", dist.Normal()), 1.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


@pytest.mark.parametrize(
    ("model", "what"),
    [
        (with_parameter, "parameter site 'level'.*Declare it with numpyro.sample"),
        (with_learned_centring, "parameter site 'level_centered'.*Give LocScaleReparam centered=0"),
        (with_class, "discrete latent site 'class'"),
        (with_part, "3 of 8"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_models_without_a_density_of_all_are_refused(model, what):
    with pytest.raises(InputError, match=what):
        Problem(model, {"x": np.ones(8), "y": np.ones(8)}, ())
