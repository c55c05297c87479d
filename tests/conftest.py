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
