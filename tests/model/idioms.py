"""Forms in which users write models in NumPy: each a function of x (3,) and u (2,)."""

import math
from math import sin

import numpy as np
from numpy import cos, zeros
from scipy.interpolate import (
    Akima1DInterpolator,
    CubicSpline,
    PchipInterpolator,
    interp1d,
    make_interp_spline,
)
from scipy.special import gamma

A = np.array([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.05, 0.0, 0.95]])
B = np.array([[0.1, 0.0], [0.0, 0.2], [0.3, -0.1]])
BEACONS = np.array([[0.3, 5.2], [4.1, -3.3], [-6.2, 1.7]])
GRID = np.array([-8.0, -3.0, -1.0, 0.4, 2.0, 3.5, 9.0])
TABLE = np.array([2.9, 3.2, 3.35, 3.5, 3.58, 3.9, 4.2])
TWO = np.stack((TABLE, TABLE**2), axis=1)
SPLINE, PCHIP, AKIMA = CubicSpline(GRID, TABLE), PchipInterpolator(GRID, TABLE), (
    Akima1DInterpolator(GRID, TABLE)
)
PERIODIC = CubicSpline([0.0, 1.0, 2.5, 4.0], [1.0, 2.0, -1.0, 1.0], bc_type="periodic")
ROWS = CubicSpline(GRID, TWO)
INSIDE = PchipInterpolator(GRID, TABLE, extrapolate=False)
LINEAR = interp1d(GRID, TABLE, fill_value="extrapolate")
CLAMPED = interp1d(GRID, TABLE, bounds_error=False, fill_value=(TABLE[0], TABLE[-1]))
STRICT = interp1d(GRID, TABLE)
KINDS = [
    interp1d(GRID, TABLE, kind=kind, fill_value="extrapolate")
    for kind in ("cubic", "quadratic", "slinear", "nearest", "nearest-up", "previous", "next")
]
B_SPLINE = make_interp_spline(GRID, TABLE, k=3)


def unpacked(x, u):
    a, b, c = x
    return np.array([b, c, -a + u[0]])


def unpacked_last_axis(x, u):
    a, b, c = (x[..., k] for k in range(3))
    rate = (a - b) / 3.0
    return x + 0.1 * np.stack([rate, np.zeros_like(rate), c * u[..., 0]], axis=-1)


def moved_axis(x, u):
    a, b, c = np.moveaxis(x, -1, 0)
    return np.stack([a * b, b * c, np.ones_like(a)], axis=-1)


def into_zeros(x, u):
    y = np.zeros(3)
    y[0], y[1:] = x[1] * x[2], x[:2] - u
    return y


def into_empty_like(x, u):
    y = np.empty_like(x)
    y[..., 0] = np.sin(x[..., 1])
    y[..., 1:] = 0.5 * x[..., :2] + u
    return y


def into_imported_zeros(x, u):
    y = zeros(3)
    y[0] = cos(x[0])
    return y


def copied(x, u):
    y = x.copy()
    y[0] += 0.1 * u[1]
    y *= 0.9
    return y


def looped(x, u):
    y = np.zeros_like(x)
    for i in range(3):
        for j in range(3):
            y[i] += A[i, j] * x[j]
    return y


def masked(x, u):
    y = np.array(x)
    y[y < 0.0] = 0.0
    return y


def masked_by_values(x, u):
    y = np.array(x)
    y[y < 0.0] = np.sin(x[x < 0.0])
    return y


def rotated(x, u):
    c, s = np.cos(x[2]), np.sin(x[2])
    turn = np.array([[c, -s], [s, c]])
    return np.concatenate([turn @ x[:2], [x[2]]])


def rotated_batch(x, u):
    c, s = np.cos(x[..., 2]), np.sin(x[..., 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return np.concatenate([np.einsum("...ij,...j->...i", turn, x[..., :2]), x[..., 2:]], -1)


def skew(x, u):
    wx = np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])
    return x + 0.1 * wx @ wx @ np.array([1.0, 2.0, u[0]])


def quaternion(x, u):
    q = np.array([1.0, *x])
    q = q / np.linalg.norm(q)
    w, v = q[0], q[1:]
    return 2.0 * np.dot(v, [1.0, 2.0, 3.0]) * v + (w * w - v @ v) * v + 2.0 * w * np.cross(v, x)


def ranges(x, u):
    return np.linalg.norm(x[..., None, :2] - BEACONS, axis=-1)


def ranges_by_list(x, u):
    return np.array([np.sqrt((x[0] - a) ** 2 + (x[1] - b) ** 2) for a, b in BEACONS])


def saturated_by_max(x, u):
    return np.array([max(min(x[0], 1.0), -1.0), max(x[1], x[2], 0.0), min(x)])


