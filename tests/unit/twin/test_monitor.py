"""A monitor on any model and sampler: likelihoods, thresholds, which factor changed."""

from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.data import NetworkLog
from dtprob.data.network_rows import split_gaps
from dtprob.errors import InputError
from dtprob.inference.exact import DirichletTables
from dtprob.models.dirichlet import log_shares
from dtprob.models.multi_access import Clusters, multi_access, priors, records, window_counts
from dtprob.twin.likelihood import table_likelihoods, window_likelihoods
from dtprob.twin.monitor import Monitor
from dtprob.twin.statistics import threshold
from tests.small_network import CLUSTERS, RECEPTION, simulate


def windows(log):
    return records(log, clusters=CLUSTERS, window=10)


@pytest.fixture(scope="module")
def learned():
    arguments = windows(simulate(300, 10))
    counts = {name: value.sum(axis=0) for name, value in window_counts(arguments).items()}
    prior = DirichletTables(priors(arguments["clusters"], 0.5))
    return prior, prior.updated(counts), counts


@pytest.fixture(scope="module")
def monitor(learned):
    prior, posterior, _ = learned
    draws, changed = (law.sample(jax.random.key(i), 100) for i, law in enumerate((posterior, prior)))
    plain = Monitor(multi_access, draws, changed, "evidence", apart=("cluster",), rate=0.1, run_length=500.0)
    return plain.calibrated(windows(simulate(400, 11)))


def test_likelihoods_are_those_of_the_counts(learned):
    arguments = windows(simulate(45, 12))
    draws = learned[1].sample(jax.random.key(2), 5)
    counted = table_likelihoods(window_counts(arguments), draws)
    found = window_likelihoods(multi_access, arguments, draws, apart=("cluster",))
    arrivals = found["arrivals[0]"] + found["arrivals[1]"]
    np.testing.assert_allclose(arrivals, counted["log_arrival"], rtol=1e-6)
    np.testing.assert_allclose(found["deliveries"], counted["log_reception"], rtol=1e-6, atol=1e-9)


@pytest.mark.study
def test_normal_data_seldom_alarm(monitor):
    watch = monitor.watch(windows(simulate(400, 13)))
    assert watch.alarm.mean() < 0.1 + 4 * np.sqrt(0.1 * 0.9 * (1 / 40 + 1 / 40))
    assert watch.detected is None
    assert watch.changed is None


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        ({"silent": (1,)}, "arrivals[0]"),
        ({"silent": (2,)}, "arrivals[1]"),
        ({"reception": {**RECEPTION, 1: [0.5, 0.5], 2: [0.6, 0.4, 0.0]}}, "deliveries"),
    ],
)
def test_a_change_is_found_and_its_factor_named(monitor, change, factor):
    watch = monitor.watch(windows(simulate(400, 14, **change)))
    assert watch.detected is not None
    assert watch.detected < 20
    assert watch.changed == factor
    assert watch.factors[factor] > 0.9


def test_the_frequentist_is_one_draw(learned):
    _, _, counts = learned
    mask = {name: value > 0 for name, value in priors(windows(simulate(10, 0))["clusters"], 1.0).items()}
    point = {name: log_shares(value + 0.01, mask[name])[None] for name, value in counts.items()}
    rival = Monitor(multi_access, point, rate=0.1).calibrated(windows(simulate(200, 11)))
    watch = rival.watch(windows(simulate(200, 14, silent=(1,))))
    assert watch.evidence == {}
    assert watch.detected is None
    assert watch.alarm.mean() > 0.2


def test_what_cannot_be_watched_is_refused(monitor, learned):
    with pytest.raises(InputError, match="expected one that is calibrated"):
        Monitor(multi_access, monitor.draws).watch(windows(simulate(20, 0)))
    with pytest.raises(InputError, match="Did you mean 'surprise'"):
        Monitor(multi_access, monitor.draws, statistic="suprise")
    with pytest.raises(InputError, match="draws of what a change may bring"):
        Monitor(multi_access, monitor.draws, statistic="evidence")
    with pytest.raises(InputError, match="expected 1 window or more, got 0"):
        Monitor(multi_access, monitor.draws, run_length=0.0)
    with pytest.raises(
        InputError, match="rate of false alarms: expected a probability between 0 and 1, got 5"
    ):
        Monitor(multi_access, monitor.draws, rate=5.0)
    with pytest.raises(InputError, match=r"several names, got 'cluster'. Write \('cluster',\)"):
        Monitor(multi_access, monitor.draws, apart="cluster")
    with pytest.raises(InputError, match=r"axes to keep apart: .* Did you mean 'cluster'"):
        window_likelihoods(multi_access, windows(simulate(20, 0)), monitor.draws, apart=("clusters",))
    markov = DirichletTables(priors(Clusters(CLUSTERS), 0.5, memory=True)).sample(jax.random.key(0), 3)
    expected = r"draws of 'log_arrival': expected .* \(2, 1, 4\) each, got \(2, 4, 4\) each"
    with pytest.raises(InputError, match=expected):
        window_likelihoods(multi_access, windows(simulate(20, 0)), markov)
    few = {"log_arrival": monitor.draws["log_arrival"]}
    with pytest.raises(InputError, match="every latent site of multi_access, got no 'log_reception'"):
        window_likelihoods(multi_access, windows(simulate(20, 0)), few)


