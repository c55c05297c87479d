"""Predictions: the law of total variance in closed form, and intervals that cover where a point estimate's do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.control import Stateless, aloha
from dtprob.errors import InputError
from dtprob.inference import PointMass
from dtprob.inference.exact import DirichletTables
from dtprob.models.dirichlet import log_shares
from dtprob.models.multi_access import Clusters, kernel, priors, records, window_counts
from dtprob.twin.counterfactual import Arm, average_effect, what_if
from dtprob.twin.predict import Prediction, predict
from dtprob.twin.rollout import overflow, random_access, rollout, throughput
from tests.small_network import ARRIVAL, CLUSTERS, RECEPTION, simulate

SYSTEM = kernel(CLUSTERS)
TRUTH = {
    "log_arrival": np.log(np.broadcast_to(ARRIVAL, (2, 1, 4)) + 0.0, where=np.broadcast_to(ARRIVAL, (2, 1, 4)) > 0,
                          out=np.full((2, 1, 4), -np.inf)),
    "log_reception": np.array([[np.log(p) if p else -np.inf for p in RECEPTION[n] + [0.0] * (5 - len(RECEPTION[n]))]
                               for n in range(5)]),
}  # fmt: skip


def test_parts_of_the_variance():
    rng = np.random.default_rng(0)
    means = rng.normal(3.0, 2.0, size=(4000, 1))
    prediction = Prediction(means + rng.normal(0.0, 0.5, size=(4000, 6)))
    assert prediction.aleatoric == pytest.approx(0.25, rel=0.05)
    assert prediction.epistemic == pytest.approx(4.0, rel=0.1)
    low, high = prediction.interval()
    assert (high - low) / 2 == pytest.approx(1.645 * np.sqrt(4.25), rel=0.06)
    low, high = prediction.expected_interval()
    assert (high - low) / 2 == pytest.approx(1.645 * 2.0, rel=0.06)


def test_throughput_of_random_access_is_that_of_the_exact_chain():
    found = predict(
        jax.random.key(0), SYSTEM, PointMass(TRUTH), policy=random_access(4, 0.25), metric=throughput,
        horizon=2000, draws=1, episodes=20,
    )  # fmt: skip
    assert abs(found.mean - 0.5882) < 4.5 * np.sqrt(found.aleatoric / 20) + 2e-3
    assert found.epistemic == 0.0


def test_policies_and_tables_of_another_network_are_refused_and_not_clamped():
    given = {"metric": throughput, "horizon": 5, "draws": 2, "episodes": 2}
    law, larger = DirichletTables(priors(Clusters(CLUSTERS), 0.5)), kernel(CLUSTERS, 4)
    small = Stateless(aloha(4, 1, 0.5))
    arms = {"baseline": Arm(random_access(4, 0.5)), "alternative": Arm(small)}
    for ask in (
        lambda: predict(jax.random.key(0), larger, law, policy=small, **given),
        lambda: average_effect(jax.random.key(0), larger, law, **arms, **given),
        lambda: what_if(jax.random.key(0), larger, law, simulate(5, 0), policy=small, draws=2),
    ):
        with pytest.raises(InputError, match="capacity of Stateless: expected 4 or more"):
            ask()
    with pytest.raises(InputError, match="policy: expected an action of each of 4 devices"):
        predict(jax.random.key(0), SYSTEM, law, policy=lambda *_: jnp.ones(3, int), **given)
    other = DirichletTables(priors(Clusters(((0, 1, 2, 3),)), 0.5))
    expected = r"draws of 'log_arrival': expected .* \(2, 1, 4\) or \(2, 4, 4\) each, got \(1, 1, 16\)"
    with pytest.raises(InputError, match=expected):
        predict(jax.random.key(0), SYSTEM, other, policy=random_access(4, 0.5), **given)
    with pytest.raises(InputError, match="episode: expected a NetworkLog"):
        what_if(jax.random.key(0), SYSTEM, law, {"buffer": np.zeros((5, 4))}, draws=2)


@pytest.mark.study
def test_intervals_cover_where_those_of_a_point_estimate_do_not():
    """Overflow over a horizon, foreseen from 10 slots; 60 twins, so 90% within 4 standard errors of chance."""
    horizon, slots, level, trials = 100, 10, 0.9, 60
    policy = random_access(4, 0.5)
    mask = {name: value > 0 for name, value in priors(Clusters(CLUSTERS), 1.0).items()}
    covered = {"bayesian": 0, "map": 0}
    truth = {name: jnp.asarray(value) for name, value in TRUTH.items()}
    run = jax.jit(lambda key: overflow(rollout(key, SYSTEM, truth, policy, horizon)))
    for trial in range(trials):
        arguments = records(simulate(slots, 1000 + trial), clusters=CLUSTERS)
        counts = {name: value.sum(axis=0) for name, value in window_counts(arguments).items()}
        prior = DirichletTables(priors(arguments["clusters"], 0.5))
        point = {name: log_shares(value + 0.01, mask[name]) for name, value in counts.items()}
        value = float(run(jax.random.key(trial)))
        for name, sampler in (("bayesian", prior.updated(counts)), ("map", PointMass(point))):
            found = foresee(jax.random.key(trial), sampler, policy, horizon)
            low, high = found.interval(level)
            covered[name] += low <= value <= high
    error = np.sqrt(level * (1 - level) / trials)
    assert covered["bayesian"] / trials > level - 4 * error
    assert covered["map"] < covered["bayesian"]


def foresee(key, sampler, policy, horizon):
    return predict(
        key, SYSTEM, sampler, policy=policy, metric=overflow, horizon=horizon, draws=50, episodes=4
    )


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="episodes: expected 2 or more, got 1"):
        predict(
            jax.random.key(0), SYSTEM, PointMass(TRUTH), policy=random_access(4, 0.5), metric=throughput,
            horizon=5, episodes=1,
        )  # fmt: skip
    few = PointMass({"log_arrival": TRUTH["log_arrival"]})
    with pytest.raises(InputError, match="draws of 'log_reception'"):
        predict(jax.random.key(0), SYSTEM, few, policy=random_access(4, 0.5), metric=throughput, horizon=5)
    with pytest.raises(InputError, match="between 0 and 1"):
        Prediction(np.zeros((2, 2))).interval(90)
