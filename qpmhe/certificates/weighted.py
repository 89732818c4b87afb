"""The theorem's proof with the norms of its ingredients kept (beyond the paper)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers, positive_definite
from ..costs import ObserverPrior, QuadraticCost
from ..errors import OptionError, ShapeError
from .window_bounds import Parts, WindowBound

__all__ = ["WeightedBound", "fit_weight", "largest"]

Array = NDArray[np.float64]


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

    Parameters
    ----------
    cost : QuadraticCost
        Its weights; no discount.
    horizon : int
        N >= 1.
    P, eta : (n, n) array_like and float
        Norm and rate of detectability.
    noise_weight : (p, p) array_like
        V, positive semidefinite.
    observer_norm, rho : (n, n) array_like and float
        O, and the observer's rate.
    gain : (n, p) array_like
        K, of the discrete-time observer.
    slope : float
        The largest :math:`|h(x) - h(z)|_M / |x - z|_O` on the certified set; see `fit_weight`
        for M.

    Raises
    ------
    OptionError, ShapeError, WeightError
        If something does not fit.
    """

    def __init__(
        self,
        cost: QuadraticCost,
        *,
        horizon: int,
        P: ArrayLike,
        eta: float,
        noise_weight: ArrayLike,
        observer_norm: ArrayLike,
        rho: float,
        gain: ArrayLike,
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
        prior = (
            cost.prior.minimum * np.eye(n) if isinstance(cost.prior, ObserverPrior) else cost.prior
        )
        self._shares = (
            largest(self.P, prior), largest(self.P, cost.disturbance),
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


def fit_weight(cost: QuadraticCost, gain: ArrayLike) -> Array:
    """The weight M = K^T Q K + R that the candidate's cost puts on fitting errors.

    Parameters
    ----------
    cost : QuadraticCost
        Q and R, without discount.
    gain : (n, p) array_like
        K.

    Raises
    ------
    OptionError
        If the cost is another one.
    ShapeError
        If the gain does not fit.
    """
    if not isinstance(cost, QuadraticCost) or cost.discount < 1.0:
        raise OptionError(
            "the weighted bound needs a QuadraticCost without discount; the theorem's own "
            "constants and the summed bound do with any cost that has constants."
        )
    K = numbers("gain", gain)
    if K.shape != (cost.n, cost.p):
        raise ShapeError(f"gain has shape {K.shape}; expected {(cost.n, cost.p)}.")
    weight: Array = K.T @ cost.disturbance @ K + cost.noise
    return weight


def norms(values: Array, weight: Array) -> Array:
    """|s|_W of each row, or what it is at most for vectors of these lengths."""
    if values.ndim == 1:
        top = float(np.linalg.eigvalsh(weight)[-1])
        scaled: Array = math.sqrt(max(0.0, top)) * values
        return scaled
    if values.shape[1] != weight.shape[0]:
        raise ShapeError(
            f"vectors have {values.shape[1]} components; expected {weight.shape[0]}."
        )
    squares: Array = np.einsum("ti,ij,tj->t", values, weight, values)
    return np.sqrt(np.maximum(squares, 0.0))


def largest(matrix: Array, weight: Array) -> float:
    """The smallest factor c with s^T matrix s <= c s^T weight s for all s, rounded up.

    Parameters
    ----------
    matrix, weight : (n, n) array
        Symmetric; the weight positive definite.
    """
    from scipy.linalg import eigh

    return _rounding(weight) * max(0.0, float(eigh(matrix, weight, eigvals_only=True)[-1]))


def _rounding(weight: Array) -> float:
    """A factor that covers what rounding does to numbers that a matrix is inverted for."""
    eps = float(np.finfo(np.float64).eps)
    return float(1.0 + 32.0 * weight.shape[0] ** 2 * eps * np.linalg.cond(weight))
