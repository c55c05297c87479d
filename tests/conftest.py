"""Settings of the whole test suite: double precision, a sound compiler, kept programs, fixed examples, no silent skips."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from dtprob.threads import one_thread
from dtprob.xla import avoid_miscompilation

avoid_miscompilation()  # before jax is imported
one_thread()

import jax  # noqa: E402

from dtprob.commands.cache import LARGEST, prune  # noqa: E402

_COMPILED = Path(__file__).parents[1] / ".pytest_cache" / "compiled"

jax.config.update("jax_enable_x64", True)
# half of the suite's time is compiling, and many tests compile what another one has compiled
jax.config.update("jax_compilation_cache_dir", str(_COMPILED))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Keep the programs of earlier runs within bounds; a worker beside others leaves this to the first process."""
    if not hasattr(session.config, "workerinput"):
        prune(_COMPILED, LARGEST)


hypothesis.settings.register_profile("fixed", derandomize=True)
hypothesis.settings.load_profile("fixed")

_LEFT_OUT = "jax_disable_most_optimizations"
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 25_000
"""Memory regions of a process after which compiled programs are let go: each takes some, and Linux allows 65,530."""


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_let_go() -> Iterator[None]:
    """A process that runs many modules does not keep every program that it ever compiled."""
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True, scope="module")
def _compiled_quickly(request: pytest.FixtureRequest) -> Iterator[None]:
    """Most tests compile longer than they run: the compiler leaves most of its passes out, also in processes begun here.

    Statistical tests run longer, and compile as users' programs do.
    """
    is_short = "statistical" not in Path(str(request.node.path)).parts
    with pytest.MonkeyPatch.context() as patch:
        if is_short:
            patch.setenv(_LEFT_OUT.upper(), "true")
        jax.config.update(_LEFT_OUT, is_short)
        yield


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
