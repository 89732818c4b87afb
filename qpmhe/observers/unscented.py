"""The unscented Kalman filter as an observer in output-injection form."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, positive
from .._linalg import cholesky, solve
from ..model.residuals import difference
from ..model.sets import ConvexSet
from .base import KalmanType, ObserverForm, Sample
from .innovation import UNJUDGED, Innovation, Prediction, Verdict
from .roots import updated

# A sigma point is drawn back into the state set, but not closer to z than this share.
_CLOSEST = 1e-3


class UnscentedKalman(KalmanType):
    r"""A one-step predictor whose gain comes from sigma points instead of Jacobians.

    With S the Cholesky factor of P(t), c the spread and the deviations

    .. math::
        F_j = f(z + d_j) - f(z), \quad H_j = h(z + d_j) - h(z), \qquad
        d_j = \pm c\, S e_1, \dots, \pm c\, S e_n

    of 2n sigma points, each with the weight :math:`1 / 2c^2` in the sums,

    .. math::
        \begin{aligned}
        K &= \textstyle\sum_j F_j H_j^\top \big(\sum_j H_j H_j^\top + R\big)^{-1}, \qquad
        L(z, v) = K v \\
        P^+ &= \textstyle\sum_j (F_j - K H_j)(F_j - K H_j)^\top + K R K^\top + Q
        \end{aligned}

    It differs from the textbook filter for a reason: an observer in output-injection form
    (eq:observer) steps from z to f(z) where the output fits, L(z, 0) = 0, while the textbook filter
    steps to the mean of the f(z + d_j) and compares y with the mean of the h(z + d_j). Deviations
    are therefore taken from f(z) and h(z). K then has the least mean square error among corrections
    K v, and :math:`P^+` includes the remaining bias; it is positive definite for any spread. On a
    linear system both are the Kalman filter; as the spread vanishes this one becomes
    `ExtendedKalman`.

    The correction is linear in v, so (eq:kappa) holds with the largest :math:`|K(t)|` that occurs.
    The model is evaluated at 2n + 1 states per step. If X has bounds, the two sigma points of a
    direction move towards z, with a larger weight, until they satisfy the bounds, but at most to a
    thousandth of their distance; if z is on a bound, both lie inside it. Steps of unusual length
    and missing outputs are supported.

    Where rounding would take digits from :math:`P^+` that matter, a QR factorisation gives K and a
    root of :math:`P^+` as for `ExtendedKalman`; the sigma points come from this root. If
    :math:`P^+` is lost all the same, or f or h cannot be evaluated at a sigma point, the observer
    only predicts, from P(0) on, with `qpmhe.Status.OBSERVER_RESET`.

    Parameters
    ----------
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array_like
        Covariances P(0) of the initial error x(0) - z(0), Q of w and R of v, in squared units,
        as for `ExtendedKalman`: P(0) and Q may be singular.
    spread : float
        c, the distance of the sigma points from z in standard deviations, above 0:
        :math:`\sqrt{n + \lambda}` or :math:`\alpha \sqrt{n + \kappa}` of the textbooks.
        :math:`\sqrt 3` matches the fourth moments of a Gaussian along each direction.
    innovation : Gate or HuberInnovation, optional
        As for `ExtendedKalman`, with :math:`\sum_j H_j H_j^\top` in place of :math:`C P C^\top`. If
        P grows, sigma points are drawn again.

    Raises
    ------
    WeightError, ShapeError
        If a covariance is not square, symmetric and positive semidefinite, R definite.
    OptionError
        If the spread is not positive, or ``innovation`` is neither.

    References
    ----------
    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proceedings of the IEEE
    92 (2004), doi 10.1109/JPROC.2003.823141.
    """

    def __init__(
        self, *, prior: ArrayLike, disturbance: ArrayLike, noise: ArrayLike,
        spread: float = math.sqrt(3.0), innovation: Innovation | None = None,
    ) -> None:
        super().__init__(prior=prior, disturbance=disturbance, noise=noise, innovation=innovation)
        self._spread = positive("spread", spread)

    @property
    def c_form(self) -> ObserverForm | None:
        """The covariances and the spread, unless a derived class may compute otherwise."""
        if type(self) is not UnscentedKalman:
            return None
        spread = {"spread": np.array(self._spread)}
        return self._form("unscented", 2 * len(self._prior), spread)

    @property
    def propagates_roots(self) -> bool:
        """Unless a derived class may compute otherwise; see `Observer.propagates_roots`."""
        return type(self) is UnscentedKalman

    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        """K v and the next covariance; see `Observer.correct`."""
        sigma, seen, r, v, verdict = self._seen(z, v, sample)
        self._remember(verdict, sample)
        f = sample.system.f.batch(sigma.points, sigma.inputs)
        ahead: Array = difference(sample.system.state_residual, f[1:], f[0]) * sigma.roots
        if v.size == 0 and sample.root is None:
            return np.zeros_like(z), ahead.T @ ahead + self._disturbance_of(sample)
        spread = seen.T @ seen + r
        if sample.root is not None or self._is_vague(spread, r, sample):
            gain, following = updated(seen, ahead, r, self._disturbance_of(sample))
            sample.next_root = following
            return gain @ v, following.T @ following
        gain = solve(spread, seen.T @ ahead).T
        left = ahead - seen @ gain.T
        following = left.T @ left + gain @ r @ gain.T + self._disturbance_of(sample)
        return gain @ v, 0.5 * (following + following.T)

    def filter(self, z: Array, v: Array, sample: Sample) -> tuple[Array, Array]:
        """The filter's measurement update with the same sigma points; see `Observer.filter`."""
        sigma, seen, r, v, _ = self._seen(z, v, sample)
        around: Array = sigma.moves * sigma.roots
        if v.size == 0:
            return z, around.T @ around
        spread = seen.T @ seen + r
        if sample.root is not None or self._is_vague(spread, r, sample):
            gain, left = updated(seen, around, r)
            return z + gain @ v, left.T @ left
        gain = solve(spread, seen.T @ around).T
        left = around - seen @ gain.T
        return z + gain @ v, left.T @ left + gain @ r @ gain.T

    def _sigma(self, z: Array, larger: Array | None, sample: Sample) -> _Sigma:
        """The sigma points of the sample's covariance, or of one with larger variances."""
        covariance, root = self._used(sample, larger)
        if root is None:
            root = cholesky(covariance).T
        ahead = self._spread * root
        moves, share = np.concatenate((ahead, -ahead)), np.ones(2 * z.size)
        states = sample.system.states if sample.states is None else sample.states
        if states is not None:
            moves, share = _inside(z, moves, states)
        points = np.concatenate((z[None], z + moves))
        # Roots of the weights go into the deviations, so that sums become products.
        roots = (1.0 / (math.sqrt(2.0) * self._spread * share))[:, None]
        inputs = np.broadcast_to(sample.u, (points.shape[0], sample.u.size))
        return _Sigma(moves, points, roots, inputs)

    def _seen(
        self, z: Array, v: Array, sample: Sample
    ) -> tuple[_Sigma, Array, Array, Array, Verdict]:
        """Sigma points, and deviations, noise covariance and fitting error of what corrects."""
        covariance, r, there = sample.covariance, self._noise_of(sample), sample.observed
        if covariance is None:
            raise ValueError("the unscented Kalman observer needs a covariance")
        sigma = self._sigma(z, None, sample)
        seen = self._outputs(sigma, sample)
        if there is not None:
            r, v = r[np.ix_(there, there)], v[there]
        if self._innovation is None:
            return sigma, seen, r, v, UNJUDGED

        def deviations_of(larger: Array) -> tuple[Array, Array]:
            if larger is covariance:
                return seen, sigma.moves * sigma.roots
            own = self._sigma(z, larger, sample)
            return self._outputs(own, sample), own.moves * own.roots

        def spread_of(larger: Array) -> Array:
            outputs = deviations_of(larger)[0]
            return outputs.T @ outputs

        cross = (sigma.moves * sigma.roots).T @ seen
        prediction = Prediction(
            covariance, cross, seen.T @ seen, spread_of, deviations_of,
            lambda innovation: self._is_vague(innovation, r, sample),
        )
        verdict = self._judge(prediction, r, v, sample)
        kept = verdict.kept
        r = r if verdict.noise is None else verdict.noise
        if verdict.covariance is not None:
            sigma = self._sigma(z, verdict.covariance, sample)
            seen = self._outputs(sigma, sample)
        if kept is not None:
            seen, r, v = seen[:, kept], r[np.ix_(kept, kept)], v[kept]
        return sigma, seen, r, v, verdict

    @staticmethod
    def _outputs(sigma: _Sigma, sample: Sample) -> Array:
        """Deviations of the outputs that are there, times the roots of their weights."""
        h, there = sample.system.h.batch(sigma.points, sigma.inputs), sample.observed
        seen: Array = difference(sample.system.output_residual, h[1:], h[0])
        return (seen if there is None else seen[:, there]) * sigma.roots


