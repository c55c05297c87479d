"""Returns and advantages against enumeration, gradients against differences, and learning on small games."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dtprob.control.policy as tables
from dtprob.control import COMA, IPPO, Budget, FramePolicy, HistoryPolicy, tabulate, train
from dtprob.control.coma import actor_loss, critic_loss, values
from dtprob.control.critic import CentralCritic
from dtprob.control.environment import Observation
from dtprob.control.returns import counterfactual_advantage, lambda_returns, normalised
from dtprob.control.rollout import Trajectory, begin, play
from dtprob.errors import InputError
from dtprob.physical.multi_access import aloha, average, chain
from tests.unit.control.networks import PAIR, world

KEY = jax.random.key(0)


def test_returns_mix_all_lengths():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, 6))
    discount, mix = 0.9, 0.7
    got = lambda_returns(jnp.array(reward), jnp.array(value), jnp.zeros(6, bool), discount, mix)
    for t in range(6):
        length = 5 - t
        steps = [
            sum(discount**i * reward[t + i] for i in range(n)) + discount**n * value[t + n]
            for n in range(1, length + 1)
        ]
        weights = [(1 - mix) * mix ** (n - 1) for n in range(1, length)] + [mix ** (length - 1)]
        expected = np.dot(weights, steps) if length else value[t]
        assert got[t] == pytest.approx(expected)
    cut = lambda_returns(jnp.array(reward), jnp.array(value), jnp.arange(6) == 2, discount, mix)
    short = lambda_returns(jnp.array(reward[:3]), jnp.array(value[:3]), jnp.zeros(3, bool), discount, mix)
    np.testing.assert_allclose(cut[:3], short, rtol=1e-6)


def test_counterfactual_advantages_against_enumeration():
    """One slot, three devices: the advantage by summing the rewards of all joint actions by hand."""
    rng = np.random.default_rng(1)
    game, logit = rng.normal(size=(2, 2, 2)), rng.normal(size=3)
    chance = 1 / (1 + np.exp(-logit))
    for action in itertools.product((0, 1), repeat=3):
        value = np.array([[game[(*action[:k], u, *action[k + 1 :])] for u in (0, 1)] for k in range(3)])
        got = counterfactual_advantage(jnp.array(value), jnp.array(logit), jnp.array(action))
        for k in range(3):
            baseline = (1 - chance[k]) * value[k, 0] + chance[k] * value[k, 1]
            assert got[k] == pytest.approx(game[action] - baseline)


def test_the_policy_gradient_against_enumeration():
    """With exact values the expected gradient of log-probability times advantage is that of the mean reward."""
    rng = np.random.default_rng(2)
    game, logit = jnp.array(rng.normal(size=(2, 2, 2))), jnp.array(rng.normal(size=3))

    def chance_of(logit, action):
        return jnp.prod(jax.nn.sigmoid(jnp.where(action > 0, logit, -logit)))

    joint = [jnp.array(action) for action in itertools.product((0, 1), repeat=3)]

    def mean_reward(logit):
        return sum(chance_of(logit, action) * game[tuple(np.asarray(action))] for action in joint)

    def value_of(action):
        a = tuple(np.asarray(action).tolist())
        return jnp.array([[game[(*a[:k], u, *a[k + 1 :])] for u in (0, 1)] for k in range(3)])

    total = jnp.zeros(3)
    for action in joint:
        advantage = counterfactual_advantage(value_of(action), logit, action)
        score = jnp.where(action > 0, 1.0, 0.0) - jax.nn.sigmoid(logit)
        total += chance_of(logit, action) * score * advantage
    np.testing.assert_allclose(total, jax.grad(mean_reward)(logit), rtol=1e-6)


@functools.cache
def played(kind=FramePolicy):
    policy, environment = kind(KEY, 2), world(PAIR, horizon=9)
    now = begin(KEY, environment, policy, 3)
    return policy, now.memory, play(KEY, environment, policy, now, 12)[1]


def slope_along(loss, module, seed):
    """Derivative of a loss in a random direction: automatic, and by differences."""
    arrays, fixed = eqx.partition(module, eqx.is_array)
    leaves, shape = jax.tree.flatten(arrays)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    way = jax.tree.unflatten(
        shape, [jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
    )

    def along(size):
        moved = jax.tree.map(lambda x, d: x + size * d, arrays, way)
        return loss(eqx.combine(moved, fixed))

    compiled = jax.jit(along)
    return float(jax.jit(jax.grad(along))(0.0)), float(compiled(1e-6) - compiled(-1e-6)) / 2e-6


@pytest.mark.parametrize("kind", [FramePolicy, pytest.param(HistoryPolicy, marks=pytest.mark.study)])
def test_the_actors_gradient_against_differences(kind):
    policy, memory, trajectory = played(kind)
    advantage = jax.random.normal(KEY, trajectory.logit.shape)
    counts = ~trajectory.truncated
    automatic, difference = slope_along(
        lambda p: actor_loss(p, memory, trajectory, advantage, weight=counts, entropy=jnp.array(0.3)),
        policy,
        1,
    )
    assert automatic == pytest.approx(difference, rel=1e-5, abs=1e-9)


def test_the_critics_gradient_against_differences():
    _, _, trajectory = played()
    critic = CentralCritic(KEY, 2)
    returns = jax.random.normal(KEY, trajectory.logit.shape)
    automatic, difference = slope_along(
        lambda c: critic_loss(c, trajectory, returns, ~trajectory.truncated), critic, 2
    )
    assert automatic == pytest.approx(difference, rel=1e-5, abs=1e-9)


def test_a_devices_values_do_not_depend_on_its_own_action():
    critic = CentralCritic(KEY, 4)
    local = [jnp.array([1, 1, 0, 1])] * 3
    seen = Observation(*local, action=local[0], slot=jnp.array(2))
    action = jnp.array([1, 0, 1, 1])
    value = critic(seen, action)
    for device in range(4):
        other = critic(seen, action.at[device].set(1 - action[device]))
        np.testing.assert_allclose(other[device], value[device], rtol=1e-6)
        moved = np.abs(np.asarray(other - value)).max(axis=1) > 1e-7
        assert moved.sum() == (3 if seen.buffer[device] else 0)  # an empty buffer's action changes nothing


def test_an_episodes_end_is_not_bridged():
    _, _, trajectory = played()
    learner = COMA()
    critic = CentralCritic(KEY, 2)
    returns, counts = learner.returns(critic, trajectory)
    assert np.array_equal(counts[:, 0], [slot not in {8, 11} for slot in range(12)])
    after = trajectory._replace(reward=trajectory.reward.at[9:].add(1000.0))
    np.testing.assert_allclose(learner.returns(critic, after)[0][:9], returns[:9], rtol=1e-6)
    assert values(critic, trajectory).shape == (12, 3, 2, 2)


@pytest.mark.parametrize("learner", [COMA(), IPPO()], ids=["coma", "ippo"])
def test_two_devices_learn_to_share(learner):
    """From one half of the optimum's lead over random access, on the way to the optimum, at a fixed key."""
    budget = Budget(40_000, 32, 16)
    fit = jax.jit(
        lambda key: tabulate(train(key, learner, FramePolicy(key, 2), world(PAIR), budget).policy).probability
    )
    exact = chain(PAIR)
    got = average(exact, np.asarray(fit(KEY), float)).throughput
    before = average(exact, aloha(PAIR, 0.5)).throughput
    best = average(exact, aloha(PAIR, 1.0)).throughput
    assert before + 0.5 * (best - before) < got


