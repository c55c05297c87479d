"""summary.json: what is doubtful is said in a sentence, and nothing in it is NaN."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.inference import Posterior
from dtprob.inference.fit import fit
from dtprob.raytracing import storage
from dtprob.workflow import summary

DEMO = Path(__file__).parents[3] / "dtprob" / "data" / "demo"


def posterior(**draws: np.ndarray) -> Posterior:
    chains, length = next(iter(draws.values())).shape[:2]
    stats = {"diverging": np.zeros((chains, length), bool)}
    return Posterior(draws=draws, sample_stats=stats, latent=tuple(draws), circular=("angle",))


def test_good_chains_have_no_warnings():
    rng = np.random.default_rng(0)
    found = summary.summarise(posterior(a=rng.normal(size=(4, 500)), angle=rng.vonmises(3, 5, (4, 500, 2))))
    assert found["warnings"] == []
    assert list(found["parameters"]) == ["a", "angle[0]", "angle[1]"]
    assert found["parameters"]["angle[1]"]["kind"] == "circular"
    json.dumps(found, allow_nan=False)


def test_doubtful_chains_are_named():
    rng = np.random.default_rng(1)
    apart = rng.normal(size=(4, 100)) + 5 * np.arange(4)[:, None]
    doubtful = posterior(apart=apart)
    doubtful.sample_stats["diverging"][0, :3] = True
    warnings = summary.summarise(doubtful)["warnings"]
    assert warnings[0].startswith("3 of 400 draws diverged")
    assert warnings[1].startswith("The chains disagree on apart ")
    assert warnings[2].startswith("Fewer than 400 effective draws of apart")


def test_doubtful_approximations_are_named():
    draws = {"a": np.random.default_rng(3).normal(size=(1, 50))}
    extra = {"converged": np.asarray(False), "pareto_k": np.asarray(0.9)}
    warnings = summary.summarise(Posterior(draws=draws, latent=("a",), extra=extra))["warnings"]
    assert [text.split(" ")[1] for text in warnings] == ["search", "approximation"]
    extra = {"converged": np.asarray(True), "pareto_k": np.asarray(0.3)}
    assert summary.summarise(Posterior(draws=draws, latent=("a",), extra=extra))["warnings"] == []


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"replaced": 2}, "does not fall off in 2 directions"),
        ({"agreeing": 0.25}, "No two of the 4 starts"),
        ({"agreeing": 0.5, "replaced": 0}, None),
    ],
)
def test_what_laplace_says_of_its_mode_is_passed_on(facts, said):
    draws = {"a": np.random.default_rng(3).normal(size=(1, 50))}
    extra = {name: np.asarray(value) for name, value in facts.items()}
    made_by = {"engine": "laplace", "settings": {"starts": 4}}
    found = Posterior(draws=draws, latent=("a",), extra=extra, provenance=made_by)
    warnings = summary.summarise(found)["warnings"]
    assert len(warnings) == (said is not None)
    assert all(said in text for text in warnings)


def flat_in_one_direction(y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    idle = numpyro.sample("idle", dist.Normal(0.0, 1.0))
    numpyro.factor("flat", 0.5 * idle**2)
    numpyro.sample("y", dist.Normal(level, 1.0), obs=y)


def test_laplace_on_a_density_that_is_flat_in_one_direction():
    found = fit(flat_in_one_direction, {"y": jnp.zeros(())}, engine="laplace", key=jax.random.key(0))
    assert any(
        "does not fall off in 1 direction from" in text for text in summary.summarise(found)["warnings"]
    )


def test_a_mean_that_is_not_finite_is_told_of():
    draws = np.random.default_rng(3).normal(size=(1, 50))
    draws[0, 7] = np.inf
    found = summary.summarise(posterior(a=draws))
    assert "mean" not in found["parameters"]["a"]
    assert [text for text in found["warnings"] if "of a are not finite" in text]


def test_one_chain_and_large_sites():
    rng = np.random.default_rng(2)
    found = summary.summarise(posterior(a=rng.normal(size=(1, 50)), big=rng.normal(size=(1, 50, 40, 30))))
    assert found["not_summarised"] == ["big"]
    assert "rhat" not in found["parameters"]["a"]
    assert found["warnings"] == []
    json.dumps(found, allow_nan=False)


def test_entries_of_materials_have_names():
    paths = storage.load(DEMO / "paths.nc")
    names = summary.entry_names({"paths": paths})
    assert names == {"material": list(paths.material_names), "object": list(paths.object_names)}
    assert summary.entry_names({"paths": paths, "materials": "per_object"})["material"] == names["object"]
    assert summary.entry_names({"buffer": 1}) == {}
