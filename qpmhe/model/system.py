"""The system whose state is estimated (eq:system)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.errors import report_unknown_options

from .._checks import count
from ..errors import InvalidInputError, ModelError, SetError
from .derivatives import Jacobian
from .functions import BatchedFunction, Probes, Trusted, check_inputs
from .sets import ConvexSet

if TYPE_CHECKING:
    from ..adapters.fused import Fused
    from ..codegen.expressions import CasadiModel

__all__ = ["Joint", "System", "checked_set", "probe_points"]

Array = NDArray[np.float64]
Function = Callable[..., Any]


class Joint(Protocol):
    """Several of a model's functions by one call."""

    #: What makes the calls of `qpmhe.adapters.fused.Fused`, where the model is machine code.
    fused: Callable[..., Fused | None] | None

    def stage(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Values f (n,), h (p,) and their Jacobian (n + p, n) at one state, until the next call."""

    def residuals(self, trajectory: Array, y: Array, u: Array) -> Array:
        """Residuals (w, v) along a trajectory (K + 1, n), in a (K, n + p) array of their own."""

    def prepare(self, horizon: int) -> None:
        """Make what the first updates with a window of this length would otherwise wait for."""


@report_unknown_options
class System:
    r"""A nonlinear discrete-time system with additive disturbance and noise.

    .. math::
        x(t+1) = f(x(t), u(t)) + w(t), \qquad y(t) = h(x(t), u(t)) + v(t),
        \qquad x \in \mathbb X,\ w \in \mathbb W,\ v \in \mathbb V

    as in (eq:system) of the paper, with known inputs u beside.

    Parameters
    ----------
    f : callable
        f(x) or f(x, u): x of shape (n,) to (n,). A function that takes (..., n), as NumPy's
        own functions do, is called once for a whole window where a trace on symbols proves
        that it may; any other is called state by state, with a copy of its arguments. With
        inputs, the second positional parameter is u, whatever its name and default.
    h : callable
        h(x) or h(x, u): x of shape (n,) to (p,). A scalar will do where p is 1. With inputs,
        f or h must take them.
    n, p : int
        Number of states and of outputs, at least 1.
    m : int
        Number of known inputs; 0 for none.
    f_jacobian, h_jacobian : callable, optional
        Derivatives with respect to x, of shapes (n, n) and (p, n), same arguments. Left out,
        they are computed: by the complex step where the function allows it, else by central
        differences; see ``derivatives``.
    states, disturbances, noises : Box or Polytope, optional
        The sets X, W and V; the whole space if left out.

    Raises
    ------
    ModelError
        If a function returns the wrong shape, changes its argument, or a given Jacobian is
        not the derivative.
    SetError
        If a set has the wrong dimension.

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> A = np.array([[1.0, 0.1], [0.0, 1.0]])
    >>> system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    >>> system.derivatives
    {'f': 'complex step', 'h': 'complex step'}
    """

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
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
    ) -> None:
        self.n, self.p, self.m = count("n", n, 1), count("p", p, 1), count("m", m, 0)
        self.states = checked_set("states", states, self.n)
        self.disturbances = checked_set("disturbances", disturbances, self.n)
        self.noises = checked_set("noises", noises, self.p)
        probes = probe_points(self.states, self.n, self.m)
        self.f = BatchedFunction("f", f, (self.n,), self.m, probes)
        self.h = BatchedFunction("h", h, (self.p,), self.m, probes)
        check_inputs(self.m, f=self.f.takes_input, h=self.h.takes_input)
        self.f_jacobian = Jacobian(self.f, f_jacobian, self.m, probes)
        self.h_jacobian = Jacobian(self.h, h_jacobian, self.m, probes)
        #: The sampling time of a system made by `from_ode`, None otherwise.
        self.dt: float | None = None
        #: f, h and Jacobians by one call, where the model offers that.
        self.joint: Joint | None = None
        #: The same model as CasADi functions, of a system made by `from_casadi`.
        self.symbolic: CasadiModel | None = None
        self._timed: Callable[[], System] | None = None
        self._recipe: tuple[Function, dict[str, Any]] = (
            type(self),
            {
                "f": f, "h": h, "n": n, "p": p, "m": m,
                "f_jacobian": f_jacobian, "h_jacobian": h_jacobian,
                "states": states, "disturbances": disturbances, "noises": noises,
            },
        )

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
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
    ) -> System:
        r"""Discretise :math:`\dot x = f_c(x, u)` with a fixed step; u is held over the step.

        The disturbance w stays that of the discrete-time system: it is added once a step.

        Parameters
        ----------
        rate : callable
            f_c(x) or f_c(x, u), in units of x per unit of time.
        h, n, p, m, h_jacobian, states, disturbances, noises
            As for `System`.
        dt : float
            Sampling time, in the time unit of the rate.
        method : {"rk4", "euler"}
            Runge-Kutta of order 4, or one explicit Euler step.
        rate_jacobian : callable, optional
            Derivative of the rate with respect to x, (n, n).

        Raises
        ------
        OptionError
            If dt is not positive or the method unknown.
        ModelError, SetError
            As for `System`.
        """
        from .ode import ode_system

        return ode_system(
            cls, rate, h, dt=dt, n=n, p=p, m=m, method=method, rate_jacobian=rate_jacobian,
            h_jacobian=h_jacobian, states=states, disturbances=disturbances, noises=noises,
        )

    @classmethod
    def from_casadi(
        cls,
        f: Any,
        h: Any,
        *,
        dt: float | None = None,
        method: str = "rk4",
        n: int | None = None,
        p: int | None = None,
        m: int | None = None,
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
        compiled: bool | None = None,
    ) -> System:
        r"""A model written for CasADi, with exact Jacobians, evaluated without Python.

        Its functions are compiled once, kept in a cache on disk, and called on a whole
        window at once; without a C compiler CasADi's own virtual machine evaluates them.
        Such a system is also what ``engine="compiled"`` and `qpmhe.codegen` need.

        Parameters
        ----------
        f, h : casadi.Function or callable
            (x) or (x, u) to a column: functions of CasADi, or Python functions that take
            symbolic columns and return one column or a list of entries.
        dt : float, optional
            If given, f is the right-hand side of an ODE, which is discretised with this
            sampling time; u is held over the step.
        method : {"rk4", "euler"}
            Its discretisation.
        n, p, m : int, optional
            Numbers of states, outputs and inputs; n (and m, if there are inputs) are needed
            where f is no casadi.Function.
        states, disturbances, noises : Box or Polytope, optional
            The sets X, W and V.
        compiled : bool, optional
            Whether to compile the functions; left out, wherever there is a compiler.

        Raises
        ------
        ModelError, SetError, OptionError
            If something does not fit.
        InvalidInputError
            If CasADi is not installed.
        CompilationError
            If ``compiled`` is True, and it fails.
        """
        from ..adapters.casadi import casadi_system

        return casadi_system(
            f, h, dt=dt, method=method, n=n, p=p, m=m, states=states,
            disturbances=disturbances, noises=noises, compiled=compiled,
        )

    @classmethod
    def from_jax(
        cls,
        f: Function,
        h: Function,
        *,
        n: int,
        p: int,
        m: int = 0,
        dt: float | None = None,
        method: str = "rk4",
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
    ) -> System:
        """A model written for JAX, compiled and vectorised by it, with exact Jacobians.

        Everything is in double precision, whatever the process's own setting is.

        Parameters
        ----------
        f, h : callable
            f(x) or f(x, u) and h(x) or h(x, u) of one state, written with ``jax.numpy``.
        n, p, m : int
            Numbers of states, outputs and inputs.
        dt : float, optional
            If given, f is the right-hand side of an ODE, which is discretised with this
            sampling time; u is held over the step.
        method : {"rk4", "euler"}
            Its discretisation.
        states, disturbances, noises : Box or Polytope, optional
            The sets X, W and V.

        Raises
        ------
        ModelError, SetError, OptionError
            If something does not fit.
        InvalidInputError
            If JAX is not installed.
        """
        from ..adapters.jax import jax_system

        return jax_system(
            f, h, n=n, p=p, m=m, dt=dt, method=method, states=states,
            disturbances=disturbances, noises=noises,
        )

    @classmethod
    def from_control(
        cls,
        system: Any,
        *,
        dt: float | None = None,
        method: str | None = None,
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
    ) -> System:
        """A system of python-control, with the inputs that it has there.

        Parameters
        ----------
        system : control.StateSpace or control.NonlinearIOSystem
            In discrete time as it is; in continuous time it is discretised. A system that
            depends on time is refused.
        dt : float, optional
            Sampling time of a system in continuous time.
        method : {"zoh", "rk4", "euler"}, optional
            How that is discretised. The default is exact for a held input (``zoh``) where
            the system is linear, ``rk4`` where it is not.
        states, disturbances, noises : Box or Polytope, optional
            The sets X, W and V.

        Raises
        ------
        ModelError, SetError, OptionError
            If something does not fit.
        InvalidInputError
            If python-control is not installed.
        """
        from ..adapters.control import control_system

        return control_system(
            system, dt=dt, method=method, states=states, disturbances=disturbances,
            noises=noises,
        )

    @classmethod
    def from_sympy(
        cls,
        f: Any,
        h: Any,
        x: Any,
        u: Any = (),
        *,
        dt: float | None = None,
        method: str = "rk4",
        states: ConvexSet | None = None,
        disturbances: ConvexSet | None = None,
        noises: ConvexSet | None = None,
    ) -> System:
        """A model in SymPy's symbols, turned into NumPy functions with exact Jacobians.

        Parameters
        ----------
        f, h : sequence of expressions, or a matrix
            Entries of the next state (or of its rate, with dt) and of the output.
        x, u : symbol, or sequence of symbols or functions of time
            The states and the inputs; taken as real.
        dt : float, optional
            If given, f is the right-hand side of an ODE, which is discretised with this
            sampling time; u is held over the step.
        method : {"rk4", "euler"}
            Its discretisation.
        states, disturbances, noises : Box or Polytope, optional
            The sets X, W and V.

        Raises
        ------
        ModelError, SetError, OptionError
            If something does not fit, such as a symbol that is neither state nor input.
        InvalidInputError
            If SymPy is not installed.
        """
        from ..adapters.sympy import sympy_system

        return sympy_system(
            f, h, x, u, dt=dt, method=method, states=states, disturbances=disturbances,
            noises=noises,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # Made anew from the user's functions: the closures inside cannot be pickled.
        return _made, self._recipe

    @cached_property
    def timed(self) -> System:
        """The same system with the step's length as one more input, behind the others.

        Raises
        ------
        InvalidInputError
            If the system has no model in continuous time.
        """
        if self._timed is None:
            raise InvalidInputError(
                "the system is discrete: steps of another length need a model in continuous "
                "time, as System.from_ode takes it."
            )
        return self._timed()

    def _private(self) -> System:
        """The same system for one estimator, which may change how its functions are called."""
        other = object.__new__(type(self))  # `copy` would make the model anew, as pickle does
        other.__dict__.update(self.__dict__)
        other.f, other.h = self.f.copy(), self.h.copy()
        other.f_jacobian = self.f_jacobian.copy(other.f)
        other.h_jacobian = self.h_jacobian.copy(other.h)
        other.__dict__.pop("timed", None)
        if self._timed is not None:
            other._timed = lambda: self.timed._private()
        return other

    def _calling(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Modes of the functions and methods of the Jacobians, behind them those of `timed`."""
        timed = self.__dict__.get("timed")
        systems = (self,) if timed is None else (self, timed)
        return (
            tuple(one.mode for system in systems for one in (system.f, system.h)),
            tuple(
                one.method for system in systems for one in (system.f_jacobian, system.h_jacobian)
            ),
        )

    def _call_as(self, calling: tuple[tuple[str, ...], tuple[str, ...]]) -> None:
        """Call the functions as `_calling` said."""
        modes, methods = calling
        systems = [self] if len(modes) == 2 else [self, self.timed]
        if len(modes) == 2:
            self.__dict__.pop("timed", None)
        for k, system in enumerate(systems):
            system.f.mode, system.h.mode = modes[2 * k : 2 * k + 2]
            system.f_jacobian.use(methods[2 * k])
            system.h_jacobian.use(methods[2 * k + 1])

    @property
    def derivatives(self) -> dict[str, str]:
        """How the Jacobians of f and h are found."""
        return {"f": self.f_jacobian.method, "h": self.h_jacobian.method}

    def check(self, x: Array, u: Array) -> None:
        """Insist that f and h are finite, of the right shapes, at a state.

        Parameters
        ----------
        x : (n,) array
            The state.
        u : (m,) array
            The input.

        Raises
        ------
        ModelError
            If they are not.
        """
        for function in (self.f, self.h, self.f_jacobian, self.h_jacobian):
            try:
                function.check(x, u)
            except ModelError:
                # Not every model is defined without input: one that divides by u is not.
                if not u.size or u.any():
                    raise
                function.check(x, np.full_like(u, 0.5))

    def __repr__(self) -> str:
        return f"System(n={self.n}, p={self.p}, m={self.m}, states={self.states})"


def _made(maker: Function, arguments: dict[str, Any]) -> Any:
    return maker(**arguments)


def checked_set(name: str, value: ConvexSet | None, dimension: int) -> ConvexSet | None:
    """Insist on a set of this dimension, or none."""
    if value is None:
        return None
    if not isinstance(value, ConvexSet):
        raise SetError(f"{name} is {value!r}; expected a qpmhe.Box, a qpmhe.Polytope or None.")
    if value.dimension != dimension:
        raise SetError(f"{name} has dimension {value.dimension}; expected {dimension}.")
    return value


def probe_points(states: ConvexSet | None, n: int, m: int) -> Probes:
    """A few irregular points inside the state bounds, to try functions on."""
    generator = np.random.default_rng(20210829)
    probes: Probes = []
    # Positive ones first, where most models are defined; then all signs, where branches part.
    for scale, least in ((1.0, 0.2), (0.3, 0.2), (3.0, 0.2), (1.0, -1.0), (10.0, -1.0)):
        x = scale * generator.uniform(least, 1.0, n)
        if states is not None:
            low, high = states.lower, states.upper
            both = np.isfinite(low) & np.isfinite(high)
            share = generator.uniform(0.2, 0.8, n)
            with np.errstate(invalid="ignore"):
                x = np.where(both, low + share * (high - low), np.clip(x, low, high))
        probes.append((x, generator.uniform(0.2, 1.0, m)))
    return probes