def test_caution_counts_more_what_pays_less():
    reward = jnp.array([[10.0, 50.0, -30.0], [30.0, 10.0, -50.0]])  # (slot, environment); means 20, 30, -40
    played = Trajectory(None, None, None, None, reward, None, None)
    np.testing.assert_array_equal(COMA().weight(played), np.ones(3))
    weight = np.asarray(COMA(caution=2.0, scale=10.0).weight(played), float)
    assert weight.mean() == pytest.approx(1.0)
    np.testing.assert_allclose(weight[0] / weight[1:], np.exp([2.0, -12.0]), rtol=1e-5)


def test_a_budget_that_teaches_nothing_is_refused():
    """The return of a trajectory's last slot is a guess: with one slot between two updates nothing would be learned."""
    with pytest.raises(InputError, match="length: expected 2 or more, got 1"):
        train(KEY, COMA(), FramePolicy(KEY, 2), world(PAIR), Budget(100, 4, 1))


def test_what_cannot_be_trained_is_refused():
    """A table has chances of 0 and 1, whose log-odds have no slope."""
    for table in (tables.aloha(2, 1, 0.5), tables.tdma(2, 1, [[0], [1]])):
        with pytest.raises(InputError, match=r"policy to train: .* Start from a FramePolicy"):
            train(KEY, COMA(), table, world(PAIR), Budget(100, 4, 2))
    broken = jax.tree.map(lambda x: x * jnp.nan if eqx.is_array(x) else x, FramePolicy(KEY, 2))
    with pytest.raises(InputError, match="training: expected a policy of finite parameters"):
        train(KEY, COMA(), broken, world(PAIR), Budget(100, 4, 2))
    for caution in (float("nan"), float("inf"), -1.0):
        with pytest.raises(InputError, match="caution: expected a finite number, 0 or more"):
            COMA(caution=caution)


def test_guessed_slots_take_no_part_in_the_scale_of_advantages():
    """By NumPy over the slots that count; where none does, nothing is learned."""
    advantage = np.random.default_rng(0).normal(3.0, 2.0, size=(6, 2, 3))
    counts = np.arange(12).reshape(6, 2) % 3 > 0
    advantage[~counts] = 0.0  # what `device_returns` leave there
    known = advantage[counts]
    expected = np.where(counts[..., None], (advantage - known.mean()) / (known.std() + 1e-6), 0.0)
    np.testing.assert_allclose(normalised(jnp.array(advantage), jnp.array(counts)), expected, atol=1e-9)
    assert not np.any(normalised(jnp.array(advantage), jnp.zeros((6, 2), bool)))
