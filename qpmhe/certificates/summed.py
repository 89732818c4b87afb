"""The theorem's proof with its sums kept, from the same numbers (beyond the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .window_bounds import Parts, WindowBound, holder
from .theorem import TheoremConstants

__all__ = ["SummedBound"]

Array = NDArray[np.float64]


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

    Parameters
    ----------
    constants : TheoremConstants
        Where the numbers come from.

    Raises
    ------
    OptionError
        If a < 1.
    """

    def __init__(self, constants: TheoremConstants) -> None:
        self.constants = constants
        cost = constants.cost
        a = cost.exponent
        #: From the fitting error's length to the root of its cost.
        self.cost_root = float(
            (cost.disturbance[1] * constants.kappa**a + cost.noise[1]) ** (1.0 / a)
        )
        super().__init__(
            horizon=constants.horizon,
            rho=constants.observer.rate,
            eta=constants.detectability.rate,
            exponent=a,
            slope=self.cost_root * constants.lipschitz,
            entry=constants.detectability.initial,
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
