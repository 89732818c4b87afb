"""The semidefinite program whose solutions are then verified."""

from __future__ import annotations

import contextlib
import importlib
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, numbers
from ..errors import OptionError, ShapeError
from .deadline import Deadline
from .inequalities import Form, Matrices, definite

Kind = Literal["output weight", "output injection", "observer", "synthesis"]
#: The largest disturbance and noise: each a length, or half-widths by component.
NoiseSizes = tuple[ArrayLike, ArrayLike]

# Seconds for one entry of a factorisation, as measured for 10 to 30 states: a rough guide.
_SECONDS = 5e-9
# Larger ones would be a certificate of nothing, and spoil the conditioning.
_MOST_CONDITION, _MOST_SUPPLY = 1e6, 1e8
_FLOOR = 1e-6  # of what noises count
# What rounding needs between matrices that follow from each other; at most the margins.
_SLACK = 1e-7
_DIGITS = 4  # of a gain, after the first
_PRINTED, _NOTHING = 8, 1e-6  # of weights: as they are verified, so they are printed
# Of SCS, where Clarabel breaks down; what is not solved by then seldom is by ten times as many.
_SPLITTING = {"eps": 1e-9, "max_iters": 10_000}
_LEAST = 1e-3  # seconds for a solver, for which zero may mean no limit
# What a noise counts as at least, of the largest one, in the sizes of states and outputs.
_SMALLEST_NOISE = 1e-4


@dataclass(frozen=True, eq=False)
class Scales:
    """Typical sizes of states and outputs, in which the programs are posed."""

    states: Array  # (n,); the largest is 1
    outputs: Array  # (p,)


@dataclass(frozen=True, eq=False)
class ConicSolution:
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


