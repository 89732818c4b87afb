"""Constant gains from the linearisation of a system about a point."""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import SINGULAR, Array, positive_definite, positive_semidefinite, vector
from .._linalg import solve, unit_diagonal
from ..errors import InvalidInputError, ModelError, OptionError, ShapeError
from ..model.system import System, checked_system
from .luenberger import Luenberger

ComplexArray = NDArray[np.complex128]

# So many standard deviations of the disturbance are a typical magnitude of a state.
_STEPS = 100.0

# Below this a direction counts as unseen. Matrices are scaled to norm one before, and the
# Jacobians may be finite differences.
_UNSEEN = float(np.sqrt(np.finfo(np.float64).eps))


def design_luenberger(
    system: System, at: ArrayLike, u: ArrayLike | None = None, *, poles: ArrayLike | None = None,
    disturbance: ArrayLike | None = None, noise: ArrayLike | None = None,
) -> Luenberger:
    r"""A Luenberger observer for the linearisation of a system about a point.

    With A and C the Jacobians of f and h at the point, the error of the observer's state obeys
    :math:`e(t+1) = (A - K C)\, e(t)` near it. The gain K either places the eigenvalues of A - K C,
    or is that of the stationary Kalman predictor

    .. math::
        K = A P C^\top S^{-1}, \quad S = C P C^\top + R, \quad
        P = A P A^\top + Q - K S K^\top

    The observer is stable only where the linearisation is accurate, in a region that is not
    computed. Choose a typical point, usually a steady state.

    Parameters
    ----------
    system : System
        The discrete-time system.
    at : (n,) array_like
        The state about which to linearise.
    u : (m,) array_like, optional
        The input there; required if the system has inputs.
    poles : (n,) array_like, optional
        Eigenvalues of A - K C, inside the unit circle, complex ones in conjugate pairs.
        With several outputs, none more often than the rank of C. For a continuous-time
        pole s and a sampling time dt, give exp(s dt). Where the states' units differ by orders
        of magnitude, give the system its `scales`.
    disturbance, noise : (r, r) and (p, p) array_like, optional
        Instead of poles: covariances Q of w and R of v (squared units), symmetric; R is
        positive definite, Q may be singular. With the system's ``disturbance_matrix`` G,
        G Q G' takes the place of Q above.

    Returns
    -------
    Luenberger
        The observer with the gain K (n, p), in units of the state per unit of the output.

    Raises
    ------
    OptionError
        Unless either the poles or both covariances are given; if a pole is not inside the unit
        circle or lacks its conjugate.
    ShapeError, WeightError
        If an argument has the wrong shape, or a covariance is not positive definite.
    ModelError
        If the model cannot be linearised there; if poles are given and a mode is not observable; if
        covariances are given and an unobservable mode is unstable; or if the problem is too
        ill-conditioned for a gain with these poles.

    References
    ----------
    Kautsky, Nichols and van Dooren, Robust pole assignment in linear state feedback,
    International Journal of Control 41 (1985), as in `scipy.signal.place_poles`; with one
    output Ackermann's formula. Anderson and Moore, Optimal Filtering, 1979, chapter 4.

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> A = np.array([[1.0, 0.1], [0.0, 1.0]])
    >>> system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    >>> observer = qpmhe.design_luenberger(system, [0.0, 0.0], poles=[0.5, 0.6])
    >>> observer.gain.round(6).tolist()
    [[0.9], [2.0]]
    """
    checked_system(system)
    if poles is not None and disturbance is None and noise is None:
        a, c, point = linearize(system, at, u)
        return Luenberger(
            _placed(a, c, _checked_poles(poles, system.n), point, system.scales)
        )
    if poles is None and disturbance is not None and noise is not None:
        covariance, _ = positive_semidefinite("disturbance covariance", disturbance, system.r)
        q = system.state_covariance(covariance)
        a, c, point = linearize(system, at, u, q)
        r = positive_definite("noise covariance", noise, system.p)
        return Luenberger(stationary(a, c, q, r, point)[0])
    options = {"poles": poles, "disturbance": disturbance, "noise": noise}
    given = [name for name, value in options.items() if value is not None]
    raise OptionError(
        f"given: {', '.join(given) or 'none of them'}; expected either the poles, or the "
        "covariances of disturbance and noise."
    )


