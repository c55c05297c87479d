"""The phases of a network's twin in turn: collect, learn, control, hand over, monitor, diagnose, and again."""

from dtprob.workflow.loop.phases import Twin
from dtprob.workflow.loop.physical import Physical, connect
from dtprob.workflow.loop.run import advance, finished, history
from dtprob.workflow.loop.settings import LoopSection, PhysicalSection, TwinCase, load_twin_case
from dtprob.workflow.loop.state import State, begin, load, save

__all__ = [
    "LoopSection",
    "Physical",
    "PhysicalSection",
    "State",
    "Twin",
    "TwinCase",
    "advance",
    "begin",
    "connect",
    "finished",
    "history",
    "load",
    "load_twin_case",
    "save",
]
