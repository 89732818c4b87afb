"""The system whose state is estimated (eq:system)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from inspect import signature
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.errors import check_options, report_unknown_options
from qpmhe_solvers.values import shown

from .._checks import dimension
from ..errors import ModelError
from .constraint import Constraint, checked_constraints
from .constraints import ConstraintFunctions
from .continuous import ContinuousTime
from .derivatives import Jacobian
from .functions import BatchedFunction, Trusted
from .model import Model, ModelCache, Origin, check_at
from .points import FEW, USUAL, Points, points
from .residuals import Residual, Turns, checked_residual
from .sets import ConvexSet, SoftSet
from .signals import Signals
from .step_table import step_table
from .system_arguments import (
    check_soft_angles,
    checked_matrix,
    checked_scales,
    checked_set,
    tried_functions,
)
from .traces import ModelTrace
from .unsolved_step import unsolved_step

Array = NDArray[np.float64]
Function = Callable[..., Any]


@report_unknown_options
class System(ContinuousTime):
    r"""A nonlinear discrete-time system with additive disturbance and noise.

    .. math::
        x(t+1) = f(x(t), u(t)) + G w(t), \qquad y(t) = h(x(t), u(t)) + v(t),
        \qquad x \in \mathbb X,\ w \in \mathbb W,\ v \in \mathbb V

    as in (eq:system) of the paper, where G is the identity, plus known inputs u.

    Parameters
    ----------
    f : callable
        f(x) or f(x, u): maps x (n,) to (n,). Estimators evaluate the expression that a trace on
        symbols finds, for a whole window at once; a function that cannot be traced is called state
        by state, with a copy of its arguments. Only for its differences is it called once for many
        states, as (K, n), if that gives the same at the initial state and others. With inputs, the
        second positional parameter is u, whatever its name.
    h : callable
        h(x) or h(x, u): maps x (n,) to (p,), or to a scalar if p is 1. With inputs, f or h must
        take them.
    n, p : int
        Number of states and of outputs, at least 1.
    m : int
        Number of known inputs; 0 for none.
    f_jacobian, h_jacobian : callable, optional
        Derivatives with respect to x, of shapes (n, n) and (p, n), same arguments. If left out, or
        equal up to rounding, the exact derivatives of the function's trace are used, see `explain`.
        If a function cannot be traced, they are differences, central or, at a bound of X, inward;
        see ``derivatives``.
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
        given = {
            "f": f, "h": h, "n": n, "p": p, "m": m,
            "f_jacobian": f_jacobian, "h_jacobian": h_jacobian,
            "states": states, "disturbances": disturbances, "noises": noises,
            "scales": scales, "disturbance_matrix": disturbance_matrix,
            "output_residual": output_residual, "state_residual": state_residual,
            "constraints": constraints,
        }
        self._make(given, Origin(recipe=(type(self), given)))

    @classmethod
    def made(
        cls, f: Function | Trusted, h: Function | Trusted, origin: Origin, **options: Any
    ) -> System:
        """Make a system as `System` does, by a function of this package that says what it is.

        Parameters
        ----------
        f, h : callable or Trusted
            As for `System`; a `Trusted` one takes leading dimensions and is not tried.
        origin : Origin
            Of what the system is made: its discretisation, its expression, how it is pickled.
        **options
            The other arguments of `System`.
        """
        check_options("System", options, list(signature(System).parameters))
        system = object.__new__(cls)
        system._make({"f": f, "h": h, **options}, origin)
        return system

    def _make(self, given: Mapping[str, Any], origin: Origin) -> None:
        """Check and remember what was given; nothing is set after this."""
        own = self.__dict__
        get = given.get
        n, p = dimension("n", given["n"], 1), dimension("p", given["p"], 1)
        m = dimension("m", get("m", 0), 0)
        own.update(n=n, p=p, m=m, origin=origin)
        own["disturbance_matrix"] = checked_matrix(get("disturbance_matrix"), n)
        for name, size in (("states", n), ("disturbances", self.r), ("noises", p)):
            own[name] = checked_set(name, get(name), size)
        own["soft"] = {
            name: one for name in ("states", "disturbances", "noises")
            if isinstance(one := get(name), SoftSet)
        }
        own["output_residual"] = checked_residual("output_residual", get("output_residual"), p)
        own["state_residual"] = checked_residual("state_residual", get("state_residual"), n)
        own["turns"] = None
        if self.states is not None and self.state_residual is not None:
            turns = Turns(self.state_residual, self.states)
            own["states"], own["turns"] = turns.states, turns or None
        check_soft_angles(self.soft.get("states"), self.state_residual, n)
        functions = tried_functions(self, given)
        own["constraints"] = None
        listed = checked_constraints(get("constraints"))
        if listed:
            own["constraints"] = ConstraintFunctions(
                listed, {"x": n, "u": m, "w": self.r, "v": p},
                {"x": self.states, "w": self.disturbances, "v": self.noises},
            )
        scales = None if get("scales") is None else checked_scales(given["scales"], n)
        if scales is not None:
            functions.take_scales(scales, self.probes(scales))
        own["has_scales"] = scales is not None
        own["tracing"] = None
        if origin.symbolic is None:
            known = origin.rate is not None or origin.sources is not None
            own["tracing"] = ModelTrace(
                origin.rate or functions.f, functions.h, n, p, m, self.states,
                origin.dt if known else None, origin.how if known else None, origin.sources,
                known and origin.rate is None, origin.equations,
            )
        own["evaluation"] = Model(self, functions, functions, scales)
        own["_models"] = ModelCache()

    if TYPE_CHECKING:
        n: int
        p: int
        m: int
        disturbance_matrix: Array | None
        states: ConvexSet | None
        disturbances: ConvexSet | None
        noises: ConvexSet | None
        #: Those of X, W and V that are soft, by name; `states` and the others are None then.
        soft: Mapping[str, SoftSet]
        #: How outputs and states are subtracted; None for plain differences.
        output_residual: Residual | None
        state_residual: Residual | None
        #: Moves angles into the turn between their bounds; None where X bounds no angle.
        turns: Turns | None
        #: The nonlinear constraints; None without any.
        constraints: ConstraintFunctions | None
        #: Whether the user gave the states' magnitudes.
        has_scales: bool
        #: What it is made of besides its functions.
        origin: Origin
        #: Traces of f and h, found when needed; None for a model that was given in CasADi.
        tracing: ModelTrace | None
        #: What evaluates f and h: as they are written, or as an estimator does.
        evaluation: Model
        _models: ModelCache

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise AttributeError(
            f"a System does not change: {name} cannot be set. Make another one with the arguments "
            "that it should have, or with other sets by with_sets."
        )

    def __delattr__(self, name: str) -> NoReturn:
        self.__setattr__(name, None)

    def _changed(self, **attributes: Any) -> System:
        """The same system but for these attributes."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__ | attributes)
        other.__dict__.pop("timed", None)
        return other

    def with_origin(self, **changes: Any) -> System:
        """The same system, made of something else: see `Origin`."""
        other = self._changed(origin=replace(self.origin, **changes), _models=ModelCache())
        other.__dict__["evaluation"] = replace(self.evaluation, system=other)
        return other

    def model(self, scales: ArrayLike | None = None) -> Model:
        """What estimators evaluate in the place of f and h; made once for each magnitude.

        Parameters
        ----------
        scales : (n,) array_like, optional
            Typical magnitudes of the states, in their units, finite and above zero; those that the
            user gave with the system take precedence. Steps of numerical derivatives are shares of
            them, and Jacobians that the user gave are compared with differences.

        Raises
        ------
        OptionError, ShapeError
            If a scale is not above zero, or their number is wrong.
        ModelError
            If a given Jacobian is not the derivative at points of these magnitudes.
        """
        given = self.has_scales or scales is None
        known = None if given or scales is None else checked_scales(scales, self.n)
        return self._models.of(self.evaluation.system.evaluation, known)

    def evaluated_by(self, model: Model) -> System:
        """The same system, whose functions are evaluated as this model does."""
        return self._changed(evaluation=model)

    def at(self, x: Array, u: Array) -> System:
        """The same system, checked at a state (n,) and an input (m,) that will be used.

        Parameters
        ----------
        x : (n,) array
            The state.
        u : (m,) array
            The input.

        Raises
        ------
        ModelError
            If f, h, their Jacobians or a constraint are not finite there, or of a wrong shape.
        """
        if self.origin.equations is not None:
            self.origin.equations.check(x, u[: self.m - self.origin.is_timed])
        try:
            model = self.evaluation.at(x, u)
        except ModelError as error:
            reason = ""
            with suppress(Exception), np.errstate(all="ignore"):  # of the user's functions
                if not np.isfinite(self.f(x, u)).all():
                    reason = unsolved_step(self.origin, x, u)
            if not reason:
                raise
            raise ModelError(reason) from error
        found = self if model is self.evaluation else self.evaluated_by(model)
        if self.constraints is not None:
            constraints = self.constraints.copy()
            check_at(constraints, x, u)
            found = found.with_constraints(constraints)
        return found

    @property
    def is_traced(self) -> bool:
        """Whether it is evaluated by expressions that may become wrong."""
        constraints = self.constraints
        return self.evaluation.is_traced or (constraints is not None and constraints.is_traced)

    @property
    def traced_functions(self) -> tuple[Callable[..., Any], ...]:
        """The user's functions in whose places traces are evaluated."""
        constraints = () if self.constraints is None else self.constraints.traced_functions
        return *self.evaluation.traced_functions, *constraints

    def fault(self, where: Points) -> str:
        """Which function differs from its trace at these states and inputs, and how.

        Blank if none does.

        Parameters
        ----------
        where : list of (x, u)
            States (n,) and inputs (m,); what is not finite is left out.
        """
        fault = self.evaluation.fault(where)
        if not fault and self.constraints is not None:
            return self.constraints.fault([one for one in where if np.isfinite(one[1]).all()])
        return fault

    def usual_points(self) -> Points:
        """States and inputs of several magnitudes, in the units of `scales`, within X's bounds."""
        units = 1.0 if self.scales is None else self.scales
        return points(USUAL, self.n, self.m, self.states, units)

    def as_written(self) -> System:
        """The same system, whose functions are called as they are written."""
        constraints = self.constraints
        return self._changed(
            evaluation=self.evaluation.as_written(),
            constraints=None if constraints is None else constraints.as_written(),
        )

    def with_constraints(self, constraints: ConstraintFunctions) -> System:
        """The same system, whose constraints are called and scaled in another way."""
        return self._changed(constraints=constraints)

    def evaluated_like(self, other: System) -> System:
        """The same system, whose functions and constraints are evaluated as another's."""
        return self._changed(evaluation=other.evaluation, constraints=other.constraints)

    def probes(self, scales: Array) -> Points:
        """Points at which functions are tried, for states of these magnitudes.

        Parameters
        ----------
        scales : (n,) array
            The magnitudes, in the states' units.
        """
        # Steps of a random length lead anywhere: `at` then has the first of a usual length.
        if self.origin.is_timed:
            return []
        return points(FEW, self.n, self.m, self.states, scales)

    @property
    def f(self) -> BatchedFunction:
        """The function f, of one state, and by its ``batch`` of many."""
        return self.evaluation.functions.f

    @property
    def h(self) -> BatchedFunction:
        """The function h, likewise."""
        return self.evaluation.functions.h

    @property
    def f_jacobian(self) -> Jacobian:
        """The derivative of f with respect to x, likewise; exact where f is an expression."""
        return self._differentiated.functions.f_jacobian

    @property
    def h_jacobian(self) -> Jacobian:
        """The derivative of h with respect to x, likewise."""
        return self._differentiated.functions.h_jacobian

    @property
    def _differentiated(self) -> Model:
        """What evaluates the Jacobians: as an estimator does."""
        model = self.evaluation
        return self.model() if model is model.system.evaluation else model

    @property
    def scales(self) -> Array | None:
        """Typical magnitudes of the states, (n,); None if they are not known."""
        return self.evaluation.scales

    @property
    def held(self) -> Mapping[int, float]:
        """Parameters that a window without information on them holds: see `Origin`."""
        return self.origin.held

    @property
    def signals(self) -> Signals | None:
        """Names, units and starts of its variables; None where its origin knows none."""
        return self.origin.signals

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

    def __reduce__(self) -> tuple[Any, ...]:
        # Made again from the user's functions: the closures inside cannot be pickled.
        return _made, self.origin.recipe or (type(self), {})

    @property
    def symbolic(self) -> Any:
        """The model as CasADi functions, for C code generation; None if it has no such form.

        NumPy functions are traced at the first access, or when an estimator is made. This takes
        some milliseconds, and 10 to 150 ms to import CasADi, which a `System` alone never does.
        """
        return self.evaluation.symbolic

    @property
    def no_symbolic(self) -> str:
        """Why ``symbolic`` is None, as text; blank otherwise."""
        return self.evaluation.no_symbolic

    def explain(self) -> str:
        """How f and h are evaluated, and what prevents a faster way, as text.

        A traced function is known as an expression: it has exact Jacobians, and estimators evaluate
        it in CasADi's virtual machine or in generated C code. Any other function is called as
        written; the text names the operation that stopped the trace, and its line.
        Of a discretised system, it shows the errors of its step and of others, as shares of states
        whose magnitudes ``scales`` says, and what they cost. That takes some tenths of a second.

        Examples
        --------
        >>> import qpmhe
        >>> system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1)
        >>> print(system.explain())
        f: traced. Jacobian: exact, by its trace.
        h: traced. Jacobian: exact, by its trace.
        """
        lines, own = [], self.model()
        for name, method in zip(("f", "h"), own.methods, strict=True):
            text = "in CasADi"
            if self.tracing is not None:
                found = (own.trace or self.tracing.now).found[name]
                text = "traced" if found.function else f"not traced: {found.reason}"
            lines.append(f"{name}: {text}. Jacobian: {_METHODS.get(method, method)}.")
        if self.origin.how is not None and self.dt is not None:
            lines.append(step_table(self))
        if self.signals is not None:
            lines.append(str(self.signals))
        if own.no_symbolic and self.has_other_steps:
            lines.append(f"No C code: {own.no_symbolic}.")
        return "\n".join(lines)

    def set_of(self, name: str) -> ConvexSet | None:
        """The set of this name (``states``, ``disturbances`` or ``noises``), hard or soft."""
        soft = self.soft.get(name)
        return getattr(self, name) if soft is None else soft.convex

    def with_sets(self, sets: Mapping[str, ConvexSet | None]) -> System:
        """The same system, its functions shared, with other sets by name; None is no set."""
        changed: dict[str, Any] = {}
        for name, one in sets.items():
            soft = self.soft.get(name)
            if soft is None:
                changed[name] = one
                continue
            others = {**changed.get("soft", self.soft)}
            if one is None:
                del others[name]
            else:
                others[name] = SoftSet(one, soft.linear, soft.quadratic)
            changed["soft"] = others
        return self._changed(**changed)

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
        return dict(zip(("f", "h"), self._differentiated.methods, strict=True))

    def __repr__(self) -> str:
        return f"System(n={self.n}, p={self.p}, m={self.m}, states={self.states})"


_METHODS = {
    "traced": "exact, by its trace", "given": "as given", "casadi": "exact, by CasADi",
    "integrator": "by CasADi, to its integrator's tolerances",
    "jax": "exact, by JAX", "fmu": "by the FMU's directional derivatives",
    "finite differences": "by finite differences",
}
def _made(maker: Function, arguments: dict[str, Any]) -> Any:
    return maker(**arguments)


def checked_system(value: Any) -> System:
    """The argument, if it is a System."""
    if not isinstance(value, System):
        raise ModelError(f"system is {shown(value)}; expected a qpmhe.System.")
    return value
