"""Own unknowns of clusters are integrated out: against closed forms, and where a joint mode sees noise vanish."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize, stats

from dtprob.effects import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting import integrated, marginal_mode
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.integrated import based
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace
from dtprob.models.complex_normal import ComplexNormal

KEY = jax.random.key(0)
SETTINGS = Settings(replicates=100, site_replicates=39, candidates=2)


def levels(place, known=None, level=None):
    """Readings about levels of their own, whose spread is unknown unless it is given."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 10.0))
    spread = numpyro.sample("spread", dist.LogNormal(0.0, 1.0)) if known is None else known
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("link", place.shape[0], dim=-2):
        own = numpyro.sample("own", dist.Normal(0.0, 1.0))
        with numpyro.plate("reading", place.shape[1], dim=-1):
            expected = numpyro.deterministic("expected", mean + spread * own + 0.0 * place)
            numpyro.sample("level", dist.Normal(expected, noise), obs=level)


def of_levels(seed=0, links=20, readings=3):
    rng = np.random.default_rng(seed)
    level = 2.0 + 1.5 * rng.normal(size=(links, 1)) + rng.normal(size=(links, readings))
    place = np.tile(np.linspace(-1, 1, readings), (links, 1))
    return {"place": jnp.asarray(place), "level": jnp.asarray(level)}


def fading(time, power=None):
    """Power that fades slowly, a state for every reading, in noise of unknown strength."""
    mean = numpyro.sample("mean", dist.Normal(-70.0, 10.0))
    memory = numpyro.sample("memory", dist.Beta(8.0, 2.0))
    step = numpyro.sample("step", dist.LogNormal(0.0, 0.5))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("run", time.shape[0], dim=-2), numpyro.plate("slot", time.shape[1], dim=-1):
        state = numpyro.sample("state", dist.Normal(0.0, 1.0))

    def onwards(last, new):
        here = memory * last + step * new
        return here, here

    _, fade = jax.lax.scan(onwards, jnp.zeros(time.shape[0]), state.T)
    expected = numpyro.deterministic("expected", mean + fade.T)
    with numpyro.plate("run", time.shape[0], dim=-2), numpyro.plate("slot", time.shape[1], dim=-1):
        numpyro.sample("power", dist.Normal(expected, noise), obs=power)


def of_fading(seed, drop=0.0, tone=0.0, runs=20, slots=24):
    rng = np.random.default_rng(seed)
    time = np.tile(np.arange(slots) * 1.0, (runs, 1))
    fade, state = np.zeros((runs, slots)), np.zeros(runs)
    for slot in range(slots):
        state = 0.8 * state + rng.normal(size=runs)
        fade[:, slot] = state
    power = -68.0 + fade + 1.2 * rng.normal(size=(runs, slots)) - drop * (time > 15)
    power += tone * np.sin(2 * np.pi * time / 6)
    return {"time": jnp.asarray(time), "power": jnp.asarray(power)}


def added(name, shape):
    rewrite = {"expected": lambda value, p, context: value + p["size"] * shape(context)}
    return Effect(name, rewrite, (Parameter("size", dist.Normal(0.0, 3.0)),))


DROP = added("drop", lambda context: -1.0 * (context["time"] > 15))
WARM = added("warm_up", lambda context: jnp.exp(-context["time"] / 5))


