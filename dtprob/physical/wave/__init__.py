"""Wave simulation in two dimensions: the field of a line source among rectangles, without rays.

`simulate(Scene2D(...), source, probes, frequency, duration=...)` gives what a channel sounder would measure.
"""

from dtprob.physical.wave.scene import AIR, CONCRETE, METAL, Medium, Rectangle, Scene2D
from dtprob.physical.wave.simulate import Cost, Response, cost, simulate

__all__ = [
    "AIR",
    "CONCRETE",
    "METAL",
    "Cost",
    "Medium",
    "Rectangle",
    "Response",
    "Scene2D",
    "cost",
    "simulate",
]
