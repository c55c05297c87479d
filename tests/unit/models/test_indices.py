"""Whole numbers in data that point into a model's arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import dtprob
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.inference import Laplace
from dtprob.models.indices import check_indices

SITES = 5


def levels(site, y=None, *, how="plain"):
    """A level for each of five sites."""
    with numpyro.plate("sites", SITES):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    index = jnp.clip(site, 0, SITES - 1) if how == "held" else site
    mean = numpyro.deterministic("mean", level[index])
    with numpyro.plate("row", site.shape[0]):
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def table(largest, kind=int):
    site = np.arange(30).astype(kind) % (largest + 1)
    return {"site": site, "y": np.zeros(30)}


@pytest.mark.parametrize("kind", [int, np.int16, np.uint32])
def test_indices_within_an_array_pass(kind):
    check_indices(levels, table(SITES - 1, kind))


def test_the_column_the_array_and_the_index_are_named():
    with pytest.raises(
        InputError, match=r"data 'site': expected indices from 0 to 4 of an array of 5, got 5\."
    ):
        check_indices(levels, table(SITES))


def test_an_index_that_is_held_on_purpose_passes():
    check_indices(levels, {**table(SITES + 3), "how": "held"})


def test_a_last_entry_counted_from_the_end_passes_and_one_before_the_first_does_not():
    data = table(SITES - 1)
    data["site"][3] = -1
    check_indices(levels, data)
    data["site"][3] = -6
    with pytest.raises(InputError, match="indices from 0 to 4"):
        check_indices(levels, data)


def test_lists_are_columns_too():
    with pytest.raises(InputError, match="'site'"):
        check_indices(levels, {"site": [0, 5], "y": np.zeros(2)})


def test_neither_fit_nor_diagnosis_takes_another_entry_without_a_word():
    with pytest.raises(InputError, match="'site'"):
        dtprob.fit(levels, table(SITES), engine="laplace", key=jax.random.key(0))
    with pytest.raises(InputError, match="'site'"):
        diagnose(levels, table(SITES), key=jax.random.key(0), engine=Laplace(), cluster="site")
