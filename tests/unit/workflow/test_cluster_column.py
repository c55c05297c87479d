"""A column of a table names the clusters, whether the model takes it or not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.case import load_case
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace, fit
from dtprob.models.arguments import model_name, taking
from dtprob.models.declaration import metadata, model
from dtprob.workflow import prepare

MODEL = """
import numpyro
import numpyro.distributions as dist

def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", x.shape[0]):
        level = numpyro.deterministic("level", slope * x)
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)
"""


@model(axes={"level": ("row",)})
def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", x.shape[0]):
        level = numpyro.deterministic("level", slope * x)
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


def table(days=8, each=12):
    rng = np.random.default_rng(0)
    x = rng.normal(size=days * each)
    return {"day": np.repeat(np.arange(days), each), "x": x, "y": 0.7 * x + rng.normal(size=days * each)}


def test_a_case_may_name_a_column_that_its_model_does_not_take(tmp_path):
    (tmp_path / "line.py").write_text(MODEL)
    rows = [
        "day,x,y,note",
        *(f"{d},{x},{y},-" for d, x, y in zip(*table().values(), strict=True)),
    ]
    (tmp_path / "table.csv").write_text("\n".join(rows))
    text = '[model]\nname = "line:line"\n[data]\nfile = "table.csv"\ncluster = "day"\n'
    (tmp_path / "case.toml").write_text(text)
    job = prepare(load_case(tmp_path / "case.toml"), need="diagnosis")
    assert job.data.keys() == {"day", "x", "y"}
    problem = Problem(job.model, job.data, job.effects, job.cluster)
    assert (problem.cluster_name, problem.n_cluster) == ("day", 8)
    posterior = fit(job.model, job.data, engine=Laplace(draws=200), key=jax.random.key(0))
    assert abs(float(posterior.flat("slope").mean()) - 0.7) < 0.5


def test_in_python_too():
    settings = Settings(replicates=50, site_replicates=19)
    found = diagnose(
        line, table(), [], key=jax.random.key(0), engine=Laplace(draws=100), settings=settings, cluster="day"
    )
    assert found.verdict == "NO_GAP"
    assert found.maps["clusters"].sizes["day"] == 8


def test_it_is_the_same_model_but_for_the_column():
    data = {name: jnp.asarray(column) for name, column in table().items()}
    wider = taking(functools.partial(line), data, "day")
    assert model_name(wider) == "line"
    assert metadata(wider).axes == {"level": ("row",)}
    assert taking(line, data, "x") is line
    assert taking(line, data, None) is line
    assert taking(line, {}, "day") is line


def test_another_column_than_the_one_named_is_still_no_argument():
    with pytest.raises(InputError, match="expected arguments among x, y, day, got 'week'"):
        diagnose(
            line, table() | {"week": np.zeros(96)}, [], key=jax.random.key(0), engine=Laplace(), cluster="day"
        )
