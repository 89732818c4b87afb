"""The trace of a system: its functions as CasADi expressions, and whether they still hold."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import EngineWarning
from .derivatives import Jacobian
from .discretize import Discretization
from .evaluation import Evaluator, machine
from .expressions import CasadiModel, import_casadi, symbols
from .functions import BatchedFunction, Trusted
from .points import ALL, USUAL, Magnitude, Points, points
from .products import MOST_OF_EACH, MOST_OPERATIONS, operations, with_slope
from .sets import ConvexSet
from .tracing import Traced, difference, expressed

if TYPE_CHECKING:
    from .dae import Equations

Array = NDArray[np.float64]

# Entries of a given Jacobian are right where they differ by less than this share of their row's.
_SAME = 1e-9


class Pinned:
    """f and h as they were traced once.

    Attributes
    ----------
    found : dict
        The traces of ``f`` (the rate, where the model has a step length) and ``h``.
    model : CasadiModel or None
        The model, if both functions are traced.
    """

    def __init__(
        self, found: dict[str, Traced], n: int, p: int, m: int, dt: float | None,
        how: Discretization | None, guess: tuple[float, ...] = (),
    ) -> None:
        self.found, self.m = found, m
        self._evaluators: dict[bool, Evaluator] = {}
        # True of the functions that are traced, with zeros for others.
        self._partial: CasadiModel | None = None
        if any(one.function for one in found.values()):
            ca = import_casadi()
            x, u = ca.SX.sym("x", n + len(guess)), ca.SX.sym("u", m)
            f, h = (
                found[name].function or ca.Function(name, [x, u], [ca.DM.zeros(size)])
                for name, size in (("f", n + len(guess)), ("h", p))
            )
            self._partial = CasadiModel(f, h, n, p, m, dt, how, guess)
        self.model = self._partial if all(one.function for one in found.values()) else None

    def evaluator(self, timed: bool = False) -> Evaluator:
        """What evaluates the traced functions, with the step's length as last input if timed."""
        if timed not in self._evaluators:
            assert self._partial is not None
            self._evaluators[timed] = Evaluator(machine(self._partial, timed))
        return self._evaluators[timed]


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
    dt, how : optional
        Where f is a rate: the step length, and the discretisation.
    sources : dict, optional
        Functions of x and u, named ``f`` and ``h``, to be traced in place of those above, which
        they are to agree with.
    is_step : bool
        Whether f is a step where there is a step length, and its source the rate.
    equations : Equations, optional
        The functions of a DAE, which then are traced as functions of w = (x, z), f with the
        algebraic residuals below the rate.
    """

    def __init__(
        self, f: BatchedFunction, h: BatchedFunction, n: int, p: int, m: int,
        states: ConvexSet | None, dt: float | None = None, how: Discretization | None = None,
        sources: dict[str, Callable[[Array, Array], Any]] | None = None,
        is_step: bool = False, equations: Equations | None = None,
    ) -> None:
        self._equations, self._width, self._is_step = equations, n, is_step
        if equations is not None:
            f, h, self._width = equations.joint, equations.output, equations.joint.shape[0]
        self._sources = sources
        self._batched = {"f": f, "h": h}
        self._functions = {name: of_both(one) for name, one in self._batched.items()}
        self._n, self._p, self._m, self._states = n, p, m, states
        self.dt, self.how = dt, how
        self._lock = threading.RLock()
        self._now: Pinned | None = None

    @property
    def now(self) -> Pinned:
        """The traces as they were found last."""
        with self._lock:
            if self._now is None:
                self._trace(self._points(ALL))
            assert self._now is not None
            return self._now

    def _trace(self, where: Points) -> None:
        self._pin({name: self._traced(name, where) for name in ("f", "h")})

    @property
    def model(self) -> CasadiModel | None:
        """The model, if both functions are traced and still agree with their traces."""
        return self.confirm(None).model

    def scalar(self, name: str) -> Traced:
        """The trace of a function in scalar operations alone, not compared with the function."""
        return expressed(self._source(name), (self._width, self._m), name)

    def _source(self, name: str) -> Callable[[Array, Array], Any]:
        return self._functions[name] if self._sources is None else self._sources[name]

    def _points(self, magnitudes: Sequence[Magnitude], scales: Array | float = 1.0) -> Points:
        """Where traces and functions are compared."""
        if self._equations is not None:
            return self._equations.points(magnitudes, self._m, self._states, scales)
        return points(magnitudes, self._n, self._m, self._states, scales)

    def _pin(self, found: dict[str, Traced]) -> None:
        guess = () if self._equations is None else tuple(self._equations.guess.tolist())
        if guess and found["f"].function is None and found["h"].function is not None:
            reason = f"it needs the algebraic equations, which are not: {found['f'].reason}"
            found = {**found, "h": Traced(None, reason)}
        self._now = Pinned(found, self._n, self._p, self._m, self.dt, self.how, guess)

    def _traced(self, name: str, where: Points) -> Traced:
        found = expressed(self._source(name), (self._width, self._m), name, products=True)
        if found.function is None:
            return found
        fault = self._difference(name, found, where)
        if fault:
            warn_of(f"{name} cannot be traced: {fault}")
            return Traced(None, fault)
        size, count = self._width if name == "f" else self._p, operations(found.function)
        if found.function.numel_out() != size:
            return Traced(None, f"it returns shape {found.shape} of symbols; expected ({size},)")
        if count > (most := max(MOST_OPERATIONS, MOST_OF_EACH * self._n)):
            return Traced(None, (
                f"it takes {count} operations, more than {most}; write a product with "
                "a matrix as A @ x, which is one"
            ))
        if self._sources is None:
            self._batched[name].reads_only = True
        return found

    def _difference(self, name: str, found: Traced, where: Points) -> str:
        """Where a trace differs from its function; blank where it does not."""
        if name == "f" and self._is_step:
            # As the step in C takes it: a rate by the method, a map as it is.
            ca, n = import_casadi(), self._n
            x, u = ca.SX.sym("x", n), ca.SX.sym("u", self._m)
            model = CasadiModel(found.function, None, n, 0, self._m, self.dt, self.how)
            stepped = ca.Function("f", [x, u], [ca.densify(model.step()(x, u, self.dt or 0.0))])
            found = Traced(stepped, "", (n,))
        return difference(found, self._functions[name], where)

    def confirm(self, scales: Array | None) -> Pinned:
        """The traces, compared with the functions again at points of these magnitudes.

        Functions that have changed since they were traced are traced again, once.
        """
        units = 1.0 if scales is None else scales
        where = self._points(USUAL, units)
        with self._lock:
            if self._now is None:
                self._trace([*self._points(ALL), *where])
                return self.now
            for name, one in self.now.found.items():
                if one.function and self._difference(name, one, where):
                    all_points = [*self._points(ALL), *where]
                    again = self._traced(name, all_points)
                    self._pin({**self.now.found, name: again})
            return self.now

    def replaces(
        self, jacobian: Jacobian, pinned: Pinned, name: str, scales: Array | None
    ) -> bool:
        """Whether a trace's Jacobian may stand in the place of this one.

        It always replaces a computed one, and a given one where both agree up to rounding.
        """
        if jacobian.method != "given":
            return True
        return self._same(jacobian, partial(pinned.evaluator().one, name), scales)

    def is_rate(self, jacobian: Jacobian, pinned: Pinned, scales: Array | None) -> bool:
        """Whether a given Jacobian of the rate equals the traced derivative, up to rounding."""
        ca, rate = import_casadi(), pinned.found["f"].function
        x, u = symbols(rate, self._n, self._m)
        slope = ca.Function("slope", [x, u], [ca.densify(with_slope(rate, x, u)[1])])
        return self._same(jacobian, lambda x, u: np.array(slope(x, u)), scales)

    def _same(
        self, jacobian: Jacobian, exact: Callable[[Array, Array], Array], scales: Array | None
    ) -> bool:
        units, compared = 1.0 if scales is None else scales, 0
        for x, u in points(USUAL, self._n, self._m, self._states, units):
            try:
                with np.errstate(all="ignore"):
                    given = np.asarray(jacobian(x, u), np.float64)
            except Exception:  # outside its domain
                continue
            mine = exact(x, u)
            if not (np.isfinite(given).all() and np.isfinite(mine).all()):
                continue
            size = np.maximum(np.abs(x), units)
            row = (np.abs(mine) * size).max(axis=1, keepdims=True)
            if (np.abs(given - mine) * size > _SAME * row).any():
                return False
            compared += 1
        return compared > 0

    @property
    def functions(self) -> tuple[Callable[[Array, Array], Any], ...]:
        """What was traced, as the user wrote it."""
        return tuple(self._functions.values())

    def forget(self) -> None:
        """Trace the functions again when a trace is needed next: they have changed."""
        with self._lock:
            self._now = None

    def wrong(self, pinned: Pinned, where: Points) -> tuple[str, str] | None:
        """Which function differs from its trace at these points, and how; None if none does."""
        if self._equations is not None:
            where = self._equations.at_guess(where)
        for name, one in pinned.found.items():
            if one.function is None:
                continue
            try:
                text = self._difference(name, one, where)
            except Exception as error:  # whatever a user's function returns now
                text = f"it raises {type(error).__name__}"
            if text:
                return name, text
        return None


def warn_of(fault: str, stacklevel: int = 6) -> None:
    """Warn that a trace is dropped, and its function evaluated as written."""
    warnings.warn(
        f"{fault}. It is now evaluated as written.", EngineWarning, stacklevel=stacklevel
    )


def evaluated_alone(
    function: BatchedFunction, jacobian: Jacobian, trace: Traced, n: int, m: int
) -> tuple[BatchedFunction, Jacobian]:
    """A function of x (n,) and u (m,), with its Jacobian, evaluated by its trace."""
    found = {"f": Traced(None, "there is none"), "h": trace}
    evaluator = Pinned(found, n, function.shape[0], m, None, None).evaluator()
    value, slope = (Trusted(partial(evaluator.one, name)) for name in ("h", "h_jacobian"))
    by_trace = function.evaluated_by(value)
    return by_trace, jacobian.evaluated_by(by_trace, slope, "traced")


def depends(trace: Traced) -> NDArray[np.bool_]:
    """Which entries of a traced function (size,) depend on each entry of its first argument."""
    ca = import_casadi()
    sparsity = trace.function.jac_sparsity(0, 0)
    found: NDArray[np.bool_] = np.array(ca.DM(sparsity, 1.0)) != 0.0
    return found


def of_both(function: BatchedFunction) -> Callable[[Array, Array], Any]:
    """The user's function as one of x and u."""
    called = function.function
    return called if function.takes_input else lambda x, _: called(x)
