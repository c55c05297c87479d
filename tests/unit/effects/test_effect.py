"""The contract of an effect on models of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers

from dtprob.effects import Context, Effect, Parameter, Rewriting, catalogue, with_effects
from dtprob.errors import InputError
from dtprob.models.declaration import declare

DATA = {"x": jnp.arange(6.0), "y": jnp.arange(6.0)}


def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("point", len(x)):
        mean = numpyro.deterministic("mean", slope * x)
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)
    return mean


BEND = Effect(
    family="bend",
    rewrites={"mean": lambda value, p, context: value + p["curvature"] * context["x"] ** 2},
    parameters=(Parameter("curvature", dist.Normal(0.0, 0.1), unit="1/m"),),
    physics="The line is bent.",
    requires=("x",),
)
SCATTER = Effect(
    family="scatter",
    rewrites={"mean": lambda value, p, _: value + p["scale"] * p["field"]},
    parameters=(Parameter("scale", dist.HalfNormal(1.0)),),
    kind="variance",
)
TAILS = Effect(
    family="tails",
    rewrites={},
    parameters=(Parameter("excess", dist.HalfNormal(1.0)),),
    distributions={"y": lambda fn, p, _: dist.Normal(fn.mean, jnp.sqrt(fn.variance) * (1 + p["excess"]))},
)


def test_an_effect_of_ones_own_in_ten_lines():
    sites = declare(line, DATA).sites
    (effect,) = catalogue(sites, DATA, [BEND])
    fixed = {"slope": 2.0, "bend.curvature": 0.5}
    seeded = handlers.seed(handlers.substitute(with_effects(line, [effect]), data=fixed), 0)
    trace = handlers.trace(seeded).get_trace(**DATA)
    assert np.allclose(trace["mean"]["value"], 2 * DATA["x"] + 0.5 * DATA["x"] ** 2)
    assert effect.name == "bend"
    assert effect.dimension == 1
    assert effect.null() == {"curvature": 0.0}


def test_extended_model_is_a_model():
    extended = with_effects(line, [BEND, SCATTER, TAILS])
    sites = declare(extended, DATA).sites
    assert [n for n, s in sites.items() if s.kind == "latent"] == [
        *("bend.curvature", "scatter.scale", "tails.excess", "slope", "scatter.field"),
    ]
    assert sites["y"].axes == ("point",)
    assert sites["scatter.field"].shape == (6,)


def test_a_field_inside_plates_keeps_its_shape():
    shared = Effect(**{**vars(SCATTER), "field_shape": lambda value, context: (1,)})

    def nested(x):
        with numpyro.plate("row", 3), numpyro.plate("column", len(x), dim=-2):
            return numpyro.deterministic("mean", jnp.zeros((len(x), 3)))

    wide = Effect(**{**vars(shared), "field_shape": lambda value, context: (value.shape[0], 1)})
    for effect, shape in ((SCATTER, (6, 3)), (wide, (6, 1))):
        trace = handlers.trace(handlers.seed(with_effects(nested, [effect]), 0)).get_trace(x=DATA["x"])
        assert trace["scatter.field"]["value"].shape == shape
        assert trace["mean"]["value"].shape == (6, 3)
    trace = handlers.trace(handlers.seed(with_effects(line, [shared]), 0)).get_trace(**DATA)
    assert trace["scatter.field"]["value"].shape == (1,)


def test_one_field_for_all_sites():
    def two(x):
        return numpyro.deterministic("a", x), numpyro.deterministic("b", x)

    table = dict.fromkeys(("a", "b"), SCATTER.rewrites["mean"])
    effect = Effect(**{**vars(SCATTER), "rewrites": table})
    trace = handlers.trace(handlers.seed(with_effects(two, [effect]), 0)).get_trace(x=jnp.zeros(4))
    assert [name for name in trace if "field" in name] == ["scatter.field"]
    assert np.array_equal(trace["a"]["value"], trace["b"]["value"])
    first = np.asarray(trace["a"]["value"])
    seeded = handlers.seed(with_effects(two, [effect]), 1)
    assert not np.array_equal(handlers.trace(seeded).get_trace(x=jnp.zeros(4))["a"]["value"], first)


def test_distributions_are_rewritten_for_data_and_for_draws():
    with (
        handlers.trace() as trace,
        Rewriting(None, [TAILS], {"tails": {"excess": 2.0}}, DATA),
        handlers.seed(rng_seed=0),
    ):
        line(**DATA)
    assert np.allclose(trace["y"]["fn"].scale, 3.0)
    draws = numpyro.infer.Predictive(with_effects(line, [TAILS]), num_samples=500)(
        jax.random.key(0), DATA["x"]
    )
    assert np.std(draws["y"][:, 0]) > 1.3


def test_effects_apply_in_order_and_see_what_came_before():
    double = Effect(
        "double",
        {"mean": lambda value, p, context: value * (1 + p["on"]) + 0 * context["slope"]},
        (Parameter("on", dist.Normal(0.0, 1.0)),),
    )
    given = {"bend": {"curvature": 1.0}, "double": {"on": 1.0}}
    with (
        Rewriting(None, [BEND, double], given, DATA),
        handlers.seed(rng_seed=0),
        handlers.substitute(data={"slope": 0.0}),
    ):
        value = line(**DATA)
    assert np.allclose(value, 2 * DATA["x"] ** 2)


DOUBLE = Effect(
    "double",
    {"mean": lambda value, p, _: value * (1 + p["on"])},
    (Parameter("on", dist.Normal(0.0, 1.0)),),
    distributions={"y": lambda fn, p, _: dist.Normal(fn.mean * (1 + p["on"]), jnp.sqrt(fn.variance))},
)
SHIFT = Effect(
    "shift",
    {},
    (Parameter("by", dist.Normal(0.0, 1.0)),),
    distributions={"y": lambda fn, p, _: dist.Normal(fn.mean + p["by"], jnp.sqrt(fn.variance))},
)
DRAWN = {"slope": 0.5, "bend.curvature": 0.3, "double.on": 1.0, "scatter.scale": 0.2, "shift.by": -0.4}


def outcome(extended):
    """Value of the mean, and of the observation's density, at fixed parameters and a fixed field."""
    fixed = handlers.substitute(extended, data={**DRAWN, "scatter.field": jnp.arange(6.0)})
    trace = handlers.trace(handlers.seed(fixed, 0)).get_trace(**DATA)
    return trace["mean"]["value"], trace["y"]["fn"].log_prob(DATA["y"])


