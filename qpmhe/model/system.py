"""The system whose state is estimated (eq:system)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import shown

from .._checks import SINGULAR, dimension, numbers, positive, vector
from ..errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError
from .constraints import Constraint, ConstraintFunctions, checked_constraints
from .derivatives import Jacobian
from .discretize import discretize
from .evaluation import Evaluator
from .functions import BatchedFunction, Probes, Trusted, check_inputs
from .residuals import Residual, Turns, checked_residual
from .sets import ConvexSet, SoftSet, equilibrated
from .traces import ModelTrace, Pinned, warn_of

if TYPE_CHECKING:
    from .augmentation import Augmentation

Array = NDArray[np.float64]
Function = Callable[..., Any]


class ModelKernel(Protocol):
    """Evaluates several of a model's functions in one call."""

    def stage(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Values f (n,), h (p,) and Jacobian (n + p, n) at one state; valid until the next call."""

    def residuals(self, trajectory: Array, y: Array, u: Array) -> Array:
        """Residuals (w, v) along a trajectory (K + 1, n), in a new array (K, n + p)."""

    def prepare(self, horizon: int) -> None:
        """Compile or allocate now what the first updates with this horizon would wait for."""


class SystemOptions(TypedDict, total=False):
    """The options of `System` that every function that makes a system hands on to it."""

    states: ConvexSet | SoftSet | None
    disturbances: ConvexSet | SoftSet | None
    noises: ConvexSet | SoftSet | None
    scales: ArrayLike | None
    output_residual: Residual | Function | None
    state_residual: Residual | Function | None
    disturbance_matrix: ArrayLike | None
    constraints: Sequence[Constraint] | None


def timed_options(options: SystemOptions) -> SystemOptions:
    """The options of a timed system: its constraints are those of the usual one."""
    return {**options, "constraints": None}


@report_unknown_options
class System:
    r"""A nonlinear discrete-time system with additive disturbance and noise.

    .. math::
        x(t+1) = f(x(t), u(t)) + G w(t), \qquad y(t) = h(x(t), u(t)) + v(t),
        \qquad x \in \mathbb X,\ w \in \mathbb W,\ v \in \mathbb V

    as in (eq:system) of the paper, where G is the identity, plus known inputs u.

    Parameters
    ----------
    f : callable
        f(x) or f(x, u): maps x (n,) to (n,). A function that takes (..., n), as NumPy's own
        functions do, is called once for a whole window if a trace on symbols proves that this is
        correct; any other is called state by state, with a copy of its arguments. With inputs, the
        second positional parameter is u, whatever its name and default.
    h : callable
        h(x) or h(x, u): maps x (n,) to (p,), or to a scalar if p is 1. With inputs, f or h must
        take them.
    n, p : int
        Number of states and of outputs, at least 1.
    m : int
        Number of known inputs; 0 for none.
    f_jacobian, h_jacobian : callable, optional
        Derivatives with respect to x, of shapes (n, n) and (p, n), same arguments. If left out, or
        equal up to rounding, estimators use the exact derivatives of the function's trace, see
        `explain`. If a function cannot be traced, they are computed by the complex step where the
        function allows it, else by differences, central or, at a bound of X, inward; see
        ``derivatives``.
    states, disturbances, noises : Box or Polytope, optional
        The sets X, W and V; the whole space if left out. `ConvexSet.soften` makes soft sets; the
        observer is not projected onto a soft X.
    scales : (n,) array_like, optional
        Typical magnitudes of the states, above zero, in their units. Difference steps are fractions
        of them, and given Jacobians are compared with differences if they are known. If left out,
        an estimator uses the standard deviations of its prior; a system alone uses 1 for its steps
        and compares nothing.
    output_residual, state_residual : Angles or callable, optional
        Difference of outputs, and of states, if components are angles: `qpmhe.angles`, or a
        function (a, b) of two vectors to a [-] b, which is zero where a = b, and equals a - b up to
        constants, such as whole turns. Then V and W bound :math:`v = y \ominus h` and :math:`w =
        x(t+1) \ominus f`. Bounds of X on an angle hold up to whole turns.
    disturbance_matrix : (n, r) array_like, optional
        G, of full column rank with r <= n; the identity if left out. Disturbances w, their set W,
        and their weights and covariances in costs and observers then have the dimension r.

    Attributes
    ----------
    r : int
        Dimension of the disturbances.
    disturbance_matrix : (n, r) array or None
        G; None for the identity.
    constraints : list of Constraint, optional
        Nonlinear inequalities g(x, u, w, v) <= 0 at every sample, hard or soft.

    Raises
    ------
    ModelError
        If a function returns the wrong shape or changes its argument, a given Jacobian is not the
        derivative, a residual function is not a difference, or the columns of G are linearly
        dependent.
    InvalidInputError
        If an angle is declared for a component that does not exist.
    SetError
        If a set has the wrong dimension, X bounds an angle by a general row or on one side only, or
        ``constraints`` is not a list of constraints.
    OptionError, ShapeError
        If a scale is not above zero, or ``scales`` or G has the wrong shape.

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> A = np.array([[1.0, 0.1], [0.0, 1.0]])
    >>> system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    >>> system.derivatives
    {'f': 'traced', 'h': 'traced'}
    """

    #: Attributes that describe a system beside its functions, sets and constraints.
    described: ClassVar[tuple[str, ...]] = ("disturbance_matrix",)

    def __init__(
        self,
        f: Function | Trusted,
        h: Function | Trusted,
        *,
        n: int,
        p: int,
        m: int = 0,
        f_jacobian: Function | Trusted | None = None,
        h_jacobian: Function | Trusted | None = None,
        states: ConvexSet | SoftSet | None = None,
        disturbances: ConvexSet | SoftSet | None = None,
        noises: ConvexSet | SoftSet | None = None,
        scales: ArrayLike | None = None,
        output_residual: Residual | Function | None = None,
        state_residual: Residual | Function | None = None,
        disturbance_matrix: ArrayLike | None = None,
        constraints: Sequence[Constraint] | None = None,
    ) -> None:
        self.n, self.p, self.m = dimension("n", n, 1), dimension("p", p, 1), dimension("m", m, 0)
        self.disturbance_matrix = _checked_matrix(disturbance_matrix, self.n)
        #: Typical magnitudes of the states, (n,); None if they are not known.
        self.scales: Array | None = None
        self._scales_given = False
        self._is_timed = False
        self.states = checked_set("states", states, self.n)
        self.disturbances = checked_set("disturbances", disturbances, self.r)
        self.noises = checked_set("noises", noises, self.p)
        given = {"states": states, "disturbances": disturbances, "noises": noises}
        #: Those of X, W and V that are soft, by name; `states` and the others are None then.
        self.soft: dict[str, SoftSet] = {
            name: one for name, one in given.items() if isinstance(one, SoftSet)
        }
        #: How outputs and states are subtracted; None for plain differences.
        self.output_residual = checked_residual("output_residual", output_residual, self.p)
        self.state_residual = checked_residual("state_residual", state_residual, self.n)
        #: Moves angles into the turn between their bounds; None where X bounds no angle.
        self.turns: Turns | None = None
        if self.states is not None and self.state_residual is not None:
            turns = Turns(self.state_residual, self.states)
            self.states, self.turns = turns.states, turns or None
        self._check_soft_angles()
        probes = probe_points(self.states, self.n, self.m)
        self.f = BatchedFunction("f", f, (self.n,), self.m, probes)
        self.h = BatchedFunction("h", h, (self.p,), self.m, probes)
        check_inputs(self.m, f=self.f.takes_input, h=self.h.takes_input)
        self.f_jacobian = Jacobian(
            self.f, f_jacobian, self.m, probes, self.states, self.state_residual
        )
        self.h_jacobian = Jacobian(
            self.h, h_jacobian, self.m, probes, self.states, self.output_residual
        )
        listed = checked_constraints(constraints)
        #: The nonlinear constraints; None without any.
        self.constraints: ConstraintFunctions | None = None
        if listed:
            self.constraints = ConstraintFunctions(
                listed, {"x": self.n, "u": self.m, "w": self.r, "v": self.p},
                {"x": self.states, "w": self.disturbances, "v": self.noises}, probe_points,
            )
        #: The Jacobian of the rate of a discretised ODE, where the user gave it.
        self.rate_jacobian: Jacobian | None = None
        if scales is not None:
            self._give_scales(scales)
        # What follows is set by the functions that make systems: `from_ode` and the adapters.
        #: Parameters among the states that a window without information on them holds, by index:
        #: within how many deviations of the prior.
        self.held: dict[int, float] = {}
        #: Sampling time of a discretised ODE; None for a discrete-time model.
        self.dt: float | None = None
        #: How it is discretised; None for a discrete-time model.
        self.method: str | None = None
        #: Evaluates f, h and their Jacobians in one call, where the model can.
        self.kernel: ModelKernel | None = None
        #: f and h as expressions, where they have such; None where ``symbolic`` was given.
        self.tracing: ModelTrace | None = ModelTrace(
            self.f, self.h, self.n, self.p, self.m, self.states
        )
        self._symbolic: Any = None
        # The trace as an estimator's copy has found it, and f, h and what belongs to them as they
        # are written, where it stands in their place.
        self._pinned: Pinned | None = None
        self._pins = False
        self._in_place: list[str] = []
        self._as_written: dict[str, Any] | None = None
        #: Makes the system `timed`; None where there is no model in continuous time.
        self.make_timed: Callable[[], System] | None = None
        #: Makes the system again with inputs among its states, in the language of its functions;
        #: None where f and h themselves will do.
        self.make_augmented: Callable[[Augmentation, SystemOptions], System] | None = None
        #: Function and keyword arguments that make this system again, when it is unpickled.
        self.recipe: tuple[Function, dict[str, Any]] = (
            type(self),
            {
                "f": f, "h": h, "n": n, "p": p, "m": m,
                "f_jacobian": f_jacobian, "h_jacobian": h_jacobian,
                "states": states, "disturbances": disturbances, "noises": noises,
                "scales": scales, "disturbance_matrix": disturbance_matrix,
                "output_residual": output_residual, "state_residual": state_residual,
                "constraints": constraints,
            },
        )

    @property
    def r(self) -> int:
        """Dimension of the disturbances w."""
        return self.n if self.disturbance_matrix is None else self.disturbance_matrix.shape[1]

    def state_covariance(self, disturbance: Array) -> Array:
        """The covariance (n, n) of G w, for the covariance ``disturbance`` (r, r) of w."""
        if self.disturbance_matrix is None:
            return disturbance
        covariance: Array = self.disturbance_matrix @ disturbance @ self.disturbance_matrix.T
        return 0.5 * (covariance + covariance.T)

    @classmethod
    def from_ode(
        cls,
        rate: Function | Trusted,
        h: Function | Trusted,
        *,
        dt: float,
        n: int,
        p: int,
        m: int = 0,
        method: str = "rk4",
        rate_jacobian: Function | Trusted | None = None,
        h_jacobian: Function | Trusted | None = None,
        **options: Unpack[SystemOptions],
    ) -> System:
        r"""Discretise :math:`\dot x = f_c(x, u)` with a fixed step; u is held over the step.

        The disturbance w acts in discrete time: it is added once a step.

        Parameters
        ----------
        rate : callable
            f_c(x) or f_c(x, u), in units of x per unit of time.
        h : callable
            Output h(x) or h(x, u), as for `System`.
        dt : float
            Sampling time, in the time unit of the rate.
        n, p, m : int
            Numbers of states, outputs and inputs; m is 0 for a system without inputs.
        method : {"rk4", "euler"}
            Runge-Kutta of order 4, or one explicit Euler step. Where a step is too long for the
            disturbance's size, the estimator warns; see `qpmhe.MovingHorizonEstimator`.
        rate_jacobian : callable, optional
            Derivative of the rate with respect to x, (n, n).
        h_jacobian, **options
            As for `System`.

        Raises
        ------
        OptionError
            If dt is not positive or the method unknown.
        ModelError, SetError
            As for `System`.
        """
        n, m = dimension("n", n, 1), dimension("m", m, 0)
        states = checked_set("states", options.get("states"), n)
        probes = probe_points(states, n, m)
        batched = BatchedFunction("rate", rate, (n,), m, probes)
        given = compared = None
        if rate_jacobian is not None:
            compared = Jacobian(batched, rate_jacobian, m, probes, states)
            given = BatchedFunction("rate_jacobian", rate_jacobian, (n, n), m, probes)
        step, step_jacobian = discretize(
            _over_leading(batched), given and _over_leading(given), method
        )
        length, scales = positive("dt", dt), options.get("scales")
        others = options.copy()
        others.pop("scales", None)
        system = cls(
            Trusted(partial(step, length)), h, n=n, p=p, m=m,
            f_jacobian=step_jacobian and Trusted(partial(step_jacobian, length)),
            h_jacobian=h_jacobian, **others,
        )
        check_inputs(m, rate=batched.takes_input, h=system.h.takes_input)
        system.dt, system.method, system.rate_jacobian = length, method, compared
        system.tracing = ModelTrace(
            batched, system.h, n, system.p, m, system.states, length, method
        )
        if scales is not None:  # not before there is a rate to compare
            system._give_scales(scales)
        system.recipe = (
            cls.from_ode,
            {
                "rate": rate, "h": h, "dt": dt, "n": n, "p": p, "m": m, "method": method,
                "rate_jacobian": rate_jacobian, "h_jacobian": h_jacobian, **options,
            },
        )

        def timed() -> System:
            return cls(
                Trusted(_timed_by_input(step, m)), Trusted(_without_last(system.h.batch, m)),
                n=n, p=p, m=m + 1,
                f_jacobian=step_jacobian and Trusted(_timed_by_input(step_jacobian, m)),
                h_jacobian=h_jacobian and Trusted(_without_last(system.h_jacobian.batch, m)),
                **timed_options(options),
            )

        def augmented(change: Augmentation, options: SystemOptions) -> System:
            return cls.from_ode(
                change.over_leading(batched, 0.0), change.over_leading(system.h),
                dt=dt, method=method, n=change.n, p=p, m=change.m, **options,
            )

        system.make_timed, system.make_augmented = timed, augmented
        return system

    def __reduce__(self) -> tuple[Any, ...]:
        # Made again from the user's functions: the closures inside cannot be pickled.
        return _made, self.recipe

    @cached_property
    def timed(self) -> System:
        """The same system with the length of the step as one more input, behind the others.

        Raises
        ------
        InvalidInputError
            If the system has no model in continuous time.
        """
        if self.make_timed is None:
            raise InvalidInputError(
                "the system is discrete; steps of another length need a model in continuous "
                "time, see System.from_ode."
            )
        made = self.make_timed()
        made._is_timed = True
        return made

    @property
    def symbolic(self) -> Any:
        """The model as CasADi functions, for C code generation; None if it has no such form.

        NumPy functions are traced at the first access, or when an estimator is made. This takes
        some milliseconds, and 10 to 150 ms to import CasADi, which a `System` alone never does.
        """
        if self._symbolic is not None or self.tracing is None:
            return self._symbolic
        # Steps of other lengths must be those of the same model.
        if self._has_other_steps:
            return None
        if self._pins and self._pinned is None:
            self._pinned = self.tracing.confirm(self.scales)
        return self.tracing.model if self._pinned is None else self._pinned.model

    @symbolic.setter
    def symbolic(self, model: Any) -> None:
        self._symbolic, self.tracing = model, None

    @property
    def no_symbolic(self) -> str:
        """Why ``symbolic`` is None, as text; blank otherwise."""
        if self.symbolic is not None or self.tracing is None:
            return ""
        if self._has_other_steps:
            return (
                "it takes steps of other lengths, of which only functions of NumPy know, as made "
                "by qpmhe.noisy_inputs"
            )
        found = self.tracing.now if self._pinned is None else self._pinned
        return "; ".join(
            f"{name} is not traced: {one.reason}" for name, one in found.found.items() if one.reason
        )

    @property
    def _has_other_steps(self) -> bool:
        """Whether it takes steps of other lengths that the trace knows nothing of."""
        return self.make_timed is not None and (self.tracing is None or self.tracing.dt is None)

    def copy(self, scales: ArrayLike | None = None, traced: bool = False) -> System:
        """The same system for one estimator, which may change how its functions are called.

        Parameters
        ----------
        scales : (n,) array_like, optional
            As for `use_scales`.
        traced : bool
            Whether f, h and their Jacobians are evaluated by their trace, where they have one.
        """
        other = object.__new__(type(self))  # `copy.copy` would make the model again, as pickle does
        other.__dict__.update(self.__dict__)
        is_traced = self._as_written is not None
        other.use_functions()
        other.f, other.h = other.f.copy(), other.h.copy()
        other.f_jacobian = other.f_jacobian.copy(other.f)
        other.h_jacobian = other.h_jacobian.copy(other.h)
        if self.constraints is not None:
            other.constraints = self.constraints.copy()
        if self.rate_jacobian is not None:
            other.rate_jacobian = self.rate_jacobian.copy(self.rate_jacobian.function)
        other.__dict__.pop("timed", None)
        make_timed = other.make_timed
        if make_timed is not None:

            def timed() -> System:
                made = (make_timed() if is_traced else self.timed).copy(other.scales)
                made.f_jacobian.follow(other.f_jacobian)
                made.h_jacobian.follow(other.h_jacobian)
                return made

            other.make_timed = timed
        if scales is not None:
            other.use_scales(scales)
        if traced:
            other._use_trace(self._pinned, self._in_place)
        return other

    def _use_trace(self, pinned: Pinned | None, names: list[str]) -> None:
        """Evaluate f and h by their traces, which agree with them, and with given Jacobians.

        By traces that have been compared already, if there are any.
        """
        tracing = self.tracing
        self._pins = True
        if tracing is None or self.kernel is not None:  # the latter has exact Jacobians
            return
        if pinned is None:
            pinned = tracing.confirm(self.scales)
            names = [
                name for name, one in pinned.found.items()
                if one.function and tracing.replaces(
                    getattr(self, f"{name}_jacobian"), pinned, f"{name}_jacobian", self.scales
                )
            ]
        self._pinned, self._in_place = pinned, names
        if not names:
            return
        self._as_written = {name: getattr(self, name) for name in _TRACED}
        self._evaluate_by(pinned.evaluator(), names)
        make_timed = self.make_timed
        if make_timed is not None and not self._has_other_steps:

            def timed() -> System:
                made = make_timed()
                made._evaluate_by(pinned.evaluator(True), names)
                return made

            self.make_timed = timed
        self.__dict__.pop("timed", None)

    def _evaluate_by(self, evaluator: Evaluator, names: list[str]) -> None:
        for name in names:
            value, slope = (
                Trusted(partial(evaluator.one, one)) for one in (name, f"{name}_jacobian")
            )
            function = getattr(self, name).evaluated_by(value)
            jacobian = getattr(self, f"{name}_jacobian")
            setattr(self, name, function)
            setattr(
                self, f"{name}_jacobian", jacobian.evaluated_by(function, slope, "traced")
            )
        if len(names) == 2:
            self.kernel = evaluator

    def use_functions(self) -> None:
        """Evaluate f and h as written from now on, if a trace replaces them."""
        written, self._as_written, self._pinned = self._as_written, None, None
        self._pins = False
        if written is not None:
            self.__dict__.update(written)
            self.__dict__.pop("timed", None)

    @property
    def is_traced(self) -> bool:
        """Whether an estimator's copy may rely on a trace."""
        return self._pinned is not None and any(one.function for one in self._pinned.found.values())

    def trace_fault(self, x: Array, u: Array) -> str:
        """Which function differs from the trace that this copy relies on at a point, and how.

        Blank if none does. Never raises, whatever the functions do.

        Parameters
        ----------
        x : (n,) array
            The state.
        u : (m,) array
            The input.
        """
        if self._pinned is None or self.tracing is None or not np.isfinite(u).all():
            return ""
        wrong = self.tracing.wrong(self._pinned, x, u)
        return "" if wrong is None else f"{wrong[0]} has changed since it was traced: {wrong[1]}"

    def explain(self) -> str:
        """How f and h are evaluated, and what prevents a faster way, as text.

        A traced function is known as an expression: it has exact Jacobians, and estimators evaluate
        it in CasADi's virtual machine or in generated C code. Any other function is called as
        written; the text names the operation that stopped the trace, and its line.

        Examples
        --------
        >>> import qpmhe
        >>> system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1)
        >>> print(system.explain())
        f: traced. Jacobian: exact, by its trace.
        h: traced. Jacobian: exact, by its trace.
        """
        lines, own = [], self.copy(traced=True)
        for name, method in own.derivatives.items():
            text = "in CasADi"
            if own.tracing is not None:
                found = (own._pinned or own.tracing.now).found[name]
                text = "traced" if found.function else f"not traced: {found.reason}"
            lines.append(f"{name}: {text}. Jacobian: {_METHODS.get(method, method)}.")
        if own._has_other_steps:
            lines.append(f"No C code: {own.no_symbolic}.")
        return "\n".join(lines)

    def set_of(self, name: str) -> ConvexSet | None:
        """The set of this name (``states``, ``disturbances`` or ``noises``), hard or soft."""
        soft = self.soft.get(name)
        return getattr(self, name) if soft is None else soft.convex

    def with_sets(self, sets: Mapping[str, ConvexSet]) -> System:
        """The same system, its functions shared, with other sides of its sets, by name."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        for name, one in sets.items():
            soft = self.soft.get(name)
            if soft is None:
                setattr(other, name, one)
            else:
                other.soft = other.soft | {name: SoftSet(one, soft.linear, soft.quadratic)}
        other.__dict__.pop("timed", None)
        if self.make_timed is not None:
            other.make_timed = lambda: self.timed
        return other

    def use_scales(self, scales: ArrayLike) -> None:
        """Take typical magnitudes of the states, unless the user gave them with the system.

        Steps of numerical derivatives are shares of them, and Jacobians that the user gave are
        compared with differences. An estimator calls this on its copy of the system, with the
        standard deviations of its prior.

        Parameters
        ----------
        scales : (n,) array_like
            Magnitudes in the states' units, finite and above zero.

        Raises
        ------
        OptionError, ShapeError
            If a scale is not, or their number is wrong.
        ModelError
            If a given Jacobian is not the derivative at points of these magnitudes.
        """
        if not self._scales_given:
            self._take_scales(_checked_scales(scales, self.n))

    def _give_scales(self, scales: ArrayLike) -> None:
        self._take_scales(_checked_scales(scales, self.n))
        self._scales_given = True

    def _take_scales(self, scales: Array) -> None:
        self.scales = scales
        # Steps of a random length lead anywhere: `check` then has the first of a usual length.
        probes = [] if self._is_timed else probe_points(self.states, self.n, self.m, scales)
        for function in (self.f, self.h):
            function.try_again(probes)
        if self.rate_jacobian is not None:  # first, to be named if it is wrong
            self.rate_jacobian.use_scales(scales, None, probes)
        self.f_jacobian.use_scales(scales, scales, probes)
        self.h_jacobian.use_scales(scales, None, probes)

    def call_modes(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Modes of f and h and methods of their Jacobians; then those of `timed`, if it exists."""
        timed = self.__dict__.get("timed")
        systems = (self,) if timed is None else (self, timed)
        return (
            tuple(one.mode for system in systems for one in (system.f, system.h)),
            tuple(
                one.method for system in systems for one in (system.f_jacobian, system.h_jacobian)
            ),
        )

    def use_call_modes(self, found: tuple[tuple[str, ...], tuple[str, ...]]) -> None:
        """Call the functions as `call_modes` has found them called."""
        modes, methods = found
        systems = [self] if len(modes) == 2 else [self, self.timed]
        if len(modes) == 2:
            self.__dict__.pop("timed", None)
        for k, system in enumerate(systems):
            for j, name in enumerate(("f", "h")):
                jacobian = getattr(system, f"{name}_jacobian")
                # Traced here or there, but not in both: what was found there does not matter here.
                if (methods[2 * k + j] == "traced") == (jacobian.method == "traced"):
                    getattr(system, name).mode = modes[2 * k + j]
                    jacobian.use(methods[2 * k + j])

    def _check_soft_angles(self) -> None:
        soft, residual = self.soft.get("states"), self.state_residual
        if soft is None or residual is None:
            return
        angles = np.zeros(self.n, np.bool_)
        angles[residual.components] = True
        bounded = np.isin(soft.convex.bounded_components, residual.components)
        if bounded.any() or soft.convex.touched(angles).any():
            raise SetError(
                f"the soft set of states, {soft.convex!r}, bounds an angle (components "
                f"{residual.components.tolist()}), which is known only up to whole turns; leave it "
                "out, or write a qpmhe.Constraint of its sine and cosine."
            )

    @property
    def extensions(self) -> tuple[str, ...]:
        """Its soft sets and nonlinear constraints, in words."""
        found = [f"a soft set of {name}" for name in self.soft]
        return (*found, "nonlinear constraints") if self.constraints else tuple(found)

    def wrap(self, residuals: Array, states: Array, measurements: Array) -> None:
        """Turn differences (w, v), (K, n + p), into residuals, in place.

        Parameters
        ----------
        residuals : (K, n + p) array
            Differences from f and h of the states and the measurements.
        states, measurements : array
            What they are differences of: x(i+1) (K, n), and y(i) (K, p).
        """
        if self.state_residual is not None:
            self.state_residual.wrap(residuals[:, : self.n], states)
        if self.output_residual is not None:
            self.output_residual.wrap(residuals[:, self.n :], measurements)

    @property
    def derivatives(self) -> dict[str, str]:
        """How an estimator computes the Jacobians of f and h."""
        methods = {"f": self.f_jacobian.method, "h": self.h_jacobian.method}
        if self._pinned is None and self.tracing is not None and self.kernel is None:
            own = self.copy(traced=True)
            methods = {"f": own.f_jacobian.method, "h": own.h_jacobian.method}
        return methods

    def check(self, x: Array, u: Array) -> None:
        """Check that f, h and their Jacobians are finite and of the right shapes at a state.

        Parameters
        ----------
        x : (n,) array
            The state.
        u : (m,) array
            The input.

        Raises
        ------
        ModelError
            If one is not.
        """
        rate = () if self.rate_jacobian is None else (self.rate_jacobian,)
        own = () if self.constraints is None else (self.constraints,)
        written = self._as_written or vars(self)
        for function in (written["f"], written["h"], *rate):
            _check(function, x, u)
        fault = self.trace_fault(x, u)
        if fault:
            self.use_functions()
            warn_of(fault)
        for function in (self.f_jacobian, self.h_jacobian, *own):
            _check(function, x, u)

    def __repr__(self) -> str:
        return f"System(n={self.n}, p={self.p}, m={self.m}, states={self.states})"


_TRACED = ("f", "h", "f_jacobian", "h_jacobian", "kernel", "make_timed")
_METHODS = {
    "traced": "exact, by its trace", "given": "as given", "casadi": "exact, by CasADi",
    "jax": "exact, by JAX", "complex step": "by the complex step",
    "finite differences": "by finite differences",
}


def _check(function: Any, x: Array, u: Array) -> None:
    try:
        function.check(x, u)
    except ModelError:
        # Not every model is defined without input: one that divides by u is not.
        if not u.size or u.any():
            raise
        function.check(x, np.full_like(u, 0.5))


def _made(maker: Function, arguments: dict[str, Any]) -> Any:
    return maker(**arguments)


def checked_set(
    name: str, value: ConvexSet | SoftSet | None, dimension: int, meaning: str = ""
) -> ConvexSet | None:
    """The set if it is a hard one, else None, after a check of its type and dimension.

    The dimension may have a meaning.
    """
    if value is None:
        return None
    if not isinstance(value, (ConvexSet, SoftSet)):
        raise SetError(
            f"{name} is {shown(value)}; expected a qpmhe.Box, a qpmhe.Polytope or None."
        )
    if value.dimension != dimension:
        raise SetError(f"{name} has dimension {value.dimension}; expected {dimension}{meaning}.")
    return value if isinstance(value, ConvexSet) else None


def checked_system(value: Any) -> System:
    """The argument, if it is a System."""
    if not isinstance(value, System):
        raise ModelError(f"system is {shown(value)}; expected a qpmhe.System.")
    return value


def _checked_matrix(given: ArrayLike | None, n: int) -> Array | None:
    """G, if it has full column rank; None for the identity."""
    if given is None:
        return None
    matrix = numbers("disturbance_matrix", given)
    if matrix.ndim != 2 or matrix.shape[0] != n or not 1 <= matrix.shape[1] <= n:
        raise ShapeError(
            f"disturbance_matrix has shape {matrix.shape}; expected (n, r) = ({n}, r) with r from "
            f"1 to {n}: one column for each disturbance. Leave it out if every state has its own "
            "disturbance."
        )
    # In numbers of order one, so that no unit makes a column look small.
    rows, columns = equilibrated(matrix)
    values = np.linalg.svd(rows[:, None] * matrix * columns, compute_uv=False)
    if values[-1] <= SINGULAR * values[0]:
        raise ModelError(
            f"disturbance_matrix is {matrix.tolist()}, whose columns are linearly dependent; "
            f"expected rank {matrix.shape[1]}. Merge the disturbances that act alike."
        )
    return None if np.array_equal(matrix, np.eye(n)) else matrix


def _checked_scales(given: ArrayLike, n: int) -> Array:
    scales = vector("scales", given, n)
    if not (scales > 0.0).all():
        raise OptionError(
            f"scales is {scales.tolist()}; expected a number > 0 for each state, its "
            "typical magnitude in its unit. Leave scales out if they are unknown."
        )
    return scales


def probe_points(
    states: ConvexSet | None, n: int, m: int, scales: Array | float = 1.0
) -> Probes:
    """A few irregular points (x, u) within the state bounds, at which functions are tried."""
    generator = np.random.default_rng(20210829)
    probes: Probes = []
    # Positive ones first, where most models are defined; then all signs, where branches part.
    for scale, least in ((1.0, 0.2), (0.3, 0.2), (3.0, 0.2), (1.0, -1.0), (10.0, -1.0)):
        x = scales * (scale * generator.uniform(least, 1.0, n))
        if states is not None:
            low, high = states.lower, states.upper
            both = np.isfinite(low) & np.isfinite(high)
            share = generator.uniform(0.2, 0.8, n)
            with np.errstate(invalid="ignore"):
                x = np.where(both, low + share * (high - low), np.clip(x, low, high))
        probes.append((x, generator.uniform(0.2, 1.0, m)))
    return probes


def _over_leading(function: BatchedFunction) -> Function:
    """A function of (..., n), however the user wrote it."""
    if function.plain:
        return function.function

    def evaluate(x: Array, *inputs: Array) -> Any:
        u = inputs[0] if inputs else np.empty((*x.shape[:-1], 0))
        return function.batch(x, u) if x.ndim > 1 else np.asarray(function(x, u))

    return evaluate


def _timed_by_input(step: Function, m: int) -> Function:
    def evaluate(x: Array, u: Array) -> Any:
        return step(u[..., m:], x, u[..., :m]) if m else step(u, x)

    return evaluate


def _without_last(function: Function, m: int) -> Function:
    def evaluate(x: Array, u: Array) -> Any:
        return function(x, u[..., :m]) if x.ndim > 1 else function(x[None], u[None, :m])[0]

    return evaluate
