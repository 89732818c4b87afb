"""The semidefinite programs whose solutions are then verified."""

from __future__ import annotations

import contextlib
import importlib
import math
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .._checks import Array
from .deadline import Deadline
from .inequalities import ErrorContraction, Form, OutputInjection, OutputWeight

Kind = Literal["output weight", "output injection", "observer", "synthesis"]

# c_p beyond 1e4 would be a certificate of nothing, and spoils the conditioning.
_MOST_CONDITION = 1e8
# Seconds for one entry of a factorisation, as measured for 10 to 30 states: a rough guide.
_SECONDS = 5e-9
_LEAST = 1e-3  # seconds for a solver, for which zero may mean no limit


@dataclass(frozen=True, eq=False)
class Scales:
    """Typical sizes of states and outputs, in which the programs are posed."""

    states: Array  # (n,); the largest is 1
    outputs: Array  # (p,)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a program returned."""

    status: str  # ``solved``, ``infeasible``, or what stopped the solver
    objective: float = np.inf
    form: Form | None = None  # filled in, in the units of the system


def started(seconds: float | Deadline) -> Deadline:
    """The deadline itself, or one after so many seconds from when the solvers are loaded.

    To import them for the first time takes seconds, which are not the search's.
    """
    Deadline.of(seconds)  # refused before anything is loaded
    for module in ("cvxpy", "scipy.optimize", "clarabel"):
        with contextlib.suppress(ImportError):  # raised where it is needed
            importlib.import_module(module)
    return Deadline.of(seconds)


def expected_seconds(n: int, p: int, kind: Kind) -> float:
    """About how long a program takes for each Jacobian, apart from what all of them take."""
    size = 2 * n + (p if kind == "output injection" else 0)
    return _SECONDS * (size * (size + 1) / 2) ** 3


class Program:
    r"""Minimise :math:`d^2 \kappa + v^2 r` over :math:`I \preceq P \preceq \kappa I` and a form.

    r bounds the weight of the output: :math:`R \preceq r I`, or :math:`L^\top P L \preceq r I`.
    Then :math:`\sqrt\kappa / \eta` and :math:`\sqrt r / \eta` are the constants of disturbance
    and noise; d and v say how much each matters.
    """

    def __init__(
        self, kind: Kind, jacobians: Array, scales: Scales, weights: tuple[float, float],
        gain: Array | None = None,
    ) -> None:
        cp: Any = importlib.import_module("cvxpy")

        n = jacobians.shape[2]
        p = jacobians.shape[1] - n
        self.expected_seconds = jacobians.shape[0] * expected_seconds(n, p, kind)
        self._d, self._s, self._kind, self._gain = scales.states, scales.outputs, kind, gain
        d, s = self._d, self._s
        self._rate2, self._margin = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._rest = cp.Parameter(nonneg=True)
        self._P = P = cp.Variable((n, n), symmetric=True)
        self._Y = Y = cp.Variable((n, p))
        self._R = R = cp.Variable((p, p), symmetric=True)
        self._M, self._N = M, N = cp.Variable((p, n)), cp.Variable((p, p))
        condition, output = cp.Variable(), cp.Variable()
        square, output_square = np.diag(d**2), np.diag(s**2)
        constraints: list[Any] = [
            P - square >> 0, condition * square - P >> 0, condition <= _MOST_CONDITION,
        ]
        if kind == "synthesis":
            constraints.append(cp.bmat([[P, Y], [Y.T, output * output_square]]) >> 0)
        elif kind == "observer":
            assert gain is not None
            scaled = gain / d[:, None] * s
            constraints.append(output * output_square - scaled.T @ P @ scaled >> 0)
        else:
            constraints += [R >> 0, output * output_square - R >> 0]
        top = P - self._margin * P
        for jacobian in jacobians:
            A = jacobian[:n] * d / d[:, None]
            C = jacobian[n:] * d / s[:, None]
            low = self._rest * P
            if kind == "output weight":
                rows = [[top, P @ A], [A.T @ P, low + C.T @ R @ C]]
            elif kind == "output injection":
                side, mixed = P @ A + Y @ C, C.T @ N - M.T
                rows = [
                    [top, side, -Y], [side.T, low + C.T @ M + M.T @ C, mixed],
                    [-Y.T, mixed.T, R - N - N.T - self._margin * R],
                ]
            else:
                side = P @ A - (Y @ C if gain is None else P @ ((gain / d[:, None] * s) @ C))
                rows = [[top, side], [side.T, low]]
            matrix = cp.bmat(rows)
            constraints.append(0.5 * (matrix + matrix.T) >> 0)
        first, second = weights
        self._problem = cp.Problem(
            cp.Minimize(first**2 * condition + second**2 * output), constraints
        )

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate."""
        self._rate2.value, self._margin.value = rate * rate, margin
        self._rest.value = max(rate * rate - margin, 0.0)
        limit = {"time_limit": max(seconds, _LEAST)} if math.isfinite(seconds) else {}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._problem.solve(solver="CLARABEL", **limit)
        except Exception as error:  # a solver may raise anything
            return Answer(f"the solver raised {type(error).__name__}")
        status = str(self._problem.status)
        if status in ("infeasible", "infeasible_inaccurate"):
            return Answer("infeasible")
        if self._P.value is None or not np.isfinite(self._P.value).all():
            return Answer(status)
        return Answer(
            "solved" if status == "optimal" else status, float(self._problem.value),
            self._form(rate),
        )

    def _form(self, rate: float) -> Form:
        d, s = self._d, self._s

        def value(variable: Any, rows: Array, columns: Array) -> Array:
            return np.asarray(variable.value, np.float64) / np.outer(rows, columns)

        P = value(self._P, d, d)
        P = 0.5 * (P + P.T)
        if self._gain is not None:
            return ErrorContraction(P, self._gain, rate)
        if self._kind == "synthesis":
            gain = np.asarray(np.linalg.solve(P, value(self._Y, d, s)), np.float64)
            return ErrorContraction(P, gain, rate)
        R = value(self._R, s, s)
        # The solver's tolerance may leave it below zero; a larger R asks for less.
        values, vectors = np.linalg.eigh(0.5 * (R + R.T))
        R = (vectors * np.maximum(values, 0.0)) @ vectors.T
        R = 0.5 * (R + R.T)
        if self._kind == "output weight":
            return OutputWeight(P, R, rate)
        Y, M, N = value(self._Y, d, s), value(self._M, s, d), value(self._N, s, s)
        return OutputInjection(P, R, Y, M, N, rate)