def test_the_mode_is_that_of_the_exact_marginal_density():
    data = of_levels()
    problem = Problem(levels, data, [added("slope", lambda context: context["place"])])
    joint, found = fit_base(problem, KEY), based(problem, KEY)
    assert found.problem.volume is not None
    level = np.asarray(data["level"])
    readings = level.shape[1]

    def height(x):
        mean, spread, noise = x[0], np.exp(x[1]), np.exp(x[2])
        covariance = spread**2 + noise**2 * np.eye(readings)
        prior = stats.norm.logpdf(x[0], 0, 10) + stats.norm.logpdf(x[1:]).sum()
        return stats.multivariate_normal(np.full(readings, mean), covariance).logpdf(level).sum() + prior

    best = optimize.minimize(lambda x: -height(x), np.zeros(3))
    values = found.problem.initial(found.fitted.x, [])
    here = np.array([values["mean"], np.log(values["spread"]), np.log(values["noise"])]).ravel()
    assert height(here) > -best.fun - 1e-3
    there = problem.initial(joint.x, [])
    joint_mode = np.array([there["mean"], np.log(there["spread"]), np.log(there["noise"])]).ravel()
    assert height(joint_mode) < -best.fun - 2.0  # what the expansion is for
    laplace = -best.fun + 1.5 * np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(best.hess_inv)[1]
    assert found.fitted.log_evidence == pytest.approx(laplace, abs=0.5)


def test_states_of_every_reading_are_integrated_out_at_once(monkeypatch):
    """No joint mode is sought, which would run away step by step; the marginal one is that of the exact density."""
    data = of_fading(3, runs=8, slots=40)
    problem = Problem(fading, data, [DROP])
    monkeypatch.setattr(integrated, "_runs_away", lambda *_: pytest.fail("a joint mode was sought"))
    found = based(problem, KEY)
    power, lag = np.asarray(data["power"]), np.arange(40)

    def height(x):
        mean, memory, step, noise = x[0], 1 / (1 + np.exp(-x[1])), np.exp(x[2]), np.exp(x[3])
        response = np.where(lag[:, None] >= lag, memory ** np.maximum(lag[:, None] - lag, 0.0), 0.0)
        covariance = step**2 * response @ response.T + noise**2 * np.eye(40)
        prior = stats.norm.logpdf(mean, -70, 10) + stats.norm.logpdf(x[2:], 0, 0.5).sum()
        prior += stats.beta.logpdf(memory, 8, 2) + np.log(memory * (1 - memory))
        return stats.multivariate_normal(np.full(40, mean), covariance).logpdf(power).sum() + prior

    best = optimize.minimize(lambda x: -height(x), np.array([-68.0, 1.4, 0.0, 0.0]))
    values = found.problem.initial(found.fitted.x, [])
    mean, memory, step, noise = (float(values[n]) for n in ("mean", "memory", "step", "noise"))
    assert (
        height(np.array([mean, np.log(memory / (1 - memory)), np.log(step), np.log(noise)]))
        > -best.fun - 0.05
    )


def test_levels_of_known_spread_are_left_to_the_joint_mode():
    data = of_levels(links=40, readings=12)
    problem = Problem(levels, {**data, "known": 1.5}, [added("slope", lambda c: c["place"])])
    assert based(problem, KEY).problem.volume is None


def test_a_volume_is_what_its_derivatives_say():
    data = of_levels()
    volume = based(Problem(levels, data, [added("slope", lambda c: c["place"])]), KEY).problem.volume
    assert np.all(np.linalg.eigvalsh(volume.bend) <= 1e-9)
    away, h = volume.centre + np.array([0.1, -0.2, 0.3]), 1e-5
    for i, unit in enumerate(np.eye(3)):
        slope = (volume.at(away + h * unit) - volume.at(away - h * unit)) / (2 * h)
        np.testing.assert_allclose(volume.gradient(away)[:, i], slope, rtol=1e-6, atol=1e-8)
    spread, noise = np.exp(volume.centre[1:])
    ratio = 3 * spread**2 / noise**2
    share = ratio / (1 + ratio)
    np.testing.assert_allclose(volume.value, -0.5 * np.log(1 + ratio), rtol=1e-5)
    np.testing.assert_allclose(volume.slope, np.tile([0.0, -share, share], (20, 1)), atol=1e-3)
    bend = -2 * share * (1 - share) * np.array([[0, 0, 0], [0, 1, -1], [0, -1, 1]])
    np.testing.assert_allclose(volume.bend, np.tile(bend, (20, 1, 1)), atol=0.02)


