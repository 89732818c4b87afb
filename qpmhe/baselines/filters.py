"""Kalman filters of the textbooks: a measurement update, then a prediction."""

from __future__ import annotations

import numpy as np

from .._checks import Array, dimension, positive
from .._linalg import cholesky, solve
from ..errors import OptionError
from ..model.residuals import difference
from ..model.system import System
from .base import Baseline, Mask, Problem, deviations, innovation

# An iterate of a measurement update that moves by less of its standard deviations is the last.
_STILL = 1e-9


class ExtendedKalmanFilter(Baseline):
    r"""The extended Kalman filter.

    With :math:`C` the Jacobian of h at the estimate, and :math:`A` that of f at the updated one:

    .. math::
        K = P C^\top (C P C^\top + R)^{-1}, \quad x^+ = x + K (y - h(x)), \quad
        x(t+1) = f(x^+), \quad P(t+1) = A (I - K C) P A^\top + Q

    (in Joseph's form). `qpmhe.ExtendedKalman` is the same filter in output-injection form, which
    linearises f at the predicted state; both agree on a linear system.

    Parameters
    ----------
    problem : Problem
        What to estimate.
    iterations : int
        Linearisations of h in an update; with more than one, the iterated filter, a Gauss-Newton
        search.

    Raises
    ------
    OptionError
        If ``iterations`` is no integer >= 1.

    References
    ----------
    Anderson and Moore, Optimal Filtering, 1979, section 8.2; Bell and Cathey, The iterated Kalman
    filter update as a Gauss-Newton method, IEEE Trans. Automat. Contr. 38 (1993).
    """

    def __init__(self, problem: Problem, *, iterations: int = 1) -> None:
        self._iterations = dimension("iterations", iterations, 1)
        super().__init__(problem)

    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        x, p, r = self.state, self.covariance, self.problem.noise[np.ix_(there, there)]
        at = x
        for _ in range(self._iterations):
            c = system.h_jacobian(at, u)[there]
            gain = solve(c @ p @ c.T + r, c @ p).T
            left = innovation(system, y, system.h(at, u))[there]
            before, at = at, x + gain @ (left - c @ difference(system.state_residual, x, at))
            if np.all(np.abs(at - before) <= _STILL * np.sqrt(p.diagonal())):
                break
        closed = np.eye(x.size) - gain @ c
        self.state, self.covariance = at, closed @ p @ closed.T + gain @ r @ gain.T

    def _predict(self, system: System, u: Array) -> None:
        a = system.f_jacobian(self.state, u)
        self.state = system.f(self.state, u)
        ahead = a @ self.covariance @ a.T + self._disturbance
        self.covariance = 0.5 * (ahead + ahead.T)


class UnscentedKalmanFilter(Baseline):
    r"""The unscented Kalman filter with additive noise.

    2n + 1 sigma points, :math:`x` and :math:`x \pm c\, S e_j` with :math:`S S^\top = P`, have the
    weights :math:`1 - n / c^2` and :math:`1 / 2 c^2`; their images under h and f give means and
    covariances. `qpmhe.UnscentedKalman` is the form of an observer, which compares y with h at the
    state, not with the mean; both agree on a linear system.

    Parameters
    ----------
    problem : Problem
        What to estimate.
    spread : float, optional
        c, in standard deviations: :math:`\sqrt{n + \kappa}` of the textbooks. By default
        :math:`\sqrt{\max(3, n)}`, at which no weight is negative.

    Raises
    ------
    OptionError
        If the spread is not between 1e-6 and 1e6.

    References
    ----------
    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proc. IEEE 92 (2004).
    """

    def __init__(self, problem: Problem, *, spread: float | None = None) -> None:
        n = problem.system.n
        self._spread = float(np.sqrt(max(3, n))) if spread is None else positive("spread", spread)
        if not 1e-6 <= self._spread <= 1e6:
            raise OptionError(
                f"spread is {self._spread:g}; expected standard deviations from 1e-6 to 1e6, "
                "usually the square root of max(3, n)."
            )
        share = 0.5 / self._spread**2
        self._weights = np.concatenate(([1.0 - 2.0 * n * share], np.full(2 * n, share)))
        super().__init__(problem)

    def _points(self) -> Array:
        """Sigma points (2n + 1, n)."""
        steps = self._spread * cholesky(self.covariance).T
        return self.state + np.concatenate((np.zeros((1, self.state.size)), steps, -steps))

    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        points = self._points()
        left = innovation(system, y, system.h.batch(points, np.tile(u, (len(points), 1))))
        left = left[:, there]
        mean = self._weights @ left
        apart, moved = mean - left, points - self.state
        spread = (apart.T * self._weights) @ apart + self.problem.noise[np.ix_(there, there)]
        gain = solve(spread, (apart.T * self._weights) @ moved).T
        self.state = self.state + gain @ mean
        # As in Joseph's form: positive semidefinite where no weight is negative.
        rest = moved - apart @ gain.T
        self.covariance = (rest.T * self._weights) @ rest + (
            gain @ self.problem.noise[np.ix_(there, there)] @ gain.T
        )

    def _predict(self, system: System, u: Array) -> None:
        points = self._points()
        ahead = system.f.batch(points, np.tile(u, (len(points), 1)))
        self.state, apart = deviations(system, ahead, self._weights)
        self.covariance = (apart.T * self._weights) @ apart + self._disturbance
