"""A model as an estimator evaluates it: step, output, Jacobians, residuals and curvature."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .accuracy import Choice, Stepper
from .derivatives import Jacobian
from .discretize import Discretization
from .evaluation import Evaluator, Places
from .expressions import CasadiModel
from .functions import BatchedFunction, Trusted
from .points import Points
from .second_derivatives import Curvature, SecondDerivatives
from .traces import Pinned, warn_of

if TYPE_CHECKING:
    from .augmentation import Augmentation
    from .constraints import ConstraintFunctions
    from .dae import Equations
    from .signals import Signals
    from .system import System
    from .system_arguments import SystemOptions

Array = NDArray[np.float64]
Along = Callable[[Array, Array, Array], Array]


class ModelKernel(Protocol):
    """Evaluates several of a model's functions in one call."""

    def stage(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Values f (n,), h (p,) and Jacobian (n + p, n) at one state; valid until the next call."""

    def residuals(self, trajectory: Array, y: Array, u: Array) -> Array:
        """Residuals (w, v) along a trajectory (K + 1, n), in a new array (K, n + p)."""

    def prepare(self, horizon: int) -> None:
        """Compile or allocate now what the first updates with this horizon would wait for."""


class Functions:
    """f, h and their Jacobians, each called by itself: as written, or by its trace.

    Attributes
    ----------
    f, h : BatchedFunction
        The functions.
    f_jacobian, h_jacobian : Jacobian
        Their derivatives with respect to x.
    rate_jacobian : Jacobian or None
        The Jacobian that the user gave for the rate of an ODE; it is checked, not evaluated.
    kernel : ModelKernel or None
        Evaluates several of them in one call; None for functions that have no expression.
    """

    kernel: ModelKernel | None = None

    def __init__(
        self, f: BatchedFunction, h: BatchedFunction, f_jacobian: Jacobian, h_jacobian: Jacobian,
        rate_jacobian: Jacobian | None = None,
    ) -> None:
        self.f, self.h, self.f_jacobian, self.h_jacobian = f, h, f_jacobian, h_jacobian
        self.rate_jacobian = rate_jacobian

    def copy(self) -> Functions:
        """The same functions, which may come to be called in other ways."""
        other, rate = copy(self), self.rate_jacobian
        other.f, other.h = self.f.copy(), self.h.copy()
        other.f_jacobian = self.f_jacobian.copy(other.f)
        other.h_jacobian = self.h_jacobian.copy(other.h)
        other.rate_jacobian = rate and rate.copy(rate.function)
        return other

    def follow(self, other: Functions) -> None:
        """Note what is taken nearby where others do."""
        self.f_jacobian.follow(other.f_jacobian)
        self.h_jacobian.follow(other.h_jacobian)

    def take_scales(
        self, scales: Array, probes: Points, right: Sequence[str] = ()
    ) -> None:
        """Take magnitudes of the states; compare given Jacobians with differences at such probes.

        Those of the functions that are known to have ``right`` ones are not compared.
        """
        if self.rate_jacobian is not None:  # first, to be named if it is wrong
            self.rate_jacobian.use_scales(scales, None, () if "rate" in right else probes)
        self.f_jacobian.use_scales(scales, scales, () if "f" in right else probes)
        self.h_jacobian.use_scales(scales, None, () if "h" in right else probes)

    @property
    def along(self) -> Along:
        """A function of trajectory, measurements and inputs to the differences w and v."""
        return self._differences

    def _differences(self, trajectory: Array, y: Array, u: Array) -> Array:
        states = trajectory[:-1]
        # Concatenating contiguous differences is faster than writing into columns.
        disturbances = trajectory[1:] - self.f.batch(states, u)
        noises = y - self.h.batch(states, u)
        residuals: Array = np.concatenate((disturbances, noises), axis=1)
        shape = len(y), trajectory.shape[1] + y.shape[1]
        if residuals.shape != shape or residuals.dtype != np.float64:
            raise TypeError("f or h returned other than real numbers of the right shape")
        return residuals

    def prepare(self, horizon: int) -> None:
        """Make ready what the first updates would wait for: nothing."""

    def evaluated_by(self, evaluator: Evaluator, names: Sequence[str]) -> Functions:
        """The same, of which these are evaluated by their traces."""
        found: dict[str, Any] = {}
        for name in ("f", "h"):
            function, jacobian = getattr(self, name), getattr(self, f"{name}_jacobian")
            if name in names:
                value, slope = (
                    Trusted(partial(evaluator.one, one)) for one in (name, f"{name}_jacobian")
                )
                function = function.evaluated_by(value)
                jacobian = jacobian.evaluated_by(function, slope, "traced")
            found[name], found[f"{name}_jacobian"] = function, jacobian
        found["rate_jacobian"] = self.rate_jacobian
        return Expression(**found, kernel=evaluator) if len(names) == 2 else Functions(**found)


class Expression(Functions):
    """f and h as expressions, with exact Jacobians; one call evaluates all that a stage needs.

    Parameters
    ----------
    f, h, f_jacobian, h_jacobian, rate_jacobian
        As for `Functions`.
    kernel : ModelKernel
        What evaluates several of them in one call.
    """

    def __init__(
        self, f: BatchedFunction, h: BatchedFunction, f_jacobian: Jacobian, h_jacobian: Jacobian,
        kernel: ModelKernel, rate_jacobian: Jacobian | None = None,
    ) -> None:
        super().__init__(f, h, f_jacobian, h_jacobian, rate_jacobian)
        self.kernel: ModelKernel = kernel

    @property
    def along(self) -> Along:
        """See `Functions.along`."""
        return self.kernel.residuals

    def prepare(self, horizon: int) -> None:
        """Compile or allocate now what the first updates with this horizon would wait for."""
        self.kernel.prepare(horizon)


@dataclass(frozen=True, eq=False)
class Origin:
    """What a system is made of besides its functions; who makes a `System` states it once.

    Parameters
    ----------
    dt, how : optional
        Sampling time and discretisation of an ODE; None for a discrete-time model.
    rate : BatchedFunction, optional
        The rate, which is traced in the place of f.
    rate_jacobian : Jacobian, optional
        The Jacobian of the rate, where the user gave it.
    equations : Equations, optional
        The functions of a DAE: ``rate`` then is the joint function of states and algebraic states.
    stepper : callable, optional
        Makes the step of a discretisation, from the user's functions: see `qpmhe.model.accuracy`.
    choice : Choice, optional
        Which discretisations were tried, where the method was to be chosen.
    sources : dict, optional
        Functions of x and u, named ``f`` and ``h``, which are traced in the place of f, or of the
        rate, and h.
    kernel : ModelKernel, optional
        Evaluates f, h and their Jacobians in one call, where f and h are expressions.
    jacobians : str
        How the given Jacobians are computed, in a word.
    integrated : tuple of str
        Which of ``f`` and ``h`` call an integrator of CasADi, whose derivatives are as accurate as
        its tolerances; they are taken as they are.
    remedy : str
        The remedy that the error about a wrong given Jacobian names; ``{name}`` is the function.
    symbolic : CasadiModel, optional
        f and h as CasADi functions, where they were given as such.
    make_timed : callable, optional
        Makes, of the system, the one whose last input is the length of the step.
    make_augmented : callable, optional
        Makes the system with inputs among its states, of an `Augmentation` and options, in the
        language of its functions; None where f and h themselves will do.
    recipe : tuple, optional
        Function and keyword arguments that make the system again, when it is unpickled.
    held : dict
        Parameters among the states that a window without information on them holds, by index:
        within how many deviations of the prior.
    is_timed : bool
        Whether the last input is the length of the step.
    signals : Signals, optional
        Names, units and starts of the variables.
    """

    dt: float | None = None
    how: Discretization | None = None
    rate: BatchedFunction | None = None
    rate_jacobian: Jacobian | None = None
    equations: Equations | None = None
    stepper: Stepper | None = None
    choice: Choice | None = None
    sources: dict[str, Callable[[Array, Array], Any]] | None = None
    kernel: ModelKernel | None = None
    jacobians: str = "given"
    integrated: tuple[str, ...] = ()
    remedy: str = ""
    symbolic: CasadiModel | None = None
    make_timed: Callable[[System], System] | None = None
    make_augmented: Callable[[Augmentation, SystemOptions], System] | None = None
    recipe: tuple[Callable[..., Any], dict[str, Any]] | None = None
    held: Mapping[int, float] = field(default_factory=dict)
    is_timed: bool = False
    signals: Signals | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """f and h with all that is computed from them, as an estimator evaluates them.

    The functions of a system are called from here alone. A model does not change: another way to
    call the functions is another model. `qpmhe.System.model` makes it.

    Parameters
    ----------
    system : System
        The system as its user made it.
    functions : Functions
        f, h and their Jacobians: an `Expression`, or `Functions`.
    written : Functions
        The same as the user wrote them, where a trace replaces them.
    scales : (n,) array or None
        Typical magnitudes of the states; None if they are not known.
    trace : Pinned or None
        The traces that `functions` are evaluated by.
    names : tuple of str
        Which of ``f`` and ``h`` these replace.
    pins : bool
        Whether a trace that is found later is the model's own, too.
    start : tuple or None
        State and input at which the model was checked.
    timed_functions : callable or None
        Makes the functions of `timed`, where they are not the system's own.
    """

    system: System
    functions: Functions
    written: Functions
    scales: Array | None = None
    trace: Pinned | None = None
    names: tuple[str, ...] = ()
    pins: bool = False
    start: tuple[Array, Array] | None = None
    timed_functions: Callable[[], Functions] | None = None

    def step(self, x: Array, u: Array) -> Array:
        """The next states f(x, u) (K, n) at states (K, n) and inputs (K, m)."""
        return self.functions.f.batch(x, u)

    def output(self, x: Array, u: Array) -> Array:
        """The outputs h(x, u) (K, p) at states (K, n) and inputs (K, m)."""
        return self.functions.h.batch(x, u)

    def linear(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Jacobians of f (K, n, n) and of h (K, p, n) at states (K, n) and inputs (K, m)."""
        functions = self.functions
        return functions.f_jacobian.batch(x, u), functions.h_jacobian.batch(x, u)

    @property
    def pattern(self) -> Places | None:
        """Rows and columns, by rows, of the entries of [A; C] that may be other than 0.

        The diagonal of A is among them. None where they are not known: of functions that are no
        expressions.
        """
        kernel = self.functions.kernel
        return kernel.pattern if isinstance(kernel, Evaluator) else None

    @property
    def _evaluator(self) -> Evaluator:
        """What evaluates entries in a pattern."""
        kernel = self.functions.kernel
        assert isinstance(kernel, Evaluator)
        return kernel

    def entries(self, x: Array, u: Array) -> Array:
        """The entries (K, e) of `linear` in the `pattern`."""
        found = self._evaluator.one("entries", x, u)
        if math.isfinite(np.vdot(found, found)):
            return found
        pattern = self.pattern
        assert pattern is not None
        joint = np.concatenate(self.linear(x, u), axis=1)  # some are taken beside these states
        return np.asarray(joint[:, *pattern])

    def stage_by_entries(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """f, h and the entries (e,) of the Jacobian at a state; good until the next call."""
        return self._evaluator.stage(x, u, True)

    @cached_property
    def residuals(self) -> Along:
        """A function of x (K + 1, n), y (K, p) and u (K, m) to w and v, a new array (K, n + p).

        Angles are not wrapped. It raises what f and h raise.
        """
        return self.functions.along

    def curvature(self, x: Array, u: Array, forces: Array) -> Curvature:
        """Second derivatives of f and h, weighed by forces (K, n + p): see `SecondDerivatives`."""
        return self.second_derivatives.at(x, u, forces)

    def prepare(self, horizon: int, by_entries: bool = False) -> None:
        """Compile or allocate now what the first updates with this horizon would wait for."""
        if by_entries:
            self._evaluator.prepare(horizon, True)
        else:
            self.functions.prepare(horizon)

    @cached_property
    def second_derivatives(self) -> SecondDerivatives:
        """What `curvature` evaluates, and whether that is exact."""
        return SecondDerivatives(self)

    @cached_property
    def timed(self) -> Model:
        """The model with the length of the step as one more input, behind the others."""
        return self._with_steps()

    def _with_steps(self) -> Model:
        system, known = self.system.timed, self.scales
        if self.timed_functions is not None:
            other = self.timed_functions()
            other.follow(self.functions)
            return Model(system, other, other, known)
        other = system.evaluation.functions.copy()
        if known is not None and not system.has_scales:
            other.take_scales(known, [])  # steps of a random length lead anywhere
        other.follow(self.functions)
        names = () if self.system.has_other_steps else self.names
        made = Model(system, other, other, known, self.trace if names else None, names, True)
        made = made._evaluated()
        if self.start is not None:
            x, u = self.start
            with suppress(ModelError):  # whoever takes such a step checks it
                made = made.at(x, np.append(u, self.system.dt or 0.0))
        return made

    # Expressions

    @cached_property
    def _pinned(self) -> Pinned | None:
        """The traces that the model relies on, for C code at least."""
        tracing = self.system.tracing
        if self.trace is not None or tracing is None or not self.pins:
            return self.trace
        return tracing.confirm(self.scales)

    @property
    def symbolic(self) -> CasadiModel | None:
        """The model as CasADi functions, for C code; None if it has no such form."""
        system = self.system
        if system.tracing is None:
            return system.origin.symbolic
        if system.has_other_steps:  # these must be those of the same model
            return None
        return system.tracing.model if self._pinned is None else self._pinned.model

    @property
    def no_symbolic(self) -> str:
        """Why ``symbolic`` is None, as text; blank otherwise."""
        tracing = self.system.tracing
        if self.symbolic is not None or tracing is None:
            return ""
        if self.system.has_other_steps:
            return (
                "it takes steps of other lengths, of which only functions of NumPy know, as made "
                "by qpmhe.noisy_inputs"
            )
        found = tracing.now if self._pinned is None else self._pinned
        return "; ".join(
            f"{name} is not traced: {one.reason}" for name, one in found.found.items() if one.reason
        )

    @property
    def _relied(self) -> Pinned | None:
        return self.__dict__.get("_pinned", self.trace)

    @property
    def is_traced(self) -> bool:
        """Whether the model relies on a trace, which may become wrong."""
        pinned = self._relied
        return pinned is not None and any(one.function for one in pinned.found.values())

    @property
    def traced_functions(self) -> tuple[Callable[..., Any], ...]:
        """The user's f and h, where traces may stand in their places."""
        return self.system.tracing.functions if self.is_traced and self.system.tracing else ()

    def fault(self, where: Points) -> str:
        """Which function differs from its trace at these states and inputs, and how.

        Blank if none does. Never raises, whatever the functions do.
        """
        pinned, tracing = self._relied, self.system.tracing
        if pinned is None or tracing is None:
            return ""
        if self.system.origin.is_timed:  # compared as the model that it is made of
            return ""
        wrong = tracing.wrong(pinned, [one for one in where if np.isfinite(one[1]).all()])
        return "" if wrong is None else f"{wrong[0]} has changed since it was traced: {wrong[1]}"

    # Other models of the same system

    def scaled(self, scales: Array | None) -> Model:
        """The model for states of these magnitudes, evaluated by its traces where it has them.

        Raises a `ModelError` if a given Jacobian is not the derivative at such points.
        """
        system, tracing = self.system, self.system.tracing
        known = self.scales if scales is None else scales
        pinned: Pinned | None = None
        if tracing is not None and self.written.kernel is None:  # the latter has exact Jacobians
            pinned = tracing.confirm(known)
        other = self.written.copy()
        names: tuple[str, ...] = ()
        right: tuple[str, ...] = ()
        if tracing is not None and pinned is not None:
            names = tuple(
                name for name, one in pinned.found.items()
                if one.function and tracing.replaces(
                    getattr(other, f"{name}_jacobian"), pinned, f"{name}_jacobian", known
                )
            )
            rate = other.rate_jacobian
            if rate is not None and "f" in names and tracing.is_rate(rate, pinned, known):
                right = ("rate",)
        if scales is not None:
            other.take_scales(scales, system.probes(scales), (*names, *right))
        return Model(system, other, other, known, pinned, names, True)._evaluated()

    def holds(self) -> bool:
        """Whether the functions still agree with the traces that the model relies on."""
        tracing = self.system.tracing
        return self.trace is None or tracing is None or (
            tracing.confirm(self.scales) is self.trace
        )

    def _evaluated(self) -> Model:
        """The same, with functions that are evaluated by their traces."""
        if not self.names:
            return replace(self, functions=self.written)
        assert self.trace is not None
        # The trace of the usual system lacks the input for the step's length.
        evaluator = self.trace.evaluator(timed=self.system.m > self.trace.m)
        return replace(self, functions=self.written.evaluated_by(evaluator, self.names))

    def at(self, x: Array, u: Array) -> Model:
        """The model, checked at a state (n,) and input (m,) that will be used.

        How functions are called and differentiated may depend on what they return there.

        Raises
        ------
        ModelError
            If f, h or a Jacobian is not finite there, or has the wrong shape.
        """
        model, written = self, self.written.copy()
        rate = written.rate_jacobian
        for function in (written.f, written.h, *(() if rate is None else (rate,))):
            check_at(function, x, u)
        fault = self.fault([(x, u)])
        if fault:
            model = self.as_written()
            warn_of(fault)
        model = replace(model, written=written, start=(x, u))._evaluated()
        for jacobian in (model.functions.f_jacobian, model.functions.h_jacobian):
            check_at(jacobian, x, u)
        # Of an expression there is nothing to find out.
        return self if isinstance(self.functions, Expression) and not fault else model

    def differentiated_at(self, x: Array, u: Array) -> Model:
        """The model, whose Jacobians are found as it suits a state (n,) and input (m,)."""
        functions = self.functions.copy()
        for jacobian in (functions.f_jacobian, functions.h_jacobian):
            jacobian.check(x, u)
        return replace(self, functions=functions)

    def copy(self) -> Model:
        """The same, for another estimator: it notes by itself what is taken nearby."""
        written = self.written.copy()
        if self.functions is self.written:
            return replace(self, functions=written, written=written)
        functions = self.functions.copy()
        written.follow(functions)
        return replace(self, functions=functions, written=written)

    def as_written(self) -> Model:
        """The model that evaluates f and h as they are written, without traces."""
        return replace(self, functions=self.written, trace=None, names=(), pins=False)

    def batched_at(self, x: Array, u: Array) -> Model:
        """The model that evaluates many states at once if that gives the same at these (K, n).

        Evidence, but no proof: for what may be wrong without harm.
        """
        functions = self.functions.copy()
        for one in (functions.f, functions.h, functions.f_jacobian, functions.h_jacobian):
            one.try_batched(x, u)
        return replace(self, functions=functions)

    @property
    def methods(self) -> tuple[str, str]:
        """How the Jacobians of f and h are computed."""
        return self.functions.f_jacobian.method, self.functions.h_jacobian.method


def check_at(
    function: BatchedFunction | Jacobian | ConstraintFunctions, x: Array, u: Array
) -> None:
    """Check a function at a state, with no input or, if it is not defined then, with some."""
    try:
        function.check(x, u)
    except ModelError:
        # Not every model is defined without input: one that divides by u is not.
        if not u.size or u.any():
            raise
        function.check(x, np.full_like(u, 0.5))


# Models of other magnitudes than these are made again.
_MOST_KEPT = 8


class ModelCache:
    """The models of a system that were made last, by the states' magnitudes."""

    def __init__(self) -> None:
        self._lock, self._kept = threading.RLock(), dict[bytes, Model]()

    def of(self, written: Model, scales: Array | None) -> Model:
        """The model for these magnitudes; made again where its functions have changed."""
        key = b"" if scales is None else scales.tobytes()
        with self._lock:
            found = self._kept.pop(key, None)
            if found is None or not found.holds():
                found = written.scaled(scales)
            self._kept[key] = found
            if len(self._kept) > _MOST_KEPT:
                self._kept.pop(next(iter(self._kept)))
            return found
