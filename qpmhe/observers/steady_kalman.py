"""The stationary Kalman predictor about a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, positive_definite, positive_semidefinite
from .._linalg import solve
from ..errors import ShapeError
from ..model.system import System, checked_system
from .base import Observer, ObserverForm, Sample, covariance_of
from .design import linearize, stationary


class SteadyStateKalman(Observer):
    r"""Constant gain of the stationary Kalman predictor, with its covariance.

    With A and C the Jacobians of f and h at a point, computed once at construction:

    .. math::
        S = C P C^\top + R, \quad K = A P C^\top S^{-1}, \quad L(z, v) = K v, \quad
        P = A P A^\top + Q - K S K^\top

    Stability and (eq:kappa) are as for a `Luenberger` observer, with :math:`\kappa` the spectral
    norm of K. In addition it has a covariance, so that `qpmhe.ObserverPrior` can weight the prior:
    the covariance of this observer's error on the linearisation,

    .. math::
        P(t+1) = (A - K C) P(t) (A - K C)^\top + Q + K R K^\top

    which stays at P from P(0) = P on, except where outputs are missing (their columns of K are then
    zero) or a sample has another noise weight. The gain itself never changes. On a linear system
    with P(0) = P it is the Kalman predictor.

    Parameters
    ----------
    system : System
        The system of the gain; the estimator's, or one of the same dimensions.
    at : (n,) array_like
        The state about which to linearise; it should be typical of the operation.
    u : (m,) array_like, optional
        The input there; required if the system has inputs.
    disturbance, noise : (r, r) and (p, p) array_like
        Covariances Q of w and R of v (squared units), symmetric; R is positive definite, Q may be
        singular. With the system's ``disturbance_matrix`` G, G Q G' takes the place of Q above.
    prior : (n, n) array_like, optional
        Covariance P(0) of the initial error x(0) - z(0); the stationary one if left out, which is
        realistic after a long run and overconfident otherwise.

    Attributes
    ----------
    gain, covariance : (n, p) and (n, n) array
        K, in units of the state per unit of the output, and the stationary P.

    Raises
    ------
    ShapeError, WeightError
        If an argument has the wrong shape, or a covariance is not symmetric and positive
        definite.
    ModelError
        If the model cannot be linearised at the point, or its linearisation is not detectable
        there; the message names the unobserved mode.

    References
    ----------
    Anderson and Moore, Optimal Filtering, 1979, chapter 4.

    Examples
    --------
    >>> import qpmhe
    >>> system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1)
    >>> observer = qpmhe.SteadyStateKalman(system, [0.0], disturbance=[[1.0]], noise=[[2.0]])
    >>> float(observer.covariance.round(6)[0, 0]), float(observer.gain.round(6)[0, 0])
    (2.0, 0.5)
    """

    def __init__(
        self, system: System, at: ArrayLike, u: ArrayLike | None = None, *, disturbance: ArrayLike,
        noise: ArrayLike, prior: ArrayLike | None = None,
    ) -> None:
        checked_system(system)
        self._own, _ = positive_semidefinite("disturbance covariance", disturbance, system.r)
        self._disturbance = system.state_covariance(self._own)
        self._a, self._c, point = linearize(system, at, u, self._disturbance)
        self._noise = positive_definite("noise covariance", noise, system.p)
        self.gain, self.covariance = stationary(
            self._a, self._c, self._disturbance, self._noise, point
        )
        cross = self.covariance @ self._c.T
        self._filter_gain = solve(self._c @ cross + self._noise, cross.T).T
        self._prior = self.covariance
        if prior is not None:
            self._prior, _ = positive_semidefinite("prior covariance", prior, system.n)
        self._closed = self._a - self.gain @ self._c
        self._entering = self._disturbance + self.gain @ self._noise @ self.gain.T

    def check(self, system: System, initial_state: Array) -> None:
        """Check that the gain is for the system's dimensions; see `Observer.check`."""
        n, p = self.gain.shape
        if (system.n, system.p) != (n, p):
            raise ShapeError(
                f"the observer is for {n} states and {p} outputs; expected {system.n} and "
                f"{system.p}, the system's."
            )
        if len(self._own) != system.r:
            raise ShapeError(
                f"disturbance covariance has shape {self._own.shape}; expected ({system.r}, "
                f"{system.r}). Make the observer with the estimator's system."
            )

    @property
    def constant_gain(self) -> Array | None:
        """The gain K, unless a derived class corrects in another way."""
        return self.gain if type(self).correct is SteadyStateKalman.correct else None

    @property
    def filter_gain(self) -> Array | None:
        """The gain of `filter`, unless a derived class filters in another way."""
        own = type(self).filter is SteadyStateKalman.filter
        return self._filter_gain if own and self.constant_gain is not None else None

    @property
    def c_form(self) -> ObserverForm | None:
        """The gains, and the covariances unless a derived class may compute others."""
        form = super().c_form
        if form is None or type(self) is not SteadyStateKalman:
            return form
        return ObserverForm(
            "steady_kalman", {**form.data, "f_jacobian": self._a, "h_jacobian": self._c},
            prior=self._prior, disturbance=self._own, noise=self._noise, plain=form,
        )

    @property
    def kappa(self) -> float:
        """The constant of (eq:kappa)."""
        return float(np.linalg.norm(self.gain, 2))

    def initial_covariance(self) -> Array:
        """P(0)."""
        return self._prior

    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        """K v and the covariance of the next error; see `Observer.correct`."""
        own = sample.observed, sample.noise_weight, sample.disturbance_weight
        if all(one is None for one in own):
            closed, entering = self._closed, self._entering
        else:
            gain, r = self._given(self.gain, sample)
            entered = covariance_of(sample.disturbance_weight, self._own)
            q = self._disturbance
            if entered is not self._own:
                q = sample.system.state_covariance(entered)
            closed, entering = self._a - gain @ self._c, q + gain @ r @ gain.T
        following = closed @ self._before(sample) @ closed.T + entering
        return self.gain @ v, 0.5 * (following + following.T)

    def filter(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        r"""The measurement update with the gain :math:`P C^\top S^{-1}`; see `Observer.filter`."""
        gain, r = self._given(self._filter_gain, sample)
        closed = np.eye(z.size) - gain @ self._c
        return z + gain @ v, closed @ self._before(sample) @ closed.T + gain @ r @ gain.T

    def _before(self, sample: Sample) -> Array:
        return self.covariance if sample.covariance is None else sample.covariance

    def _given(self, gain: Array, sample: Sample) -> tuple[Array, Array]:
        """A gain without the columns of missing outputs, and this sample's noise covariance."""
        if sample.observed is not None:
            gain = np.where(sample.observed, gain, 0.0)
        return gain, covariance_of(sample.noise_weight, self._noise)
