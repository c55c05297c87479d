"""Whole diagnoses of small models: each verdict where it is due, on several data sets and keys."""

import json
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap import diagnose as diagnosing
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import integrated
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.confirm import confirm
from dtprob.inference import NUTS, Laplace
from dtprob.models.declaration import model
from tests.unit.gap.examples import (
    SIGMA,
    bend,
    counts,
    draw,
    inputs,
    jitter,
    line,
    pair,
    ripple,
    saturation,
    tone,
    use,
)

EFFECTS = (bend(), ripple(), ripple("ripple5", 5.0), saturation(), jitter())
FAST = Settings(replicates=200)


@dataclass(frozen=True)
class Started:
    """An engine that returns what it was started at."""

    initial: Any = None
    name = "started"

    def __call__(self, key, model, data, *, options=None):
        """One draw."""
        del key, model, data, options
        return SimpleNamespace(draws={n: np.asarray(v)[None, None] for n, v in self.initial.items()})


@pytest.fixture(scope="module", autouse=True)
def shared_compilation():
    """Problems that differ only in their arrays share their compiled functions."""
    known: dict[Any, Problem] = {}

    def shared(key, make, data):
        if key not in known:
            known[key] = make()
        return use(known[key], data)

    def key_of(model, data, effects, cluster, live=()):
        shapes = tuple((n, np.shape(v), str(np.asarray(v).dtype)) for n, v in data.items())
        return model.__name__, shapes, tuple(e.name for e in effects), cluster, frozenset(live)

    def make(model, data, effects, cluster=None, reference=None):
        if reference is not None or cluster in data:
            return Problem(model, data, effects, cluster, reference)
        return shared(
            key_of(model, data, effects, cluster), lambda: Problem(model, data, effects, cluster), data
        )

    plain = Problem.with_live

    def with_live(self, names):
        if self.known or self.column in self.data or set(names) <= {e.name for e in self.live}:
            return plain(self, names)
        key = key_of(self.model, self.data, self.effects, self.declaration.cluster, names)
        return shared(key, lambda: plain(self, names), self.data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosing, "Problem", make)
        patch.setattr(Problem, "with_live", with_live)
        yield


def run(model, data, effects=EFFECTS, key=0, engine=None, **options):
    options = {"settings": FAST, **options}
    return diagnose(model, data, effects, key=jax.random.key(key), engine=engine or Started(), **options)


@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(seed, marks=pytest.mark.study) for seed in (3, 4))])
def test_no_gap_where_there_is_none(seed):
    found = run(line, draw("line", seed=seed), key=seed)
    assert found.verdict == "NO_GAP"
    assert found.causes == ()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.study) for seed in (1, 2, 3))])
def test_the_true_effect_is_listed(seed):
    found = run(line, draw("line", seed=10 + seed, shift=0.5 * inputs() ** 2), key=seed)
    assert found.verdict == "LISTED"
    cause = found.causes[0]
    assert cause.effects == ("bend",)
    assert cause.alias_class == (("bend",),)
    assert cause.plausible
    assert cause.probability > 0.9
    assert abs(cause.size[0].mean - 0.5) < 0.15
    fraction = cause.closed_fraction
    assert fraction is not None
    assert fraction.low <= fraction.mean <= fraction.high <= 1.0
    assert fraction.mean > 0.85
    assert fraction.low > 0.7


@pytest.mark.study
def test_the_verdict_does_not_hang_on_the_key():
    gap, none = draw("line", seed=5, shift=0.4 * np.sin(3 * inputs())), draw("line", seed=6)
    found = [run(line, gap, key=k) for k in range(4)]
    assert {(d.verdict, d.causes[0].effects) for d in found} == {("LISTED", ("ripple",))}
    assert {run(line, none, key=k).verdict for k in range(4)} == {"NO_GAP"}


@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1])
def test_two_effects_are_found_one_after_the_other(seed):
    shift = 0.5 * inputs() ** 2 + 0.5 * np.sin(3 * inputs())
    found = run(line, draw("line", seed=20 + seed, shift=shift), key=seed)
    assert found.verdict == "LISTED"
    assert set(found.causes[0].effects) == {"bend", "ripple"}
    tried = {frozenset(t["effects"]): t for t in found.sections["tried"]}
    alone, both = tried[frozenset(["bend"])], tried[frozenset(["bend", "ripple"])]
    assert 0 < alone["gain_nats"] < both["gain_nats"]
    assert alone["behind_nats"] > 3
    behind = [t["behind_nats"] for t in found.sections["tried"]]
    assert behind == sorted(behind)


