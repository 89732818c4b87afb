"""Bounds beyond the paper: its proof with the norms kept, or at least the sums."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from .._checks import Array, count, numbers, positive_definite
from ..costs import Cost
from ..errors import OptionError, ShapeError
from .decay import checked_length, decaying_sums
from .inequalities import norms
from .theorem import TheoremConstants


@dataclass(frozen=True)
class Parts:
    """Initial error, disturbances and noises, in the norms in which they enter a bound."""

    observer_start: float  # the initial error in the observer's bound
    window_start: float  # the initial error in detectability's bound
    entering: Array  # (T,): what enters the observer's error at each sample
    misfit: Array  # (T,): the noises in the candidate's cost
    disturbances: Array  # (T,): in detectability's bound
    noises: Array  # (T,): in detectability's bound


class WindowBound(ABC):
    r"""A bound of the estimator's error along the theorem's proof, with all sums kept.

    With k = min(t, N) the window's length, E the bound of the observer's error, and the
    norms of `Parts`,

    .. math::
        \begin{aligned}
        E(t+1) &= \rho E(t) + \text{entering}(t) \\
        \hat J(t)^{1/a} &\le j(t) = \Big(\sum_{i=t-k}^{t-1}
            (\ell E(i) + \text{misfit}(i))^a\Big)^{1/a} \\
        |x(t) - \hat x(t)| &\le s\,(\alpha_k\, j(t) + G_k(t))
        \end{aligned}

    where G_k is what detectability makes of the true disturbances and noises of the window,
    step by step from p E(t-N), or from the initial error itself as long as t <= N, and
    :math:`\alpha_k` the most that it makes of estimated ones that cost 1. See the page "What
    is guaranteed, and what is not" for the derivation.
    """

    kind: ClassVar[Literal["summed", "weighted"]]

    def __init__(
        self, *, horizon: int, rho: float, eta: float, exponent: float, slope: float, entry: float,
        scales: Array,
    ) -> None:
        self.horizon = count("horizon", horizon, 1)
        if not exponent >= 1.0:
            raise OptionError(
                f"the cost's exponent is {exponent!r}; expected at least 1: below, norms of "
                "sums do not add up, and only the theorem's own constants are there."
            )
        for name, value in (("rho", rho), ("eta", eta)):
            if not 0.0 < value < 1.0:
                raise OptionError(f"{name} is {value!r}; expected a number in (0, 1).")
        self.rho, self.eta, self.exponent = rho, eta, exponent
        self.slope, self.entry, self.scales = slope, entry, scales
        #: alpha_k for k = 0, ..., N: from the root of the cost to the norm of detectability.
        self.alphas: Array = np.array([self._alpha(k) for k in range(horizon + 1)])

    @abstractmethod
    def _advance(self, difference: Array, disturbance: Array, noise: Array) -> Array:
        """One step of detectability, in its norms."""

    @abstractmethod
    def _alpha(self, length: int) -> float:
        """The largest sum of a window's estimated parts whose cost is 1."""

    @abstractmethod
    def parts(self, initial: Array, disturbances: Array, noises: Array) -> Parts:
        """The norms of an initial error, disturbances and noises."""

    def bound(
        self, initial: ArrayLike, disturbances: ArrayLike, noises: ArrayLike, *,
        costs: ArrayLike | None = None,
    ) -> Array:
        """The bound of |x(t) - x_hat(t)| at t = 0, ..., T."""
        value: Array = self.scales[0] * self._evaluate(initial, disturbances, noises, costs)
        return value

    def components(
        self, initial: ArrayLike, disturbances: ArrayLike, noises: ArrayLike, *,
        costs: ArrayLike | None = None,
    ) -> Array:
        """The bound of each component's error, (T + 1, n); arguments as of `bound`."""
        norm = self._evaluate(initial, disturbances, noises, costs)
        return np.multiply.outer(norm, self.scales[1:])

    def _evaluate(
        self, initial: ArrayLike, disturbances: ArrayLike, noises: ArrayLike,
        costs: ArrayLike | None,
    ) -> Array:
        start = numbers("initial", initial)
        w, v = numbers("disturbances", disturbances), numbers("noises", noises)
        if w.shape[:1] != v.shape[:1] or not 1 <= w.ndim <= 2 or not 1 <= v.ndim <= 2:
            raise ShapeError(
                f"disturbances have shape {w.shape} and noises {v.shape}; expected (T, n) and "
                "(T, p), or their lengths (T,)."
            )
        for lengths in (start, w, v):
            if lengths.ndim < (1 if lengths is start else 2) and (lengths < 0.0).any():
                raise OptionError("a length is negative; expected Euclidean lengths, all >= 0.")
        return self.along(self.parts(start, w, v), costs)

    def along(self, parts: Parts, costs: ArrayLike | None = None) -> Array:
        """The bound in the norm of detectability, at t = 0, ..., T, (T + 1,)."""
        N, a, steps = self.horizon, self.exponent, parts.disturbances.size
        lengths = np.minimum(np.arange(steps + 1), N)
        decay: Array = self.rho ** np.arange(steps + 1.0)
        error = parts.observer_start * decay + decaying_sums(self.rho, parts.entering)
        fit = (self.slope * error[:-1] + parts.misfit) ** a
        roots: Array = _window_sums(fit, N) ** (1.0 / a)
        if costs is not None:
            known = numbers("costs", costs, finite=False)
            if known.shape != (steps,):
                raise ShapeError(f"costs have shape {known.shape}; expected ({steps},).")
            # NaN is no cost: fmin leaves the bound in its place.
            roots[1:] = np.fmin(roots[1:], np.maximum(known, 0.0) ** (1.0 / a))
        entry = np.full(steps + 1, parts.window_start)
        entry[N + 1 :] = self.entry * error[1 : max(1, steps + 1 - N)]
        padded = np.zeros((2, N + steps))
        padded[:, N:] = parts.disturbances, parts.noises
        own = np.where(lengths == 0, entry, 0.0)
        for j in range(N):  # a shorter window begins later
            own = np.where(lengths == N - j, entry, own)
            own = self._advance(own, *padded[:, j : j + steps + 1])
        own[0] = parts.window_start
        return self.alphas[lengths] * roots + own

    def funnel(self, initial: float, disturbance: float, noise: float, steps: int) -> Array:
        """The bound at t = 0, ..., steps for all |w| <= disturbance and |v| <= noise."""
        return self.bound(initial, np.full(steps, disturbance), np.full(steps, noise))

    def limit(self, disturbance: float, noise: float) -> float:
        """What the bound tends to for |w| <= disturbance and |v| <= noise as t grows."""
        checked_length("disturbance", disturbance)
        checked_length("noise", noise)
        parts = self.parts(np.zeros(()), np.array([disturbance]), np.array([noise]))
        error = parts.entering / (1.0 - self.rho)
        fit = self.slope * error + parts.misfit
        own = self.entry * error
        for _ in range(self.horizon):
            own = self._advance(own, parts.disturbances, parts.noises)
        root = self.horizon ** (1.0 / self.exponent) * fit
        return float(self.scales[0] * (self.alphas[-1] * root + own)[0])


