"""The paper's own tool beside ours: CasADi with Ipopt, terminated after i iterations."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

from .._checks import Array
from ..costs import QuadraticCost
from ..errors import InvalidInputError
from ..estimation.estimate import Estimate, Status
from ..estimation.problem import Formulation
from ..estimation.window import Window
from ..model.expressions import import_casadi
from ..model.residuals import Angles, Residual
from ..model.system import System
from ..observers import Observer
from ..terms.sum import further_terms


class IpoptEstimator:
    """The estimator of Definition def:estimator with Ipopt on the nonlinear program.

    The program is (eq:optiMHE) in the state trajectory, as in `Problem`: with disturbances as
    variables, too, Ipopt took a quarter longer. It is built once for each window length and
    starts at the candidate. The true cost and the true constraints judge its iterate.
    """

    def __init__(
        self, system: System, observer: Observer, cost: QuadraticCost, *, f: Callable[[Any], Any],
        h: Callable[[Any], Any], horizon: int, initial_state: Array,
        max_iterations: int | None = None, tolerance: float = 1e-8,
    ) -> None:
        self._casadi = import_casadi()
        if system.m or cost.observer_prior is not None:
            raise InvalidInputError(
                "the comparison with Ipopt takes systems without inputs and constant prior weights."
            )
        if system.held:
            raise InvalidInputError(
                "the comparison with Ipopt does not support held parameters; make the system "
                "without hold."
            )
        if cost.directions(system.disturbance_matrix) is not None:
            raise InvalidInputError(
                "the comparison with Ipopt takes no disturbance_matrix and no singular covariance "
                "of the disturbance; give each state its own disturbance."
            )
        if system.extensions:
            raise InvalidInputError(
                f"the comparison with Ipopt does not have {' and '.join(system.extensions)}; leave "
                "them out."
            )
        further = further_terms(system, cost)
        if further:
            raise InvalidInputError(
                f"the comparison with Ipopt has no term of J for {further}; leave it out."
            )
        self._system, self._cost, self._f, self._h = system, cost, f, h
        self._prior = cost.prior
        self._window = Window(system, observer, cost, horizon, initial_state, False, "observer")
        self._formulation = Formulation(system, observer, cost)
        self._options: dict[str, Any] = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": tolerance,
            "ipopt.bound_relax_factor": 0.0,  # the verdict allows no relaxed bounds
        }
        if max_iterations is not None:
            self._options["ipopt.max_iter"] = max_iterations
        self._programs: dict[int, tuple[Any, dict[str, Array]]] = {}

    def update(self, y: Array) -> Estimate:
        """Take y(t) in and estimate x(t+1); as `qpmhe.MovingHorizonEstimator.update`."""
        began = perf_counter()
        window, n = self._window, self._system.n
        window.push(y, np.zeros(0))
        problem = self._formulation.problem(window)
        count = window.length
        solve, bounds = self._programs.get(count) or self._build(count)
        candidate = problem.candidate
        start = candidate.trajectory.ravel()
        parameters = np.concatenate((problem.prior.mean, problem.measurements.ravel()))
        solving = perf_counter()
        answer = solve(x0=start, p=parameters, **bounds)
        solve_time = perf_counter() - solving
        states = np.array(answer["x"]).reshape(count + 1, n)
        trial = problem.evaluate(states)
        improved = math.isfinite(trial.cost) and trial.cost < candidate.cost * (1 - 1e-12)
        best = trial if improved else candidate
        estimate = Estimate(
            window.time - 1, best.trajectory.copy(), best.residuals.copy(), best.cost,
            window.candidate.copy(), candidate.cost,
            Status.IMPROVED if improved else Status.CANDIDATE, str(solve.stats()["return_status"]),
            0, int(solve.stats()["iter_count"]), solve_time,
        )
        estimate.step_time = perf_counter() - began
        return estimate

    def _build(self, count: int) -> tuple[Any, dict[str, Array]]:
        ca, n, p = self._casadi, self._system.n, self._system.p
        states = ca.SX.sym("x", n, count + 1)
        prior, measured = ca.SX.sym("prior", n), ca.SX.sym("y", p, count)
        offset = self._wrapped(self._system.state_residual, states[:, 0] - prior)
        objective = offset.T @ self._prior @ offset
        disturbances, noises = [], []
        for i in range(count):
            w, v = states[:, i + 1] - self._f(states[:, i]), measured[:, i] - self._h(states[:, i])
            disturbances.append(self._wrapped(self._system.state_residual, w))
            noises.append(self._wrapped(self._system.output_residual, v))
            objective += disturbances[i].T @ self._cost.disturbance @ disturbances[i]
            objective += noises[i].T @ self._cost.noise @ noises[i]
        rows, bounds = self._rows(ca.horzsplit(states), disturbances, noises)
        program = {
            "x": ca.vec(states),
            "p": ca.veccat(prior, measured),
            "f": objective,
            "g": ca.vertcat(*rows),
        }
        box = self._system.states
        nothing = np.full(n, np.inf)
        limits = {
            "lbx": np.tile(box.lower if box else -nothing, count + 1),
            "ubx": np.tile(box.upper if box else nothing, count + 1),
            "lbg": np.concatenate([low for low, _ in bounds] or [np.empty(0)]),
            "ubg": np.concatenate([high for _, high in bounds] or [np.empty(0)]),
        }
        self._programs[count] = ca.nlpsol("mhe", "ipopt", program, self._options), limits
        return self._programs[count]

    def _wrapped(self, residual: Residual | None, plain: Any) -> Any:
        """The same branch as in `Angles.wrap`, with the derivative of the difference."""
        if residual is None:
            return plain
        if not isinstance(residual, Angles):
            raise InvalidInputError(
                "the comparison with Ipopt takes residual functions made by qpmhe.angles only."
            )
        for j, period in zip(residual.components.tolist(), residual.periods.tolist(), strict=True):
            plain[j] -= period * self._casadi.floor(plain[j] / period + 0.5)
        return plain

    def _rows(
        self, states: list[Any], disturbances: list[Any], noises: list[Any]
    ) -> tuple[list[Any], list[tuple[Array, Array]]]:
        """W and V as rows, and the general inequalities of all sets."""
        system = self._system
        rows: list[Any] = []
        bounds: list[tuple[Array, Array]] = []
        for one, points in (
            (system.states, states), (system.disturbances, disturbances), (system.noises, noises)
        ):
            if one is None:
                continue
            for point in points:
                if points is not states:
                    rows.append(point)
                    bounds.append((one.lower, one.upper))
                if one.matrix.shape[0]:
                    rows.append(self._casadi.DM(one.matrix) @ point)
                    bounds.append((one.row_lower, one.row_upper))
        return rows, bounds