def linearize(
    system: System, at: ArrayLike, u: ArrayLike | None, disturbance: Array | None = None
) -> tuple[Array, Array, Array]:
    """The Jacobians A (n, n) and C (p, n) at a point, and the point (n,).

    A covariance of the disturbance, (n, n), sets the states' magnitudes: a multiple of it.
    """
    point = vector("at", at, system.n)
    if u is None and system.m:
        raise InvalidInputError(
            f"u is missing; the system has {system.m} inputs, and the linearisation depends on "
            "them."
        )
    inputs = np.zeros(0) if u is None else vector("u", u, system.m)
    if disturbance is not None:
        deviations = np.sqrt(disturbance.diagonal())
        sizes = np.where(point != 0.0, np.abs(point), 1.0)  # of states without disturbance
        scales = np.where(deviations > 0.0, _STEPS * deviations, sizes)
        model = system.model(scales).differentiated_at(point, inputs)
        system = system.evaluated_by(model)
    found = []
    for function, jacobian in ((system.f, system.f_jacobian), (system.h, system.h_jacobian)):
        try:
            with np.errstate(all="ignore"):
                value = np.asarray(function(point, inputs), dtype=np.float64)
                slope = np.asarray(jacobian(point, inputs), dtype=np.float64)
        except Exception as error:
            raise ModelError(
                f"{function.name} cannot be linearised at x = {point.tolist()}: it raised "
                f"{type(error).__name__}: {error}. Choose a point where it is defined and "
                "differentiable."
            ) from error
        # The value too: outside of a function's domain differences may look like a slope.
        if not (np.isfinite(value).all() and np.isfinite(slope).all()):
            raise ModelError(
                f"{function.name} is {value.tolist()} at x = {point.tolist()}, its Jacobian "
                f"{slope.tolist()}; expected finite numbers. Choose another point."
            )
        found.append(slope)
    return found[0], found[1], point


def stationary(a: Array, c: Array, q: Array, r: Array, point: Array) -> tuple[Array, Array]:
    """Gain (n, p) and covariance (n, n) of the stationary Kalman predictor."""
    # In standard deviations of disturbance and noise, rounded to powers of two: the result
    # then depends on no unit.
    _, states, whole = unit_diagonal(_positive_diagonal(a, c, q, r))
    q = np.ldexp(q, -whole - states[:, None] - states)
    r, outputs, other = unit_diagonal(r)
    r = np.ldexp(r, other - whole)
    a = np.ldexp(a, states - states[:, None])
    c = np.ldexp(c, states - outputs[:, None])
    gain, covariance = _stationary(a, c, q, r, point)
    covariance = np.ldexp(covariance, whole + states[:, None] + states)
    return np.ldexp(gain, states[:, None] - outputs), covariance


def _positive_diagonal(a: Array, c: Array, q: Array, r: Array) -> Array:
    """Q, with a variance of the size of the state where it has none."""
    if q.diagonal().all():
        return q
    reached = term = q
    for _ in range(len(q) - 1):
        term = a @ term @ a.T
        reached = reached + term
    # What no disturbance reaches is as large as the noise of the outputs that show it.
    shown = ((c / np.sqrt(r.diagonal())[:, None]) ** 2).max(axis=0)
    size = np.where(shown > 0.0, 1.0 / np.where(shown > 0.0, shown, 1.0), 1.0)
    size = np.where(reached.diagonal() > 0.0, reached.diagonal(), size)
    filled: Array = q + np.diag(np.where(q.diagonal() > 0.0, 0.0, size))
    return filled