def _window_sums(values: Array, width: int) -> Array:
    """Sums over the last values before t = 0, ..., T."""
    padded = np.concatenate((np.zeros(width), values))
    sums: Array = sliding_window_view(padded, width).sum(axis=1)
    return sums


def holder(values: Array, exponent: float) -> float:
    """The largest sum of values[i] s[i] with the sum of s[i]^a up to 1, for a >= 1."""
    if exponent == 1.0:
        return float(values.max())
    dual = exponent / (exponent - 1.0)
    top = float(values.max())
    if top == 0.0 or not math.isfinite(top):
        return top
    return float(top * np.sum((values / top) ** dual) ** (1.0 / dual))


class SummedBound(WindowBound):
    r"""Sums and Hoelder's inequality in place of geometric majorants and factors 3.

    It needs no more than the theorem does: the Euclidean constants of detectability,
    observer and cost, for a >= 1. It keeps

    - the sums over the window, instead of their bounds by the newest time (eq:proof_rho5);
    - the norm of a sum, by Minkowski's inequality, instead of (eq:Kprop) twice;
    - that one cost pays for all parts of the estimate, by Hoelder's inequality: with
      1/a + 1/b = 1,

    .. math::
        \alpha_k^b = (c_p \eta^k \underline c_p^{-1/a})^b + \sum_{\tau=1}^k \big(
            (c_w \eta^\tau \underline c_w^{-1/a})^b + (c_v \eta^\tau \underline c_v^{-1/a})^b
        \big)
    """

    kind = "summed"

    def __init__(self, constants: TheoremConstants) -> None:
        self.constants = constants
        cost = constants.cost
        a = cost.exponent
        #: From the fitting error's length to the root of its cost.
        self.cost_root = float(
            (cost.disturbance[1] * constants.kappa**a + cost.noise[1]) ** (1.0 / a)
        )
        super().__init__(
            horizon=constants.horizon, rho=constants.observer.rate,
            eta=constants.detectability.rate, exponent=a,
            slope=self.cost_root * constants.lipschitz, entry=constants.detectability.initial,
            scales=np.ones(1),
        )

    def _alpha(self, length: int) -> float:
        c_p, c_w, c_v = self.constants.detectability.constants
        cost, a = self.constants.cost, self.exponent
        lags: Array = self.eta ** np.arange(1.0, length + 1.0)
        values = np.concatenate((
            [c_p * self.eta**length * cost.prior[0] ** (-1.0 / a)],
            c_w * cost.disturbance[0] ** (-1.0 / a) * lags,
            c_v * cost.noise[0] ** (-1.0 / a) * lags,
        ))
        return holder(values, a)

    def parts(self, initial: Array, disturbances: Array, noises: Array) -> Parts:
        """Euclidean lengths times the constants; see `WindowBound.parts`."""
        start = float(np.linalg.norm(np.atleast_1d(initial)))
        w, v = (x if x.ndim == 1 else np.linalg.norm(x, axis=1) for x in (disturbances, noises))
        c_p, c_w, c_v = self.constants.detectability.constants
        C_p, C_w, C_v = self.constants.observer.constants
        return Parts(
            C_p * start, c_p * start, self.rho * (C_w * w + C_v * v), self.cost_root * v,
            self.eta * c_w * w, self.eta * c_v * v,
        )

    def _advance(self, difference: Array, disturbance: Array, noise: Array) -> Array:
        return self.eta * difference + disturbance + noise


