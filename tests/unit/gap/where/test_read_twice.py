"""A log that was read twice is noticed; places that were measured twice, and coarse readings, are no copies."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.model.problem import Problem
from dtprob.gap.where.read_twice import read_twice

N = 200


def street(distance, device, seen=None, level=None):
    """Path loss with readings of which some may be missing."""
    exponent = numpyro.sample("exponent", dist.Normal(3.0, 1.0))
    mean = numpyro.deterministic("mean", -40 - 10 * exponent * jnp.log10(distance))
    with numpyro.plate("reading", distance.shape[0]):
        law = dist.Normal(mean, 4.0)
        numpyro.sample("level", law if seen is None else law.mask(seen), obs=level)


def log(seed=0, step=0.0):
    rng = np.random.default_rng(seed)
    distance, device = rng.uniform(5.0, 200.0, N), rng.integers(0, 4, N).astype(float)
    level = -40 - 30 * np.log10(distance) + 4.0 * rng.normal(size=N)
    return {
        "distance": distance,
        "device": device,
        "level": np.round(level / step) * step if step else level,
    }


def notes(data):
    return read_twice(Problem(street, {name: jnp.asarray(column) for name, column in data.items()}, []))


@pytest.mark.parametrize("step", [0.0, 1.0])
@pytest.mark.parametrize("copied", [N, 20])
def test_a_log_that_was_read_twice_is_noticed(copied, step):
    data = {name: np.concatenate([column, column[:copied]]) for name, column in log(step=step).items()}
    (note,) = notes(data)
    assert note.startswith(f"{copied} of {N + copied} values of level are others again")


@pytest.mark.parametrize("step", [0.01, 1.0])
def test_what_was_measured_twice_is_no_copy(step):
    one, other = log(step=step), log(1, step=step)
    both = {name: np.concatenate([column, column]) for name, column in one.items()}
    noise = other["level"] + 30 * np.log10(other["distance"]) + 40
    level = np.round((-40 - 30 * np.log10(one["distance"]) + noise) / step) * step
    assert not notes({**both, "level": np.concatenate([one["level"], level])})


@pytest.mark.parametrize("step", [0.0, 1.0, 20.0])
def test_single_readings_are_no_copies(step):
    assert not notes(log(step=step))


def test_circumstances_that_a_few_devices_share_tell_nothing():
    data = log(step=3.0)
    assert not notes({**data, "distance": np.full(N, 50.0)})


def test_what_does_not_count_is_no_copy():
    data = log()
    seen = np.arange(N) < N - 30
    for name in ("distance", "device", "level"):
        data[name] = np.where(seen, data[name], 1.0)
    assert not notes({**data, "seen": seen})
    assert notes(data) == []  # one value thirty times is no log that was read twice
