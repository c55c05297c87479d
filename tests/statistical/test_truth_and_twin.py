"""Truth and twin are written apart; with the true parameters and no effect they must still agree."""

import jax
import numpy as np
import pytest
from numpyro import handlers

from dtprob.effects.library import FAMILIES as LIBRARY
from dtprob.models.channel import ray_traced_channel
from dtprob.physical.campaign import Plan, make_site
from dtprob.physical.choose import FOREIGN, LISTED

PLAN = Plan(links=6, subcarriers=8)


def test_the_library_has_what_cases_call_listed_and_not_what_is_foreign():
    assert set(LISTED) <= set(LIBRARY)
    assert not set(FOREIGN) & set(LIBRARY)


@pytest.mark.libllvm
@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1])
def test_a_null_case_holds_nothing_that_a_fit_could_notice(seed):
    site = make_site(np.random.default_rng(seed), PLAN)
    names = site.paths.material_names
    materials = [site.setting.materials[name] for name in names]
    substitutes = {
        "material_permittivity": np.array([one.permittivity for one in materials]),
        "material_conductivity": np.array([one.conductivity for one in materials]),
    }
    twin = handlers.substitute(handlers.seed(ray_traced_channel, jax.random.key(0)), data=substitutes)
    mean = twin(
        paths=site.paths,
        subcarrier_frequency=PLAN.sounding.subcarrier_frequency,
        rx_array=site.nominal.rx_array,
        tx_array=site.nominal.tx_array,
        noise_power=site.recorded_noise,
        snapshot_time=PLAN.sounding.snapshot_time,
    )
    difference = np.asarray(mean) - site.bench.base.mean
    assert 2 * np.sum(np.abs(difference) ** 2) / site.bench.noise_power < 0.05
    assert np.mean(np.abs(site.bench.base.mean) ** 2) == pytest.approx(100 * site.bench.noise_power)