@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_effect_out_of_the_library_is_not_blamed_on_another(seed):
    others = (saturation(), ripple("ripple9", 9.0))
    shift = 0.8 * np.sin(3 * inputs())
    found = run(line, draw("line", seed=30 + seed, shift=shift), others, key=seed)
    assert found.verdict == "UNLISTED"
    assert "mean" in found.to_report()["unlisted"]["sites"]


def test_two_names_of_one_rewrite_are_one_class():
    effects = (*EFFECTS, ripple("twin"))
    found = run(line, draw("line", seed=7, shift=0.5 * np.sin(3 * inputs())), effects)
    assert found.verdict == "UNDETERMINED"
    assert set(found.causes[0].alias_class) == {("ripple",), ("twin",)}
    assert abs(found.causes[0].probability - 0.5) < 0.01
    assert found.sections["next_measurement"] is not None
    assert all(abs(t["behind_nats"]) < 0.01 for t in found.sections["tried"][:2])
    screening = found.maps["screening"]
    assert float(screening.correlation.sel(effect="ripple", other_effect="twin")) > 0.999


@pytest.mark.study
def test_random_levels_are_a_variance_effect():
    shift = 0.8 * np.random.default_rng(3).normal(size=(12, 1))
    found = run(line, draw("line", seed=8, shift=shift))
    assert found.verdict == "LISTED"
    assert found.causes[0].effects == ("jitter",)
    size = found.causes[0].size[0]
    assert (
        size.low < np.sqrt(np.mean(shift**2)) < size.high
    )  # twelve draws can be far from the 0.8 that they are of


@pytest.mark.study
def test_counts_and_turned_tones_are_diagnosed_too():
    found = run(counts, draw("counts", shift=0.25 * inputs() ** 2), (bend(), ripple()))
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("bend",))
    found = run(tone, draw("tone", shift=0.3 * inputs() ** 2), (bend(), ripple()))
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("bend",))
    assert run(tone, draw("tone"), (bend(), ripple())).verdict == "NO_GAP"


def raised():
    """Adds to the level, as another value of `a` would."""
    return Effect(
        "raised",
        {"level": lambda v, p, _: v + p["c"]},
        (Parameter("c", dist.Normal(0.0, 1.0)),),
        physics="level",
    )


def test_a_change_that_the_fit_can_follow_is_no_gap():
    found = run(line, draw("line", shift=0.6), (raised(), bend()))
    assert found.verdict == "NO_GAP"
    assert {s["effect"]: s["absorbed_by"] for s in found.to_report()["screening"]}["raised"] == "a"


class Earlier:
    """What 96 earlier observations say of the line, without its correlation."""

    def sample(self, key, n):
        """Draws of both parameters."""
        noise = SIGMA / np.sqrt(96) * np.asarray(jax.random.normal(key, (2, n)))
        return {"a": 0.7 + noise[0], "b": -1.2 + noise[1]}


@pytest.mark.study
def test_earlier_data_turn_a_change_into_a_gap():
    found = run(line, draw("line", seed=41, shift=0.6), (raised(), bend()), reference=Earlier())
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("raised",))
    assert abs(found.causes[0].size[0].mean - 0.6) < 0.25


@pytest.mark.parametrize("seed", [41, pytest.param(43, marks=pytest.mark.study)])
def test_what_a_fit_that_follows_a_change_costs_on_earlier_data_is_part_of_the_gap(seed):
    found = run(line, draw("line", seed=seed, shift=0.7 * SIGMA), (raised(), bend()), reference=Earlier())
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("raised",))
    assert found.causes[0].closed_fraction.low > 0.7  # 0.5 and 0.6 by these data alone


def test_sizes_too_are_relative_to_earlier_data():
    plain = Problem(line, draw("line", seed=41, shift=0.6), (raised(),), None, Earlier())
    problem = plain.with_live(["raised"])
    fitted = fit(problem, problem.null(), ["raised"])
    sizes, _ = confirm(problem, fitted, problem.effects, jax.random.key(0), Laplace())
    assert sizes[0].low < 0.6 < sizes[0].high
    assert sizes[0].high - sizes[0].low < 0.4  # twice 1.64 standard deviations of 0.07, and room


@pytest.mark.study
def test_another_engine_too_knows_the_earlier_data():
    plain = Problem(line, draw("line", seed=41, shift=0.6), (raised(),), None, Earlier())
    problem = plain.with_live(["raised"])
    fitted = fit(problem, problem.null(), ["raised"])
    ours, _ = confirm(problem, fitted, problem.effects, jax.random.key(0), Laplace())
    nuts = NUTS(chains=2, warmup=200, draws=400)
    theirs, _ = confirm(problem, fitted, problem.effects, jax.random.key(1), nuts)
    width = ours[0].high - ours[0].low
    np.testing.assert_allclose([theirs[0].low, theirs[0].high], [ours[0].low, ours[0].high], atol=0.2 * width)


