"""Von Mises EM against the closed forms of a phase-error channel, and against quadrature."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from scipy.special import i0e, i1e

from dtprob.errors import InputError
from dtprob.inference import VonMisesEM
from dtprob.inference.build import build_target
from dtprob.inference.phasors import least_squares_start, reference_phases
from dtprob.inference.relaxation import Layout, Resultants, expected_log_joint, find_layout, quadratic
from dtprob.models.complex_normal import ComplexNormal
from tests.unit.inference.examples import normal, normal_data, phase_errors, phase_errors_data

KEY = jax.random.key(31)


def ratio(kappa):
    return i1e(kappa) / i0e(kappa)


def log_i0(kappa):
    return np.log(i0e(kappa)) + kappa


def reference(response, h, concentration, noise, starts):
    """Free energy, directions and concentrations of one link by the closed-form coordinate update, best start."""
    m, kappa = np.array(starts, complex), np.zeros(np.shape(starts))
    for _ in range(3000):
        before = m.copy()
        for p in range(len(response)):
            others = h - m @ response + m[:, p, None] * response[p]
            eta = concentration + 2 / noise * others @ response[p].conj()
            kappa[:, p] = abs(eta)
            m[:, p] = ratio(kappa[:, p]) * eta / abs(eta)
        if np.max(np.abs(m - before)) < 1e-13:
            break
    fit = np.sum(np.abs(h - m @ response) ** 2, axis=1)
    fit += np.sum(np.sum(np.abs(response) ** 2, 1) * (1 - np.abs(m) ** 2), axis=1)
    terms = kappa * np.abs(m) - log_i0(kappa) - concentration * m.real + log_i0(concentration)
    energy = len(h) * np.log(np.pi * noise) + fit / noise + terms.sum(axis=1)
    best = np.argmin(energy)
    return energy[best], np.angle(m[best]), kappa[best]


def least_squares(response, h, concentration, noise):
    gram = response.conj() @ response.T
    return np.exp(1j * np.angle(np.linalg.solve(gram, response.conj() @ h + noise * concentration / 2)))


def best_reference(data):
    """The lowest for each link of many starts: no error, least squares, no knowledge, and random angles."""
    random, found = np.random.default_rng(5), []
    for response, h in zip(data["response"], data["h"], strict=True):
        known = (data["concentration"], data["noise"])
        anywhere = np.exp(1j * random.uniform(-np.pi, np.pi, (40, len(response))))
        ones = np.ones(len(response))
        starts = [ones, least_squares(response, h, *known), 0 * ones, *anywhere]
        found.append(reference(response, h, *known, starts))
    return [np.stack(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize(
    ("spread", "concentration", "seed"),
    [
        (1.0, 2.0, 3),
        *(pytest.param(0.05, *case, marks=pytest.mark.study) for case in ((0.5, 3), (0.5, 4), (2.0, 5))),
    ],
)
def test_agrees_with_the_closed_form(spread, concentration, seed):
    data, _ = phase_errors_data(links=12, paths=4, spread=spread, concentration=concentration, seed=seed)
    posterior = VonMisesEM(draws=10)(KEY, phase_errors, data)
    energy, direction, kappa = best_reference(data)
    assert float(posterior.extra["free_energy"]) <= energy.sum() + 1e-5
    assert float(posterior.extra["free_energy"]) == pytest.approx(energy.sum(), abs=1e-2)
    if spread == 1.0:
        turn = np.exp(1j * (posterior.extra["direction.phase"] - direction))
        np.testing.assert_allclose(np.angle(turn), 0, atol=1e-4)
        np.testing.assert_allclose(posterior.extra["concentration.phase"], kappa, rtol=1e-4)
    assert bool(posterior.extra["converged"])


@pytest.mark.study
@pytest.mark.parametrize("noise", [0.1, 4.0])
def test_the_reference_e_step_is_the_papers(noise):
    data, _ = phase_errors_data(links=5, paths=3, noise=noise)
    posterior = VonMisesEM(draws=10, e_step="reference")(KEY, phase_errors, data)
    snr = np.sum(np.abs(data["response"]) ** 2, axis=2) / noise
    expected = [
        least_squares(response, h, data["concentration"], noise)
        for response, h in zip(data["response"], data["h"], strict=True)
    ]
    turn = np.exp(1j * posterior.extra["direction.phase"]) / np.stack(expected)
    np.testing.assert_allclose(np.angle(turn), 0, atol=1e-6)
    kappa = 2 * np.sqrt(np.where(snr > 1, snr * (snr - 1), 0))
    np.testing.assert_allclose(posterior.extra["concentration.phase"], kappa, rtol=1e-6, atol=1e-9)
    assert bool(posterior.extra["converged"])
    exact = VonMisesEM(draws=10)(KEY, phase_errors, data)
    assert float(exact.extra["free_energy"]) < float(posterior.extra["free_energy"])


def test_e_steps_that_are_not_there_are_refused():
    with pytest.raises(InputError, match="Did you mean 'reference'"):
        VonMisesEM(e_step="referense")(KEY, phase_errors, phase_errors_data(links=1, paths=1)[0])
    with pytest.raises(InputError, match="expected ComplexNormal, got VonMises"):
        VonMisesEM(e_step="reference")(KEY, _directions, {"seen": np.array([0.1, 0.2])})


def _directions(seen=None):
    angle = numpyro.sample("angle", dist.VonMises(0.0, 1.0))
    with numpyro.plate("packet", 2):
        numpyro.sample("seen", dist.VonMises(angle, 2.0), obs=seen)


def test_one_path_is_exact():
    data, _ = phase_errors_data(links=8, paths=1)
    posterior = VonMisesEM(draws=20_000)(KEY, phase_errors, data)
    eta = 2.0 + 2 / 0.1 * np.einsum("lpf,lf->lp", data["response"].conj(), data["h"])
    np.testing.assert_allclose(posterior.extra["direction.phase"], np.angle(eta), atol=1e-9)
    np.testing.assert_allclose(posterior.extra["concentration.phase"], np.abs(eta), rtol=1e-9)
    resultant = np.exp(1j * posterior.flat("phase")).mean(0)
    np.testing.assert_allclose(resultant, ratio(np.abs(eta)) * np.exp(1j * np.angle(eta)), atol=0.03)


@pytest.mark.study
def test_two_paths_bound_the_evidence():
    data, _ = phase_errors_data(links=1, paths=2, noise=0.5)
    response, h = data["response"][0], data["h"][0]

    def joint(z):
        fit = np.sum(np.abs(h - np.exp(1j * np.asarray(z)) @ response) ** 2) / 0.5
        return -fit - 12 * np.log(np.pi * 0.5) + 2 * np.cos(z).sum() - 2 * (np.log(2 * np.pi) + log_i0(2.0))

    grid = np.linspace(-np.pi, np.pi, 200, endpoint=False)
    values = np.array([[joint((a, b)) for b in grid] for a in grid])
    weight = np.exp(values - values.max())
    evidence = values.max() + np.log(weight.mean() * (2 * np.pi) ** 2)
    posterior = VonMisesEM(draws=10)(KEY, phase_errors, data)
    gap = evidence + float(posterior.extra["free_energy"])
    assert 0 <= gap < 1.0
    # The free energy itself, by quadrature over q.
    mu, kappa = posterior.extra["direction.phase"][0], posterior.extra["concentration.phase"][0]
    log_q = kappa[:, None] * np.cos(grid - mu[:, None]) - log_i0(kappa)[:, None] - np.log(2 * np.pi)
    q = np.exp(log_q[0][:, None] + log_q[1])
    energy = np.sum(q * (log_q[0][:, None] + log_q[1] - values)) * (grid[1] - grid[0]) ** 2
    assert float(posterior.extra["free_energy"]) == pytest.approx(energy, rel=1e-6)


def learning(response, h=None):
    concentration = numpyro.sample("concentration", dist.LogNormal(0.0, 3.0))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 3.0))
    gain = numpyro.sample("gain", dist.LogNormal(0.0, 1.0))
    phase_errors(gain * response, concentration, noise, h)


@pytest.mark.study
def test_noise_concentration_and_gain_are_learnt():
    data, _ = phase_errors_data(links=150, paths=2, noise=0.05)
    posterior = VonMisesEM(draws=5)(KEY, learning, {"response": data["response"], "h": 1.7 * data["h"]})
    found = {name: posterior.draws[name][0, 0] for name in ("concentration", "noise", "gain")}
    assert found["gain"] == pytest.approx(1.7, rel=0.02)
    assert found["noise"] == pytest.approx(0.05 * 1.7**2, rel=0.1)
    history = posterior.extra["free_energy_history"]
    assert np.all(np.diff(history) <= 1e-6)
    # The concentration solves R(k) = mean of R cos mu, up to its (wide) prior.
    mean = np.mean(ratio(posterior.extra["concentration.phase"]) * np.cos(posterior.extra["direction.phase"]))
    assert ratio(found["concentration"]) == pytest.approx(mean, abs=2e-3)
    assert all(np.ptp(posterior.draws[name]) == 0 for name in found)


def enumerated(density, moments, rest, target):
    """E[log p] with half on each of mu +- delta of every angle, all combinations."""
    spread = np.arccos(moments.length)
    total = 0.0
    for signs in itertools.product((-1.0, 1.0), repeat=moments.length.size):
        angles = (moments.direction + np.reshape(signs, moments.length.shape) * spread).ravel()
        total += float(density(rest.at[target.angles].set(jnp.asarray(angles))))
    return total / 2**moments.length.size


@pytest.mark.study
def test_expectations_are_exact_for_couplings_of_pairs():
    def model(noise, y=None):
        with numpyro.plate("site", 5):
            z = numpyro.sample("z", dist.VonMises(0.3, 0.7))
        numpyro.factor("ring", 1.5 * jnp.sum(jnp.cos(z - jnp.roll(z, 1) - 0.4)))
        numpyro.sample("y", dist.Normal(0.0, noise), obs=y)

    target, inputs = build_target(model, {"noise": np.float64(2.0), "y": np.float64(0.7)})
    layout = find_layout(target, inputs, KEY)
    assert layout.table.shape == (1, 5)
    random = np.random.default_rng(0)
    moments = Resultants(*(jnp.asarray(random.uniform(0.1, 0.9, (1, 5))) for _ in range(2)))
    rest = jnp.zeros(target.dimension)
    exact = enumerated(jax.jit(lambda u: target.log_density(u, inputs)), moments, rest, target)
    assert float(expected_log_joint(target, layout, moments, rest, inputs)) == pytest.approx(exact, rel=1e-10)
    form = quadratic(target, layout, rest, inputs)
    assert float(form.constant + form.expectation(moments.vector)[0]) == pytest.approx(exact, rel=1e-10)


def test_links_that_do_not_meet_are_groups():
    data, _ = phase_errors_data(links=6, paths=3)
    target, inputs = build_target(phase_errors, data)
    layout = find_layout(target, inputs, KEY)
    assert layout.table.shape == (6, 3)
    np.testing.assert_array_equal(layout.table, np.arange(18).reshape(6, 3))


@pytest.mark.parametrize(
    ("density", "reason"),
    [
        (lambda z: jnp.cos(2 * z[0]), "affine in"),
        (lambda z: jnp.cos(z[0]) * jnp.cos(z[1]) * jnp.cos(z[2]), "couplings of pairs"),
        (lambda z: 0.1 * z[0] ** 2, "affine in"),
    ],
)
def test_other_models_are_refused(density, reason):
    def model(y=None):
        with numpyro.plate("site", 3):
            z = numpyro.sample("z", dist.VonMises(0.0, 1.0))
        numpyro.factor("term", density(z))
        numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)

    with pytest.raises(InputError, match=f"{reason}.*another dependence on 'z'.*exp"):
        VonMisesEM()(KEY, model, {"y": np.float64(0.0)})


def test_a_model_without_angles_is_refused():
    with pytest.raises(InputError, match="expected a latent site with circular support, got none"):
        VonMisesEM()(KEY, normal, normal_data())


def test_a_sharp_angle_hides_none_of_another_kind():
    def model(y, c):
        sharp = numpyro.sample("sharp", dist.VonMises(0.0, 1.0))
        other = numpyro.sample("other", dist.VonMises(0.0, 1.0))
        with numpyro.plate("reading", len(y)):
            numpyro.sample("y", dist.Normal(jnp.cos(sharp), 1e-3), obs=y)
        numpyro.sample("c", dist.Bernoulli(logits=3 * jnp.cos(2 * other)), obs=c)

    data = {"y": jnp.full(100, 0.8), "c": jnp.asarray(1)}
    with pytest.raises(InputError, match="another dependence on 'other'"):
        VonMisesEM()(jax.random.key(0), model, data)


def partly(response, seen, times, h=None):
    """Phase errors, some of whose observations are masked, and all count several times."""
    with numpyro.plate("path", response.shape[0]):
        phase = numpyro.sample("phase", dist.VonMises(0.0, 2.0))
    mean = jnp.exp(1j * phase) @ response
    with numpyro.plate("frequency", response.shape[1]), handlers.mask(mask=seen), handlers.scale(scale=times):
        numpyro.sample("h", ComplexNormal(mean, 0.1), obs=h)


def first_e_steps(response, seen, times, h):
    """Directions and concentrations by least squares."""
    target, inputs = build_target(partly, {"response": response, "seen": seen, "times": times, "h": h})
    layout = Layout(jnp.arange(3)[None], jnp.ones((1, 3)))
    start = least_squares_start(target, layout, jnp.zeros(3), inputs)
    return [start.direction, start.length, *reference_phases(target, layout, jnp.zeros(3), inputs)]


@pytest.mark.study
def test_least_squares_leave_out_what_is_masked_and_repeat_what_is_scaled():
    """Phases from masked or scaled observations are those from the others alone, or from each of them twice."""
    data, _ = phase_errors_data(links=1, paths=3)
    response, h, seen = data["response"][0], data["h"][0], np.arange(12) < 8
    masked = first_e_steps(response, seen, 1.0, np.where(seen, h, np.nan))
    few = first_e_steps(response[:, :8], seen[:8], 1.0, h[:8])
    scaled = first_e_steps(response, seen | True, 2.0, h)
    twice = first_e_steps(np.tile(response, 2), np.tile(seen | True, 2), 1.0, np.tile(h, 2))
    for found, expected in zip([*masked, *scaled], [*few, *twice], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
