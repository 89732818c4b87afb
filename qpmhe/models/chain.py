"""A benchmark of any size: a chain of masses and springs that hangs between two points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import count
from ..errors import OptionError
from ..model.system import System
from ..observers import design_luenberger
from .example import Array, Example, make_example

_MASS, _STIFFNESS, _LENGTH = 0.033, 1.0, 0.033  # kg, N/m, m
_GRAVITY, _SPACING = 9.81, 0.25  # m/s^2, m
# Above dt times the stiffness, so that an explicit Euler step is stable, too.
_DAMPING = 0.04  # N s/m
_DT = 0.03  # s
_POSITION_DISTURBANCE, _VELOCITY_DISTURBANCE = 0.001, 0.03  # m and m/s, a step
_NOISE, _DISPLACEMENT = 0.03, 0.3  # m


class _Chain:
    """The chain's functions of (..., n), n = 2 dimension masses, with few and large operations.

    One affine map of the state gives the linear part of the rate and the vectors of all links.
    On a line, these have a second component, the constant distance of the rails.
    """

    def __init__(self, masses: int, dimension: int) -> None:
        links, width, half = masses + 1, max(dimension, 2), masses * dimension
        n = 2 * half
        self._n, self._half, self._shape = n, half, (links, width)
        # Link k is row k of the differences times the positions, plus the end's own.
        differences = np.eye(links, masses) - np.eye(links, masses, -1)
        spread = np.kron(differences, np.eye(width, dimension))
        coupling = np.kron(differences.T @ differences, np.eye(dimension)) / _MASS
        ends = np.zeros((links, width))
        ends[-1, 0] = links * _SPACING
        if dimension == 1:
            ends[:, 1] = _LENGTH
        push = np.zeros((masses, dimension))
        push[-1, 0] = _STIFFNESS / _MASS * links * _SPACING
        if dimension > 1:
            push[:, -1] -= _GRAVITY

        linear = np.zeros((n, n))
        linear[:half, half:] = np.eye(half)
        linear[half:, :half] = -_STIFFNESS * coupling
        linear[half:, half:] = -_DAMPING * coupling
        self._affine = np.hstack((linear.T, np.vstack((spread.T, np.zeros((half, ends.size))))))
        self._offset = np.concatenate((np.zeros(half), push.ravel(), ends.ravel()))
        self._sums = np.kron(np.eye(links), np.ones((width, width)))
        rest_force = _STIFFNESS * _LENGTH / _MASS
        self._pull = np.hstack((np.zeros((ends.size, half)), rest_force * spread))

        self._entries, self._constants, self._index = _pattern(linear, masses, dimension, width)
        self._output_jacobian = np.eye(half, n)
        self._output_jacobian.flags.writeable = False

    def rate(self, x: Array) -> Array:
        """The rate of the state (..., n)."""
        linear = x.dot(self._affine)
        linear += self._offset
        links = linear[..., self._n :]
        lengths = np.sqrt((links * links).dot(self._sums))
        value: Array = (links / lengths).dot(self._pull)
        value += linear[..., : self._n]
        return value

    def rate_jacobian(self, x: Array) -> Array:
        """The derivative of the rate, (..., n, n)."""
        links = x.dot(self._affine[:, self._n :])
        links += self._offset[self._n :]
        squares = (links * links).dot(self._sums)
        lead = x.shape[:-1]
        rows = (links / squares).reshape(*lead, *self._shape, 1)
        columns = (links / np.sqrt(squares)).reshape(*lead, self._shape[0], 1, self._shape[1])
        entries = (rows * columns).reshape(*lead, -1).dot(self._entries)
        entries += self._constants
        value: Array = entries.take(self._index, axis=-1)
        return value

    def output(self, x: Array) -> Array:
        """The positions, (..., n/2)."""
        return x[..., : self._half]

    def output_jacobian(self, x: Array) -> Array:
        """The derivative of the output, (..., n/2, n)."""
        if x.ndim == 1:
            return self._output_jacobian
        return np.broadcast_to(self._output_jacobian, (*x.shape[:-1], self._half, self._n))

    def rest(self) -> Array:
        """The state at rest, by Newton's method from that of springs without length."""
        half, state = self._half, np.zeros(self._n)
        linear, constant = self._affine[:half, half : self._n], self._offset[half : self._n]
        state[:half] = np.linalg.solve(linear.T, -constant)
        for _ in range(20):
            slope = self.rate_jacobian(state)[half:, :half]
            step = np.linalg.solve(slope, self.rate(state)[half:])
            state[:half] -= step
            if np.abs(step).max() <= 1e-12 * np.abs(state).max():
                break
        return state