@pytest.mark.parametrize("cuts", [(1,), (2,), (3,), (1, 2), (1, 2, 3)])
@pytest.mark.parametrize("order", [(BEND, DOUBLE, SCATTER, SHIFT), (SHIFT, SCATTER, DOUBLE, BEND)])
def test_nesting_makes_no_difference(order, cuts):
    """An extension of an extension is the extension by both lists, one after the other."""
    nested = line
    for begin, end in zip((0, *cuts), (*cuts, len(order)), strict=True):
        nested = with_effects(nested, order[begin:end])
    at_once, other_order = with_effects(line, order), with_effects(line, order[::-1])
    for one, same, other in zip(outcome(at_once), outcome(nested), outcome(other_order), strict=True):
        assert np.array_equal(one, same)
        assert not np.allclose(one, other)  # else the test could not fail


def test_values_that_a_site_cannot_take():
    def rewriting(rewrite):
        effect = Effect("wrong", {"mean": rewrite}, (Parameter("p", dist.Normal(0.0, 1.0)),))
        return handlers.seed(with_effects(line, [effect]), 0)

    with pytest.raises(InputError, match=r"effect wrong, new value of site 'mean': expected shape \(6,\)"):
        rewriting(lambda value, p, _: value[:3])(**DATA)
    with pytest.raises(InputError, match="axes of size 1 allowed to grow"):
        rewriting(lambda value, p, _: value[None])(**DATA)
    with pytest.raises(InputError, match="Return real values"):
        rewriting(lambda value, p, _: value * 1j)(**DATA)


def test_dtype_stays_that_of_the_site():
    single = {"x": jnp.arange(6, dtype=jnp.float32)}
    with Rewriting(None, [BEND], {"bend": {"curvature": jnp.float64(0.1)}}, single):
        value = numpyro.deterministic("mean", single["x"])
    assert value.dtype == jnp.float32


@pytest.mark.parametrize("values", [jnp.arange(6), jnp.arange(6) > 2], ids=["whole", "boolean"])
def test_a_site_of_whole_numbers_takes_real_ones(values):
    with Rewriting(None, [BEND], {"bend": {"curvature": 0.1}}, DATA):
        value = numpyro.deterministic("mean", values)
    np.testing.assert_allclose(value, values + 0.1 * DATA["x"] ** 2)
    up = Effect("up", {"mean": lambda value, p, _: value + 2}, BEND.parameters)
    with Rewriting(None, [up], {"up": {"curvature": 0.1}}, DATA):
        assert numpyro.deterministic("mean", jnp.arange(6)).dtype == jnp.arange(6).dtype


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewrites": {}}, "a site to rewrite"),
        ({"parameters": ()}, "parameters of different names"),
        ({"parameters": BEND.parameters * 2}, "parameters of different names"),
        ({"kind": "variance", "distributions": TAILS.distributions}, "a field_shape where it rewrites"),
    ],
)
def test_incomplete_declarations_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        Effect(**{**vars(BEND), **changes})


def test_context_prefers_sites_to_data():
    context = Context({"a": 1, "b": 2}, {"b": 3})
    assert dict(context) == {"a": 1, "b": 3}
    assert len(context) == 2
    assert context.get("c") is None


def test_an_inner_extension_sees_what_the_outer_one_did():
    """Later sites see final values, whether effects come at once or one extension inside the other."""

    def two(x):
        first = numpyro.deterministic("first", x)
        return numpyro.deterministic("second", 0.0 * first)

    follow = Effect(
        "follow",
        {"second": lambda value, p, context: value + p["share"] * context["first"]},
        (Parameter("share", dist.Normal(0.0, 1.0)),),
    )
    lift = Effect(
        "lift", {"first": lambda value, p, _: value + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
    )
    fixed = {"follow.share": 2.0, "lift.by": 3.0}
    for extended in (with_effects(with_effects(two, [follow]), [lift]), with_effects(two, [follow, lift])):
        assert handlers.substitute(extended, data=fixed)(x=jnp.ones(())) == 8.0


def test_an_effect_whose_rewrite_fails_is_named():
    def run(rewrite):
        effect = Effect("wrong", {"mean": rewrite}, (Parameter("size", dist.Normal()),))
        with Rewriting(None, [effect], {"wrong": {"size": jnp.zeros(())}}, {"x": jnp.ones(6)}):
            numpyro.deterministic("mean", jnp.zeros(6))

    with pytest.raises(InputError, match=r"effect wrong, rewrite of site 'mean': .*\(x\), got 'hours'"):
        run(lambda value, p, context: value + p["size"] * context["hours"])
    with pytest.raises(InputError, match="its own site, which is its first argument"):
        run(lambda value, p, context: value + p["size"] * context["mean"])
    with pytest.raises(InputError, match=r"effect wrong, rewrite of site 'mean': .*value of shape \(6,\)"):
        run(lambda value, p, context: value + p["size"] * jnp.ones(5))
