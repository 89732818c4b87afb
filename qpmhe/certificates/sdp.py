"""The semidefinite programs whose solutions are then verified."""

from __future__ import annotations

import contextlib
import importlib
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, numbers
from ..errors import OptionError, ShapeError
from .deadline import Deadline
from .inequalities import ErrorContraction, Form, Matrices, OutputInjection, OutputWeight, definite

Kind = Literal["output weight", "output injection", "observer", "synthesis"]
#: The largest disturbance and noise: each a length, or half-widths by component.
NoiseSizes = tuple[ArrayLike, ArrayLike]

# c_p beyond 1e4 would be a certificate of nothing, and spoils the conditioning.
_MOST_CONDITION = 1e8
# Seconds for one entry of a factorisation, as measured for 10 to 30 states: a rough guide.
_SECONDS = 5e-9
# Bounds on the limit, as multiples of the largest noise.
_SMALLEST_LIMIT, _LARGEST_LIMIT = 0.1, 1e3
_DIGITS = 4  # of a gain, after the first
_LEAST = 1e-3  # seconds for a solver, for which zero may mean no limit
# What a noise counts as at least, of the largest one, in the sizes of states and outputs.
_SMALLEST_NOISE = 1e-4
# What rounding needs between matrices that follow from each other; at most the margins.
_SLACK = 1e-7


@dataclass(frozen=True, eq=False)
class Scales:
    """Typical sizes of states and outputs, in which the programs are posed."""

    states: Array  # (n,); the largest is 1
    outputs: Array  # (p,)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a program returned."""

    status: str  # ``solved``, ``infeasible``, or what stopped the solver
    objective: float = np.inf  # a measure of what lasting disturbances and noises make
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