def _stationary(a: Array, c: Array, q: Array, r: Array, point: Array) -> tuple[Array, Array]:
    """The same in numbers of order one."""
    from scipy.linalg import solve_discrete_are

    hidden = _unobservable_modes(a, c)
    lasting = hidden[np.abs(hidden) > 1.0 - _UNSEEN]
    if lasting.size:
        raise ModelError(
            f"the linearisation at x = {point.tolist()} is not detectable: the outputs do not "
            f"show the mode with eigenvalue {_text(lasting)}, which does not decay. Choose another "
            "point, add outputs, or remove that part from the state."
        )
    singular = float(np.linalg.eigvalsh(q)[0]) <= SINGULAR
    still = _unobservable_modes(a.T, q) if singular else hidden
    still = still[np.abs(np.abs(still) - 1.0) < _UNSEEN]
    if still.size:
        raise ModelError(
            f"no disturbance reaches the mode with eigenvalue {_text(still)} of the linearisation "
            f"at x = {point.tolist()}, which "
            "neither decays nor grows, so the stationary gain does not correct it. Give it a small "
            "variance, or use qpmhe.ExtendedKalman."
        )
    try:
        covariance = np.asarray(solve_discrete_are(a.T, c.T, q, r), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(
            f"the Riccati equation about x = {point.tolist()} could not be solved: {error} "
            "Scale states and outputs to similar sizes."
        ) from error
    covariance = 0.5 * (covariance + covariance.T)
    cross = a @ covariance @ c.T
    gain = solve(c @ covariance @ c.T + r, cross.T).T
    radius = spectral_radius(a - gain @ c)
    if not radius < 1.0:
        raise ModelError(
            f"the solution of the Riccati equation about x = {point.tolist()} gives A - K C the "
            f"spectral radius {radius:.6g}; expected less than 1. Scale states and outputs to "
            "similar sizes."
        )
    return gain, covariance


def ackermann(a: Array, c: Array, poles: ComplexArray) -> Array:
    r"""The gain K (n, 1) that gives A - K C the poles, for a pair with one output.

    .. math::
        K = p(A)\, [C;\ C A;\ \dots;\ C A^{n-1}]^{-1} e_n
    """
    # A shift and a scaling of A move the poles along. They part the rows of the
    # observability matrix, which short sampling times bring close to each other.
    shift, scale = _shift_and_scale(a)
    eye = np.eye(a.shape[0])
    a = (a - shift * eye) / scale
    rows, product = [c[0]], eye.astype(np.complex128)
    for pole in (poles - shift) / scale:
        rows.append(rows[-1] @ a)
        product = product @ (a - pole * eye)
    column = np.linalg.solve(np.array(rows[:-1]), eye[:, -1])
    gain: Array = scale * (product.real @ column)
    return gain[:, None]


def spectral_radius(matrix: Array) -> float:
    """The largest modulus of an eigenvalue."""
    return float(np.abs(_eigenvalues(matrix)).max())


def _eigenvalues(matrix: Array) -> ComplexArray:
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)


def _placed(
    a: Array, c: Array, poles: ComplexArray, point: Array, scales: Array | None
) -> Array:
    """The gain that places the poles, found in numbers of order one."""
    exponents = np.zeros(point.size, np.int32) if scales is None else np.frexp(scales)[1]
    a = np.ldexp(a, exponents - exponents[:, None])
    c = np.ldexp(c, exponents)
    rows = np.frexp(np.abs(c).max(axis=1))[1]
    found = _placed_scaled(a, np.ldexp(c, -rows[:, None]), poles, point)
    gain: Array = np.ldexp(found, exponents[:, None] - rows)
    return gain


def _placed_scaled(a: Array, c: Array, poles: ComplexArray, point: Array) -> Array:
    hidden = _unobservable_modes(a, c)
    if hidden.size:
        raise ModelError(
            f"the linearisation at x = {point.tolist()} is not observable: the outputs do not "
            f"show the mode with eigenvalue {_text(hidden)}, and no gain moves it. If it is "
            "stable, give covariances of disturbance and noise instead of poles."
        )
    # Outputs that say the same are one output: C is made one of full rank.
    combinations, sizes, _ = np.linalg.svd(c, full_matrices=False)
    combinations = combinations[:, sizes > sizes[0] * 1e-14].T
    if combinations.shape[0] == 1:
        reduced = ackermann(a, combinations @ c, poles)
    else:
        reduced = _place_poles(a, combinations @ c, poles)
    gain: Array = reduced @ combinations
    # Characteristic polynomials, as the eigenvalues of a multiple pole are all but random.
    placed, asked = np.poly(a - gain @ c), np.poly(poles)
    off = float(np.abs(placed - asked).max() / np.abs(asked).max())
    if not (off < 1e-3 and spectral_radius(a - gain @ c) < 1.0):
        raise ModelError(
            f"the poles about x = {point.tolist()} come out as {_text(_eigenvalues(a - gain @ c))} "
            f"instead of {_text(poles)}: the pair is too ill-conditioned. Choose slower poles, or "
            "give covariances instead."
        )
    return gain


