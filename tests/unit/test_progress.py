"""Telling the progress: on a terminal, and where nobody reads it."""

import io
import os
import sys
import time

from dtprob.commands import progress
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


def test_a_long_step_is_told_again(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SILENCE", 0.05)
    with telling() as say:
        say("screening 209 effects")
        say("note: a prior is wrong")
        time.sleep(0.5)
    told = capsys.readouterr().out.splitlines()
    assert told[1].endswith("note: a prior is wrong")
    assert told[2].endswith("still at: screening 209 effects")
    time.sleep(0.2)
    assert not capsys.readouterr().out
