"""Figures. Matplotlib is imported when the first one is drawn.

Every function takes the axes that it draws into, or makes a figure, and returns the axes.
"""

from .bounds import error_and_bounds
from .steps import costs, outcomes, step_times
from .style import save
from .trajectories import states, trajectories, window

__all__ = [
    "costs", "error_and_bounds", "outcomes", "save", "states", "step_times", "trajectories",
    "window",
]
