"""The models of the package keep the contract that users' models can be checked against."""

from importlib import resources

import pytest

from dtprob.case import load_case
from dtprob.models.channel import phase_error_channel, ray_traced_channel
from dtprob.testing import check_effect, check_model
from dtprob.workflow import prepare


@pytest.fixture(scope="module")
def prepared():
    return prepare(load_case(str(resources.files("dtprob.data") / "demo" / "case.toml")), need="diagnosis")


@pytest.fixture(scope="module")
def few_links(prepared):
    data = dict(prepared.data)
    data["paths"], data["channel"] = data["paths"].take([0, 1, 2]), data["channel"][:3]
    return data


@pytest.mark.parametrize(
    "model", [pytest.param(ray_traced_channel, marks=pytest.mark.study), phase_error_channel]
)
def test_channel_models(model, few_links):
    data = {
        name: value for name, value in few_links.items() if model is ray_traced_channel or name != "phase"
    }
    check_model(model, data)


def test_an_effect_on_the_channel(prepared, few_links):
    effect = next(e for e in prepared.effects if e.name == "timing_offset")
    check_effect(effect, ray_traced_channel, few_links)