class Program(ABC):
    """A semidefinite program at some Jacobians, in numbers without units."""

    def __init__(self, kind: Kind, jacobians: Array, scales: Scales) -> None:
        self._cp: Any = importlib.import_module("cvxpy")
        count, rows, n = jacobians.shape
        self.expected_seconds = count * expected_seconds(n, rows - n, kind)
        self._jacobians = Matrices.exact(jacobians)
        self._d, self._s = d, s = scales.states, scales.outputs
        self._A = jacobians[:, :n] * d / d[:, None]
        self._C = jacobians[:, n:] * d / s[:, None]
        # The square of the rate; the margin, and what it leaves of the square.
        self._rate2, self._margin, self._rest = (self._cp.Parameter(nonneg=True) for _ in range(3))
        self._P = self._cp.Variable((n, n), symmetric=True)

    @abstractmethod
    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate."""

    def _detectable(self, kind: Kind, top: Any, R: Any, Y: Any, M: Any, N: Any) -> list[Any]:
        """The inequality of detectability at each Jacobian, with its first block ``top``."""
        P, low, found = self._P, self._rest * self._P, []
        for A, C in zip(self._A, self._C, strict=True):
            if kind == "output weight":
                rows = [[top, P @ A], [A.T @ P, low + C.T @ R @ C]]
            else:
                side, mixed = P @ A + Y @ C, C.T @ N - M.T
                rows = [
                    [top, side, -Y], [side.T, low + C.T @ M + M.T @ C, mixed],
                    [-Y.T, mixed.T, R - N - N.T - self._margin * R],
                ]
            found.append(self._definite(rows))
        return found

    def _definite(self, rows: list[list[Any]]) -> Any:
        """The constraint that blocks form a matrix that is positive semidefinite."""
        matrix = self._cp.bmat(rows)
        return 0.5 * (matrix + matrix.T) >> 0

    def _answer(
        self, problem: Any, form: Callable[[float], Form], rate: float, margin: float,
        seconds: float,
    ) -> Answer:
        """Solve one of the problems, and fill its form in; without its measure."""
        self._rate2.value, self._margin.value = rate * rate, margin
        self._rest.value = max(rate * rate - margin, 0.0)
        limit = {"time_limit": max(seconds, _LEAST)} if math.isfinite(seconds) else {}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                problem.solve(solver="CLARABEL", **limit)
        except Exception as error:  # a solver may raise anything
            return Answer(f"the solver raised {type(error).__name__}")
        status = str(problem.status)
        if status in ("infeasible", "infeasible_inaccurate"):
            return Answer("infeasible")
        if any(each.value is None or not np.isfinite(each.value).all()
               for each in problem.variables()):
            return Answer(status)
        try:
            found = form(rate)
        except np.linalg.LinAlgError:
            return Answer(status)
        if status == "optimal":
            return Answer("solved", form=found)
        # A solver that stopped early may have returned anything.
        matrices = *found.constants(), found.matrices(self._jacobians)
        usable = all(definite(each)[0].all() for each in matrices)
        return Answer(status, form=found if usable else None)

    def _value(self, variable: Any, rows: Array, columns: Array) -> Array:
        return np.asarray(variable.value, np.float64) / np.outer(rows, columns)

    def _symmetric(self, variable: Any) -> Array:
        value = self._value(variable, self._d, self._d)
        return 0.5 * (value + value.T)


class DetectabilityProgram(Program):
    r"""Minimise :math:`d^2 \kappa + v^2 r` over :math:`I \preceq P \preceq \kappa I` and a form.

    r bounds the weight of the output, :math:`R \preceq r I`. Then :math:`\sqrt\kappa / \eta` and
    :math:`\sqrt r / \eta` are the constants of disturbance and noise; d and v say how much each
    matters.
    """

    def __init__(
        self, kind: Kind, jacobians: Array, scales: Scales, weights: tuple[float, float]
    ) -> None:
        super().__init__(kind, jacobians, scales)
        cp, d, s, P = self._cp, self._d, self._s, self._P
        n, p = d.size, s.size
        self._kind = kind
        self._Y, self._R = Y, R = cp.Variable((n, p)), cp.Variable((p, p), symmetric=True)
        self._M, self._N = M, N = cp.Variable((p, n)), cp.Variable((p, p))
        condition, output = cp.Variable(), cp.Variable()
        square, output_square = np.diag(d**2), np.diag(s**2)
        constraints: list[Any] = [
            P - square >> 0, condition * square - P >> 0, condition <= _MOST_CONDITION,
            R >> 0, output * output_square - R >> 0,
        ]
        constraints += self._detectable(kind, P - self._margin * P, R, Y, M, N)
        first, second = weights
        self._problem = cp.Problem(
            cp.Minimize(first**2 * condition + second**2 * output), constraints
        )

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate; the measure is the program's, up to a factor the limit."""
        answer = self._answer(self._problem, self._form, rate, margin, seconds)
        if answer.form is None:
            return answer
        return replace(
            answer, objective=math.sqrt(max(float(self._problem.value), 0.0)) / (1.0 - rate)
        )

    def _form(self, rate: float) -> Form:
        d, s, P = self._d, self._s, self._symmetric(self._P)
        R = self._value(self._R, s, s)
        # The solver's tolerance may leave it below zero; a larger R asks for less.
        values, vectors = np.linalg.eigh(0.5 * (R + R.T))
        R = (vectors * np.maximum(values, 0.0)) @ vectors.T
        R = 0.5 * (R + R.T)
        if self._kind == "output weight":
            return OutputWeight(P, R, rate)
        Y, M, N = self._value(self._Y, d, s), self._value(self._M, s, d), self._value(self._N, s, s)
        return OutputInjection(P, R, Y, M, N, rate)


