r"""The matrix inequality of the Lyapunov design, and the search for its unknowns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from ..model.system import System
from .branch_and_bound import Cover
from .deadline import Deadline
from .evidence import NotCertifiedError, OutOfTimeError
from .inequalities import Form, Matrices, OutputInjection, OutputWeight, norms
from .regions import Region
from .sdp import Answer, Kind, Program, Scales, _columns
from .search import Found, Search
from .sizes import Sizes, lengths_of, read_size, sides_of

_MOST_CONDITION = 1e8
_FLOOR = 1e-6  # of the noise's weight: a cost needs a positive one
_MARGIN = 1e-4  # of gamma: it saves the verification most of its cells, and costs as much
_DIGITS, _NOTHING = 8, 1e-6  # of the weights: as they are verified, so they are printed
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Dissipation:
    r"""A quadratic Lyapunov function of detectability, with the supply of w and of the output.

    .. math::
        |f(x_1) + G w_1 - f(x_2) - G w_2|_P^2 \le \gamma\, |x_1 - x_2|_P^2
        + |w_1 - w_2|_Q^2 + |h(x_1) - h(x_2)|_R^2

    It follows from two inequalities, of which the first is that of `OutputWeight` or
    `OutputInjection` with X for its first P, and the second has no state in it:

    .. math::
        \begin{pmatrix} X & P A \\ \cdot & \gamma P + C^\top R C \end{pmatrix} \succ 0, \qquad
        \begin{pmatrix} P - X & P G \\ \cdot & Q \end{pmatrix} \succ 0 .
    """

    inner: OutputWeight | OutputInjection
    X: Array  # (n, n)
    Q: Array  # (r, r)
    G: Array  # (n, r)

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

    def constants(self) -> tuple[Matrices, ...]:
        """The second matrix; see `Form.constants`."""
        product = Matrices.exact(self.P) @ Matrices.exact(self.G)
        rest = Matrices.exact(self.P) - Matrices.exact(self.X)
        return (Matrices(*(
            np.block([[a, b], [b.T, c]])[None] for a, b, c in (
                (rest.middle, product.middle, self.Q),
                (rest.radius, product.radius, np.zeros_like(self.Q)),
            )
        )),)

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """The conclusion of the first inequality alone; see `Form.excess`."""
        S = self.P @ np.linalg.solve(self.X, self.P)
        left = norms(df, 0.5 * (S + S.T)) * (1.0 - _ROUNDING)
        return left - np.hypot(self.rate * norms(dx, self.P), norms(dh, self.R))


class DesignProgram(Program):
    r"""Minimise the limit of the estimate's error over P, X, Q, R and the forms' other unknowns.

    In states of the region's size :math:`P \succeq I`, and what the largest w and v supply is
    minimised: a length is bounded by a multiple of the identity, a box by a diagonal matrix.
    """

    def __init__(
        self, kind: Kind, jacobians: Array, scales: Scales, G: Array, sizes: Sizes,
        horizon: int | None,
    ) -> None:
        widths, groups, largest = _columns(G, scales, largest_sizes(sizes))
        super().__init__(
            kind, jacobians, Scales(largest * scales.states, largest * scales.outputs)
        )
        cp, P, d, s = self._cp, self._P, self._d, self._s
        (n, r), p = G.shape, s.size
        self._kind, self._G, self._sizes, self._horizon = kind, G, sizes, horizon
        self._w, share = widths[:r], widths[r:] / s  # Q is in units of w's size, R in those of y
        X, Q, R = (cp.Variable((size, size), symmetric=True) for size in (n, r, p))
        Y, M, N = (cp.Variable(shape) for shape in ((n, p), (p, n), (p, p)))
        self._X, self._Q, self._R, self._Y, self._M, self._N = X, Q, R, Y, M, N
        shares = cp.Variable(groups.shape[1])
        sides, PG = groups @ shares, P @ (G / d[:, None] * self._w)
        constraints: list[Any] = [
            P - np.eye(n) >> 0, _MOST_CONDITION * np.eye(n) - P >> 0,
            cp.diag(sides[:r]) - Q >> 0, R - _FLOOR * np.eye(p) >> 0,
            cp.diag(sides[r:]) - cp.multiply(np.outer(share, share), R) >> 0,
            self._definite([[P - X - self._margin * P, PG], [PG.T, Q - self._margin * Q]]),
        ]
        constraints += self._detectable(kind, X - self._margin * P, R, Y, M, N)
        self._problem = cp.Problem(cp.Minimize(cp.sum(shares)), constraints)

    def solve(self, rate: float, margin: float, seconds: float = math.inf) -> Answer:
        """Solve for a rate, the root of gamma; the measure is the limit for a minimiser."""
        margin = max(margin, _MARGIN * rate * rate)
        answer = self._answer(self._problem, self._form, rate, margin, seconds)
        if answer.form is None:
            return answer
        supply = max(float(self._problem.value), 0.0)
        return replace(
            answer, objective=math.sqrt(supply * growth(rate * rate, self._horizon))
        )

    def _form(self, rate: float) -> Dissipation:
        """The unknowns, scaled so that the largest w and v cost 1, and rounded."""
        d, s, w, sizes = self._d, self._s, self._w, self._sizes
        P, X, Q, R = (
            self._value(each, side, side)
            for each, side in ((self._P, d), (self._X, d), (self._Q, w), (self._R, s))
        )
        supply = sum(
            float(lengths_of(name, read_size(name, given), len(weight), weight)) ** 2
            for name, given, weight in (
                ("disturbances", sizes.disturbance, Q), ("noises", sizes.noise, R)
            )
        )
        scale = 1.0 / (supply or 1.0)
        P, Q, R = (_rounded(scale * each) for each in (P, Q, R))
        inner: OutputWeight | OutputInjection = OutputWeight(P, R, rate)
        if self._kind == "output injection":
            Y, M, N = (
                scale * self._value(*each)
                for each in ((self._Y, d, s), (self._M, s, d), (self._N, s, s))
            )
            inner = OutputInjection(P, R, Y, M, N, rate)
        return Dissipation(inner, 0.5 * scale * (X + X.T), Q, self._G)


class DesignSearch(Search):
    """`Search` with the program of the design."""

    def __init__(
        self, system: System, region: Region, sizes: Sizes, horizon: int | None,
        seconds: float | Deadline,
    ) -> None:
        super().__init__(system, region, None, (1.0, 1.0), seconds=seconds)
        self._bounds, self._horizon = sizes, horizon
        half = 0.5 * (region.upper - region.lower)[: system.n]
        states = np.where(half > 0.0, half, 1.0) / (half.max() or 1.0)
        outputs = np.abs(self.jacobians[:, system.n :] * states).sum(axis=2).max(axis=0)
        self.scales = Scales(states, np.where(outputs > 0.0, outputs, 1.0))  # of any units
        self._answers: list[Answer] = []

    @property
    def program(self) -> Program:
        """The program at the states chosen so far."""
        if self._program is None:
            matrix = self.system.disturbance_matrix
            self._program = DesignProgram(
                self.kind, self.jacobians[self._chosen], self.scales,
                np.eye(self.system.n) if matrix is None else matrix, self._bounds,
                self._horizon,
            )
        return self._program

    def answer(
        self, name: str, rate: float | None, advice: tuple[str, ...],
        why: Callable[[Search, str], NotCertifiedError],
    ) -> Found:
        """As `Search.answer`; when the time is over, the best weights that pass the samples."""
        try:
            return super().answer(name, rate, advice, why)
        except OutOfTimeError:
            for one in sorted(self._answers, key=lambda each: each.objective):
                assert one.form is not None
                found = self._verified(one.form)
                if isinstance(found, Found):
                    return found
            raise

    def _solved(self, rate: float, margin: float, deadline: Deadline) -> Answer:
        answer = super()._solved(rate, margin, deadline)
        if answer.form is not None:
            self._answers.append(answer)
        return answer

    def _verified(self, form: Form) -> Found | Cover:
        """As `Search` does, after a look at the samples, which is cheap."""
        blocks = form.matrices(Matrices.exact(self.jacobians)).middle
        broken = np.linalg.eigvalsh(0.5 * (blocks + np.swapaxes(blocks, 1, 2)))[:, 0] <= 0.0
        if broken.any():
            return Cover(False, 0, 0.0, self.points[broken], self.jacobians[broken])
        return super()._verified(form)


def largest_sizes(sizes: Sizes) -> tuple[float | Array, float | Array]:
    """The largest disturbances and noises: lengths, or half-widths by component."""
    w, v = (
        np.abs(sides_of(name, given)).max(axis=0) if isinstance(given, ConvexSet) else given
        for name, given in (("disturbances", sizes.disturbance), ("noises", sizes.noise))
    )
    return w, v


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