def test_sizes_come_from_the_engine():
    plain = Problem(line, draw("line", seed=10, shift=0.5 * inputs() ** 2), (bend(),))
    problem = plain.with_live(["bend"])
    fitted = fit(problem, problem.null(), ["bend"])
    sizes, plausible = confirm(problem, fitted, problem.effects, jax.random.key(0), Laplace())
    index = problem.layout["bend.c"].offset
    mean, sd = fitted.x[index], np.sqrt(fitted.covariance[index, index])
    assert plausible
    assert abs(sizes[0].mean - mean) < 0.2 * sd  # 1000 draws
    np.testing.assert_allclose(
        [sizes[0].low, sizes[0].high], mean + 1.645 * sd * np.array([-1, 1]), atol=0.25 * sd
    )


def test_a_tolerance_makes_a_small_gap_none():
    """Of a gap that is listed without one: errors are 1.1 in the unit of the data, whose noise is 0.5."""
    data = draw("line", seed=10, shift=0.5 * inputs() ** 2)
    found = run(line, data, settings=Settings(replicates=200, tolerance_db=1.5))
    assert found.verdict == "NO_GAP"
    assert found.sections["gap"]["tolerated"]
    assert found.causes
    assert found.summary.startswith("A gap was found")


def rows(x, device, y=None):
    """Line whose clusters are named by a column."""
    del device
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", x.shape[0]):
        offset = numpyro.deterministic("offset", jnp.zeros_like(x))
        mean = numpyro.deterministic("mean", offset + slope * x)
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


@model(axes={"mean": ("row", "sample")}, cluster="row")
def wave(x, y=None):
    """A wave of unknown frequency, with many local optima."""
    frequency = numpyro.sample("frequency", dist.Normal(1.0, 1.0))
    mean = numpyro.deterministic("mean", jnp.cos(2 * jnp.pi * frequency * x))
    with numpyro.plate("row", x.shape[0], dim=-2), numpyro.plate("sample", x.shape[1], dim=-1):
        numpyro.sample("y", dist.Normal(mean, SIGMA), obs=y)


@pytest.mark.study
def test_a_base_fit_in_a_wrong_basin_is_taken_back(monkeypatch):
    rng = np.random.default_rng(0)
    x = rng.uniform(0.0, 2.0, (12, 20))
    data = {"x": x, "y": np.cos(2 * np.pi * 2.0 * x) + SIGMA * rng.normal(size=x.shape)}
    monkeypatch.setattr(integrated, "fit_base", lambda problem, *_, **__: fit(problem, np.array([0.9])))
    lines = []
    found = run(wave, data, (bend(), ripple()), say=lines.append)
    assert any("starting again" in line for line in lines)
    assert "fitting the base model to 12 clusters (row)" in lines
    assert found.verdict == "NO_GAP"
    assert found.to_report()["fit"]["nuisances"][0]["mean"] == pytest.approx(2.0, abs=0.02)


@pytest.mark.study
def test_a_column_may_name_the_clusters():
    rng = np.random.default_rng(0)
    x, device = rng.normal(size=90), rng.integers(0, 9, 90)
    y = -1.2 * x + 0.5 * x**2 + SIGMA * rng.normal(size=90)
    data = {"x": jnp.asarray(x), "device": device, "y": jnp.asarray(y)}
    found = run(rows, data, (bend(),), cluster="device")
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("bend",))
    assert found.to_report()["fit"]["n_clusters"] == 9
    assert found.maps["clusters"].sizes["device"] == 9


def test_the_report_is_plain_and_the_maps_are_named():
    found = run(line, draw("line", seed=10, shift=0.5 * inputs() ** 2))
    report = json.loads(json.dumps(found.to_report(), allow_nan=False))
    assert report["verdict"] == "LISTED"
    assert report["causes"][0]["closed_fraction"]["mean"] > 0.8
    assert report["gap"]["before"] > report["gap"]["after"]
    assert report["screening"][0]["effect"] == "bend"
    assert report["tried"][0]["effects"] == ["bend"]
    assert report["tried"][0]["behind_nats"] == 0.0
    assert all(t["behind_nats"] > 3 for t in report["tried"][1:])
    assert report["where"]["sites"][0]["site"] == "mean"
    slope = next(n for n in report["fit"]["nuisances"] if n["name"] == "b")
    assert slope["low"] < slope["mean"] < slope["high"]
    assert 0.9 < slope["contraction"] <= 1.0
    tree = found.to_datatree()
    assert {"where", "links", "screening", "differences"} <= set(tree.children)
    shown = tree["differences"]
    limit = 4 * shown["spread_0"].values
    assert np.any(np.abs(shown["before_0"].values) > limit)
    assert np.all(np.abs(shown["after_0"].values) < limit)
    assert tree["links"].sizes["link"] == 12