def with_math(x, u):
    return [math.sin(x[0]), math.exp(-abs(x[1])), math.hypot(x[0], x[2])]


def with_imported_sin(x, u):
    return np.array([sin(x[0]), x[1], x[2]])


def branch(x, u):
    if x[0] > 0.0:
        return 0.9 * x
    return 0.5 * x


def piecewise(x, u):
    return np.piecewise(x, [x < 0.0, x >= 2.0], [lambda v: -v, lambda v: v**2, 0.5])


def chosen_by_index(x, u):
    return TABLE[int(abs(x[0]))] * x


def friction(x, u):
    v = x[..., 1]
    return np.stack([x[..., 0] + 0.1 * v, v - 0.1 * np.sign(v) * np.sqrt(np.abs(v) + 0.1),
                     np.where(v > 0.0, v, 0.1 * v)], axis=-1)


# What is traced.
TRACED = {
    "lambda with a list": lambda x, u: [x[1], x[2] + u[0], -np.sin(x[0])],
    "np.array of a list": lambda x, u: np.array([x[1], x[2], -np.sin(x[0]) + u[1]]),
    "unpacked": unpacked,
    "unpacked along the last axis": unpacked_last_axis,
    "moveaxis, ones_like": moved_axis,
    "matmul": lambda x, u: A @ x + B @ u,
    "x @ A.T": lambda x, u: x @ A.T + u @ B.T,
    "dot and .dot": lambda x, u: np.dot(A, x) + B.dot(u),
    "einsum": lambda x, u: np.einsum("ij,...j->...i", A, x),
    "outer": lambda x, u: np.outer(x, x) @ x + np.trace(np.outer(x, x)),
    "kron and diag": lambda x, u: np.diag(x) @ x + np.kron(u, [1.0, 2.0])[:3],
    "solve": lambda x, u: np.linalg.solve(3.0 * np.eye(3) + np.diag(np.cos(x)) + A, x),
    "stack": lambda x, u: np.stack((x[..., 1], -x[..., 0], x[..., 2] ** 2), axis=-1),
    "hstack, r_": lambda x, u: np.hstack([x[1:], np.r_[u[0]]]) + np.r_[x[0], x[1], u[1]],
    "concatenate": lambda x, u: np.concatenate([x[..., 1:], x[..., :1] * u[..., :1]], axis=-1),
    "[..., None]": lambda x, u: x[..., 0][..., None] * x,
    "norm [..., None]": lambda x, u: x / (1.0 + np.linalg.norm(x, axis=-1)[..., None]),
    "norm keepdims": lambda x, u: np.linalg.norm(x[..., :2], axis=-1, keepdims=True),
    "sum [..., None]": lambda x, u: x.sum(-1)[..., None] + np.sum(x, axis=-1)[..., np.newaxis],
    "mean(axis=-1)[..., None]": lambda x, u: x - x.mean(axis=-1)[..., None],
    "zeros_like of one": lambda x, u: np.stack([x[..., 0], np.zeros_like(x[..., 0])], -1),
    "ones_like of a sine": lambda x, u: np.stack([np.ones_like(np.sin(x[..., 0])), x[..., 1]], -1),
    "full_like": lambda x, u: np.stack([np.full_like(x[..., 0], 2.0), x[..., 1]], -1),
    "atleast_1d": lambda x, u: np.atleast_1d(x[0] * x[1]),
    "reshape of one": lambda x, u: (x[0] * u[0]).reshape(1),
    "a number": lambda x, u: x[0] * x[1],
    "expand_dims, squeeze": lambda x, u: np.squeeze(np.expand_dims(x, -1) * 2.0, axis=-1),
    "reshape and .T": lambda x, u: (x.reshape(3, 1) @ x.reshape(1, 3)).T.sum(axis=0),
    "column vectors": lambda x, u: (A @ x[:, None] + B @ u[:, None]).flatten(),
    "into zeros": into_zeros,
    "into empty_like": into_empty_like,
    ".copy() and in place": copied,
    "double loop": looped,
    "comprehension": lambda x, u: np.array([
        sum(a * v for a, v in zip(row, x, strict=True)) for row in A
    ]),
    "np.array of rows": rotated,
    "rotation matrices in a batch": rotated_batch,
    "skew matrix": skew,
    "quaternion, cross": quaternion,
    "cross with numbers": lambda x, u: np.cross(np.array([x[0], u[1], 1.0]), [1.0, 2.0, 3.0]),
    "cross by rows": lambda x, u: np.cross(x[..., None, :], A)[..., 0, :],
    "ranges by broadcasting": ranges,
    "ranges by a list": ranges_by_list,
    "hypot, arctan2": lambda x, u: np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])]),
    "angle wrapped": lambda x, u: np.mod(x + np.pi, 2.0 * np.pi) - np.pi,
    "where": lambda x, u: np.where(x > 0.0, x, 0.1 * x) + np.where(np.abs(u[0]) < 1.0, u[0], 0.0),
    "where with a square root": lambda x, u: np.where(x > 0.0, np.sqrt(np.abs(x)), x),
    "clip": lambda x, u: np.clip(x, -1.0, 1.0) + x.clip(0.0, None),
    "maximum": lambda x, u: np.maximum(x, 0.0) - np.minimum(x, u[0]),
    "max and min": saturated_by_max,
    "functions of lists": lambda x, u: np.array([
        np.max([x[0], u[0], 0.0]), np.hypot([x[1], x[2]], 1.0)[1], np.minimum.reduce([x[0], x[1]]),
        np.linalg.norm([x[0] - 1.0, x[2]]), np.linalg.det([[2.0 + x[0] ** 2, x[1]], [u[0], 3.0]]),
        np.interp([x[0], x[1]], GRID, TABLE)[1], np.clip([x[0], x[2]], -1.0, 1.0)[0],
    ]),
    "divmod": lambda x, u: np.array([divmod(x[0], 2.0)[1]]),
    "mask times value": lambda x, u: (x > 0.0) * x + (x <= 0.0) * 0.5 * x,
    "assignment by a mask": masked,
    "select": lambda x, u: np.select([x < -1.0, x > 1.0], [-(x**2), x**2], default=x),
    "piecewise": piecewise,
    "sign, heaviside": lambda x, u: np.sign(x) * x**2 + np.heaviside(x, 0.5) * x,
    "friction": friction,
    "interp": lambda x, u: np.interp(x, GRID, TABLE),
    "float power": lambda x, u: np.abs(x) ** 1.5 + np.power(np.abs(x) + 0.1, 0.3),
    "exp, log1p, tanh": lambda x, u: np.exp(-np.abs(x)) + np.log1p(x**2) + np.tanh(u[0]),
    "ufunc.reduce": lambda x, u: x * np.add.reduce(x) + np.multiply.reduce(x, axis=-1),
    "prod, cumsum, diff": lambda x, u: np.cumsum(x)[1:] * np.prod(x) + np.diff(x),
    "math": with_math,
    "polyval": lambda x, u: np.polyval([0.1, -0.2, 0.3, 1.0], x),
    "matrix power, block": lambda x, u: np.block([[A, B], [B.T, np.eye(2)]])[:3, :3] @ x,
    "tile, repeat": lambda x, u: np.tile(u, 2)[:3] + np.repeat(x[:1], 3),
    "linspace, arange": lambda x, u: x * np.arange(3) + x[0] * np.linspace(0.0, 1.0, 3),
    "real": lambda x, u: np.real(x) + np.float64(2.0) * x,
    "array of float": lambda x, u: np.array([x[0], x[1], 0], dtype=float) + np.asarray(x, float),
    "CubicSpline": lambda x, u: np.array([SPLINE(x[0]), SPLINE(x[1], 1)]),
    "CubicSpline, periodic": lambda x, u: PERIODIC(x),
    "CubicSpline of rows": lambda x, u: ROWS(x[0]) + ROWS(x)[..., 1, :],
    "PchipInterpolator": lambda x, u: PCHIP(x[..., :2]) + PCHIP([x[2], 1.0]),
    "PchipInterpolator inside": lambda x, u: INSIDE(x),
    "Akima1DInterpolator": lambda x, u: AKIMA(x[..., :2]) * PCHIP.derivative()(x[..., :2]),
    "interp1d": lambda x, u: LINEAR(x) + CLAMPED(x),
    "interp1d, strict": lambda x, u: STRICT(x[0])[..., None],
    "interp1d of all kinds": lambda x, u: np.array([kind(x[1]) for kind in KINDS]),
    "B-spline": lambda x, u: B_SPLINE(x),
}
# What is not traced, and a part of the text that says what to write instead.
OTHERS = {
    "a branch": (branch, "numpy.where"),
    "an index from a value": (chosen_by_index, "numpy.interp"),
    "values by a mask": (masked_by_values, "numpy.where"),
    "from math import sin": (with_imported_sin, "numpy.sin"),
    "a special function": (lambda x, u: gamma(np.abs(x)), "table in how-to/speed"),
    "eigenvalues": (lambda x, u: np.linalg.eigvalsh(np.outer(x, x)), "table in how-to/speed"),
    "from numpy import zeros": (into_imported_zeros, "numpy.zeros"),
}
