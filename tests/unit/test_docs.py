"""What the documentation of one's own models and effects says is executed."""

import re
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[2] / "docs" / "declaring.md").read_text()


def test_a_model_and_effects_of_ones_own(capsys):
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(block, "declaring.md", "exec"), names)  # noqa: S102  (our own text)
    said = capsys.readouterr().out
    assert "The gap comes from antenna_tilt" in said
    assert "dB/m" in said
    size = names["found"].causes[0].size[0]  # pyright: ignore[reportAttributeAccessIssue]
    assert size.low < -0.4 < size.high


@pytest.mark.parametrize("page", ["declaring", "ray_tracing"])
def test_jax_is_set_up_before_a_part_of_dtprob_starts_it(page):
    text = (Path(__file__).parents[2] / "docs" / f"{page}.md").read_text()
    code = "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    assert code.index("dtprob.configure()") < code.index("from dtprob.")
