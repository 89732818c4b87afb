"""Bounds for one horizon: the paper's, and its proof with the norms kept, or at least the sums."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .._checks import Array
from ..costs import Cost, CostConstants
from ..errors import OptionError
from .inequalities import Matrices, norms
from .properties import Detectability, ObserverStability
from .theorem import Sizes, TheoremConstants, decaying_sums

Kind = Literal["paper", "summed", "weighted", "measured"]

# Covers the rounding of a few products and roots.
_OUTWARD = 1.0 + 1e-9


@dataclass(frozen=True, eq=False)
class Norms:
    """Weights of the norms in which initial error, disturbances and noises enter a bound."""

    observer: Array  # (n, n): the initial error in the observer's bound
    window: Array  # (n, n): the initial error in detectability's bound
    driving: Array  # (n, n): the disturbance in the observer's step
    corrected: Array  # (p, p): the noise in the observer's step
    misfit: Array  # (p, p): the noise in the candidate's cost
    disturbance: Array  # (n, n): the disturbance in detectability's step
    noise: Array  # (p, p): the noise in detectability's step
    gain: Array | None = None  # (n, p): K, where w - K v enters the observer's step as one


@dataclass(frozen=True, eq=False)
class WindowBound:
    r"""A bound of the estimator's error along the theorem's proof, with all sums kept.

    With the window's length k = min(t, N) and the bound E(t) of the observer's error, the error
    is at most :math:`s (\alpha_k j(t) + G_k(t))`, where j(t) bounds the root of the candidate's
    cost, G_k(t) is what detectability makes of the true disturbances and noises of the window,
    and :math:`\alpha_k` the most that it makes of estimated ones that cost 1. Derived in "What
    is guaranteed, and what is not" of the documentation.
    """

    kind: Literal["summed", "weighted"]
    horizon: int
    rho: float
    eta: float
    exponent: float  # a
    slope: float  # from the observer's error to the root of a stage's cost
    entry: float  # from the observer's norm to detectability's
    scale: float  # s, from detectability's norm to the error's length
    alphas: Array = field(repr=False)  # (N + 1,): alpha_0, ..., alpha_N
    norms: Norms = field(repr=False)

    def bound(self, initial: Array, w: Array, v: Array, costs: Array | None = None) -> Array:
        """The bound of |x(t) - x_hat(t)| at t = 0, ..., T, (T + 1,).

        Arguments are vectors or lengths, (T, n) or (T,); with costs, (T,), where these are known.
        """
        N, a, steps, weights = self.horizon, self.exponent, len(w), self.norms
        lengths = np.minimum(np.arange(steps + 1), N)
        first = np.asarray(initial, np.float64)[None]
        error = float(norms(first, weights.observer)[0]) * self.rho ** np.arange(steps + 1.0)
        error = error + decaying_sums(self.rho, self._entering(w, v))
        fit = (self.slope * error[:-1] + norms(v, weights.misfit)) ** a
        padded = np.concatenate((np.zeros(N), fit))
        roots: Array = sliding_window_view(padded, N).sum(axis=1) ** (1.0 / a)
        if costs is not None:
            # NaN is no cost: fmin leaves the bound in its place.
            roots[1:] = np.fmin(roots[1:], np.maximum(costs, 0.0) ** (1.0 / a))
        entry = np.full(steps + 1, float(norms(first, weights.window)[0]))
        entry[N + 1 :] = self.entry * error[1 : max(1, steps + 1 - N)]
        true = np.zeros((2, N + steps))
        true[:, N:] = norms(w, weights.disturbance), norms(v, weights.noise)
        own = entry
        for j in range(N):  # a shorter window begins later
            own = np.where(lengths < N - j, entry, self._advanced(own, *true[:, j : j + steps + 1]))
        bound: Array = self.scale * (self.alphas[lengths] * roots + own)
        return bound

    def _entering(self, w: Array, v: Array) -> Array:
        if self.norms.gain is not None and w.ndim == v.ndim == 2:
            return norms(w - v @ self.norms.gain.T, self.norms.driving)
        return norms(w, self.norms.driving) + norms(v, self.norms.corrected)

    def _advanced(self, difference: Array, disturbance: Array, noise: Array) -> Array:
        """One step of detectability, in its norms."""
        if self.kind == "weighted":
            return np.hypot(self.eta * difference, noise) + disturbance
        return self.eta * difference + noise + disturbance

    def limit(self, disturbance: float, noise: float) -> float:
        """What the bound tends to for |w| <= disturbance and |v| <= noise as t grows."""
        w, v = np.array([disturbance]), np.array([noise])
        error = self._entering(w, v) / (1.0 - self.rho)
        own = self.entry * error
        for _ in range(self.horizon):
            own = self._advanced(
                own, norms(w, self.norms.disturbance), norms(v, self.norms.noise)
            )
        fit = self.slope * error + norms(v, self.norms.misfit)
        root = self.horizon ** (1.0 / self.exponent) * fit
        return float(self.scale * (self.alphas[-1] * root + own)[0])


def summed_bound(constants: TheoremConstants, n: int = 1, p: int = 1) -> WindowBound:
    r"""Sums and Hoelder's inequality in place of geometric majorants and factors 3.

    It needs no more than the theorem does, and a >= 1. With 1/a + 1/b = 1,

    .. math::
        \alpha_k^b = (c_p \eta^k \underline c_p^{-1/a})^b + \sum_{\tau=1}^k \big(
            (c_w \eta^\tau \underline c_w^{-1/a})^b + (c_v \eta^\tau \underline c_v^{-1/a})^b
        \big)
    """
    cost, N, a = constants.cost, constants.horizon, constants.cost.exponent
    if not a >= 1.0:
        raise OptionError(
            f"the cost's exponent is {a!r}; expected at least 1: below, norms of sums do not add "
            "up, and only the theorem's own constants are there."
        )
    eta, (c_p, c_w, c_v) = constants.detectability.rate, constants.detectability.constants
    rho, (C_p, C_w, C_v) = constants.observer.rate, constants.observer.constants
    paid = [each[0] ** (-1.0 / a) for each in (cost.prior, cost.disturbance, cost.noise)]
    dual = math.inf if a == 1.0 else a / (a - 1.0)
    alphas = [
        float(np.linalg.norm(
            np.append(c_p * paid[0] * eta**k, np.outer((c_w * paid[1], c_v * paid[2]), lags)), dual
        ))
        for k in range(N + 1) for lags in [eta ** np.arange(1.0, k + 1.0)]
    ]
    # From the fitting error's length to the root of its cost.
    root = float((cost.disturbance[1] * constants.kappa**a + cost.noise[1]) ** (1.0 / a))
    weights = Norms(*(
        factor**2 * np.eye(size) for factor, size in (
            (C_p, n), (c_p, n), (rho * C_w, n), (rho * C_v, p), (root, p), (eta * c_w, n),
            (eta * c_v, p),
        )
    ))
    return WindowBound(
        "summed", N, rho, eta, a, root * constants.lipschitz, c_p, 1.0, np.array(alphas), weights
    )


def weighted_bound(
    cost: Cost, horizon: int, *, eta: float, P: Array, V: Array, rho: float, O: Array,  # noqa: E741
    K: Array, slope: float,
) -> WindowBound:
    r"""The quadratic cost's own weights, and the norms of the Lyapunov functions.

    With the cost's weights :math:`\Pi, Q, R` and the largest eigenvalue lambda,

    .. math::
        \alpha_0^2 = \lambda(P \Pi^{-1}), \qquad
        \alpha_{k+1}^2 = \max\{\eta^2 \alpha_k^2, \lambda(V R^{-1})\} + \lambda(P Q^{-1}) .

    The slope is the largest :math:`|\Delta h|_M / |\Delta x|_O`, M that of `fit_weight`.
    """
    squares, bought = [largest(P, cost.least_prior)], largest(P, cost.disturbance)
    noise = largest(V, cost.noise)
    for _ in range(horizon):
        squares.append(max(eta**2 * squares[-1], noise) + bought)
    return WindowBound(
        "weighted", horizon, rho, eta, 2.0, slope, math.sqrt(largest(P, O)),
        math.sqrt(largest(np.eye(len(P)), P)), np.sqrt(squares),
        Norms(O, P, O, K.T @ O @ K, fit_weight(cost, K), P, V, K),
    )


def fit_weight(cost: Cost, gain: Array) -> Array:
    """The weight M = K^T Q K + R that the candidate's cost puts on fitting errors."""
    return gain.T @ cost.disturbance @ gain + cost.noise