def _pattern(
    linear: Array, masses: int, dimension: int, width: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """The Jacobian's different entries, as a map and constants, and which stands where."""
    eye = np.eye(width)
    projection = np.einsum("ab,cd->cdab", eye, eye) - np.einsum("ac,bd->cdab", eye, eye)
    one_link = projection[..., :dimension, :dimension].reshape(width**2, dimension**2)
    # A mass feels what its two links do, its neighbour the negative of the one between.
    own = np.eye(masses + 1, masses) + np.eye(masses + 1, masses, -1)
    between = -np.eye(masses + 1, masses - 1, -1)
    varying = _STIFFNESS * _LENGTH / _MASS * np.kron(np.hstack((own, between)), one_link)

    half, size = masses * dimension, dimension**2
    number = np.full((masses, masses), -1)
    i, j = np.arange(masses), np.arange(masses - 1)
    number[i, i], number[j, j + 1], number[j + 1, j] = i, masses + j, masses + j
    block = np.arange(size).reshape(dimension, dimension)
    which = np.full(linear.shape, -1)
    which[half:, :half] = np.where(
        number[:, None, :, None] < 0, -1, number[:, None, :, None] * size + block[:, None]
    ).reshape(half, half)
    fixed, position = np.unique(linear[which < 0], return_inverse=True)
    constants = np.concatenate((np.zeros(varying.shape[1]), fixed))
    constants[which[which >= 0]] = linear[which >= 0]
    which[which < 0] = varying.shape[1] + position.ravel()
    return np.hstack((varying, np.zeros((varying.shape[0], fixed.size)))), constants, which


def casadi_rate(masses: int = 2, dimension: int = 3) -> Callable[[Any], Any]:
    """The rate of `chain_of_masses`, same arguments and errors, for a CasADi column."""
    masses, dimension = _checked(masses, dimension)

    def rate(x: Any) -> Any:
        import casadi

        half, along = masses * dimension, [1.0] + [0.0] * (dimension - 1)
        position, velocity = x[:half], x[half:]
        wall, end = casadi.DM.zeros(dimension), (masses + 1) * _SPACING * casadi.DM(along)
        points = [wall, *casadi.vertsplit(position, dimension), end]
        moves = [wall, *casadi.vertsplit(velocity, dimension), wall]
        rail = _LENGTH if dimension == 1 else 0.0
        forces = []
        for k in range(masses + 1):
            link = points[k + 1] - points[k]
            length = casadi.sqrt(casadi.sumsqr(link) + rail**2)
            spring = _STIFFNESS * (1.0 - _LENGTH / length) * link
            forces.append(spring + _DAMPING * (moves[k + 1] - moves[k]))
        weight = casadi.DM.zeros(dimension)
        if dimension > 1:
            weight[-1] = _GRAVITY
        pulls = [(forces[i + 1] - forces[i]) / _MASS - weight for i in range(masses)]
        return casadi.vertcat(velocity, *pulls)

    return rate


def casadi_output(masses: int = 2, dimension: int = 3) -> Callable[[Any], Any]:
    """The output of `chain_of_masses`, same arguments and errors, for a CasADi column."""
    masses, dimension = _checked(masses, dimension)
    return lambda x: x[: masses * dimension]


def chain_of_masses(masses: int = 2, dimension: int = 3, method: str = "rk4") -> Example:
    r"""Masses in a chain, connected by springs, between a wall and a fixed end point.

    .. math::
        m \ddot p_i = F_{i+1} - F_i - m g e_{\text{last}}, \quad
        F_i = D \Bigl(1 - \frac{L}{|d_i|}\Bigr) d_i + c\, \dot d_i, \quad
        d_i = p_i - p_{i-1}, \quad i = 1, \dots, M

    with the wall :math:`p_0 = 0` and the end point :math:`p_{M+1} = 0.25\,(M + 1)\, e_1` m,
    which is fixed: there is no input. The state is all positions, then all velocities, mass after
    mass; n = 2 dimension M. The positions are measured, p = n/2.

    The springs are those of acados' example: m = 0.033 kg, D = 1 N/m, L = 0.033 m, and with
    M = 3 its end point, 1 m from the wall; g = 9.81 m/s^2 along the last axis. The damping,
    c = 0.04 N s/m, is an addition: it resists relative motion of neighbours in any direction,
    with 2 % of critical for the slowest swing of 16 masses and 22 % for the fastest. Gravity
    stretches the springs to far above L, so that the chain is mildly nonlinear.

    In one dimension there is no gravity, and the masses run alternately on two parallel rails
    the distance L apart, as do wall and end point: :math:`|d_i|^2 = (p_i - p_{i-1})^2 + L^2`.
    On one rail, the springs would be linear as long as no mass passes another.

    The sampling time is 0.03 s, N = 30. Disturbances have standard deviations of 0.001 m and
    0.03 m/s a step, the noise 0.03 m. The chain starts displaced from rest by
    :math:`0.3 \sin(\pi i / (M+1))` m along every axis, the estimation from rest. The prior's
    standard deviations are 0.3 m and the corresponding velocity, :math:`0.3 \sqrt{D/m}`. The
    observer's constant gain is the gain of the stationary Kalman predictor about rest.

    Parameters
    ----------
    masses : int
        M >= 1, free masses.
    dimension : {1, 2, 3}
        Dimension of space.
    method : {"rk4", "euler"}
        Discretisation of the model. Euler steps are stable here, too, but damp much less.

    Notes
    -----
    In two and three dimensions, the force of a spring is undefined where two neighbours meet:
    x = 0 cannot be a start.

    No region is stated: noises of three standard deviations at each sample allow position errors of
    half a metre, within which neighbours may meet, where the force is undefined.

    Once settled, the observer is as good as MHE: it has the Kalman gain, and the prior weight,
    chosen for the initial error, is weak. MHE is better until then.

    References
    ----------
    Wirsching, Bock and Diehl, Fast NMPC of a chain of masses connected by springs, IEEE
    International Conference on Control Applications 2006.
    Verschueren et al., acados, Mathematical Programming Computation 14 (2022).

    Examples
    --------
    >>> import qpmhe.models.chain
    >>> system, observer, cost, scenario = qpmhe.models.chain.chain_of_masses(masses=2)
    >>> system.n, system.p
    (12, 6)
    """
    masses, dimension = _checked(masses, dimension)
    chain, half = _Chain(masses, dimension), masses * dimension
    n = 2 * half
    system = System.from_ode(
        chain.rate, chain.output, dt=_DT, n=n, p=half, method=method,
        rate_jacobian=chain.rate_jacobian, h_jacobian=chain.output_jacobian,
    )
    rest = chain.rest()
    disturbance = np.repeat([_POSITION_DISTURBANCE, _VELOCITY_DISTURBANCE], half)
    noise = np.full(half, _NOISE)
    observer = design_luenberger(
        system, rest, disturbance=np.diag(disturbance**2), noise=np.diag(noise**2)
    )
    shape = np.sin(np.pi * np.arange(1, masses + 1) / (masses + 1))
    displaced = rest.copy()
    displaced[:half] += _DISPLACEMENT * np.repeat(shape, dimension)
    axes = "xyz"[:dimension]
    names = [f"{axis}{i}" for i in range(1, masses + 1) for axis in axes]
    swing = _DISPLACEMENT * (_STIFFNESS / _MASS) ** 0.5
    return make_example(
        system, observer, prior=np.repeat([_DISPLACEMENT, swing], half), disturbance=disturbance,
        noise=noise, initial_state=displaced, initial_estimate=rest, dt=_DT, horizon=30, steps=120,
        labels=(*(f"{name} (m)" for name in names), *(f"v{name} (m/s)" for name in names)),
        settling_time=1.5, title=f"Chain of {masses} mass{'es' * (masses > 1)} in {dimension} D",
    )


def _checked(masses: Any, dimension: Any) -> tuple[int, int]:
    masses = count("masses", masses, 1)
    if isinstance(dimension, bool) or not isinstance(dimension, (int, np.integer)) or not (
        1 <= dimension <= 3
    ):
        raise OptionError(f"dimension is {dimension!r}; expected 1, 2 or 3, the axes of space.")
    return masses, int(dimension)