class _Sigma(NamedTuple):
    """Deviations from z, z and the sigma points, roots of their weights, and their inputs."""

    moves: Array
    points: Array
    roots: Array
    inputs: Array


def _inside(z: Array, moves: Array, states: ConvexSet) -> tuple[Array, Array]:
    """The moves (2n, n), drawn nearer to z so that they stay in the bounds, and by how much."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(moves > 0.0, states.upper - z, z - states.lower)
        steps = np.where(moves == 0.0, math.inf, room / np.abs(moves))
    allowed = steps.min(axis=1).reshape(2, -1)  # of z + d_j and of z - d_j
    nearer, farther = allowed.min(axis=0), allowed.max(axis=0)
    # Where z is on a bound both points lie inside of it: a sum of products ignores their sign.
    on_bound = (nearer < _CLOSEST) & (farther >= _CLOSEST)
    inwards = np.where(allowed[0] >= allowed[1], 1.0, -1.0)
    signs = np.where(on_bound, inwards, np.array([[1.0], [-1.0]]))
    share = np.tile(np.clip(np.where(on_bound, farther, nearer), _CLOSEST, 1.0), 2)
    ahead = moves[: z.size]
    both = np.concatenate((signs[0, :, None] * ahead, signs[1, :, None] * ahead))
    return both * share[:, None], share
