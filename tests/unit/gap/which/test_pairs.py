"""The best pairs of effects by scores and information, against enumeration in closed form."""

import itertools

import numpy as np
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.gap.fitting.plausible import log_bayes_factor
from dtprob.gap.which.pairs import best_pairs


def effect(name, size=1):
    prior = dist.Normal(0.0, 1.0) if size == 1 else dist.Normal(0.0, 1.0).expand([size]).to_event(1)
    return Effect(name, {"mean": lambda value, p, context: value + p["size"]}, (Parameter("size", prior),))


@pytest.fixture(scope="module")
def scores():
    """Ten effects of one or two parameters on 200 rows; the data hold the third and the eighth, which hide one another."""
    rng = np.random.default_rng(4)
    sizes = [1, 2, 1, 1, 2, 1, 1, 1, 2, 1]
    stops = np.cumsum([0, *sizes])
    groups = tuple(np.arange(low, high) for low, high in itertools.pairwise(stops))
    columns = rng.normal(size=(200, stops[-1]))
    third, eighth = groups[2][0], groups[7][0]
    columns[:, eighth] = -0.9 * columns[:, third] + 0.45 * columns[:, eighth]
    data = 1.5 * columns[:, third] + 1.5 * columns[:, eighth] + rng.normal(size=200)
    effects = tuple(effect(f"e{i}", size) for i, size in enumerate(sizes))
    return effects, groups, columns.T @ columns, columns.T @ data


def alone(effects, groups, information, score):
    return np.array(
        [
            log_bayes_factor(information[np.ix_(g, g)], score[g], np.ones(e.dimension))
            for e, g in zip(effects, groups, strict=True)
        ]
    )


def test_a_pair_that_hides_itself_is_found(scores):
    single = alone(*scores)
    found = best_pairs(*scores, single, price=np.zeros(len(single)))
    assert found[0].names == ("e2", "e7")
    assert found[0].log_bayes_factor > single.max() + 5
    assert set(np.argsort(-single)[:2].tolist()) != {2, 7}  # one after another would not begin with both


def test_pairs_are_those_of_enumeration(scores):
    effects, groups, information, score = scores
    every = {}
    for i, j in itertools.combinations(range(len(effects)), 2):
        both = np.concatenate([groups[i], groups[j]])
        part, own = information[np.ix_(both, both)], score[both]
        every[f"e{i}", f"e{j}"] = log_bayes_factor(part, own, np.ones(len(both)))
    ranked = sorted(every, key=lambda names: -every[names])
    single = alone(*scores)
    found = best_pairs(*scores, single, price=np.zeros(len(single)))
    assert [pair.names for pair in found] == ranked[: len(found)]
    np.testing.assert_allclose([p.log_bayes_factor for p in found], [every[p.names] for p in found])
