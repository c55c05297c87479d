"""What `diagnose` is given: candidates by name, single precision, and one clear line for what it cannot use."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import dtprob
from dtprob.errors import InputError
from dtprob.gap.keys import key_for
from dtprob.gap.model.masked import counted
from dtprob.gap.settings import Settings
from dtprob.models.arguments import doubled

KEY = jax.random.key(0)
QUICK = Settings(replicates=50, site_replicates=19, site_times=1)


def line(x, y=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    mean = numpyro.deterministic("mean", level + slope * x)
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


def data(dtype=float):
    rng = np.random.default_rng(0)
    x = rng.normal(size=80)
    return {"x": jnp.asarray(x, dtype), "y": jnp.asarray(1.0 + 2.0 * x + 0.5 * rng.normal(size=80), dtype)}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"key": 0}, r"key: expected one typed JAX key, got int.*jax\.random\.key\(seed\)"),
        ({"settings": {"level": 0.01}}, r"settings of a diagnosis: expected Settings, got dict"),
        ({"reference": {"slope": np.zeros(3)}}, r"reference of a diagnosis: expected a posterior, got dict"),
        ({"effects": ["tilted"]}, r"effect.* got 'tilted'"),
        ({"effects": "tilted"}, r"effect.* got 'tilted'"),
        ({"engine": "laplac"}, r"Did you mean 'laplace'"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(arguments, said):
    with pytest.raises(InputError, match=said):
        dtprob.diagnose(line, data(), **{"key": KEY, **arguments})


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        *(("level", v) for v in (0.0, 1.0, 3, "0.01", float("nan"))),
        *(("folds", v) for v in (1, -1, 4.0, True)),
        *(("relevance", v) for v in (-0.1, 1.1, None)),
        *(("tolerance_db", v) for v in (0.0, -3.0, float("inf"))),
        *(("replicates", 19), ("site_replicates", 0), ("candidates", 0), ("remainder", "yes")),
    ],
)
def test_settings_out_of_their_range_are_refused(setting, value):
    with pytest.raises(InputError, match=f"settings of a diagnosis: {setting}: expected"):
        Settings(**{setting: value})


def test_settings_at_the_ends_of_their_ranges_are_taken():
    assert Settings(relevance=0, minor=1.0, polished=0, tolerance_db=None, folds=2).relevance == 0


def test_candidates_are_taken_by_name():
    by_name = dtprob.diagnose(line, data(), "all", key=KEY, settings=QUICK)
    assert by_name.verdict == "NO_GAP"


def test_single_precision_is_no_less_sure():
    """Notebooks are in single precision unless they ask for double: the diagnosis computes in double all the same."""
    found = {}
    for double in (False, True):
        with jax.enable_x64(double):
            found[double] = dtprob.diagnose(line, data(np.float32), key=KEY, settings=QUICK).to_report()
            assert jax.numpy.ones(()).dtype == (jnp.float64 if double else jnp.float32)
    assert found[True] == found[False]


def test_named_keys_are_those_of_no_split():
    children = jax.random.key_data(jax.random.split(KEY, 4000))
    named = [jax.random.key_data(key_for(KEY, f"step {i}")) for i in range(20)]
    assert len({tuple(map(int, k)) for k in [*children, *named]}) == 4020


def test_chains_in_threads_have_the_same_precision():
    """Threads have a precision of their own: NUTS, asked for in a notebook of single precision, ended the diagnosis."""
    with jax.enable_x64(False):
        given = data(np.float32)
        with jax.enable_x64(True):
            posterior = dtprob.fit(
                line, doubled(given), engine="nuts", key=KEY, chains=2, draws=20, warmup=20
            )
    assert posterior.draws["slope"].dtype == np.float64


def test_columns_keep_their_order_and_become_double():
    given = {"z": np.float16(1.5), "a": jnp.ones(2, jnp.complex64), "n": np.arange(3), "word": "x"}
    found = doubled(given)
    assert list(found) == ["z", "a", "n", "word"]
    assert [getattr(v, "dtype", None) for v in found.values()] == [np.float64, np.complex128, np.int64, None]


def padded(ok, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    with numpyro.plate("group", 8, dim=-2), numpyro.plate("slot", 12, dim=-1), numpyro.handlers.mask(mask=ok):
        jitter = numpyro.sample("jitter", dist.Normal(0.0, 1.0))
        mean = numpyro.deterministic("mean", level + jitter)
        numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


def test_padded_rows_of_groups_are_no_gap_and_whole_masks_stay():
    rng = np.random.default_rng(2)
    ok = np.arange(12) < rng.integers(6, 13, 8)[:, None]
    given = {"ok": jnp.asarray(ok), "y": jnp.asarray(rng.normal(1.0, 1.25**0.5, (8, 12)))}
    assert dtprob.diagnose(padded, given, key=KEY, settings=QUICK).verdict == "NO_GAP"
    assert counted(padded, given) is not padded

    def whole(y=None):
        numpyro.sample(
            "y", dist.Normal(numpyro.sample("free", dist.Normal(0.0, 1.0).mask(False)), 1.0), obs=y
        )

    assert counted(whole, {"y": jnp.ones(())}) is whole


def test_obs_mask_is_refused_with_what_to_do():
    def masked(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 5.0))
        with numpyro.plate("row", 8):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y, obs_mask=jnp.arange(8) > 2)

    with pytest.raises(InputError, match=r"observed site 'y': expected no obs_mask.*handlers\.mask"):
        dtprob.diagnose(masked, {"y": jnp.ones(8)}, key=KEY, settings=QUICK)