def test_windows_that_are_not_whole_set_no_threshold_and_raise_no_alarm(learned):
    """Half of the normal windows are three slots long; of whole ones few alarm all the same."""
    draws = learned[1].sample(jax.random.key(0), 50)
    plain = Monitor(multi_access, draws, rate=0.1)
    short = simulate(3, 15, episodes=60)
    whole = simulate(10, 16, episodes=60)
    columns = {
        f.name: np.concatenate([getattr(log, f.name) for log in (whole, short)]) for f in fields(whole)
    }
    columns["episode"][600:] += 60
    both, alone = windows(NetworkLog(**columns)), windows(whole)
    found, expected = plain.calibrated(both), plain.calibrated(alone)
    np.testing.assert_allclose(found.normal, expected.normal, rtol=1e-6)
    watched = found.watch(both)
    assert not watched.alarm[60:].any()
    assert (watched.p_value[60:] == 1.0).all()
    assert (watched.p_value[:60] < 1.0).any()
    few = {name: value[55:] if name != "clusters" else value for name, value in both.items()}
    with pytest.raises(
        InputError, match=r"whole normal windows for a rate of 0\.1: expected 9 or more, got 5"
    ):
        plain.calibrated(few)
    with pytest.raises(InputError, match="windows to watch: expected 10 readings, as when calibrated, got 3"):
        found.watch(windows(short))


@pytest.mark.study
def test_a_log_with_gaps_keeps_the_rate_of_alarms(learned):
    """Calibrated on a log with 5% of its rows missing, watched on a whole one; 6 standard errors of both samples."""
    draws, random = learned[1].sample(jax.random.key(0), 50), np.random.default_rng(0)
    log = simulate(8000, 18)
    kept = random.random(8000) >= 0.05
    columns = {f.name: getattr(log, f.name)[kept] for f in fields(log)}
    columns["episode"] = split_gaps(columns["episode"], columns["slot"])
    monitor = Monitor(multi_access, draws, rate=0.1).calibrated(windows(NetworkLog(**columns)))
    for seen in (simulate(4000, 19), NetworkLog(**columns)):
        watched = monitor.watch(windows(seen))
        error = np.sqrt(0.1 * 0.9 * (1 / len(monitor.normal) + 1 / len(watched.alarm)))
        assert watched.alarm.mean() < 0.1 + 3 * error


def readings(y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    with numpyro.plate("window", 200, dim=-2), numpyro.plate("reading", 4, dim=-1):
        numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


def with_a_factor(y=None, *, of_data=True):
    readings(y)
    numpyro.factor("more", -jnp.sum(y**2) if of_data and y is not None else -1.0)


def test_a_reading_that_is_no_number_is_told_and_not_taken_for_a_change():
    draws = {"level": np.zeros(5)}
    y = np.random.default_rng(0).normal(size=(200, 4))
    y[3, 1] = np.nan
    plain = Monitor(readings, draws, statistic="disagreement", rate=0.05)
    with pytest.raises(
        InputError, match="log likelihood of y: expected a number of each window, got NaN in window 3"
    ):
        plain.calibrated({"y": jnp.asarray(y)})
    with pytest.raises(InputError, match="NaN in window 3"):
        plain.calibrated({"y": jnp.asarray(np.nan_to_num(y))}).watch({"y": jnp.asarray(y)})


def test_what_belongs_to_no_window_is_refused():
    with pytest.raises(InputError, match=r"got numpyro\.factor 'more'"):
        window_likelihoods(with_a_factor, {"y": jnp.ones((200, 4))}, {"level": np.zeros(2)})
    given = {"y": jnp.ones((200, 4)), "of_data": False}
    found = window_likelihoods(with_a_factor, given, {"level": np.zeros(2)})
    np.testing.assert_allclose(found["y"], 4 * -0.5 * (1 + np.log(2 * np.pi)))


def test_normal_windows_that_cannot_be_are_no_threshold():
    statistic = np.where(np.arange(100) < 8, np.inf, np.arange(100.0))
    assert np.isfinite(threshold(statistic, 0.1))
    with pytest.raises(InputError, match="8 of 100 that cannot be under any draw"):
        threshold(statistic, 0.05)
