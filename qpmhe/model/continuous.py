"""Systems of differential equations and of equations: how they are made, and their steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Unpack, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidInputError
from .dae import made_from_dae, made_from_implicit
from .functions import Trusted
from .implicit_steps import COLLOCATIONS
from .ode import checked_method, made_from_ode
from .sets import ConvexSet, SoftSet
from .system_arguments import SystemOptions

if TYPE_CHECKING:
    from .model import Model, Origin
    from .system import System
    from .traces import ModelTrace

Array = NDArray[np.float64]
Function = Callable[..., Any]


class ContinuousTime:
    """The part of `System` by which models in continuous time are discretised."""

    if TYPE_CHECKING:
        n: int
        m: int
        origin: Origin
        tracing: ModelTrace | None
        evaluation: Model

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
        steps: int = 1,
        tolerance: float | None = None,
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
        method : {"rk4", "euler", "radau", "midpoint", "auto"}
            Explicit: Runge-Kutta of order 4, or Euler. Implicit, for stiff rates: Radau IIA of
            order 5, which damps what decays within a step, or the implicit midpoint rule of order
            2, which keeps quadratic invariants. Implicit steps are solved by Newton's method to
            rounding; where that fails, the model fails at this state. Where a step is too long for
            the disturbance's size, the estimator warns; see `qpmhe.MovingHorizonEstimator`.
            ``"auto"`` chooses between substeps of ``"rk4"`` and of ``"radau"``, once, now;
            `explain` shows what was tried.
        steps : int
            Number of substeps of equal length in each sample; left out with ``"auto"``.
        tolerance : float, optional
            With ``"auto"``: the largest error of a sample's step, as a share of the states or of
            their ``scales``, at states of these magnitudes within X; 1e-6 if left out.
        rate_jacobian : callable, optional
            Derivative of the rate with respect to x, (n, n).
        h_jacobian, **options
            As for `System`.

        Raises
        ------
        OptionError
            If dt is not positive, the method unknown, steps no integer from 1 on, or a tolerance is
            given without ``"auto"``, or steps with it.
        ModelError, SetError
            As for `System`; also if ``"auto"`` finds no step that is accurate enough.
        """
        how, allowed = checked_method(method, steps, tolerance)
        return made_from_ode(
            cast("type[System]", cls), rate, h, dt=dt, n=n, p=p, m=m, how=how,
            rate_jacobian=rate_jacobian, h_jacobian=h_jacobian, options=options, tolerance=allowed,
        )

    @classmethod
    def from_dae(
        cls,
        rate: Function | Trusted,
        algebraic: Function | Trusted,
        h: Function | Trusted,
        *,
        dt: float,
        n: int,
        k: int,
        p: int,
        m: int = 0,
        algebraic_guess: ArrayLike,
        algebraic_set: ConvexSet | SoftSet | None = None,
        method: str = "radau",
        steps: int = 1,
        tolerance: float | None = None,
        **options: Unpack[SystemOptions],
    ) -> System:
        r"""Discretise a differential-algebraic equation of index 1; u is held over the step.

        .. math::
            \dot x = f_c(x, z, u), \qquad 0 = g(x, z, u), \qquad y = h(x, z, u)

        The algebraic states z are functions z(x, u), wherever :math:`\partial g / \partial z` is
        regular. An estimator estimates x; `algebraic_states` gives the z of a state. The
        disturbance w acts in discrete time: it is added to x once a step. Where u jumps, z jumps
        with it: y(t) is that of u(t), the input held from t on.

        Newton's method solves for z from ``algebraic_guess``, and for stages and z of a step
        together; both go on until rounding stops them, so that nothing depends on what was solved
        before. Where it fails, the model fails at this state.

        Parameters
        ----------
        rate, algebraic, h : callable
            f_c(x, z, u) (n,), in units of x per unit of time, g(x, z, u) (k,) and h(x, z, u) (p,),
            or functions of x and z alone. Functions that cannot be traced have derivatives by
            differences.
        dt : float
            Sampling time, in the time unit of the rate.
        n, k, p, m : int
            Numbers of states, algebraic states, outputs and inputs; m is 0 without inputs.
        algebraic_guess : (k,) array_like
            Where z is looked for, in its units; it picks one of several solutions. Its magnitudes
            are those of z for derivatives by differences.
        algebraic_set : Box or Polytope, optional
            A set of z at every sample, hard or soft: nonlinear constraints of x and u.
        method : {"radau", "midpoint", "auto"}
            As for `from_ode`; ``"auto"`` chooses between substeps of ``"radau"``.
        steps : int
            Number of substeps of equal length in each sample; left out with ``"auto"``.
        tolerance : float, optional
            As for `from_ode`, of the error in x.
        **options
            As for `System`.

        Raises
        ------
        OptionError, ShapeError
            If dt is not positive, the method unknown, steps no integer from 1 on, or the guess
            does not have k entries.
        ModelError, SetError
            As for `System`; also if :math:`\partial g / \partial z` is singular, structurally or at
            all points that are tried (index 2), or at the guess (a fold), or if ``"auto"`` finds no
            step that is accurate enough. An estimator raises one if no z is found at its initial
            state.

        Examples
        --------
        A pendulum that a spring holds, whose force f solves an equation:

        >>> import numpy as np, qpmhe
        >>> system = qpmhe.System.from_dae(
        ...     lambda x, z: np.stack([x[1], z[0] - np.sin(x[0])]),
        ...     lambda x, z: z + 0.1 * z**3 + x[:1], lambda x, z: x[0] + z[0],
        ...     dt=0.1, n=2, k=1, p=1, algebraic_guess=[0.0])
        >>> system.algebraic_states(np.array([1.1, 0.0]))
        array([-1.])
        """
        how, allowed = checked_method(method, steps, tolerance, tuple(COLLOCATIONS))
        return made_from_dae(
            cast("type[System]", cls), rate, algebraic, h, dt=dt, n=n, k=k, p=p, m=m,
            how=how, guess=algebraic_guess, options=options, algebraic_set=algebraic_set,
            tolerance=allowed,
        )

    @classmethod
    def from_implicit(
        cls,
        residual: Function,
        h: Function,
        *,
        dt: float,
        n: int,
        p: int,
        k: int = 0,
        m: int = 0,
        algebraic_guess: ArrayLike | None = None,
        rate_guess: ArrayLike | None = None,
        algebraic_set: ConvexSet | SoftSet | None = None,
        method: str = "radau",
        steps: int = 1,
        tolerance: float | None = None,
        **options: Unpack[SystemOptions],
    ) -> System:
        r"""Discretise :math:`0 = F(\dot x, x, z, u)` of index 1; u is held over the step.

        The rates are algebraic states, too, in front of z: `from_dae` says how they are solved
        for, and `algebraic_states` gives both.

        Parameters
        ----------
        residual : callable
            F(xdot, x, z, u) (n + k,), or F(xdot, x, z); without z where k is 0.
        h : callable
            Output h(x, z, u) (p,) or h(x, z); without z where k is 0.
        dt : float
            Sampling time.
        n, p, k, m : int
            Numbers of states, outputs, algebraic states and inputs.
        algebraic_guess, rate_guess : (k,) and (n,) array_like, optional
            Where z and the rates are looked for. The rates' is zero if left out.
        algebraic_set : Box or Polytope, optional
            A set of z alone, of dimension k; see `from_dae`.
        method, steps, tolerance, **options
            As for `from_dae`.

        Raises
        ------
        InvalidInputError
            If k is not 0 and ``algebraic_guess`` is missing.
        OptionError, ShapeError, ModelError, SetError
            As for `from_dae`.

        Examples
        --------
        A mass that depends on the position:

        >>> import numpy as np, qpmhe
        >>> system = qpmhe.System.from_implicit(
        ...     lambda xdot, x: np.stack([xdot[0] - x[1], (2.0 + x[0]) * xdot[1] + x[0]]),
        ...     lambda x: x[0], dt=0.1, n=2, p=1)
        >>> system.algebraic_states(np.array([1.0, 0.0])).round(4)
        array([ 0.    , -0.3333])
        """
        how, allowed = checked_method(method, steps, tolerance, tuple(COLLOCATIONS))
        return made_from_implicit(
            cast("type[System]", cls), residual, h, dt=dt, n=n, k=k, p=p, m=m,
            how=how, guess=algebraic_guess, rate_guess=rate_guess, options=options,
            algebraic_set=algebraic_set, tolerance=allowed,
        )

    @property
    def dt(self) -> float | None:
        """Sampling time of a discretised ODE; None for a discrete-time model."""
        return self.origin.dt

    @property
    def method(self) -> str | None:
        """How it is discretised; None for a discrete-time model."""
        return None if self.origin.how is None else self.origin.how.method

    @property
    def steps(self) -> int:
        """Number of substeps of an ODE in a sample; 1 for a discrete-time system."""
        return 1 if self.origin.how is None else self.origin.how.steps

    @property
    def has_timed(self) -> bool:
        """Whether it takes steps of other lengths: see `timed`."""
        return self.origin.make_timed is not None

    @property
    def has_other_steps(self) -> bool:
        """Whether it takes steps of other lengths that the trace knows nothing of."""
        return self.has_timed and (self.tracing is None or self.tracing.dt is None)

    @cached_property
    def timed(self) -> System:
        """The same system with the length of the step as one more input, behind the others.

        Raises
        ------
        InvalidInputError
            If the system has no model in continuous time.
        """
        user = self.evaluation.system
        if self.evaluation is not user.evaluation:
            return user.timed.evaluated_by(self.evaluation.timed)
        if self is not user:
            return user.timed
        if self.origin.make_timed is None:
            raise InvalidInputError(
                "the system is discrete; steps of another length need a model in continuous "
                "time, see System.from_ode."
            )
        return self.origin.make_timed(self)

    def discretized(self, method: str, steps: int) -> System | None:
        """The same model in continuous time by another discretisation; None if there is none.

        Parameters
        ----------
        method, steps
            As for `from_ode`.
        """
        if self.dt is None or self.origin.recipe is None:
            return None
        maker, arguments = self.origin.recipe
        # Of parameters or noisy inputs among its states.
        inner = next((name for name in ("f", "system") if isinstance(
            arguments.get(name), ContinuousTime)), None)
        if inner is not None:
            found = arguments[inner].discretized(method, steps)
            return None if found is None else maker(**arguments | {inner: found})
        if "method" not in arguments:
            return None
        made: System = maker(**arguments | {"method": method, "steps": steps})
        return made

    def algebraic_states(self, x: ArrayLike, u: ArrayLike | None = None) -> Array:
        """The algebraic states z (..., k) at states x (..., n) and inputs u (..., m); NaN for none.

        Parameters
        ----------
        x, u : array_like
            States, such as those of an estimate, and inputs, which may be left out if m is 0.

        Raises
        ------
        InvalidInputError
            If the system has none (see `from_dae`), or u is missing.
        ShapeError
            If the last dimension is not n or m.
        """
        if self.origin.equations is None:
            raise InvalidInputError("the system has no algebraic states; see System.from_dae.")
        return self.origin.equations.algebraic_states(x, u, self.n, self.m)
