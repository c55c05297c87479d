"""From which pairs a search starts once more."""

from dataclasses import dataclass
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.gap.which.pairs import Pair
from dtprob.gap.which.starts import exchanged, promising

TILT_AND_NOISE, TILT_AND_SHIFT = Pair(("noise", "tilt"), 900.0), Pair(("shift", "tilt"), 880.0)


def end(effects, *, leaves, pairs=(TILT_AND_NOISE, TILT_AND_SHIFT)):
    """A fit with these effects, at which a way ended; noise alone moves no mean."""
    scores = SimpleNamespace(
        pairs=pairs,
        locating=frozenset({"shift", "tilt", "gain"}),
        log_bayes_factor=np.array([700.0, 500.0]),
    )
    return SimpleNamespace(
        problem=SimpleNamespace(effects=("shift", "tilt", "gain", "noise")),
        fitted=SimpleNamespace(effects=effects),
        screening=SimpleNamespace(scores=scores),
        alarmed=lambda _: leaves,
    )


def promised(seen, reached, settings):
    """The pair that promises most, of one view that is the base fit's and a way's end."""
    return promising(seen, [seen], reached, settings)


def test_noise_is_no_start_where_what_moves_the_mean_leaves_nothing():
    assert promised(end(("gain",), leaves=False), 800.0, Settings()) == ("shift", "tilt")
    only_noise = end(("gain",), leaves=False, pairs=(TILT_AND_NOISE,))
    assert promised(only_noise, 800.0, Settings()) is None


@pytest.mark.parametrize(("effects", "leaves"), [(("gain",), True), (("noise",), False)])
def test_noise_is_a_start_where_something_is_left_or_noise_was_needed(effects, leaves):
    assert promised(end(effects, leaves=leaves), 800.0, Settings()) == ("noise", "tilt")


@pytest.mark.parametrize(("effects", "reached"), [(("noise", "tilt"), 800.0), (("gain",), 1500.0), ((), 0.0)])
def test_no_pair_that_was_reached_or_promises_less_or_where_nothing_was_found(effects, reached):
    assert promised(end(effects, leaves=True), reached, Settings()) is None


def test_no_pair_where_one_effect_is_all_that_is_looked_for():
    assert promised(end(("gain",), leaves=True), 800.0, Settings(max_effects=1)) is None


def part(effects, evidence, pairs=()):
    """A fit beside a part of what was found."""
    names = ("image", "others", "first", "gain", "phase", "tilt")
    problem = SimpleNamespace(effects=[SimpleNamespace(name=name, kind="mean") for name in names])
    fitted = Fitted(effects, evidence)
    return SimpleNamespace(
        problem=problem,
        fitted=fitted,
        screening=SimpleNamespace(scores=SimpleNamespace(pairs=pairs)),
    )


@dataclass(frozen=True)
class Fitted:
    """The effects of a fit and its log evidence."""

    effects: tuple[str, ...]
    log_evidence: float


def test_a_plainer_pair_takes_the_place_of_two_effects_that_were_taken_one_by_one():
    base, found = Fitted((), 0.0), part(("image", "others", "first"), 4456.0)
    views = [
        part(("image",), 2008.0, (Pair(("gain", "phase"), 2440.0), Pair(("gain", "tilt"), 1500.0))),
        part(("image", "others"), 4162.0, (Pair(("gain", "phase"), 900.0),)),  # more than the largest set
        part((), 0.0, (Pair(("gain", "phase"), 9000.0),)),  # beside nothing that was found
        part(("tilt",), 10.0, (Pair(("gain", "phase"), 9000.0),)),
    ]
    chosen = exchanged(views, [found], 4440.0, base, Settings(max_effects=3))
    assert [(seen.fitted.effects, pair) for seen, pair in chosen] == [(("image",), ("gain", "phase"))]
    ends = [found, part(("image", "gain", "phase"), 4500.0)]
    assert exchanged(views, ends, 4440.0, base, Settings(max_effects=3)) == []


def test_what_every_element_shares_is_not_named_by_element():
    """A gain and a phase of all four elements, which the others' and the first's gains and phases explain too."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(-2.0, 2.0, 120))
    path = np.stack([np.cos(3 * x) + 0.5 * x, np.sin(3 * x)], -1)[:, None] * np.ones((1, 4, 1))
    turned = np.asarray(_turned(jnp.asarray(path), 0.03, 0.022)) + 0.03 * path[..., ::-1]
    reading = turned + 0.05 * rng.normal(size=path.shape)
    data = {"x": x, "reading": reading}
    found = diagnose(_elements, data, effects=_of_elements(), key=jax.random.key(0))
    assert found.verdict == "LISTED"
    assert [set(cause.effects) for cause in found.causes] == [{"gain", "phase", "image"}]


def _elements(x, reading=None):
    """Real and imaginary parts (place, element, 2) of what four elements receive."""
    trend = numpyro.sample("trend", dist.Normal(0.0, 3.0))
    noise = numpyro.sample("noise", dist.HalfNormal(1.0))
    with numpyro.plate("place", len(x)):
        path = jnp.stack([jnp.cos(3 * x) + trend * x, jnp.sin(3 * x)], -1)
        mean = numpyro.deterministic("mean", path[:, None] * jnp.ones((1, 4, 1)))
        numpyro.sample("reading", dist.Normal(mean, noise).to_event(2), obs=reading)


def _turned(value, log_gain, phase):
    new = (value[..., 0] + 1j * value[..., 1]) * jnp.exp(log_gain + 1j * phase)
    return jnp.stack([new.real, new.imag], -1)


def _of_elements():
    """Gains and phases of all elements, of all but the first, and of the first, and a part of the other component."""

    def size(name, count=1):
        return Parameter(name, dist.Normal(0.0, 0.1) if count == 1 else dist.Normal(0.0, 0.1).expand([count]))

    def but_first(entries):
        return jnp.concatenate([jnp.zeros(1), entries])

    first = jnp.arange(4) == 0
    return [
        Effect("gain", {"mean": lambda v, p, _: _turned(v, p["gain"], 0.0)}, (size("gain"),)),
        Effect("phase", {"mean": lambda v, p, _: _turned(v, 0.0, p["phase"])}, (size("phase"),)),
        Effect(
            "others",
            {"mean": lambda v, p, _: _turned(v, but_first(p["gain"]), but_first(p["phase"]))},
            (size("gain", 3), size("phase", 3)),
        ),
        Effect(
            "first",
            {"mean": lambda v, p, _: _turned(v, p["gain"] * first, p["phase"] * first)},
            (size("gain"), size("phase")),
        ),
        Effect("image", {"mean": lambda v, p, _: v + p["share"] * v[..., ::-1]}, (size("share"),)),
    ]
