"""What a declaration tells of a model."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
from numpyro import handlers
from numpyro.infer.reparam import CircularReparam

from dtprob.errors import InputError
from dtprob.models.arguments import model_name, select_arguments, split_static
from dtprob.models.declaration import declare, metadata, model
from dtprob.models.execution import trace_model

DATA = {"x": jnp.arange(6.0).reshape(3, 2), "degree": 2, "y": jnp.zeros((3, 2))}


def plain(x, degree, y=None):
    """A model without metadata."""
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    angle = numpyro.sample("angle", dist.VonMises(0.0, 1.0))
    with numpyro.plate("row", x.shape[0], dim=-2):
        own = numpyro.sample("own", dist.Normal(level, 1.0))
        mean = numpyro.deterministic("mean", own + jnp.cos(angle) * x**degree)
        with numpyro.plate("column", x.shape[1], dim=-1):
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


@model(axes={"mean": ("row", "column")}, cluster="column")
def marked(x, degree, y=None):
    """The same with names."""
    plain(x, degree, y)


def test_sites_are_of_three_kinds():
    found = declare(plain, DATA)
    assert list(found.latent) == ["level", "angle", "own"]
    assert list(found.deterministic) == ["mean"]
    assert list(found.observed) == ["y"]
    assert found.latent["angle"].is_circular
    assert not found.latent["level"].is_circular
    assert found.observed["y"].argument == "y"
    assert found.observed["y"].distribution == "Normal"
    assert found.sites["own"].shape == (3, 1)
    assert found.sites["mean"].size == 6


def test_the_first_plate_is_the_cluster_unless_one_is_named():
    assert declare(plain, DATA).cluster == "row"
    assert declare(marked, DATA).cluster == "column"
    assert declare(marked, DATA, cluster="row").cluster == "row"


def test_names_of_axes():
    assert declare(plain, DATA).observed["y"].axes == ("row", "column")
    assert declare(marked, DATA).sites["mean"].axes == ("row", "column")
    assert metadata(functools.partial(marked, degree=1)).cluster == "column"
    assert model_name(functools.partial(marked, degree=1)) == "marked"


def test_arrays_and_settings_come_apart():
    arrays, static = split_static(DATA)
    assert {name for name, value in arrays.items() if value is not None} == {"x", "y"}
    assert {name: value for name, value in static.items() if value is not None} == {"degree": DATA["degree"]}
    _, words = split_static({**DATA, "phase": "coherent"})
    assert words["phase"] == "coherent"


def grouped(group, groups, y=None):
    level = numpyro.sample("level", dist.Normal(0, 1).expand([groups]))
    with numpyro.plate("row", len(group)):
        numpyro.sample("y", dist.Normal(level[group], 1.0), obs=y)


def test_a_number_among_the_data_may_size_a_site():
    data = {"group": np.array([0, 1, 2, 2]), "groups": 3, "y": np.zeros(4)}
    assert declare(grouped, data).sites["level"].shape == (3,)


def test_substituted_sites_have_their_values():
    trace = trace_model(plain, DATA, jax.random.key(0), {"level": jnp.array(3.0)})
    assert float(trace["level"]["value"]) == 3.0
    assert trace["own"]["value"].shape == (3, 1)


def test_wrong_arguments():
    with pytest.raises(InputError, match="Did you mean 'degree'"):
        select_arguments(plain, {**DATA, "degre": 2})
    with pytest.raises(InputError, match="an entry 'degree'"):
        select_arguments(plain, {"x": DATA["x"]})


def test_a_model_without_an_observation():
    def prior(x):
        numpyro.sample("level", dist.Normal(jnp.sum(x), 1.0))

    with pytest.raises(InputError, match="observed site"):
        declare(prior, {"x": DATA["x"]})


def outside(distance, height, y=None):
    """Sites that are computed before a plate opens."""
    slope = numpyro.sample("slope", dist.Normal())
    mean = numpyro.deterministic("mean", slope * distance)
    numpyro.deterministic("curve", slope * jnp.arange(4.0))
    if mean.ndim > 1:
        numpyro.deterministic("of_row", mean.sum(axis=1, keepdims=True))
    with numpyro.plate_stack("place", mean.shape):
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def test_what_is_computed_outside_of_a_plate_has_the_axes_of_what_is_observed():
    """Or no column of the data would be looked at along it."""
    found = declare(outside, {"distance": jnp.ones(5), "height": jnp.ones(5), "y": jnp.ones(5)})
    assert found.sites["mean"].axes == found.sites["y"].axes
    assert found.sites["curve"].axes == ("curve_dim_0",)
    found = declare(outside, {"distance": jnp.ones((5, 3)), "height": jnp.ones(5), "y": jnp.ones((5, 3))})
    assert found.sites["mean"].axes == found.sites["y"].axes
    assert found.sites["of_row"].axes == (found.sites["y"].axes[0], "of_row_dim_1")


def test_a_square_matrix_has_no_axis_of_what_is_observed():
    def square(y):
        table = numpyro.sample("table", dist.Normal().expand([5, 5]).to_event(2))
        table = numpyro.deterministic("twice", 2.0 * table)
        with numpyro.plate("row", 5):
            numpyro.sample("y", dist.Normal(table.sum(0), 1.0), obs=y)

    assert declare(square, {"y": jnp.ones(5)}).sites["twice"].axes == ("twice_dim_0", "twice_dim_1")


def test_observed_values_are_numbers():
    given = {"distance": jnp.ones(2), "height": jnp.ones(2), "y": ["-60.1", "-61.0"]}
    with pytest.raises(InputError, match="observed site 'y': expected numbers, got text"):
        declare(outside, given)


def test_logits_of_classes_have_the_axes_of_what_is_observed_first():
    def schemes(snr, mcs=None):
        slope = numpyro.sample("slope", dist.Normal(0.0, 1.0).expand([4]).to_event(1))
        with numpyro.plate("row", snr.shape[0]):
            logits = numpyro.deterministic("logits", slope * snr[:, None])
            numpyro.sample("mcs", dist.Categorical(logits=logits), obs=mcs)

    sites = declare(schemes, {"snr": np.ones(9), "mcs": np.zeros(9, int)}).sites
    assert sites["logits"].axes == ("row", "logits_dim_1")


def test_where_observed_sites_do_not_agree_an_axis_has_no_name():
    def two(y, z):
        mean = numpyro.deterministic("mean", jnp.ones(5) * numpyro.sample("a", dist.Normal()))
        with numpyro.plate("one", 5):
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)
        with numpyro.plate("other", 5):
            numpyro.sample("z", dist.Normal(mean, 1.0), obs=z)

    assert declare(two, {"y": jnp.ones(5), "z": jnp.ones(5)}).sites["mean"].axes == ("mean_dim_0",)


def test_values_of_another_shape_than_the_distribution_are_refused():
    data = {"distance": jnp.ones(5), "height": jnp.ones(5)}
    for wrong in (jnp.ones((5, 1)), jnp.ones(4)):
        with pytest.raises(InputError, match=r"observed site 'y': expected values of shape \(5,\)"):
            declare(outside, {**data, "y": wrong})


def test_what_jax_cannot_trace_is_told_in_one_line():
    def branching(distance, y=None):
        slope = numpyro.sample("slope", dist.Normal())
        mean = slope * distance if distance.mean() > 0 else distance
        with numpyro.plate("place", len(distance)):
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)

    with pytest.raises(
        InputError,
        match=r"model branching \(test_declaration.py, line \d+\): expected operations .* jnp.where",
    ):
        declare(branching, {"distance": jnp.ones(5), "y": jnp.ones(5)})


def test_a_plate_of_another_size_than_its_data_is_named_with_its_place():
    def short(x, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("row", 5):
            numpyro.deterministic("mean", level + x)
            numpyro.sample("y", dist.Normal(level + x, 1.0), obs=y)

    expected = r"model short \(test_declaration.py, line \d+\): .*\(5,\), \(7,\).* come to row of 5\."
    with pytest.raises(InputError, match=expected):
        declare(short, {"x": jnp.zeros(7), "y": jnp.zeros(7)})
    with pytest.raises(TypeError, match="unhashable"):  # what a model raises of itself is left alone
        declare(lambda x, y=None: {x: y}[[]], {"x": jnp.zeros(7), "y": jnp.zeros(7)})


def test_a_prior_that_cannot_be_drawn_from_is_named():
    def improper(y=None):
        numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
        level = numpyro.sample("level", dist.ImproperUniform(dist.constraints.real, (), ()))
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    with pytest.raises(InputError, match=r"one that cannot at 'level'\. Give every parameter a proper prior"):
        declare(improper, {"y": jnp.zeros(3)})


def of_table(table, y=None):
    slope = numpyro.sample("slope", dist.Normal())
    with numpyro.plate("row", len(table)):
        numpyro.sample("y", dist.Normal(slope * table["x"], 1.0), obs=y)


def test_what_numpyro_and_jax_say_of_tables_and_empty_plates_is_said_in_a_line():
    table = pd.DataFrame({"x": np.ones(3)})
    with pytest.raises(
        InputError, match=r"test_declaration\.py, line \d+.*indexed by a name\. Hand the table"
    ):
        declare(of_table, {"table": table, "y": np.ones(3)})
    with pytest.raises(InputError, match="expected plates of one or more, got one of size 0"):
        declare(outside, {"distance": jnp.ones(0), "height": jnp.ones(0), "y": jnp.ones(0)})


def test_columns_within_a_dictionary_are_arrays():
    found = select_arguments(plain, {"x": {"a": pd.Series([1.0, 2.0]), "b": [1, 2]}, "degree": 1})
    assert isinstance(found["x"]["a"], np.ndarray)
    assert found["x"]["b"] == [1, 2]


def test_angles_need_no_circular_reparametrisation():
    def model(y):
        angle = numpyro.sample("angle", dist.VonMises(0.0, 1.0))
        numpyro.sample("y", dist.VonMises(angle, 2.0), obs=y)

    turned = handlers.reparam(model, config={"angle": CircularReparam()})
    with pytest.raises(InputError, match=r"'angle_unwrapped'\. Leave CircularReparam out"):
        declare(turned, {"y": jnp.asarray(1.0)})
