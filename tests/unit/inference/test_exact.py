"""The exact engine: counts from the model itself, closed forms, refusals, agreement with NUTS."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import special

from dtprob.errors import InputError
from dtprob.inference import LATENTS_ONLY, NUTS, Point
from dtprob.inference.exact import DirichletTables, Exact
from dtprob.models.dirichlet import LogDirichlet
from dtprob.models.factored import Factor, Logistic, Table, factored
from dtprob.models.multi_access import multi_access, priors, records, window_counts
from tests.small_network import CLUSTERS, simulate

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def arguments():
    return {**records(simulate(60, 1), clusters=CLUSTERS), "concentration": 1.0}


@pytest.fixture(scope="module")
def posterior(arguments):
    return Exact(draws=4000)(KEY, multi_access, arguments)


@pytest.mark.study
def test_counts_are_found_from_the_model(arguments, posterior):
    for name, counts in window_counts(arguments).items():
        free = (priors(arguments["clusters"], 1.0)[name] > 0).sum(axis=-1, keepdims=True) > 1
        np.testing.assert_allclose(posterior.extra[f"counts.{name}"], counts.sum(axis=0) * free, atol=1e-6)


@pytest.mark.study
def test_draws_have_the_moments_of_the_closed_form(arguments, posterior):
    counts = {name: value.sum(axis=0) for name, value in window_counts(arguments).items()}
    law = DirichletTables(priors(arguments["clusters"], 1.0)).updated(counts)
    for name, a in law.concentration.items():
        mask = a > 0
        total = np.broadcast_to(a.sum(axis=-1, keepdims=True), a.shape)
        draws = posterior.flat(name)
        mean = np.where(mask, special.digamma(np.where(mask, a, 1)) - special.digamma(total), 0)[mask]
        sd = np.sqrt(np.maximum(special.polygamma(1, a[mask]) - special.polygamma(1, total[mask]), 0))
        np.testing.assert_array_less(
            np.abs(draws[:, mask].mean(axis=0) - mean), 4.5 * sd / np.sqrt(len(draws)) + 1e-9
        )
        assert np.all(np.isneginf(draws[:, ~mask]))


def test_evidence_is_the_chain_rule_of_predictions():
    def coin(y=None):
        table = numpyro.sample("table", LogDirichlet(0.5, np.ones(3, dtype=bool)))
        with numpyro.plate("toss", 4):
            numpyro.sample("y", dist.Categorical(logits=table), obs=y)

    y = jnp.array([0, 2, 2, 0])
    evidence = float(Exact(draws=10)(KEY, coin, {"y": y}).extra["log_evidence"])
    assert evidence == pytest.approx(np.log((0.5 / 1.5) * (0.5 / 2.5) * (1.5 / 3.5) * (1.5 / 4.5)), rel=1e-6)


@pytest.mark.study
def test_agrees_with_nuts():
    rng = np.random.default_rng(0)
    columns = {"a": rng.integers(0, 2, (1, 40)), "b": rng.integers(0, 3, (1, 40))}
    model = factored([Factor("b", "b", ("a",), Table("log_b", {"a": 2}, 3, 0.8))])
    exact = Exact(draws=4000)(KEY, model, columns).flat("log_b")
    nuts = NUTS(warmup=300, draws=1000, chains=2)(KEY, model, columns).flat("log_b")
    error = np.sqrt(exact.var(axis=0) / 4000 + nuts.var(axis=0) / 500)
    np.testing.assert_array_less(np.abs(exact.mean(axis=0) - nuts.mean(axis=0)), 5 * error)


@pytest.mark.study
def test_mode_is_the_textbooks(arguments):
    data = {**arguments, "concentration": 1.01}
    point = Point()(KEY, multi_access, data).flat("log_arrival")[0]
    counts = window_counts(arguments)["log_arrival"].sum(axis=0) + 0.01
    np.testing.assert_allclose(np.exp(point), counts / counts.sum(axis=-1, keepdims=True), atol=1e-4)


def test_refuses_what_is_not_conjugate():
    columns = {"a": np.ones((1, 5), int), "b": np.zeros((1, 5), int)}
    logistic = factored([Factor("b", "b", ("a",), Logistic("w", ("a",), 2))])
    with pytest.raises(InputError, match="expected Dirichlet tables under counts, or a normal posterior"):
        Exact()(KEY, logistic, columns)

    def tempered(y=None):
        table = numpyro.sample("table", LogDirichlet(1.0, np.ones(2, dtype=bool)))
        numpyro.sample("y", dist.Categorical(logits=0.5 * table), obs=y)

    with pytest.raises(InputError, match="product of powers of the tables' entries"):
        Exact()(KEY, tempered, {"y": jnp.array(1)})


def test_a_sharp_unknown_hides_none_that_is_not_normal():
    """4,000 readings tell `a` to 2e-4; ten outcomes of logit b leave a skew posterior, of mean 3.96."""

    def model(y, c):
        a, b = numpyro.sample("a", dist.Normal(0.0, 1.0)), numpyro.sample("b", dist.Normal(0.0, 3.0))
        with numpyro.plate("reading", len(y)):
            numpyro.sample("y", dist.Normal(a, 0.01), obs=y)
        with numpyro.plate("outcome", len(c)):
            numpyro.sample("c", dist.Bernoulli(logits=b), obs=c)

    data = {"y": jnp.asarray(0.01 * np.random.default_rng(0).normal(size=4000)), "c": jnp.ones(10, int)}
    with pytest.raises(InputError, match="a log density that is not quadratic"):
        Exact()(KEY, model, data)


def test_a_closed_form_compiles_few_programs():
    """Concentrations and the points of the check are no draws of JAX, which compiles a program for each shape."""
    compiled = []

    def note(event, *_, **__):
        compiled.append(event)

    data = records(simulate(60, 1), clusters=((0, 1, 2), (3,)), window=13)
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        Exact(draws=50)(KEY, multi_access, data, options=LATENTS_ONLY)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert 0 < compiled.count("/jax/core/compile/backend_compile_duration") < 130


def test_a_concentration_that_varies_with_another_table_is_refused():
    def nested(y=None):
        first = numpyro.sample("first", LogDirichlet(1.0, np.ones(3, dtype=bool)))
        second = numpyro.sample("second", LogDirichlet(1.0 + jnp.exp(first[1]), np.ones(2, dtype=bool)))
        with numpyro.plate("toss", 4):
            numpyro.sample("y", dist.Categorical(logits=second), obs=y)

    with pytest.raises(InputError, match="concentrations that are known, got one that varies at 'second'"):
        Exact()(KEY, nested, {"y": jnp.array([0, 1, 0, 0])})


@pytest.mark.parametrize("is_log", [False, True])
def test_tables_of_a_plain_dirichlet_are_told_how_to_be_exact(is_log):
    before, after = np.array([0, 0, 1, 1, 1, 0]), np.array([0, 1, 1, 1, 0, 1])

    def model(before, after=None):
        if is_log:
            logits = numpyro.sample("p", LogDirichlet(1.0, np.ones((2, 2), bool)))
        else:
            logits = jnp.log(numpyro.sample("p", dist.Dirichlet(jnp.ones(2)).expand([2]).to_event(1)))
        with numpyro.plate("slot", before.shape[0]):
            numpyro.sample("after", dist.Categorical(logits=logits[before]), obs=after)

    given = {"before": before, "after": after}
    if not is_log:
        with pytest.raises(
            InputError, match=r"Sample tables of log probabilities from dtprob\.models\.dirichlet"
        ):
            Exact()(KEY, model, given)
        return
    draws = np.exp(Exact(draws=4000)(KEY, model, given).draws["p"])
    np.testing.assert_allclose(draws.mean(axis=(0, 1)), [[2 / 5, 3 / 5], [2 / 5, 3 / 5]], atol=0.02)
