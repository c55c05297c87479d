"""What docs/ray_tracing.md says is executed."""

import re
from pathlib import Path

import numpy as np
import pytest

TEXT = (Path(__file__).parents[2] / "docs" / "ray_tracing.md").read_text()


def test_its_code_runs():
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict[str, object] = {}
    with pytest.warns(
        RuntimeWarning, match="no path touches the material of building_1, building_5, building_2"
    ):
        exec(compile(block, "ray_tracing.md", "exec"), names)  # noqa: S102  (our own text)
    power = np.asarray(names["power"])
    assert power.shape == (names["paths"].n_link,)
    assert np.all(power > 0)
    assert np.all(np.asarray(names["found"].permittivity) > 1)
