"""filterpy's extended Kalman filter: no window, another problem."""

from __future__ import annotations

from typing import Any

import numpy as np
from problems import Problem

from .base import Array, Peer, UnavailableError, WindowData
from .casadi_program import InPlace

__all__ = ["FilterpyEkf"]


class FilterpyEkf(Peer):
    """The extended Kalman filter with the covariances whose inverses are MHE's weights."""

    name = "filterpy EKF"
    package = "filterpy"
    kind = "other"
    converges = False
    recursive = True
    limitations = (
        "filterpy EKF: another problem, a filter without window, sets or smoothed states; no "
        "J. f, h and their Jacobians by CasADi's virtual machine, called in place."
    )

    def setup(self, problem: Problem) -> None:
        """Model functions and filter."""
        try:
            import casadi as ca
            from filterpy.kalman import ExtendedKalmanFilter
        except ImportError as error:
            raise UnavailableError("not installed: pip install filterpy casadi") from error
        self._problem = problem
        x, u = ca.SX.sym("x", problem.n), ca.SX.sym("u", problem.m)
        moved, seen = problem.step(x, u), problem.output(x)
        self._move = _Linearized(ca, x, u, moved)
        self._see = _Linearized(ca, x, u, seen)
        move = self._move

        class Filter(ExtendedKalmanFilter):  # type: ignore[misc]  # it has no types
            """The nonlinear prediction, which filterpy leaves to a subclass."""

            def predict_x(self, u: Any = 0) -> None:
                move.hold(u)
                self.x, self.F = move.evaluate(self.x)

        self._class = Filter
        self.restart()

    def restart(self) -> None:
        """A filter at the record's start."""
        problem = self._problem
        self._filter = self._class(problem.n, problem.p)
        self._filter.x = problem.scenario.initial_estimate.copy()
        self._filter.P = np.linalg.inv(problem.cost.prior)
        self._filter.Q = np.linalg.inv(problem.cost.disturbance)
        self._filter.R = np.linalg.inv(problem.cost.noise)

    def update(self, window: WindowData) -> Array:
        """Correct by y(t), and predict x(t+1)."""
        self._filter.update(window.newest, self._see.jacobian_at, self._see.value_at)
        self._filter.predict(window.newest_input)
        state: Array = self._filter.x
        return state.copy()


class _Linearized:
    """A function of x and u with its Jacobian by x, both from one call."""

    def __init__(self, ca: Any, x: Any, u: Any, value: Any) -> None:
        slope = ca.densify(ca.jacobian(value, x))
        names = ["x", "u"], ["value", "slope"]
        self._call = InPlace(ca.Function("f", [x, u], [value, slope], *names))
        self._x, self._value = self._call.arguments["x"], self._call.results["value"]
        self._slope = self._call.results["slope"].reshape(x.shape[0], value.shape[0]).T

    def hold(self, u: Array) -> None:
        """Take u for the calls that follow."""
        self._call.arguments["u"][:] = u

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        self._x[:] = x
        self._call()
        return self._value.copy(), self._slope

    def jacobian_at(self, x: Array) -> Array:
        return self.evaluate(x)[1]

    def value_at(self, _: Array) -> Array:
        """The value at the point of the last call: filterpy asks for the Jacobian first."""
        return self._value
