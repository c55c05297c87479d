"""dtprob: probabilistic programming for digital twins of wireless systems.

Declare a generative model of the physical twin in NumPyro, infer its posterior with the engine that suits,
and use the posterior: to control, monitor, predict, collect data, and find out why reality differs from it.

The rooms are imported when they are first named, so ``import dtprob`` itself is quick and changes nothing.
"""

import importlib
import importlib.util
from typing import Any

__version__ = "0.1.0"

_ROOMS = (
    "case",
    "cli",
    "commands",
    "control",
    "data",
    "effects",
    "errors",
    "files",
    "gap",
    "inference",
    "models",
    "physical",
    "raytracing",
    "report",
    "reproduce",
    "testing",
    "twin",
    "workflow",
)
_FUNCTIONS = {
    "configure": "precision",
    "diagnose": "gap.diagnose",
    "fit": "inference.fit",
    "model": "models.declaration",
}
"""For each function at the top, the module that has it."""


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"{__name__}.{_FUNCTIONS[name]}"), name)
    if name in _ROOMS and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_ROOMS, *_FUNCTIONS])
