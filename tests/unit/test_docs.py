"""What the documentation of one's own models and effects says is executed."""

import re
from pathlib import Path

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
