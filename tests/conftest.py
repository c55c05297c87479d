"""Settings of the whole test suite: double precision, a sound compiler, and no silent skips on CI."""

import os

import pytest

from dtprob.xla import avoid_miscompilation

avoid_miscompilation()  # before jax is imported

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    """With CI=true a test that needs libLLVM or the measured data fails where it would have been skipped."""
    report = yield
    needs = item.get_closest_marker("libllvm") or item.get_closest_marker("measured")
    if report.skipped and needs and not hasattr(report, "wasxfail") and os.environ.get("CI") == "true":
        report.outcome = "failed"
        report.longrepr = (
            f"skipped on CI, where '{needs.name}' must be there: {call.excinfo and call.excinfo.value}"
        )
    return report


KNOWN_DEFECTS = (
    "test_every_effect.py::test_all_together_compile_and_compose",
    "test_checks.py::test_broken_models[fails_for_some-expected",
    "test_checks.py::test_good_effects[mean]",
    "test_checks.py::test_good_effects[variance]",
    "test_checks.py::test_broken_effects[changes6-finite]",
)
"""Tests that fail for a known reason that is not mended yet."""


def pytest_collection_modifyitems(items: list[pytest.Item]):
    """Expect the known defects, so that a new one stands out."""
    for item in items:
        if any(name in item.nodeid for name in KNOWN_DEFECTS):
            item.add_marker(pytest.mark.xfail(reason="known defect", strict=False))
