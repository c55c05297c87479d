"""Information against what maximum likelihood gains, on cases that can be solved."""

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical.information import (
    colour_information,
    impulse_information,
    mean_information,
    power_information,
    projected,
    size_for,
    spread_information,
)
from dtprob.physical.noise import circular


def stack(values):
    return np.concatenate([values.real, values.imag], axis=-1)


def test_mean_information_is_twice_the_expected_gain_of_a_linear_model():
    rng = np.random.default_rng(0)
    tangents, direction = circular(rng, (3, 40)), circular(rng, (40,))
    s2, size = 0.3, 0.8
    draws = size * direction + np.sqrt(s2) * circular(rng, (4000, 40))
    base, full = stack(tangents).T, np.column_stack([stack(tangents).T, stack(direction)])
    gains = []
    for design in (base, full):
        q, _ = np.linalg.qr(design)
        gains.append(np.sum((stack(draws) @ q) ** 2, axis=1) / (s2 / 2))
    gained = np.mean(gains[1] - gains[0]) - 1
    spread = np.std(gains[1] - gains[0]) / np.sqrt(4000)
    found = mean_information(size * direction, tangents, s2)
    assert abs(found - gained) < 4 * spread


def test_what_the_twin_can_mimic_carries_no_information():
    rng = np.random.default_rng(1)
    tangents = circular(rng, (4, 30))
    assert mean_information(np.array([0.3, -1, 2, 0.1]) @ tangents, tangents, 0.1) < 1e-6
    assert mean_information(1j * tangents[0], tangents[:0], 0.5) == pytest.approx(
        4 * np.sum(np.abs(tangents[0]) ** 2)
    )


def test_a_prior_lets_the_twin_mimic_less():
    rng = np.random.default_rng(2)
    tangent, d = circular(rng, (1, 20)), circular(rng, (20,))
    values = [mean_information(d, tangent, 0.2, np.array([p])) for p in (0.0, 10.0, 1e12)]
    assert values[0] < values[1] < values[2]
    assert values[2] == pytest.approx(2 * np.sum(np.abs(d) ** 2) / 0.2, rel=1e-6)
    cov = 0.1 * np.eye(40) + np.outer(stack(tangent[0]), stack(tangent[0])) / 10.0
    assert values[1] == pytest.approx(stack(d) @ np.linalg.solve(cov, stack(d)), rel=1e-9)


def gaussian_divergence(covariance):
    """2 KL from N(0, C) to N(0, v I) with the best v."""
    count = len(covariance)
    return count * np.log(np.trace(covariance) / count) - np.linalg.slogdet(covariance)[1]


def test_spread_information_is_a_divergence():
    rng = np.random.default_rng(3)
    columns = circular(rng, (2, 3, 12))
    blocks = [0.2 / 2 * np.eye(24) + stack(one).T @ stack(one) for one in columns]
    joint = np.block([[blocks[0], np.zeros((24, 24))], [np.zeros((24, 24)), blocks[1]]])
    assert spread_information(columns, columns[0, :0], 0.2) == pytest.approx(gaussian_divergence(joint))


@pytest.mark.parametrize("precision", [0.0, 30.0])
def test_spread_that_the_twin_can_mimic_carries_no_information(precision):
    rng = np.random.default_rng(3)
    columns, tangents = circular(rng, (4, 3, 30)), circular(rng, (5, 120))
    tangents[0] = 0.0
    tangents[0, :30] = columns[0, 1]  # of unit size in one block
    s2, prior = 0.2, np.full(5, precision)
    every = np.zeros((12, 120), complex)
    for block in range(4):
        every[3 * block : 3 * block + 3, 30 * block : 30 * block + 30] = columns[block]
    seen = np.stack([projected(one, tangents, s2, prior) for one in every])
    extra = np.linalg.eigvalsh(stack(every) @ seen.T) / (s2 / 2)
    expected = 240 * np.log1p(extra.sum() / 240) - np.log1p(extra).sum()
    assert spread_information(columns, tangents, s2, prior) == pytest.approx(expected)
    alone = np.pad(columns[:1, 1:2], ((0, 3), (0, 0), (0, 0)))
    found = spread_information(alone, tangents, s2, prior)
    assert found < 1e-6 if precision == 0 else found > 1


def test_power_and_colour_are_divergences():
    power = np.array([1.0, 2.0, 5.0, 0.5])
    assert power_information(power) == pytest.approx(2 * gaussian_divergence(np.diag(power)))
    index = np.arange(6)
    colour = 0.6 ** np.abs(index[:, None] - index)
    assert colour_information(colour.astype(complex), 3) == pytest.approx(3 * 2 * gaussian_divergence(colour))


@pytest.mark.parametrize(("probability", "ratio"), [(0.02, 3.0), (0.05, 30.0), (0.5, 1.0), (0.01, 1000.0)])
def test_impulse_information_is_what_draws_say(probability, ratio):
    rng = np.random.default_rng(4)
    count = 400_000
    power = np.where(rng.random(count) < probability, 1 + ratio, 1.0)
    u = power * rng.exponential(size=count)
    mean = 1 + probability * ratio
    mixture = np.logaddexp(
        np.log(1 - probability) - u, np.log(probability) - np.log(1 + ratio) - u / (1 + ratio)
    )
    gained = 2 * (mixture + np.log(mean) + u / mean)
    error = gained.std() / np.sqrt(count)
    assert abs(impulse_information(probability, ratio, 1) - gained.mean()) < 4 * error


def test_no_impulses_no_information():
    assert impulse_information(0.0, 5.0, 10) == 0
    assert impulse_information(0.1, 0.0, 10) == 0


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("target", [1.0, 25.0, 1e5])
def test_size_is_found_on_a_power_law(power, target):
    size, found = size_for(target, lambda s: 1e6 * s**power, limit=1.0)
    assert found == pytest.approx(target, rel=0.02)
    assert size == pytest.approx((target / 1e6) ** (1 / power), rel=0.05)


def test_size_is_found_where_information_saturates_and_turns():
    size, found = size_for(900.0, lambda s: 1000 * np.sin(s) ** 2, limit=10.0)
    assert found == pytest.approx(900, rel=0.02)
    assert 1000 * np.sin(size) ** 2 == pytest.approx(found)


def test_too_much_information_is_refused():
    with pytest.raises(InputError, match="at most"):
        size_for(1e4, lambda s: 1e3 * s**2, limit=1.0)
    with pytest.raises(InputError, match="at most 0"):
        size_for(1e4, lambda _: 0.0, limit=1.0)


def test_the_calibrator_counts_calls():
    calls = []

    def information(size):
        calls.append(size)
        return 300 * size**2

    size_for(100.0, information, limit=10.0)
    assert len(calls) <= 4
