"""Importing dtprob is quick and changes nothing."""

import json
import subprocess
import sys

import pytest

import dtprob

SNAPSHOT = """
import json, logging, os, sys, warnings
def state():
    handlers = len(logging.getLogger().handlers)
    return [dict(os.environ), [str(f) for f in warnings.filters], handlers, list(sys.path)]
before = state()
import dtprob
after = state()
print(json.dumps([before == after, sorted(sys.modules)]))
"""


def test_import_changes_nothing_and_loads_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", SNAPSHOT], capture_output=True, text=True, check=True)
    same, modules = json.loads(done.stdout)
    assert same
    assert done.stderr == ""
    heavy = {"jax", "numpy", "numpyro", "sionna", "mitsuba", "drjit", "pettingzoo", "matplotlib", "xarray"}
    assert not heavy & set(modules)


def test_rooms_are_found_by_name():
    assert dtprob.errors.__name__ == "dtprob.errors"
    assert dtprob.data.read is not None
    assert "data" in dir(dtprob)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = dtprob.nothing


def test_factors_work_where_arviz_was_imported_first():
    program = """
import arviz_stats.base
import dtprob.inference
import numpyro
from numpyro import handlers
trace = handlers.trace(lambda: numpyro.factor("loss", -1.0)).get_trace()
print(float(trace["loss"]["fn"].log_prob(trace["loss"]["value"])))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert float(done.stdout) == -1.0
