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


MEANT = {
    "held": lambda level, site: level[jnp.clip(site, 0, SITES - 1)],
    "filled": lambda level, site: level.at[site].get(mode="fill", fill_value=0.0),
    "taken": lambda level, site: jnp.take(level, site, mode="clip"),
    "added": lambda level, site: level.mean() + jnp.zeros(SITES).at[site].add(1.0).sum() + 0.0 * site,
    "summed": lambda level, site: (
        level.mean() + jax.ops.segment_sum(1.0 * site, site, SITES).sum() + 0.0 * site
    ),
}
"""Ways that say themselves what happens beyond the end."""


def levels(site, y=None, *, how="plain"):
    """A level for each of five sites."""
    with numpyro.plate("sites", SITES):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    mean = numpyro.deterministic("mean", MEANT[how](level, site) if how in MEANT else level[site])
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


@pytest.mark.parametrize("how", MEANT)
def test_what_says_itself_what_happens_beyond_the_end_passes(how):
    check_indices(levels, {**table(SITES + 3), "how": how})


def test_an_index_that_no_column_holds_passes():
    def of_level(day, y=None):
        level = numpyro.sample("level", dist.Normal(30.0, 1.0))
        mean = jnp.arange(4.0)[jnp.floor(level).astype(int)] + 0.0 * day
        with numpyro.plate("row", len(day)):
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)

    check_indices(of_level, {"day": np.arange(9) % 3, "y": np.zeros(9)})


def test_what_is_wrong_with_arguments_is_told_first():
    for given in ({**table(3), "opr": 1}, {"y": np.zeros(30), "cell": np.arange(30)}):
        with pytest.raises(InputError, match="data for levels"):
            diagnose(levels, given, key=jax.random.key(0))


def test_what_cannot_be_traced_is_left_to_others():
    def sized(site, y=None):
        with numpyro.plate("sites", int(site.max()) + 1):
            numpyro.sample("level", dist.Normal(0.0, 1.0))

    check_indices(sized, table(SITES))


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


def test_of_columns_that_hold_the_number_the_one_that_points_is_named():
    """A count of packets may be as large as a wrong number of a site."""

    def counted(packets, site, y=None):
        return levels(site, y - 0.0 * packets if y is not None else None)

    data = {"packets": jnp.array([7, 3, 6]), "site": jnp.array([0, 7, 1]), "y": jnp.zeros(3)}
    with pytest.raises(InputError, match="'site'"):
        check_indices(counted, data)
