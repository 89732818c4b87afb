r"""The matrix inequality of the Lyapunov design, and the search for its unknowns."""

from __future__ import annotations

import importlib
import math
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from .deadline import Deadline
from .evidence import OutOfTimeError
from .inequalities import Matrices, OutputInjection, OutputWeight, definite, norms
from .observer_bound import SignalBounds, _alone, _read, _sides
from .regions import Region
from .sdp import Answer, Scales, expected_seconds
from .search import Search

_MOST_CONDITION = 1e8
_LEAST = 1e-3  # seconds for a solver, for which zero may mean no limit
_FLOOR = 1e-6  # of the noise's weight: a cost needs a positive one
_DIGITS = 8  # of the weights: as they are verified, so they are printed
_ROUNDING = _NOTHING = 1e-6
_MARGIN = 1e-4  # of gamma: it saves the verification most of its cells, and costs as much
_LEAST_SIZE = 1e-3  # of the other: what never occurs has a weight all the same
_SHARES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92)


@dataclass(frozen=True, eq=False)
class Dissipation:
    r"""A quadratic Lyapunov function of detectability, with the supply of w and of the output.

    .. math::
        |f(x_1) + G w_1 - f(x_2) - G w_2|_P^2 \le \gamma\, |x_1 - x_2|_P^2
        + |w_1 - w_2|_Q^2 + |h(x_1) - h(x_2)|_R^2

    It follows from two inequalities, of which the first is that of `OutputWeight` or
    `OutputInjection` with X for the first P, and the second has no state in it:

    .. math::
        \begin{pmatrix} X & P A \\ \cdot & \gamma P + C^\top R C \end{pmatrix} \succ 0, \qquad
        \begin{pmatrix} P - X & P G \\ \cdot & Q \end{pmatrix} \succ 0 .
    """

    inner: OutputWeight | OutputInjection
    X: Array  # (n, n)
    Q: Array  # (r, r)

    @property
    def P(self) -> Array:  # noqa: N802 - the paper's symbol
        """The Lyapunov function's matrix, (n, n)."""
        return self.inner.P

    @property
    def R(self) -> Array:  # noqa: N802
        """The weight of the output, (p, p)."""
        return self.inner.R

    @property
    def rate(self) -> float:
        """The root of gamma, the contraction of the norm."""
        return self.inner.rate

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The first matrix; see `Form.matrices`."""
        found, n = self.inner.matrices(jacobian), len(self.X)
        middle = found.middle.copy()
        middle[..., :n, :n] = self.X  # the first P was exact, and so is this
        return Matrices(middle, found.radius)

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """The conclusion of the first inequality alone; see `Form.excess`."""
        S = self.P @ np.linalg.solve(self.X, self.P)
        left = norms(df, 0.5 * (S + S.T)) * (1.0 - _ROUNDING)
        return left - np.hypot(self.rate * norms(dx, self.P), norms(dh, self.R))

    def supplies(self, directions: Array) -> bool:
        """Whether the second inequality holds, verified."""
        product = Matrices.exact(self.P) @ Matrices.exact(directions)
        rest = Matrices.exact(self.P) - Matrices.exact(self.X)
        none = np.zeros_like(self.Q)
        block = Matrices(*(
            np.block([[a, b], [b.T, c]])[None] for a, b, c in (
                (rest.middle, product.middle, self.Q), (rest.radius, product.radius, none)
            )
        ))
        return bool(definite(block)[0][0])


class DesignProgram:
    r"""Minimise the supply of the largest w and v over the inequality and :math:`P \succeq I`.

    States are in units of the region, so that the root of the supply, divided by
    :math:`1 - \gamma`, is what lasting disturbances make of the error there.
    """

    def __init__(
        self, kind: Literal["output weight", "output injection"], jacobians: Array,
        scales: Scales, directions: Array, sizes: SignalBounds,
    ) -> None:
        cp: Any = importlib.import_module("cvxpy")

        n = jacobians.shape[2]
        p, r = jacobians.shape[1] - n, directions.shape[1]
        self._kind, self._directions, self._sizes = kind, directions, sizes
        self._d, self._s = d, s = scales.states, scales.outputs
        self._g = g = 1.0 / np.abs(directions / d[:, None]).max(axis=0)
        self.expected_seconds = jacobians.shape[0] * expected_seconds(n, p, kind)
        self._gamma, self._margin = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._P = P = cp.Variable((n, n), symmetric=True)
        self._X = X = cp.Variable((n, n), symmetric=True)
        self._Q = Q = cp.Variable((r, r), symmetric=True)
        self._R = R = cp.Variable((p, p), symmetric=True)
        self._Y = Y = cp.Variable((n, p))
        self._M, self._N = M, N = cp.Variable((p, n)), cp.Variable((p, p))
        w_sides, v_sides = cp.Variable(r), cp.Variable(p)
        G = directions * g / d[:, None]
        supply = cp.bmat([[P - X - self._margin * P, P @ G], [G.T @ P, Q - self._margin * Q]])
        constraints: list[Any] = [
            P - np.eye(n) >> 0, _MOST_CONDITION * np.eye(n) - P >> 0, R - _FLOOR * np.eye(p) >> 0,
            cp.diag(w_sides) - Q >> 0, cp.diag(v_sides) - R >> 0, 0.5 * (supply + supply.T) >> 0,
        ]
        top, low = X - self._margin * P, self._gamma * P
        for jacobian in jacobians:
            A = jacobian[:n] * d / d[:, None]
            C = jacobian[n:] * d / s[:, None]
            if kind == "output weight":
                rows = [[top, P @ A], [A.T @ P, low + C.T @ R @ C]]
            else:
                side, mixed = P @ A + Y @ C, C.T @ N - M.T
                rows = [
                    [top, side, -Y], [side.T, low + C.T @ M + M.T @ C, mixed],
                    [-Y.T, mixed.T, R - N - N.T - self._margin * R],
                ]
            matrix = cp.bmat(rows)
            constraints.append(0.5 * (matrix + matrix.T) >> 0)
        # A length bounds all components as one, a set each of them.
        given = [
            np.abs(_sides(name, each)).max(axis=0) if isinstance(each, ConvexSet) else each
            for name, each in (("disturbances", sizes.disturbances), ("noises", sizes.noises))
        ]
        relative = [np.broadcast_to(a, u.shape) / u for a, u in zip(given, (g, s), strict=True)]
        most = max(float(each.max()) for each in relative) or 1.0
        terms = []
        for sides, each, side in zip((w_sides, v_sides), relative, given, strict=True):
            cost = cp.multiply(np.square(np.maximum(each / most, _LEAST_SIZE)), sides)
            terms.append(cp.sum(cost) if np.ndim(side) else cp.max(cost))
        self._problem = cp.Problem(cp.Minimize(terms[0] + terms[1]), constraints)

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate, the root of gamma."""
        margin = max(margin, _MARGIN * rate * rate)
        self._gamma.value, self._margin.value = max(rate * rate - margin, 0.0), margin
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
        form = self._form(rate)
        if form is None:
            return Answer("inaccurate")
        return Answer("solved" if status == "optimal" else status, float(self._problem.value), form)

    def _form(self, rate: float) -> Dissipation | None:
        """The unknowns, scaled so that the largest w and v cost 1, and rounded."""
        d, s, g = self._d, self._s, self._g

        def value(variable: Any, rows: Array, columns: Array) -> Array:
            return np.asarray(variable.value, np.float64) / np.outer(rows, columns)

        P, X, Q, R = (
            value(*each) for each in (
                (self._P, d, d), (self._X, d, d), (self._Q, g, g), (self._R, s, s)
            )
        )
        sizes = self._sizes
        w = _alone("disturbances", _read("disturbances", sizes.disturbances), len(Q), Q)
        v = _alone("noises", _read("noises", sizes.noises), len(R), R)
        scale = 1.0 / (float(w**2 + v**2) or 1.0)
        P, Q, R = (_rounded(scale * each) for each in (P, Q, R))
        X = 0.5 * scale * (X + X.T)
        inner: OutputWeight | OutputInjection = OutputWeight(P, R, rate)
        if self._kind == "output injection":
            Y, M, N = (
                scale * value(*each) for each in (
                    (self._Y, d, s), (self._M, s, d), (self._N, s, s)
                )
            )
            inner = OutputInjection(P, R, Y, M, N, rate)
        for slack in (0.0, 1e-6, 1e-4, 1e-2):
            form = Dissipation(inner, X, _rounded((1.0 + slack) * Q))
            if form.supplies(self._directions):
                return form
        return None


