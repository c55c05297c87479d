"""Factored transition models: graphs, laws of the package and of a user, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import Laplace
from dtprob.models.declaration import declare
from dtprob.models.factored import Factor, Logistic, Neural, Table, factored
from dtprob.testing import check_model


@pytest.fixture
def columns():
    """Two subsets of the state and an action; the second subset follows the first one's new value."""
    rng = np.random.default_rng(0)
    level, action = rng.integers(0, 3, (4, 25)), rng.integers(0, 2, (4, 25))
    new_level = np.clip(level + action - rng.integers(0, 2, (4, 25)), 0, 2)
    alarm = (rng.random((4, 25)) < 0.1 + 0.35 * new_level).astype(int)
    return {name: jnp.asarray(v) for name, v in locals().items() if name != "rng"}


def graph(alarm_law):
    return factored(
        [
            Factor(
                "level",
                "new_level",
                ("level", "action"),
                Table("log_level", {"level": 3, "action": 2}, 3, 0.5),
            ),
            Factor("alarm", "alarm", ("new_level",), alarm_law),
        ],
        name="plant",
    )


@pytest.mark.parametrize(
    "law",
    [
        Logistic("weight", ("new_level",), 2),
        pytest.param(Neural("net", ("new_level",), 2, hidden=3), marks=pytest.mark.study),
    ],
)
def test_models_keep_their_contract(columns, law):
    check_model(graph(law), columns)


def test_sites(columns):
    sites = declare(graph(Logistic("weight", ("new_level",), 2)), columns).sites
    assert sites["log_level"].axes == ("level", "action", "log_level_outcome")
    assert sites["level_logits"].shape == (4, 25, 3)
    assert sites["alarm"].axes == ("episode", "slot")
    assert sites["weight"].shape == (1, 2)


def test_a_users_own_law_is_a_function(columns):
    def slope(given):
        rise = numpyro.sample("rise", dist.Normal(0.0, 3.0))
        logit = rise * (given["new_level"] - 1.0)
        return jnp.stack([jnp.zeros_like(logit), logit], axis=-1)

    posterior = Laplace(draws=500)(jax.random.key(0), graph(slope), columns)
    rise = posterior.flat("rise")
    assert rise.mean() - 2 * rise.std() > 0


def test_a_factor_without_parents(columns):
    model = factored([Factor("action", "action", (), Table("log_action", {}, 2, 1.0))])
    sites = declare(model, {"action": columns["action"]}).sites
    assert sites["log_action"].shape == (2,)
    assert sites["action_logits"].shape == (4, 25, 2)


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ([Factor("a", "x", (), Table("t", {}, 2)), Factor("b", "x", (), Table("u", {}, 2))], "two for 'x'"),
        (
            [Factor("a", "x", ("y",), Table("t", {"y": 2}, 2)), Factor("b", "y", (), Table("u", {}, 2))],
            "parents of earlier factors, got 'y'",
        ),
        ([Factor("a", "x", ("state",), Table("t", {"stat": 2}, 2))], "Did you mean 'state'"),
    ],
)
def test_graphs_that_are_none_are_refused(factors, message):
    with pytest.raises(InputError, match=message):
        factored(factors)


def test_a_missing_column_is_named(columns):
    del columns["action"]
    with pytest.raises(InputError, match="an entry 'action'"):
        declare(graph(Logistic("weight", ("new_level",), 2)), columns)