class SemidefiniteProgram:
    r"""Minimise the limit of an error over the unknowns of a `Form`, at some Jacobians.

    .. math::
        \min \textstyle\sum_j d_j^2 D_j \quad \text{s.t. both inequalities of the form}, \quad
        D \text{ diagonal}, \quad \operatorname{tr} P^{-1} \le n,

    in states of the region's size, for disturbances and noises d of the given ``sizes``; a length
    is shared by its components. In the limit, :math:`|e|_P^2` is at most the sum divided by
    :math:`1 - \rho^2`. A rate hardly above the smallest leaves no room between X and P: then X is
    P, as it is from the first with ``triangle``. There, and for the weights of a cost, P is no less
    than I instead, and the latter are scaled to a sum of 1.

    The Jacobians are (K, n + p, n). For ``synthesis`` the gain is sought as well, with Y = P L.
    ``matrix`` is G. ``growth`` is the limit's square for a supply of 1, by the rate; with it,
    weights are rounded to be printed.
    """

    def __init__(
        self, kind: Kind, jacobians: Array, scales: Scales, sizes: NoiseSizes, matrix: Array,
        gain: Array | None = None, growth: Callable[[float], float] | None = None,
        triangle: bool = False,
    ) -> None:
        self._cp = cp = importlib.import_module("cvxpy")
        self._all, self._kind, self._gain, self._G = (jacobians, scales, sizes), kind, gain, matrix
        self._growth = growth or (lambda rate: 1.0 / (1.0 - rate * rate))
        self._printed = growth is not None
        count, rows, n = jacobians.shape
        p, r, observes = rows - n, matrix.shape[1], kind in ("observer", "synthesis")
        self.expected_seconds = count * expected_seconds(n, p, kind)
        self._jacobians = Matrices.exact(jacobians)
        widths, groups, largest = _columns(matrix, scales, sizes)
        self._d, self._s = d, s = largest * scales.states, largest * scales.outputs
        self._w, self._v = widths[:r], widths[r:]
        # The square of the rate; the margin, and what it leaves of the square.
        self._margin, self._rest = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._P, self._X, T = (cp.Variable((n, n), symmetric=True) for _ in range(3))
        P, room, low = self._P, self._margin * self._P, self._rest * self._P
        shares, self._Y = cp.Variable(groups.shape[1]), cp.Variable((n, p))
        self._M, self._N = cp.Variable((p, n)), cp.Variable((p, p))
        self._D = D = groups @ shares
        R = cp.diag(cp.multiply(D[r:], (s / self._v) ** 2))
        PB = P @ (matrix / d[:, None] * self._w)
        injected = self._Y if gain is None else P @ (gain / d[:, None] * s)
        if observes:
            PB = cp.hstack([PB, -injected @ np.diag(self._v / s)])
        supply = D if observes else D[:r]

        def problem(squares: bool) -> Any:
            top, rest, eye = self._X if squares else P, P - self._X if squares else P, np.eye(n)
            found = [
                P << _MOST_CONDITION * eye, cp.trace(T) <= n, self._definite([[T, eye], [eye, P]])
            ] if squares and growth is None else [P >> eye]
            found += [shares >= _FLOOR, cp.sum(shares) <= _MOST_SUPPLY, self._definite([
                [rest - _SLACK * P, PB], [PB.T, (1.0 - _SLACK) * cp.diag(supply)]
            ])]
            first, Y, M, N = top - room, self._Y, self._M, self._N
            for jacobian in jacobians:
                A, C = jacobian[:n] * d / d[:, None], jacobian[n:] * d / s[:, None]
                if kind != "output injection":
                    side = P @ A - injected @ C if observes else P @ A
                    rows = [[first, side], [side.T, low if observes else low + C.T @ R @ C]]
                else:
                    side, mixed = P @ A + Y @ C, C.T @ N - M.T
                    rows = [
                        [first, side, -Y], [side.T, low + C.T @ M + M.T @ C, mixed],
                        [-Y.T, mixed.T, (1.0 - self._margin) * R - N - N.T],
                    ]
                found.append(self._definite(rows))
            return cp.Problem(cp.Minimize(cp.sum(shares)), found)

        self._forms = (True, False) if observes else (not triangle,)
        self._problem = lru_cache(None)(problem)

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> ConicSolution:
        """Solve for a rate; the measure is the length of the error's components in the limit."""
        for squares in self._forms:
            answer = self._answer(squares, rate, margin, seconds)
            if answer.form is not None or answer.status == "user_limit":
                break
        if answer.form is None:
            return answer
        growth = self._growth(rate) if squares else 1.0 / (1.0 - rate) ** 2
        square = max(float(self._problem(squares).value), 0.0) * growth
        return replace(answer, objective=math.sqrt(square))

    def of_gain(self, gain: Array) -> SemidefiniteProgram:
        """The program for an observer with this gain."""
        return SemidefiniteProgram("observer", *self._all, self._G, gain)

    def _definite(self, rows: list[list[Any]]) -> Any:
        """The constraint that blocks form a matrix that is positive semidefinite."""
        matrix = self._cp.bmat(rows)
        return 0.5 * (matrix + matrix.T) >> 0

    def _answer(self, squares: bool, rate: float, margin: float, seconds: float) -> ConicSolution:
        """Solve one of the problems, and fill its form in; without its measure."""
        problem = self._problem(squares)
        self._margin.value, self._rest.value = margin, max(rate * rate - margin, 0.0)
        limit = max(seconds, _LEAST) if math.isfinite(seconds) else None
        failure = ""
        for solver, options in (
            ("CLARABEL", {} if limit is None else {"time_limit": limit}),
            # Slower, but it ends where an interior point breaks down; what it finds is verified.
            ("SCS", _SPLITTING if limit is None else {**_SPLITTING, "time_limit_secs": limit}),
        ):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    problem.solve(solver=solver, **options)
                break
            except Exception as error:  # a solver may raise anything
                failure = failure or f"the solver raised {type(error).__name__}"
        else:
            return ConicSolution(failure)
        status = str(problem.status)
        if status in ("infeasible", "infeasible_inaccurate"):
            return ConicSolution("infeasible")
        if any(each.value is None or not np.isfinite(each.value).all()
               for each in problem.variables()):
            return ConicSolution(status)
        try:
            form = self._form(rate, squares)
        except np.linalg.LinAlgError:
            return ConicSolution(status)
        if status == "optimal":
            return ConicSolution("solved", form=form)
        # A solver that stopped early may have returned anything.
        usable = form.holds_always() and definite(form.matrices(self._jacobians)).all()
        return ConicSolution(status, form=form if usable else None)

    def _form(self, rate: float, squares: bool) -> Form:
        """The unknowns in the units of the system."""
        d, s = self._d, self._s
        P = 0.5 * (self._P.value + self._P.value.T) / np.outer(d, d)
        r, D = len(self._w), self._D.value / np.append(self._w, self._v) ** 2
        scale = 1.0 / float(self._problem(squares).value) if self._printed else 1.0
        if self._printed:
            P, D = _rounded(scale * P), _rounded(np.diag(scale * D)).diagonal()
        B, Q, R = self._G, np.diag(D[:r]), np.diag(D[r:])
        gain, observes = self._gain, self._kind in ("observer", "synthesis")
        if observes:
            if gain is None:
                gain = _printable(np.linalg.solve(P, self._Y.value / np.outer(d, s)))
            B = np.hstack((B, -gain))
        form = Form(P, rate, R, gain)
        if self._kind == "output injection":
            Y, M, N = (
                scale * each.value / np.outer(one, other)
                for each, one, other in ((self._Y, d, s), (self._M, s, d), (self._N, s, s))
            )
            form = replace(form, injection=(Y, M, N))
        if squares:  # X as large as the second inequality allows
            PB = P @ B
            X = (1.0 - _SLACK) * P - (1.0 + _SLACK) * (PB / D[: B.shape[1]]) @ PB.T
            return replace(form, X=0.5 * (X + X.T), B=B, Q=Q)
        return form if not observes else replace(form, R=np.empty((0, 0)))


def _rounded(matrix: Array) -> Array:
    """A symmetric matrix with as many digits as are printed, and zeros for what is close to it."""
    sizes = np.sqrt(np.abs(matrix.diagonal()))
    kept = np.where(np.abs(matrix) > _NOTHING * np.outer(sizes, sizes), matrix, 0.0)
    return np.array([[float(f"{value:.{_PRINTED}g}") for value in row] for row in kept])


def _printable(gain: Array) -> Array:
    """A gain with as many digits in each row as are worth printing."""
    sizes = np.abs(gain).max(axis=1)
    powers = 10.0 ** (_DIGITS - np.floor(np.log10(np.where(sizes > 0.0, sizes, 1.0))))[:, None]
    short = np.round(gain * powers) / powers
    return np.array([[float(f"{each:.{_DIGITS + 3}g}") for each in row] for row in short])


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
