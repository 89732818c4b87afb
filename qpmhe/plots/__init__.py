"""Figures. Matplotlib is imported when the first one is drawn.

Every function takes the axes that it draws into, or makes a figure, and returns the axes.
`COLORS` has the colours of truth, measurement, observer and estimate.
"""

from .bounds import error_and_bounds
from .steps import costs, outcomes, step_times
from .style import COLORS, save
from .trajectories import states, trajectories, window

__all__ = [
    "COLORS", "costs", "error_and_bounds", "outcomes", "save", "states", "step_times",
    "trajectories", "window",
]