class WeightedBound(WindowBound):
    r"""The quadratic cost's own weights, and the norms of the Lyapunov functions.

    From detectability and from an observer with constant gain K, for its error e,

    .. math::
        \begin{aligned}
        |\Delta x^+|_P &\le \sqrt{\eta^2 |\Delta x|_P^2 + |\Delta h|_V^2} + |\Delta w|_P \\
        |e^+|_O &\le \rho |e|_O + |w - K v|_O
        \end{aligned}

    With the cost's weights :math:`\Pi, Q, R` the candidate costs
    :math:`\sum |v_z|_M^2`, :math:`M = K^\top Q K + R`. Step by step, a cost of 1 pays for at
    most

    .. math::
        \alpha_0^2 = \lambda(P \Pi^{-1}), \qquad
        \alpha_{k+1}^2 = \max\{\eta^2 \alpha_k^2, \lambda(V R^{-1})\} + \lambda(P Q^{-1})

    where lambda is the largest eigenvalue.
    """

    kind = "weighted"

    def __init__(
        self, cost: Cost, *, horizon: int, P: ArrayLike, eta: float,
        noise_weight: ArrayLike, observer_norm: ArrayLike, rho: float, gain: ArrayLike,
        slope: float,
    ) -> None:
        n, p = cost.n, cost.p
        self.P = positive_definite("P", P, n)
        self.observer_norm = positive_definite("observer_norm", observer_norm, n)
        self._V = np.atleast_2d(numbers("noise_weight", noise_weight))
        if self._V.shape != (p, p):
            raise ShapeError(f"noise_weight has shape {self._V.shape}; expected {(p, p)}.")
        self._fit = fit_weight(cost, gain)
        self.gain = numbers("gain", gain)
        self._shares = (
            largest(self.P, cost.least_prior), largest(self.P, cost.disturbance),
            largest(self._V, cost.noise),
        )
        inverse = np.linalg.inv(self.P)
        super().__init__(
            horizon=horizon, rho=rho, eta=eta, exponent=2.0, slope=float(numbers("slope", slope)),
            entry=math.sqrt(largest(self.P, self.observer_norm)),
            scales=_rounding(self.P) * np.sqrt(
                np.append(np.linalg.eigvalsh(inverse)[-1], np.diag(inverse))
            ),
        )

    def _alpha(self, length: int) -> float:
        square, disturbance, noise = self._shares
        for _ in range(length):
            square = max(self.eta**2 * square, noise) + disturbance
        return math.sqrt(square)

    def _advance(self, difference: Array, disturbance: Array, noise: Array) -> Array:
        return np.hypot(self.eta * difference, noise) + disturbance

    def parts(self, initial: Array, disturbances: Array, noises: Array) -> Parts:
        """Norms of vectors, or the largest ones of vectors of these lengths."""
        w, v, O = disturbances, noises, self.observer_norm  # noqa: E741 - the symbol
        if w.ndim == v.ndim == 2:
            entering = norms(w - v @ self.gain.T, O)
        else:
            entering = norms(w, O) + norms(v, self.gain.T @ O @ self.gain)
        return Parts(
            float(norms(initial[None], O)[0]), float(norms(initial[None], self.P)[0]), entering,
            norms(v, self._fit), norms(w, self.P), norms(v, self._V),
        )


def fit_weight(cost: Cost, gain: ArrayLike) -> Array:
    """The weight M = K^T Q K + R that the candidate's cost puts on fitting errors."""
    if not isinstance(cost, Cost) or not cost.quadratic or cost.discount < 1.0:
        raise OptionError(
            "the weighted bound needs a QuadraticCost without discount; the theorem's own "
            "constants and the summed bound do with any cost that has constants."
        )
    K = numbers("gain", gain)
    if K.shape != (cost.n, cost.p):
        raise ShapeError(f"gain has shape {K.shape}; expected {(cost.n, cost.p)}.")
    return K.T @ cost.disturbance @ K + cost.noise


def largest(matrix: Array, weight: Array) -> float:
    """The smallest factor c with s^T matrix s <= c s^T weight s for all s, rounded up."""
    from scipy.linalg import eigh

    return _rounding(weight) * max(0.0, float(eigh(matrix, weight, eigvals_only=True)[-1]))


def _rounding(weight: Array) -> float:
    """A factor that covers what rounding does to numbers that a matrix is inverted for."""
    eps = float(np.finfo(np.float64).eps)
    return float(1.0 + 32.0 * weight.shape[0] ** 2 * eps * np.linalg.cond(weight))
