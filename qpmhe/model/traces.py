"""The trace of a system: its functions as CasADi expressions, and whether they still hold."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import EngineWarning
from .evaluation import Evaluator, VirtualMachine
from .expressions import CasadiModel, import_casadi
from .functions import BatchedFunction
from .sets import ConvexSet
from .tracing import Traced, difference, traced

Array = NDArray[np.float64]
Points = list[tuple[Array, Array]]

# Magnitudes of points and the least share of them, usual ones first.
_USUAL = ((1.0, 0.2), (1.0, -1.0), (0.3, -1.0), (3.0, -1.0), (0.1, 0.2), (1.0, 0.2))
_UNUSUAL = ((10.0, -1.0), (30.0, 0.2), (0.01, -1.0), (1e-3, 0.2), (1e-6, -1.0), (100.0, -1.0),
            (1e3, 0.2), (1e4, -1.0))
# The function takes longer in CasADi's virtual machine, and in a compiler, than it is worth.
_MOST_OPERATIONS = 20_000


def points(
    states: ConvexSet | None, n: int, m: int, scales: Array | float = 1.0, usual: bool = False,
) -> Points:
    """Random points (x, u) of several magnitudes, within the bounds of X."""
    generator = np.random.default_rng(20210829)
    found: Points = []
    for scale, least in (*_USUAL, *(() if usual else _UNUSUAL)):
        for _ in range(2):
            x = scales * (scale * generator.uniform(least, 1.0, n))
            if states is not None:
                low, high = states.lower, states.upper
                both = np.isfinite(low) & np.isfinite(high)
                share = generator.uniform(0.0, 1.0, n)
                with np.errstate(invalid="ignore"):
                    x = np.where(both, low + share * (high - low), np.clip(x, low, high))
            found.append((x, min(scale, 100.0) * generator.uniform(least, 1.0, m)))
    return found


class ModelTrace:
    """f (the rate, where there is a step length) and h as expressions, found when first needed.

    Finding them takes some milliseconds, and the first time in a process as long as CasADi takes
    to be imported. All copies of a system share it. Functions that have changed since, as
    closures can, are traced again.

    Parameters
    ----------
    f, h : BatchedFunction
        The functions.
    n, p, m : int
        Numbers of states, outputs and inputs.
    states : ConvexSet or None
        X, in which trace and function are compared.
    dt, method : optional
        Where f is a rate: the step length, and the discretisation.
    """

    def __init__(
        self, f: BatchedFunction, h: BatchedFunction, n: int, p: int, m: int,
        states: ConvexSet | None, dt: float | None = None, method: str | None = None,
    ) -> None:
        self._functions = {"f": _of_both(f), "h": _of_both(h)}
        self._n, self._p, self._m, self._states = n, p, m, states
        self._dt, self._method = dt, method
        self._lock = threading.RLock()
        self._found: dict[str, Traced] | None = None
        self._model: CasadiModel | None = None
        self._evaluators: dict[bool, Evaluator] = {}

    @property
    def found(self) -> dict[str, Traced]:
        """The traces of ``f`` and ``h``."""
        with self._lock:
            if self._found is None:
                where = points(self._states, self._n, self._m)
                self._found = {name: self._traced(name, where) for name in ("f", "h")}
            return self._found

    def _traced(self, name: str, where: Points) -> Traced:
        function = self._functions[name]
        found = traced(function, (self._n, self._m), where, name=name)
        if found.function is None:
            return found
        size, count = self._n if name == "f" else self._p, found.function.n_instructions()
        if found.function.numel_out() != size:
            return Traced(None, f"it returns shape {found.shape} of symbols; expected ({size},)")
        if count > _MOST_OPERATIONS:
            return Traced(None, f"it takes {count} operations, more than {_MOST_OPERATIONS}")
        return found

    @property
    def model(self) -> CasadiModel | None:
        """The model, if both functions are traced."""
        with self._lock:
            if self._model is None and all(one.function for one in self.found.values()):
                self._model = self.partial_model()
            return self._model

    def partial_model(self) -> CasadiModel:
        """A model that is true of the functions that are traced, with zeros for others."""
        ca, sizes = import_casadi(), {"f": self._n, "h": self._p}
        x, u = ca.SX.sym("x", self._n), ca.SX.sym("u", self._m)
        made = {
            name: one.function or ca.Function(name, [x, u], [ca.DM.zeros(sizes[name])])
            for name, one in self.found.items()
        }
        return CasadiModel(
            made["f"], made["h"], self._n, self._p, self._m, self._dt, self._method
        )

    def evaluator(self, timed: bool = False) -> Evaluator:
        """What evaluates the traced functions, with the step's length as last input if timed."""
        with self._lock:
            if timed not in self._evaluators:
                self._evaluators[timed] = Evaluator(VirtualMachine(self.partial_model(), timed))
            return self._evaluators[timed]

    def confirm(self, scales: Array | None) -> dict[str, Traced]:
        """Compare functions and traces again, at points of these magnitudes of the states.

        Functions that have changed since they were traced are traced again, once.
        """
        where = points(self._states, self._n, self._m, 1.0 if scales is None else scales, True)
        with self._lock:
            for name, one in dict(self.found).items():
                if one.function and difference(one, self._functions[name], where):
                    again = self._traced(name, [*points(self._states, self._n, self._m), *where])
                    self._replace(name, again)
                    if again.function is None:
                        warn_of(f"{name} is not as it was traced: {again.reason}")
            return self.found

    def wrong(self, x: Array, u: Array) -> tuple[str, str] | None:
        """Which function differs from its trace at a point, and how; None if none does."""
        for name, one in self.found.items():
            if one.function is None:
                continue
            try:
                text = difference(one, self._functions[name], [(x, u)])
            except Exception as error:  # whatever a user's function returns now
                text = f"it raises {type(error).__name__}"
            if text:
                return name, text
        return None

    def forget(self) -> None:
        """Trace the functions anew where they are needed again."""
        with self._lock:
            self._found = self._model = None
            self._evaluators = {}

    def _replace(self, name: str, by: Traced) -> None:
        self._found, self._model, self._evaluators = {**self.found, name: by}, None, {}


def warn_of(fault: str, stacklevel: int = 6) -> None:
    """Warn that a trace is given up, and its function evaluated as it is written."""
    warnings.warn(
        f"{fault}. It is evaluated as it is written.", EngineWarning, stacklevel=stacklevel
    )


def _of_both(function: BatchedFunction) -> Callable[[Array, Array], Any]:
    """The user's function as one of x and u."""
    called = function.function
    return called if function.takes_input else lambda x, u: called(x)  # noqa: ARG005


def next_check(time: int, horizon: int) -> int:
    """When an estimator that has compared at a time does so again.

    At each sample of the first window, then at powers of two, then at each thousandth.
    """
    if time < horizon:
        return time + 1
    return min(1 << time.bit_length(), (time // 1000 + 1) * 1000)
