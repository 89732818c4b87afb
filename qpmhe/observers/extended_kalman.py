"""The extended Kalman filter as an observer in output-injection form."""

from __future__ import annotations

import numpy as np

from .._checks import Array
from .._linalg import cholesky, solve
from .base import KalmanType, ObserverForm, Sample
from .innovation import UNJUDGED, Prediction, Verdict
from .roots import grown, updated


class ExtendedKalman(KalmanType):
    r"""The one-step predictor of the extended Kalman filter.

    With A and C the Jacobians of f and h at z(t):

    .. math::
        S = C P C^\top + R, \quad K = A P C^\top S^{-1}, \quad L(z, v) = K v, \quad
        P^+ = (A - K C) P (A - K C)^\top + K R K^\top + Q

    The correction is linear in v, so (eq:kappa) holds with the largest :math:`|K(t)|` that occurs.
    On a linear system it is the Kalman filter. Its covariance can weight the prior, see
    `qpmhe.ObserverPrior`. It is robustly stable only where the Kalman filter of the linearisation
    is, and the estimator inherits this.

    Where rounding would take digits from :math:`P^+` that matter, as after a prior that is vague
    beside the noise, a QR factorisation gives K and a root of :math:`P^+`, and the next step
    continues from the root. If P is lost all the same, since it is not finite or not positive
    semidefinite, the observer only predicts, from P(0) on, with `qpmhe.Status.OBSERVER_RESET`.

    Parameters
    ----------
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array_like
        Covariances P(0) of the initial error x(0) - z(0), Q of w and R of v. P(0) and Q may be
        singular. r is n, or the number of columns of the system's ``disturbance_matrix`` G; then
        :math:`G Q G^\top` replaces Q above.
    innovation : Gate or HuberInnovation, optional
        Rule for innovations that S does not explain; by default all correct alike. K and
        :math:`P^+` then use the outputs that pass, with the P and R of the rule; K takes finitely
        many forms, each bounded, so (eq:kappa) still holds.

    Raises
    ------
    WeightError, ShapeError
        If a covariance is not square, symmetric and positive semidefinite, R definite.
    OptionError
        If ``innovation`` is neither, or a group of its gate names an output that R does not have.

    References
    ----------
    Anderson and Moore, Optimal Filtering, 1979, sections 3.1 and 8.2.
    """

    needs_jacobians = True

    @property
    def c_form(self) -> ObserverForm | None:
        """The covariances, unless a derived class may compute otherwise."""
        if type(self) is not ExtendedKalman:
            return None
        return self._form("extended_kalman", len(self._prior))

    @property
    def propagates_roots(self) -> bool:
        """Unless a derived class may compute otherwise; see `Observer.propagates_roots`."""
        return type(self) is ExtendedKalman

    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        """K v and the next covariance; see `Observer.correct`."""
        a, c, covariance = _given(sample)
        c, r, v, verdict = self._seen(c, v, covariance, sample)
        covariance, root = self._used(sample, verdict.covariance)
        self._remember(verdict, sample)
        if root is None:
            cross = a @ covariance @ c.T
            spread = c @ covariance @ c.T + r
            if not self._is_vague(spread, r, sample):
                gain = solve(spread, cross.T).T if v.size else cross
                # Joseph's form: symmetric, and positive semidefinite by construction.
                closed = a - gain @ c
                following = closed @ covariance @ closed.T + gain @ r @ gain.T
                following += self._disturbance_of(sample)
                return gain @ v, 0.5 * (following + following.T)
            root = cholesky(covariance).T
        gain, following = updated(root @ c.T, root @ a.T, r, self._disturbance_of(sample))
        sample.next_root = following
        return gain @ v, following.T @ following

    def filter(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        """The filter's measurement update; see `Observer.filter`."""
        _, c, covariance = _given(sample)
        c, r, v, verdict = self._seen(c, v, covariance, sample)
        covariance, root = self._used(sample, verdict.covariance)
        if not v.size:
            return z, covariance
        if root is None:
            cross = covariance @ c.T
            spread = c @ cross + r
            if not self._is_vague(spread, r, sample):
                gain = solve(spread, cross.T).T
                closed = np.eye(z.size) - gain @ c
                return z + gain @ v, closed @ covariance @ closed.T + gain @ r @ gain.T
            root = cholesky(covariance).T
        gain, left = updated(root @ c.T, root, r)
        return z + gain @ v, left.T @ left

    def _seen(
        self, c: Array, v: Array, covariance: Array, sample: Sample
    ) -> tuple[Array, Array, Array, Verdict]:
        """Rows of C, covariance of the noise, and fitting error of the outputs that correct."""
        r, there = self._noise_of(sample), sample.observed
        if there is not None:
            c, r, v = c[there], r[np.ix_(there, there)], v[there]
        if self._innovation is None:
            return c, r, v, UNJUDGED
        prediction = self._predicted(c, r, covariance, sample)
        verdict = self._judge(prediction, r, v, sample)
        kept = verdict.kept
        r = r if verdict.noise is None else verdict.noise
        if kept is None:
            return c, r, v, verdict
        return c[kept], r[np.ix_(kept, kept)], v[kept], verdict

    def _predicted(self, c: Array, r: Array, covariance: Array, sample: Sample) -> Prediction:
        """The prediction of the outputs with these rows of C; from a root of P if there is one."""
        root = sample.root

        def deviations_of(larger: Array) -> tuple[Array, Array]:
            own = cholesky(larger).T if root is None else grown(root, covariance, larger)
            return own @ c.T, own

        def spread_of(larger: Array) -> Array:
            if root is None:
                return c @ larger @ c.T
            outputs = deviations_of(larger)[0]
            return outputs.T @ outputs

        if root is None:
            cross = covariance @ c.T
            spread = c @ cross
        else:
            seen = root @ c.T
            cross, spread = root.T @ seen, seen.T @ seen
        return Prediction(
            covariance, cross, spread, spread_of, deviations_of,
            lambda innovation: self._is_vague(innovation, r, sample),
        )


def _given(sample: Sample) -> tuple[Array, Array, Array]:
    a, c, covariance = sample.f_jacobian, sample.h_jacobian, sample.covariance
    if a is None or c is None or covariance is None:
        raise ValueError("the extended Kalman observer needs Jacobians and a covariance")
    return a, c, covariance