@pytest.mark.study
@pytest.mark.parametrize("drop", [0.0, 2.0])
def test_a_state_for_every_reading_is_no_gap(drop):
    """The joint mode lets the noise vanish, and all that is random would look like a gap."""
    told = []
    found = diagnose(
        fading,
        of_fading(1, drop),
        [DROP, WARM],
        key=KEY,
        engine=Laplace(draws=100),
        settings=SETTINGS,
        say=told.append,
    )
    assert any(line.startswith("integrating out") for line in told)
    assert not any(line.startswith("note") for line in told)
    if drop:
        assert [c.effects for c in found.causes] == [("drop",)]
        assert abs(found.causes[0].size[0].mean - drop) < 1.0
    else:
        assert found.verdict == "NO_GAP"


@pytest.mark.study
def test_what_no_candidate_explains_is_seen_at_its_site_beside_many_states():
    """States that are free at each reading could follow it: their spread must not take it with it."""
    found = diagnose(
        fading,
        of_fading(1, tone=1.5),
        [DROP, WARM],
        key=KEY,
        engine=Laplace(draws=100),
        settings=SETTINGS,
    )
    assert found.verdict == "UNLISTED"
    assert found.sections["unlisted"]["sites"][0] == "expected"
    before = found.sections["remainder"]["before"]
    assert 0.85 < before["coverage"] < 0.95  # new runs, their states unknown
    assert 0.9 < before["error_ratio"] < 1.1


def test_a_broken_model_with_states_says_what_breaks():
    data = of_levels()
    data["level"] = data["level"].at[3, 1].set(jnp.nan)
    with pytest.raises(InputError, match=r"data level: expected finite values"):
        based(Problem(levels, data, [added("slope", lambda c: c["place"])]), KEY)


def turned_tones(tone, signal=None):
    """Tones that come with a phase of each link, in noise that is known to a tenth."""
    gain = numpyro.sample("gain", dist.LogNormal(0.0, 0.5))
    slope = numpyro.sample("slope", dist.Normal(0.0, 0.5))
    noise = numpyro.sample("noise", dist.LogNormal(jnp.log(1e-4), 0.1))
    with numpyro.plate("link", tone.shape[0], dim=-2):
        phase = numpyro.sample("phase", dist.VonMises(0.0, 0.01))
        with numpyro.plate("tone", tone.shape[1], dim=-1):
            mean = gain * (1 + slope * tone) * jnp.exp(1j * phase)
            expected = numpyro.deterministic("expected", mean)
            numpyro.sample("signal", ComplexNormal(expected, noise), obs=signal)


@pytest.mark.study
def test_a_gap_that_no_prior_of_the_noise_expects_is_no_runaway(monkeypatch):
    """A twin far off puts the noise 60 standard deviations from its prior; expansions on the way there took minutes."""
    rng = np.random.default_rng(0)
    tone = np.tile(np.linspace(-1, 1, 16), (12, 1))
    phase = rng.uniform(-np.pi, np.pi, (12, 1))
    signal = (1 + 0.5 * np.sin(9 * tone)) * np.exp(1j * phase)
    expansions = []
    monkeypatch.setattr(
        marginal_mode, "_expanded", lambda *a: expansions.append(a) or pytest.fail("expanded")
    )
    problem = Problem(turned_tones, {"tone": jnp.asarray(tone), "signal": jnp.asarray(signal)}, [], "link")
    start = based(problem, KEY)
    assert not expansions
    (noise,) = start.fitted.x[start.problem.layout.indices(["noise"])]
    assert noise > np.log(1e-4) + 10 * 0.1
    turn = start.fitted.x[start.problem.layout["phase"].index[:, 0]] - phase[:, 0]
    np.testing.assert_allclose(np.exp(1j * turn), 1.0, atol=0.3)
