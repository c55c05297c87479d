"""The verdict in one sentence."""

from types import SimpleNamespace

import pytest

from dtprob.gap.compose import summary


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ([("a",), ("b",)], "There is a gap, but the data cannot tell a or b apart."),
        ([("a", "b"), ("c",)], "There is a gap, but the data cannot tell a and b or c apart."),
        (
            [("a", "b"), ("c", "a")],
            "The gap comes from a together with b or c, and the data cannot tell which.",
        ),
        ([("a",), ("a", "b")], "The gap comes from a, perhaps together with b: the data cannot tell."),
        ([("a",)], "There are signs of a, but held-out data do not confirm that it closes a gap."),
    ],
)
def test_what_explanations_share_is_said_first(sets, said):
    cause = SimpleNamespace(effects=sets[0], alias_class=sets, closed_fraction=None)
    assert summary("UNDETERMINED", (cause,), SimpleNamespace()) == said
