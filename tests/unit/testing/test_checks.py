"""The contract checks accept what keeps the contract and name what breaks it."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from jax.experimental.ode import odeint

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.inference import AbstractEngine, Laplace, Point
from dtprob.inference.fit import fit
from dtprob.models.declaration import model
from dtprob.testing import ContractError, check_effect, check_engine, check_model

X = np.linspace(0.5, 2.0, 8)
DATA = {"x": X, "y": 1.5 * X}


def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        mean = numpyro.deterministic("mean", slope * x)
        numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


line = model(axes={"mean": ("row",)})(line)


def test_a_good_model():
    check_model(line, DATA)


def unnamed(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(slope * x, 0.5).to_event(1), obs=y)


def sized_by_its_data(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", 3 if y is None else x.shape[0]):
        numpyro.sample("y", dist.Normal(slope, 0.5), obs=y)


def stops_the_gradient(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(jax.lax.stop_gradient(slope) * x, 0.5), obs=y)


def fails_for_some(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(jnp.sqrt(slope) * x, 0.5), obs=y)


def levels_of_nodes(x, y=None):
    """A latent site in the outer of two plates, whose other axis has one entry."""
    with numpyro.plate("node", x.shape[0], dim=-2):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("hour", x.shape[1], dim=-1):
            numpyro.sample("y", dist.Normal(level + x, 0.5), obs=y)


def battery(x, y=None):
    """A differential equation whose derivatives go backwards only."""
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
    charge = odeint(lambda charge, _, r: -r * charge, 1.0, jnp.linspace(0.0, 1.0, x.shape[0]), rate)
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(charge, 0.5), obs=y)


def test_axes_of_one_entry_need_no_name():
    check_model(levels_of_nodes, {"x": jnp.zeros((5, 4)), "y": jnp.ones((5, 4))})


def test_what_cannot_be_differentiated_forwards_is_refused_with_a_remedy():
    given = {"x": jnp.zeros(6), "y": jnp.ones(6)}
    for ask in (check_model, lambda model, data: fit(model, data, engine="laplace", key=jax.random.key(0))):
        with pytest.raises(InputError, match=r"odeint\. .*jax\.lax\.scan"):
            ask(battery, given)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (unnamed, "a name for every axis of 'y'"),
        (sized_by_its_data, r"prior draw of 'y': expected shape \(8,\), got \(3,\)"),
        (stops_the_gradient, "the gradient of the log density"),
        (fails_for_some, "expected finite|a finite log density"),
    ],
)
def test_broken_models(broken, message):
    with pytest.raises(ContractError, match=message):
        check_model(broken, DATA)


USUAL = Laplace(draws=2000)


@dataclasses.dataclass(frozen=True)
class Shifted(AbstractEngine):
    """An engine that is wrong by a little, forgets its key, or compiles for every data set."""

    name: ClassVar[str] = "shifted"
    answer: ClassVar[str] = "approximation"

    shift: float = 0.0
    ignore_key: bool = False
    compile_again: bool = False
    base: AbstractEngine = USUAL

    def __call__(self, key, model, data, **options):
        if self.compile_again:
            jax.jit(lambda: 2 * data["y"])()
        used = jax.random.key(0) if self.ignore_key and isinstance(key, jax.Array) else key
        posterior = self.base(used, model, data, **options)
        draws = {
            "level": posterior.draws["level"] + self.shift,
            "doubled": posterior.draws["doubled"] + 2 * self.shift,
        }
        return dataclasses.replace(posterior, draws=draws)


def test_engines():
    check_engine(Shifted())
    with pytest.raises(ContractError, match="the posterior of the closed form"):
        check_engine(Shifted(shift=0.2))
    with pytest.raises(ContractError, match="other draws for another key"):
        check_engine(Shifted(ignore_key=True))
    with pytest.raises(ContractError, match="nothing to compile for other data of known shapes"):
        check_engine(Shifted(compile_again=True))


class Turned(Shifted):
    """An engine with a single value, wrong by a turn where nothing turns."""

    answer: ClassVar[str] = "point"


def test_a_turn_is_an_error_of_what_is_no_angle():
    check_engine(Turned(base=Point()))
    with pytest.raises(ContractError, match="the mode"):
        check_engine(Turned(base=Point(), shift=2 * np.pi))


def offset(**changes):
    settings = {
        "family": "offset",
        "rewrites": {"mean": lambda value, given, context: value + given["size"]},
        "parameters": (Parameter("size", dist.Normal(0.0, 1.0), unit="V"),),
        "physics": "a constant voltage added to the output",
        "source": "any textbook",
    }
    return Effect(**{**settings, **changes})


def rough(value, given, context):
    return value + jnp.abs(given["size"])


def noisy(value, given, context):
    return value * given["size"] * given["field"] + value


GOOD = {
    "mean": offset(),
    "variance": offset(
        kind="variance",
        rewrites={"mean": noisy},
        parameters=(Parameter("size", dist.HalfNormal(1.0), unit="1"),),
    ),
    "distribution": offset(
        rewrites={},
        distributions={"y": lambda fn, given, context: dist.Normal(fn.loc + given["size"], fn.scale)},
    ),
}


@pytest.mark.parametrize("name", GOOD)
def test_good_effects(name):
    check_effect(GOOD[name], line, DATA)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"physics": ""}, "a text for 'physics'"),
        ({"parameters": (Parameter("size", dist.Normal(0.0, 1.0), unit=""),)}, "a unit"),
        ({"parameters": (Parameter("size", dist.Uniform(1.0, 2.0), unit="V"),)}, "around the null 0"),
        ({"rewrites": {"slope of nothing": rough}}, "a site 'slope of nothing'"),
        ({"rewrites": {"mean": lambda v, g, c: v + g["size"] + 1e-9}}, "'mean' unchanged at the null"),
        ({"rewrites": {"mean": rough}}, "the derivative of finite differences"),
        ({"rewrites": {"mean": lambda v, g, c: v + jnp.sqrt(g["size"])}}, "finite"),
    ],
)
def test_broken_effects(changes, message):
    with pytest.raises(ContractError, match=message):
        check_effect(offset(**changes), line, DATA)