def _place_poles(a: Array, c: Array, poles: ComplexArray) -> Array:
    from scipy.signal import place_poles

    rank = c.shape[0]
    values, times = np.unique(poles, return_counts=True)
    if times.max() > rank:
        raise OptionError(
            f"the pole {_text(values[[times.argmax()]])} is given {times.max()} times; "
            f"expected at most rank C = {rank} times. Move the copies slightly apart."
        )
    with warnings.catch_warnings():
        # It warns where it has not found the most robust of the gains with these poles.
        warnings.simplefilter("ignore")
        try:
            gain = place_poles(a.T, c.T, poles).gain_matrix
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ModelError(
                f"no gain with the poles {_text(poles)} was found: {error}. Give covariances "
                "instead of poles."
            ) from error
    return np.asarray(gain, dtype=np.float64).T


def _checked_poles(poles: ArrayLike, n: int) -> ComplexArray:
    try:
        given = np.atleast_1d(np.array(poles, dtype=np.complex128))
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(f"poles is {shown(poles)}, not an array of numbers.") from error
    if given.shape != (n,):
        raise ShapeError(f"poles has shape {given.shape}; expected (n,) = ({n},).")
    outside = given[~(np.abs(given) < 1.0)]
    if outside.size:
        raise OptionError(
            f"the poles {_text(outside)} do not lie inside the unit circle; for a continuous-time "
            "pole s, give exp(s dt)."
        )
    upper, lower = given[given.imag > 0.0], given[given.imag < 0.0]
    if upper.size != lower.size or not np.allclose(
        np.sort_complex(upper), np.sort_complex(lower.conj()), rtol=0.0, atol=1e-9
    ):
        raise OptionError(
            f"poles is {_text(given)}; expected complex poles "
            "in conjugate pairs, since the gain is real."
        )
    return np.concatenate((given[given.imag == 0.0], upper, upper.conj()))


def _unobservable_modes(a: Array, c: Array) -> ComplexArray:
    """Eigenvalues of A on the largest invariant subspace that C does not see."""
    shift, scale = _shift_and_scale(a)
    shifted = (a - shift * np.eye(a.shape[0])) / scale
    size = np.linalg.norm(c, axis=1, keepdims=True)
    basis = _kernel(c / np.where(size > 0.0, size, 1.0))
    while basis.shape[1]:
        moved = shifted @ basis
        staying = _kernel(moved - basis @ (basis.T @ moved))
        if staying.shape[1] == basis.shape[1]:
            return _eigenvalues(basis.T @ a @ basis)
        basis = basis @ staying
    return np.zeros(0, dtype=np.complex128)


def _shift_and_scale(a: Array) -> tuple[float, float]:
    """Numbers s and r for which (A - s I) / r is of norm one, unless A is a multiple of I."""
    shift = float(np.trace(a)) / a.shape[0]
    size = float(np.linalg.norm(a - shift * np.eye(a.shape[0])))
    return shift, max(size, _UNSEEN * float(np.linalg.norm(a))) or 1.0


def _kernel(matrix: Array) -> Array:
    _, values, rows = np.linalg.svd(matrix)
    return rows[int(np.count_nonzero(values > _UNSEEN)) :].T


def _text(values: ComplexArray) -> str:
    return ", ".join(
        f"{value.real:.6g}" if math.isclose(value.imag, 0.0, abs_tol=1e-12) else f"{value:.6g}"
        for value in values
    )