def largest(matrix: Array, weight: Array) -> float:
    """The smallest factor c with s^T matrix s <= c s^T weight s for all s, rounded up."""
    from scipy.linalg import eigh

    return _rounding(weight) * max(0.0, float(eigh(matrix, weight, eigvals_only=True)[-1]))


def _rounding(weight: Array) -> float:
    """A factor that covers what rounding does to numbers that a matrix is inverted for."""
    eps = float(np.finfo(np.float64).eps)
    return float(1.0 + 32.0 * weight.shape[0] ** 2 * eps * np.linalg.cond(weight))


@dataclass(frozen=True, eq=False)
class HorizonBounds:
    """What bounds the error for one horizon: the paper's constants, and a window's bound.

    The latter has norms for a quadratic cost and certified constants, sums for other costs and
    assumed constants, and is None for costs whose exponent is below 1.
    """

    paper: TheoremConstants
    window: WindowBound | None

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of bounds at hand, the sharpest last."""
        return ("paper",) if self.window is None else ("paper", self.window.kind, "measured")

    def beyond(self, kind: Kind) -> WindowBound:
        """The bound beyond the paper that a kind asks for."""
        if self.window is None or kind not in self.kinds:
            raise OptionError(
                f"kind is {kind!r}, for which there is no bound here; expected one of "
                f"{list(self.kinds)}. The weighted one is there for a quadratic cost and constants "
                "that were certified, the summed one where the weighted one is not."
            )
        return self.window

    def to_dict(self, sizes: Sizes) -> dict[str, Any]:
        """All constants in types that JSON knows."""
        names = (
            "L_bar", "c_bar", "eta_bar", "rho_bar_1", "rho_bar_2", "C_bar", "C_prime",
            "C_double_prime", "C",
        )
        content: dict[str, Any] = {
            "horizon": self.paper.horizon,
            "paper": {name: getattr(self.paper, name) for name in names} | {
                "lambda": self.paper.lam,
                "limit": self.paper.result.limit(sizes.disturbance, sizes.noise),
            },
        }
        if self.window is not None:
            content[self.window.kind] = {
                "beyond_the_paper": True, "alpha": self.window.alphas.tolist(),
                "limit": self.window.limit(sizes.disturbance, sizes.noise),
            }
        return content


def bounds_for(
    horizon: int, detectability: Detectability, stability: ObserverStability, cost: Cost,
    constants: CostConstants, *, lipschitz: float, output: Matrices | None = None,
) -> HorizonBounds:
    """The bounds that follow from what was certified."""
    plain = TheoremConstants(
        detectability.sums, stability.sums, constants, kappa=stability.kappa,
        lipschitz=lipschitz, horizon=horizon,
    )
    paper = plain
    if lipschitz > 0.0:  # a larger C_v holds as well, and from 1 / L_h on L_bar is L_h
        larger = max(plain.observer.noise, 1.0 / lipschitz)
        paper = replace(plain, observer=replace(plain.observer, noise=larger))
    P, V, O, K = detectability.P, detectability.V, stability.P, stability.gain  # noqa: E741
    plain_cost = cost.quadratic and cost.discount == 1.0
    if plain_cost and P is not None and V is not None and O is not None and K is not None:
        return HorizonBounds(paper, weighted_bound(
            cost, horizon, eta=detectability.eta, P=P, V=V, rho=stability.rho, O=O, K=K,
            slope=_slope(fit_weight(cost, K), O, lipschitz, output),
        ))
    summed = constants.exponent >= 1.0
    return HorizonBounds(paper, summed_bound(plain, cost.n, cost.p) if summed else None)


def _slope(fit: Array, O: Array, lipschitz: float, output: Matrices | None) -> float:  # noqa: E741
    """The largest |h(x) - h(z)|_M / |x - z|_O, from L_h or from a constant Jacobian of h."""
    plain = math.sqrt(float(np.linalg.eigvalsh(fit)[-1]) * largest(np.eye(len(O)), O))
    slope = plain * lipschitz
    if output is not None:
        C, radius = output.middle[0], float(np.linalg.norm(output.radius[0]))
        slope = min(slope, math.sqrt(largest(C.T @ fit @ C, O)) + plain * radius)
    return slope * _OUTWARD