class ObserverProgram(Program):
    r"""Minimise the limit of the bound on an observer's error, for noises of given sizes.

    Of :math:`d = (w, v)` within these sizes, and B with :math:`B d = G w - L v`, it is

    .. math::
        \min \operatorname{tr} X \quad \text{s.t.} \quad
        \begin{pmatrix} X - B \Delta B^\top & (A - L C) X \\ \cdot & \rho^2 X \end{pmatrix}
        \succeq 0, \quad \sum_j d_j^2 / \Delta_j \le 1 - \rho^2,

    in states of the region's size. With P the inverse of X, S the inverse of the first block, and
    diag(Q, R) the inverse of :math:`\Delta`, it is the pair of inequalities of `ErrorContraction`,
    with :math:`|e|_P \le 1` in the limit. :math:`\Delta` is diagonal; a length d is shared by its
    components. A rate hardly above the smallest leaves no room between S and P: then X is
    the first block, and :math:`|B d|_P \le 1`.
    """

    def __init__(
        self, jacobians: Array, scales: Scales, sizes: NoiseSizes, gain: Array,
        matrix: Array | None = None,
    ) -> None:
        matrix = np.eye(scales.states.size) if matrix is None else matrix
        self._widths, self._groups, largest = _columns(matrix, scales, sizes)
        self._scales, sizes_now = scales.states, Scales(
            largest * scales.states, largest * scales.outputs
        )
        super().__init__("observer", jacobians, sizes_now)
        cp, d, n = self._cp, self._d, self._d.size
        self._gain, self._matrix = gain, matrix
        B = np.hstack((matrix, -gain)) / d[:, None] * self._widths
        self._X = X = cp.Variable((n, n), symmetric=True)
        self._weights = weights = cp.Variable(self._groups.shape[1], pos=True)
        # X at infinity, or at zero where nothing disturbs, would be feasible for any rate.
        limits = [
            cp.sum(cp.inv_pos(weights)) <= 1.0, X - _SMALLEST_LIMIT**2 * np.eye(n) >> 0,
            cp.trace(X) <= _LARGEST_LIMIT**2,
        ]
        noise = B @ cp.diag(self._groups @ weights) @ B.T
        closed = self._A - (gain / d[:, None] * self._s) @ self._C
        least, low = cp.Minimize(cp.trace(X)), self._rest * X
        self._share = cp.Parameter(nonneg=True)  # of the noise, 1 / (1 - rate^2)

        def problem(top: Any, *others: Any) -> Any:
            first = top - self._margin * X
            contracts = [self._definite([[first, A @ X], [X @ A.T, low]]) for A in closed]
            return cp.Problem(least, [*limits, *others, *contracts])

        self._squares = problem(X - self._share * noise)
        self._triangle = problem(X, X - noise >> 0)

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate; its measure is the length of the error's components in the limit."""
        self._share.value = 1.0 / (1.0 - rate * rate)
        answer, share = self._answer(self._squares, self._squared, rate, margin, seconds), 1.0
        if answer.form is None and answer.status != "user_limit":
            answer = self._answer(self._triangle, self._plain, rate, margin, seconds)
            share = 1.0 / (1.0 - rate)
        if answer.form is None:
            return answer
        scaled = answer.form.P * np.outer(self._scales, self._scales)
        limit = math.sqrt(max(float(np.trace(np.linalg.inv(scaled))), 0.0))
        return replace(answer, objective=limit * share)

    def _plain(self, rate: float) -> ErrorContraction:
        P = np.linalg.inv(self._X.value) / np.outer(self._d, self._d)
        return ErrorContraction(0.5 * (P + P.T), self._gain, rate)

    def _squared(self, rate: float) -> ErrorContraction:
        d, r = self._d, self._matrix.shape[1]
        weights = self._groups @ self._weights.value / (1.0 - rate * rate)
        B = np.hstack((self._matrix, -self._gain)) / d[:, None] * self._widths
        S = np.linalg.inv((1.0 - _SLACK) * self._X.value - (B * weights) @ B.T) / np.outer(d, d)
        D = 1.0 / (weights * np.square(self._widths))
        return replace(
            self._plain(rate), S=0.5 * (S + S.T), G=self._matrix, Q=np.diag(D[:r]),
            R=np.diag(D[r:]),
        )


