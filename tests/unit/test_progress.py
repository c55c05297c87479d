"""Telling the progress: on a terminal, and where nobody reads it."""

import io
import os
import sys

from dtprob.commands.progress import telling


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_names_in_brackets_are_told_on_a_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Terminal())
    with telling() as say:
        say("LISTED: device_disconnected[device_1], see case.toml [engine] and [/results]")
    told = " ".join(sys.stdout.getvalue().split())
    assert "device_disconnected[device_1], see case.toml [engine] and [/results]" in told


def test_the_work_goes_on_where_nobody_reads(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with telling() as say:
            say("a step")
            say("the next one")


def test_the_work_goes_on_where_standard_output_is_closed(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with telling() as say:
        say("a step")