def test_without_candidates_it_is_told_whether_and_where_there_is_a_gap():
    assert run(line, draw("line"), ()).verdict == "NO_GAP"
    found = run(line, draw("line", seed=10, shift=0.5 * inputs() ** 2), ())
    assert (found.verdict, found.causes) == ("UNLISTED", ())
    assert found.summary.startswith(
        "There is a gap; no effects were given that could explain it. It shows at "
    )


def test_three_clusters_are_refused():
    with pytest.raises(InputError, match="at least 4"):
        run(line, draw("line", x=inputs(n_link=3)))


def test_an_effect_on_an_absent_site_is_refused():
    lost = Effect("lost", {"gain": lambda v, p, _: v + p["c"]}, (Parameter("c", dist.Normal(0.0, 1.0)),))
    with pytest.raises(InputError, match="effect lost"):
        run(line, draw("line"), (lost,))


def waiting(x, y=None):
    """Observations that the diagnosis cannot whiten."""
    with numpyro.plate("row", x.shape[0]):
        mean = numpyro.deterministic("mean", x)
        numpyro.sample("y", dist.Pareto(jnp.exp(mean), 1.0), obs=y)


def test_an_unknown_distribution_is_refused():
    with pytest.raises(InputError, match="Pareto"):
        run(waiting, {"x": jnp.zeros(6), "y": jnp.ones(6)}, (bend(),))


@pytest.mark.study
def test_a_pair_of_parameters_is_one_effect():
    x = inputs()
    found = run(line, draw("line", seed=11, shift=0.5 * np.cos(2 * x) + 0.1 * x**3), (pair(), saturation()))
    assert (found.verdict, found.causes[0].effects) == ("LISTED", ("pair",))
    assert [s.name for s in found.causes[0].size] == ["c_0", "c_1"]
    assert abs(found.causes[0].size[1].mean - 0.5) < 0.25


def town(east, north, power=None):
    """Power around a base station at the origin, 20 m high; what is in the table are places, not distances."""
    level = numpyro.sample("level", dist.Normal(-40.0, 20.0))
    exponent = numpyro.sample("exponent", dist.Normal(3.0, 1.0))
    error = numpyro.sample("error", dist.LogNormal(0.0, 1.0))
    distance = numpyro.deterministic("distance", jnp.sqrt(east**2 + north**2 + 400.0))
    expected = numpyro.deterministic("expected", level - 10 * exponent * jnp.log10(distance))
    with numpyro.plate("place", len(east)):
        numpyro.sample("power", dist.Normal(expected, error), obs=power)


@pytest.mark.study
@pytest.mark.parametrize(
    ("wrong", "labels"),
    [
        (lambda distance, _power: 2.0 * np.sin(2 * np.pi * distance / 40), ("ripple in distance, 17 to 32",)),
        (lambda _distance, power: np.minimum(-95.0 - power, 0.0), ("along ", "beyond ")),
    ],
    ids=["a wave from the ground", "a receiver that saturates"],
)
def test_what_varies_over_a_quantity_of_the_model_is_seen(wrong, labels):
    """Neither is a function of a column."""
    rng = np.random.default_rng(3)
    east, north = rng.uniform(-300, 300, (2, 300))
    distance = np.sqrt(east**2 + north**2 + 400.0)
    power = -35 - 30 * np.log10(distance)
    power = power + wrong(distance, power) + 2.0 * rng.normal(size=300)
    data = {"east": jnp.asarray(east), "north": jnp.asarray(north), "power": jnp.asarray(power)}
    north_side = Effect(
        "north_side",
        {"expected": lambda value, p, context: value + p["size"] * (context["north"] > 0)},
        (Parameter("size", dist.Normal(0.0, 3.0)),),
    )
    found = run(town, data, (north_side,), settings=Settings(replicates=100), engine=Laplace(draws=100))
    assert found.verdict == "UNLISTED"
    first = found.sections["where"]["sites"][0]
    assert first["site"] in ("distance", "expected")
    assert any(label in first["family"] for label in labels)