class DesignSearch(Search):
    """`Search` with the design's program; the best rate is that of the smallest limit."""

    def __init__(
        self, system: Any, region: Region, sizes: SignalBounds, horizon: int | None,
        seconds: float | Deadline,
    ) -> None:
        super().__init__(system, region, None, (1.0, 1.0), seconds=seconds)
        half = 0.5 * (region.upper - region.lower)[: system.n]
        states = np.where(half > 0.0, half, 1.0) / (half.max() or 1.0)
        self.scales = Scales(states, np.abs(self.jacobians[:, system.n :] * states).sum(2).max(0))
        self.scales.outputs[self.scales.outputs == 0.0] = 1.0
        matrix = system.disturbance_matrix
        self._directions = np.eye(system.n) if matrix is None else np.asarray(matrix, np.float64)
        self._sizes, self._horizon = sizes, horizon

    @property
    def program(self) -> Any:
        """The program at the states chosen so far."""
        if self._program is None:
            self._program = DesignProgram(  # type: ignore[assignment]
                self.kind, self.jacobians[self._chosen], self.scales,  # type: ignore[arg-type]
                self._directions, self._sizes,
            )
        return self._program

    def _best_rate(self, smallest: float) -> float:
        """The rate with the smallest limit of the error, J(estimate) being at most J(truth)."""
        deadline = self._deadline.part(0.5)
        tried: dict[float, float] = {}

        def attempt(gamma: float) -> None:
            if gamma not in tried:
                supply = self._feasible(math.sqrt(gamma), deadline).objective
                tried[gamma] = supply * growth(gamma, self._horizon)

        least = smallest**2
        try:
            for share in _SHARES:
                attempt(least + share * (1.0 - least))
            for _ in range(2):
                known = sorted(tried)
                best = min(tried, key=lambda gamma: tried[gamma])
                k = known.index(best)
                for other in known[max(k - 1, 0) : k + 2]:
                    attempt(0.5 * (best + other))
        except OutOfTimeError:
            pass
        best = min(tried, key=lambda gamma: tried[gamma], default=least)
        return math.sqrt(best) if tried and math.isfinite(tried[best]) else smallest


def growth(gamma: float, horizon: int | None) -> float:
    r"""The square of the limit for a supply of 1: :math:`4 S / (1 - 4 \gamma^N)`, S its sum."""
    left = 0.0 if horizon is None else gamma**horizon
    if 4.0 * left >= 1.0:
        return math.inf
    return 4.0 * (1.0 - left) / ((1.0 - gamma) * (1.0 - 4.0 * left))


def _rounded(matrix: Array) -> Array:
    """A symmetric matrix with as many digits as are printed, and zeros for what is close to it."""
    sizes = np.sqrt(np.abs(matrix.diagonal()))
    there = np.abs(matrix) > _NOTHING * np.outer(sizes, sizes)
    kept = np.where(there & there.T, 0.5 * (matrix + matrix.T), 0.0)
    return np.array([[float(f"{value:.{_DIGITS}g}") for value in row] for row in kept])
