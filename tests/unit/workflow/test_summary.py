"""summary.json: what is doubtful is said in a sentence, and nothing in it is NaN."""

import json
from pathlib import Path

import numpy as np

from dtprob.inference import Posterior
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
