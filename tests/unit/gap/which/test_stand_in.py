"""What was found beside something else that is wrong: kept if the best family of a site does not take its gain."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.gap.which.stand_in import _lead
from dtprob.inference import Laplace
from tests.unit.gap.examples import of_access_points

POINTS, EACH = 8, 30
LEVELS = 1.5 * np.array([1.0, -1.0, 0.5, -0.5, 1.2, -1.2, 0.3, -0.3])


def effect(name, shape):
    return Effect(
        name,
        {"mean": lambda value, p, data: value + p["size"] * shape(data)},
        (Parameter("size", dist.Normal(0.0, 2.0)),),
    )


BEND = effect("bend", lambda data: data["x"] ** 2)
FIRST = effect("first_points", lambda data: data["access_point"] < 2)


def found(candidate, curvature, levels):
    rng = np.random.default_rng(3)
    x, point = rng.uniform(-1, 1, POINTS * EACH), rng.permutation(np.repeat(np.arange(POINTS), EACH))
    y = 1 + 2 * x + rng.normal(size=x.size) + levels[point] + curvature * x**2
    data = {"x": jnp.asarray(x), "access_point": jnp.asarray(point), "y": jnp.asarray(y)}
    settings = Settings(site_replicates=50, remainder=False)
    return diagnose(
        of_access_points, data, [candidate], key=jax.random.key(0), engine=Laplace(), settings=settings
    )


@pytest.mark.study
def test_an_effect_beside_unknown_levels_is_kept():
    """Levels of access points, which no effect knows, bring four times its gain."""
    said = found(BEND, 1.6, LEVELS)
    assert said.verdict == "UNLISTED"
    (cause,) = said.causes
    assert cause.effects == ("bend",)
    assert cause.size[0].low > 0.0
    assert said.to_report()["remainder"] is None


@pytest.mark.study
def test_an_effect_that_takes_up_a_part_of_unknown_levels_is_not():
    """Two access points of eight are as far off as the effect says, others are, too."""
    levels = 2.0 * np.array([1.0, 1.0, -1.0, -1.0, 1.5, -1.5, 0.8, -0.8])
    said = found(FIRST, 0.0, levels)
    assert said.verdict == "UNLISTED"
    assert not said.causes


@pytest.mark.parametrize(
    ("gain", "lead"), [(4.0, 3.0), (6.3, 3.15), (16.0, 8.0), (50.0, 8.0), (100.0, 15.0), (1e4, 1500.0)]
)
def test_how_much_better_than_one_effect_a_family_has_to_be(gain, lead):
    """Half as much again where little was gained, eight nats, or a seventh of what was gained."""
    assert _lead(gain) == pytest.approx(lead)
