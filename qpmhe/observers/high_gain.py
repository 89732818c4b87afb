"""The high-gain observer of a chain of integrators."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, choice, dimension, positive, vector
from ..errors import InvalidInputError, ModelError, OptionError, ShapeError
from ..model.system import System
from .design import ackermann, linearize, spectral_radius
from .luenberger import Luenberger

Sampling = Literal["exact", "euler"]


class HighGain(Luenberger):
    r"""Constant gain, arbitrarily high, for the observability canonical form.

    For systems that equal, sampled with the step dt,

    .. math::
        \dot x_i = x_{i+1} + \varphi_i(x_1, \dots, x_i, u), \quad i = 1, \dots, n - 1, \qquad
        \dot x_n = \varphi_n(x, u), \qquad y = x_1

    or are close to it: the only output is the first state itself, each state enters the rate of the
    previous one with factor 1, and the :math:`\varphi_i` are Lipschitz continuous. A position with
    its derivatives is the common case. Transform any other model to these coordinates first, with
    this order of states and y = x_1 without a factor.

    In continuous time the gain :math:`(\alpha_1/\varepsilon, \alpha_2/\varepsilon^2, \dots,
    \alpha_n/\varepsilon^n)` gives the chain without :math:`\varphi` the poles
    :math:`r_i/\varepsilon`, where the :math:`r_i` are the roots of :math:`s^n + \alpha_1 s^{n-1} +
    \dots + \alpha_n`. One Euler step of that observer is stable only if dt is small against
    :math:`\varepsilon`. Here the discrete-time gain gives the *sampled* chain, A_d, the sampled
    poles:

    .. math::
        \operatorname{eig}(A_d - K e_1^\top) = e^{r_i\, dt/\varepsilon}, \qquad L(z, v) = K v

    For dt small against :math:`\varepsilon` this is dt times the continuous-time gain; for
    :math:`\varepsilon \to 0` it is a deadbeat observer of the chain. Smaller :math:`\varepsilon`
    means faster convergence and less effect of :math:`\varphi`, but more noise in the estimate and
    a higher peak at the start, both like :math:`\varepsilon^{1-n}`; (eq:kappa) holds with
    :math:`\kappa = |K|`. Nothing saturates the peak: bound the disturbance set W to exclude such
    large corrections as candidates, or start near y.

    Parameters
    ----------
    n : int
        Number of states, the length of the chain.
    epsilon : float
        Time constant of the observer, above 0, in the unit of dt.
    dt : float
        Sampling time, above 0. Steps of another length keep the gain.
    coefficients : (n,) array_like, optional
        :math:`\alpha_1, \dots, \alpha_n`, without unit, of a polynomial with all roots in the open
        left half plane; by default those of :math:`(s + 1)^n`.
    sampling : {"exact", "euler"}
        How the system was discretised: ``exact``, as by one Runge-Kutta step for a chain of up to 5
        states, or by one ``euler`` step.

    Attributes
    ----------
    gain : (n, 1) array
        K; its i-th entry is in units of y over the (i-1)-th power of the unit of dt.

    Raises
    ------
    OptionError, ShapeError
        If epsilon or dt is not positive, the number of coefficients is not n, a root is not in the
        left half plane, or the sampling is unknown.
    ShapeError, InvalidInputError, ModelError
        When an estimator is made: if the system has another number of states, another sampling
        time, or more than one output, or if A - K C, with the Jacobians at the initial state (and
        zero input), is not stable. The message gives its spectral radius.

    References
    ----------
    Khalil and Praly, High-gain observers in nonlinear feedback control, International
    Journal of Robust and Nonlinear Control 24 (2014), doi 10.1002/rnc.3051. Dabroom and
    Khalil, Discrete-time implementation of high-gain observers for numerical
    differentiation, International Journal of Control 72 (1999).

    Examples
    --------
    >>> import qpmhe
    >>> observer = qpmhe.HighGain(2, epsilon=1e-6, dt=0.1)   # all but deadbeat
    >>> observer.gain.round(6).tolist()
    [[2.0], [10.0]]
    """

    def __init__(
        self, n: int, *, epsilon: float, dt: float, coefficients: ArrayLike | None = None,
        sampling: Sampling = "exact",
    ) -> None:
        n = dimension("n", n, 1)
        self.epsilon, self.dt = positive("epsilon", epsilon), positive("dt", dt)
        choice("sampling", sampling, get_args(Sampling))
        roots = -np.ones(n) if coefficients is None else _roots(coefficients, n)
        # In the coordinates x_i dt^(i-1) the sampled chain does not depend on dt.
        shift = np.eye(n, k=1)
        chain, term = np.eye(n) + shift, shift
        if sampling == "exact":
            for power in range(2, n):
                term = term @ shift / power
                chain += term
        poles = np.exp(roots.astype(np.complex128) * (self.dt / self.epsilon))
        gain = ackermann(chain, np.eye(1, n), poles)[:, 0]
        # Products, not powers: so a time unit larger by a power of two changes no digit.
        self._units: Array = np.cumprod(np.append(1.0, np.full(n - 1, 1.0 / self.dt)))
        super().__init__(gain * self._units)

    def check(self, system: System, initial_state: Array) -> None:
        """Check that there is one output, and stability at z(0); see `Observer.check`."""
        n = self.gain.shape[0]
        if system.p != 1:
            raise ShapeError(
                f"the system has {system.p} outputs; expected 1: a high-gain observer measures the "
                "first state of a chain. Use design_luenberger for several outputs."
            )
        if system.n != n:
            raise ShapeError(f"the high-gain observer is for n = {n}; expected {system.n} states.")
        if system.dt is not None and not math.isclose(system.dt, self.dt):
            raise InvalidInputError(
                f"dt of the high-gain observer is {self.dt!r}; expected {system.dt!r}, the "
                "system's sampling time."
            )
        a, c, _ = linearize(system, initial_state, np.zeros(system.m))
        error = (a - self.gain @ c) * self._units / self._units[:, None]
        radius = spectral_radius(error)
        if not radius < 1.0:
            raise ModelError(
                f"A - K C has the spectral radius {radius:.6g} at the initial state "
                f"{initial_state.tolist()}; expected less than 1. The output must be the first "
                f"state (C is {c.tolist()}), each state the rate of the previous "
                "one, and sampling as in the system; otherwise try another epsilon."
            )


def _roots(coefficients: ArrayLike, n: int) -> NDArray[np.complex128]:
    given = vector("coefficients", coefficients, n)
    roots = np.asarray(np.roots(np.append(1.0, given)), dtype=np.complex128)
    # Vanishing coefficients at the end are roots at zero, which np.roots keeps.
    worst = float(roots.real.max())
    if not worst < 0.0:
        raise OptionError(
            f"coefficients is {given.tolist()}, a polynomial with a root of real part "
            f"{worst:.6g}; expected all roots in the left half plane, as of (s + 1)^n."
        )
    return roots
