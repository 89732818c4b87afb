"""A generated estimator, compiled and loaded."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost, ObserverPrior, QuadraticCost
from ..errors import CompilationError, OptionError
from ..observers import HighGain, Luenberger, Observer, SteadyStateKalman
from ..settings import Settings
from ..system import System
from .compiler import compiled_library
from .layout import SET_NAMES, Layout, settings_record
from .source import CONTINUOUS, estimator_files

__all__ = ["EstimatorLibrary", "generated", "uncovered"]

# Indices in C are of type int.
_MOST_ENTRIES = 2**31 - 1
_CONSTANT_GAIN = (Luenberger, HighGain, SteadyStateKalman)


def uncovered(system: System, observer: Observer, cost: Cost, settings: Settings) -> str:
    """Why an estimator has no C form, with the remedy; empty if it has one.

    Parameters
    ----------
    system, observer, cost, settings
        The estimator's.
    """
    if system.symbolic is None:
        return "the system has no CasADi form; make it by qpmhe.System.from_casadi."
    if type(observer) not in _CONSTANT_GAIN:
        return (
            f"{type(observer).__name__} has no C form; take an observer with constant gain "
            "(Luenberger, SteadyStateKalman, HighGain)."
        )
    if type(cost) is not QuadraticCost:
        return f"{type(cost).__name__} has no C form; take a QuadraticCost."
    if isinstance(cost.prior, ObserverPrior):
        return "a prior weight from the observer has no C form; take a constant one."
    for name in SET_NAMES:
        one = getattr(system, name)
        if one is not None and (
            one.fixed_components.size or (one.row_lower == one.row_upper).any()
        ):
            return (
                f"the set of {name} has a direction of zero width, which the interior-point "
                "method in C cannot take; widen it."
            )
    entries = (settings.horizon + 1) * system.n * (2 * system.n + 32)
    if entries > _MOST_ENTRIES:
        return (
            f"a horizon of {settings.horizon} with {system.n} states needs {entries:.3g} entries "
            f"in one array, more than the {_MOST_ENTRIES:.3g} that C counts; take a shorter one."
        )
    if settings.backend not in ("auto", "banded"):
        return (
            f"the compiled step solves its QPs itself, not by {settings.backend!r}; take "
            "backend='auto', or 'banded' for QPs without inequalities."
        )
    if settings.subproblem != "qp":
        return "subproblem='exact' has no C form; take 'qp'."
    if settings.time_budget is not None:
        return (
            "the compiled step has no clock; bound it by max_qps and max_solver_iterations "
            "in place of time_budget."
        )
    return ""


def generated(
    system: System,
    observer: Observer,
    cost: Cost,
    settings: Settings,
    name: str = "mhe",
    real: str = "double",
) -> tuple[dict[str, str], str, Layout, NDArray[Any]]:
    """Source of an estimator, its structure, its layout and its settings.

    Parameters
    ----------
    system, observer, cost, settings
        The estimator's.
    name : str
        Prefix of public names.
    real : {"double", "float"}
        Precision.

    Raises
    ------
    OptionError
        If something has no C form; the text names it and the remedy.
    """
    reason = uncovered(system, observer, cost, settings)
    if reason:
        raise OptionError(f"no C code for this estimator: {reason}")
    model = system.symbolic
    assert model is not None
    assert isinstance(observer, _CONSTANT_GAIN)
    layout = Layout.of(system, settings.horizon, CONTINUOUS[model.method], real)
    record = settings_record(layout, system, observer, cost, settings)
    files, structure = estimator_files(model, layout, record, name)
    return files, structure, layout, record


class EstimatorLibrary:
    """Functions and structures of one compiled estimator.

    Parameters
    ----------
    system, observer, cost, settings
        The estimator's.

    Attributes
    ----------
    layout : Layout
        Its sizes.
    settings : structured array
        The ``mhe_settings`` in use; must outlive all estimators that point to it.
    update, update_special, update_members, amend, reset, run : ctypes functions
        The C functions of these names.

    Raises
    ------
    OptionError
        If something has no C form.
    CompilationError
        If it cannot be compiled or loaded.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings
    ) -> None:
        files, structure, layout, record = generated(system, observer, cost, settings)
        self.layout, self.settings = layout, record
        library = compiled_library(files, "mhe.c", structure)
        # Single steps are shorter than handing the interpreter's lock over; runs are not.
        quick = ctypes.PyDLL(library._name)
        self.estimator_type = layout.estimator_type()
        self.estimate_type = layout.estimate_type()
        self.workspace_size = self._check_sizes(quick)
        pointer, integer = ctypes.c_void_p, ctypes.c_int64
        self.update, self.update_special = quick.mhe_update, quick.mhe_update_special
        self.amend, self.reset, self.run = quick.mhe_amend, quick.mhe_reset, library.mhe_run
        self.update_members = library.mhe_update_members
        for function in (
            self.update, self.update_special, self.reset, self.run, self.update_members
        ):
            function.restype = None
        self.update_special.argtypes = [
            pointer, pointer, pointer, pointer, ctypes.c_double, pointer, pointer
        ]
        self.amend.argtypes = [pointer, pointer, integer, pointer, pointer]
        self.reset.argtypes = [pointer, pointer, pointer]
        self.update_members.argtypes = [pointer, integer, pointer, pointer, pointer, pointer]
        self.run.argtypes = [pointer, integer, pointer, integer, pointer, pointer, pointer]

    def _check_sizes(self, library: ctypes.PyDLL) -> int:
        """Insist that C and NumPy lay the structures out alike; the workspace's size."""
        sizes = np.zeros(4, np.int64)
        library.mhe_sizes.restype = None
        library.mhe_sizes(ctypes.c_void_p(sizes.ctypes.data))
        mine = [
            self.estimator_type.itemsize, self.estimate_type.itemsize, self.settings.dtype.itemsize
        ]
        found = [int(sizes[0]), int(sizes[2]), int(sizes[3])]
        if mine != found:
            raise CompilationError(
                f"the compiler lays structures out in {found} bytes; expected {mine}. "
                "Take engine='python' here."
            )
        return int(sizes[1])

    def workspace(self) -> NDArray[np.uint8]:
        """Scratch for the estimators of one thread."""
        return np.zeros(self.workspace_size, np.uint8)

    def estimators(self, states: NDArray[np.float64]) -> NDArray[Any]:
        """Memory of one estimator for each row of initial states, reset.

        Parameters
        ----------
        states : (K, n) array
            Where they start.
        """
        memory = np.zeros(len(states), self.estimator_type)
        base, size = memory.ctypes.data, self.estimator_type.itemsize
        for i, state in enumerate(np.ascontiguousarray(states)):
            self.reset(base + i * size, self.settings.ctypes.data, state.ctypes.data)
        return memory