class GainProgram(Program):
    r"""Find a gain whose error stays small; `ObserverProgram` then takes it as given.

    .. math::
        \min \operatorname{tr} D \quad \text{s.t.} \quad P \succeq I, \quad
        \begin{pmatrix} P & P A - Y C & P G & -Y \\ \cdot & \rho^2 P & 0 & 0 \\
        \cdot & \cdot & D_w & 0 \\ \cdot & \cdot & \cdot & D_v \end{pmatrix} \succeq 0,

    with Y = P L, in noises of the given sizes and states of the region's size: the limit is
    :math:`|e|^2 \le \operatorname{tr} D / (1 - \rho^2)`.
    """

    def __init__(
        self, jacobians: Array, scales: Scales, sizes: NoiseSizes, matrix: Array | None = None
    ) -> None:
        self._all = jacobians, scales, sizes
        matrix = np.eye(scales.states.size) if matrix is None else matrix
        widths, groups, largest = _columns(matrix, scales, sizes)
        super().__init__(
            "synthesis", jacobians, Scales(largest * scales.states, largest * scales.outputs)
        )
        cp, d, s, P = self._cp, self._d, self._s, self._P
        n, r = matrix.shape
        self._matrix = matrix
        self._Y = Y = cp.Variable((n, s.size))
        weights = cp.Variable(groups.shape[1], nonneg=True)
        PB = cp.hstack([P @ (matrix / d[:, None] * widths[:r]), -Y @ np.diag(widths[r:] / s)])
        nothing, D = np.zeros(PB.shape), cp.diag(groups @ weights)
        closed = [P @ A - Y @ C for A, C in zip(self._A, self._C, strict=True)]
        self._problem = cp.Problem(cp.Minimize(cp.sum(weights)), [
            P - np.eye(n) >> 0, _LARGEST_LIMIT**2 * np.eye(n) - P >> 0,
            cp.sum(weights) <= _LARGEST_LIMIT**2,
            *(self._definite([
                [P - self._margin * P, side, PB], [side.T, self._rest * P, nothing],
                [PB.T, nothing.T, D],
            ]) for side in closed),
        ])

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate; its measure is the bound on the error in the limit."""
        answer = self._answer(self._problem, self._form, rate, margin, seconds)
        if answer.form is None:
            return answer
        squares = max(float(self._problem.value), 0.0) / (1.0 - rate * rate)
        return replace(answer, objective=math.sqrt(squares))

    def improved(self, answer: Answer, margin: float, seconds: float) -> Answer:
        """A better P for the gain that was found."""
        if answer.form is None:
            return answer
        assert isinstance(answer.form, ErrorContraction)
        again = ObserverProgram(*self._all, answer.form.gain, self._matrix)
        return again.solve(answer.form.rate, margin, seconds)

    def _form(self, rate: float) -> Form:
        P, Y = self._symmetric(self._P), self._value(self._Y, self._d, self._s)
        return ErrorContraction(P, _printable(np.asarray(np.linalg.solve(P, Y), np.float64)), rate)


def _printable(gain: Array) -> Array:
    """A gain with as many digits in each row as are worth printing."""
    sizes = np.abs(gain).max(axis=1)
    powers = np.floor(np.log10(np.where(sizes > 0.0, sizes, 1.0)))
    return np.array([
        [float(f"{round(float(each), _DIGITS - int(power)):.{_DIGITS + 3}g}") for each in row]
        for row, power in zip(gain, powers, strict=True)
    ])


def _columns(matrix: Array, scales: Scales, sizes: NoiseSizes) -> tuple[Array, Array, float]:
    """Half-widths of disturbances and noises, which share a weight, and the largest, relative."""
    units = 1.0 / np.abs(matrix / scales.states[:, None]).max(axis=0), scales.outputs
    relative, groups = [], []
    for name, size, unit in zip(("disturbance", "noise"), sizes, units, strict=True):
        given = numbers(f"size of the {name}", size)
        if given.shape not in ((), unit.shape):
            raise ShapeError(
                f"the size of the {name} has shape {given.shape}; expected a length, or "
                f"{unit.size} half-widths."
            )
        if (given < 0.0).any():
            raise OptionError(f"the size of the {name} is {given.tolist()}; expected >= 0.")
        relative.append(given / unit)
        groups.append(np.ones((unit.size, 1)) if given.ndim == 0 else np.eye(unit.size))
    largest = max(float(each.max()) for each in relative) or 1.0
    shared = np.zeros((sum(map(len, groups)), sum(each.shape[1] for each in groups)))
    rows, columns = groups[0].shape
    shared[:rows, :columns], shared[rows:, columns:] = groups
    widths = np.maximum(np.concatenate(relative), _SMALLEST_NOISE * largest)
    return widths * np.concatenate(units), shared, largest
