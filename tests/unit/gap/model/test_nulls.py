"""Effects that change the model where they should do nothing are refused; those that do nothing are not."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.model.nulls import check_nulls
from dtprob.gap.model.problem import Problem
from tests.unit.gap.examples import bend, bump, draw, gusty, line


def scaled(null):
    return Effect(
        "scaled",
        {"mean": lambda value, p, c: value * p["by"]},
        (Parameter("by", dist.LogNormal(0.0, 0.3), null=null),),
    )


def test_an_effect_that_changes_the_model_at_its_null_is_refused():
    problem = Problem(line, draw("line"), [bend(), scaled(0.0)])
    with pytest.raises(
        InputError, match=r"effect scaled: expected site 'mean' unchanged at its null, by = 0.0"
    ):
        check_nulls(problem)


def test_a_constant_that_is_always_added_is_refused():
    lifted = Effect("lifted", {"mean": lambda v, p, c: v + 0.01 + p["c"]}, (Parameter("c", dist.Normal()),))
    with pytest.raises(InputError, match="effect lifted"):
        check_nulls(Problem(line, draw("line"), [lifted]))


def test_a_name_that_the_library_has_excuses_no_effect():
    lifted = Effect(
        "gain_offset",
        {"mean": lambda v, p, c: v + c["x"] + p["b"] * c["x"]},
        (Parameter("b", dist.Normal()),),
    )
    with pytest.raises(InputError, match="effect gain_offset: expected site 'mean' unchanged at its null"):
        check_nulls(Problem(line, draw("line"), [lifted]))


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda v, p, c: v + c["x"] + p["s"] * p["field"],
        lambda v, p, c: v + (0.01 + p["s"]) * p["field"],
        lambda v, p, c: v * jnp.exp((1.0 + p["s"]) * p["field"]),
    ],
    ids=["always", "spread", "factor"],
)
def test_a_random_field_that_changes_the_model_at_size_zero_is_refused(rewrite):
    field = Effect("field", {"mean": rewrite}, (Parameter("s", dist.HalfNormal()),), kind="variance")
    with pytest.raises(InputError, match="effect field: expected site 'mean' unchanged at its null, s = 0"):
        check_nulls(Problem(line, draw("line"), [field]))


def test_effects_that_do_nothing_there_pass():
    check_nulls(Problem(line, draw("line"), [bend(), bump(), gusty(), scaled(1.0)]))


def test_a_missing_value_in_a_column_of_an_effect_is_told():
    data = draw("line")
    data = {**data, "x": data["x"]}
    marks = np.zeros(np.shape(data["x"]))
    marks.reshape(-1)[3] = np.nan
    marked = Effect(
        "marked",
        {"mean": lambda v, p, c: v + p["by"] * marks},
        (Parameter("by", dist.Normal()),),
        requires=("mark",),
    )
    with pytest.raises(
        InputError, match=r"effect marked: expected finite values of site 'mean', got 1 of .* in mark"
    ):
        check_nulls(Problem(line, data, [marked]))


def test_a_site_of_another_shape_is_told():
    cut = Effect("cut", {"mean": lambda v, p, c: v[:3] + p["by"]}, (Parameter("by", dist.Normal()),))
    with pytest.raises(
        InputError, match=r"effect cut: expected site 'mean' of a shape that fits \(\d+, \d+\), got \(3, "
    ):
        check_nulls(Problem(line, draw("line"), [cut]))


@pytest.mark.parametrize(
    ("rewrite", "message"),
    [
        (lambda v, p, c: v + p["by"] ** 2, "a derivative at its null that is not 0, got 0"),
        (lambda v, p, c: v + np.sqrt(2.0) * p["by"] ** 0.5, "a finite derivative at its null"),
    ],
    ids=["square", "root"],
)
def test_an_effect_without_a_slope_at_its_null_is_refused(rewrite, message):
    bent = Effect("bent", {"mean": rewrite}, (Parameter("by", dist.HalfNormal()),))
    with pytest.raises(InputError, match=f"effect bent: expected {message}"):
        check_nulls(Problem(line, draw("line"), [bent]))


def test_an_effect_that_acts_on_none_of_the_data_passes():
    nothing = Effect("far", {"mean": lambda v, p, c: v + 0.0 * p["by"]}, (Parameter("by", dist.Normal()),))
    check_nulls(Problem(line, draw("line"), [nothing]))


def levels(x, y=None):
    """Each row has the level that its number points to."""
    level = numpyro.sample("level", dist.Normal(0.0, 1.0).expand([4]).to_event(1))
    with numpyro.plate("row", len(x)):
        at = numpyro.deterministic("at", x)
        numpyro.sample("y", dist.Normal(level[at], 1.0), obs=y)


def test_effects_on_indices_are_refused():
    """They have no gradient: a gap at every row was not seen at all."""
    rng = np.random.default_rng(0)
    data = {"x": jnp.asarray(rng.integers(0, 4, 60)), "y": jnp.asarray(rng.normal(size=60))}
    lifted = Effect("lifted", {"at": lambda v, p, c: v + p["by"]}, (Parameter("by", dist.Normal()),))
    with pytest.raises(InputError, match=r"expected real numbers at site 'at', got true and false, or whole"):
        check_nulls(Problem(levels, data, [lifted]))


def test_two_effects_of_one_name_are_refused():
    with pytest.raises(InputError, match="effects: expected one of each name, got several named 'bend'"):
        Problem(line, draw("line"), [bend(), bend()])


def test_an_effect_that_acts_nowhere_at_its_usual_place_is_not_refused():
    """One unit from there it does: it is looked for at other places."""
    start = float(draw("line")["x"].min())
    before = Effect(
        "before",
        {"mean": lambda v, p, c: v + p["c"] * jnp.maximum(p["edge"] - c["x"], 0.0)},
        (
            Parameter("c", dist.Normal()),
            Parameter("edge", dist.Normal(start, 1.0), null=start - 0.5, is_place=True),
        ),
    )
    check_nulls(Problem(line, draw("line"), [before]))
