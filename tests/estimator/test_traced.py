"""Functions of NumPy as CasADi expressions: the same numbers, or no trace and the reason."""

import contextlib
import ctypes
import math
import threading
import time

import numpy as np

from qpmhe.model.tracing import traced

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
BUFFER = np.zeros(2)


def into_zeros(x):
    out = np.zeros(2)
    out[0] = x[1]
    out[1] = -math.sin(x[0])
    return out


def into_like(x):
    out = np.empty_like(x)
    out[..., 0], out[..., 1] = x[..., 1], np.clip(x[..., 0], -1.0, 1.0)
    return out


def into_identity(x):
    matrix = np.eye(2)
    matrix[0, 1] = x[0]
    return matrix @ x


def in_place(x):
    y = 0.5 * x
    y += np.sin(x)
    y[..., 0] *= 2.0
    return y


def divided(x):
    out = np.zeros_like(x)
    np.divide(1.0, x, out=out, where=np.abs(x) > 0.5)
    return out


def made_by_compiled_code(x):
    # NumPy's generator itself calls `numpy.empty` for an array of numbers.
    out = np.empty(2)
    out[:] = np.random.default_rng(3).normal(size=2) + np.array(x)
    return out


STRAIGHT = {
    "an array of compiled code": made_by_compiled_code,
    "zeros": into_zeros,
    "empty_like": into_like,
    "eye": into_identity,
    "in place": in_place,
    "out and where": divided,
    "list": lambda x: [x[1], -np.sin(x[0])],
    "number": lambda x: x[0] * x[1],
    "A @ x": lambda x: A @ x,
    "x @ A.T": lambda x: x @ A.T,
    "dot": lambda x: np.dot(A, x) + x.dot(A),
    "a product over nothing": lambda x: x + x[2:] @ np.zeros((0, 2)),
    "einsum": lambda x: np.einsum("ij,...j->...i", A, x),
    "outer": lambda x: np.outer(x, x) @ x,
    "kron": lambda x: np.kron(x, [1.0, 2.0]),
    "cross": lambda x: np.cross(np.array([x[0], x[1], 1.0]), [1.0, 2.0, 3.0]),
    "solve": lambda x: np.linalg.solve(np.array([[2.0 + x[0] ** 2, 1.0], [1.0, 3.0]]), x),
    "inv and det": lambda x: np.linalg.inv(np.diag(2.0 + x**2)) * np.linalg.det(A * x[0]),
    "norm": lambda x: x / (1.0 + np.linalg.norm(x, axis=-1, keepdims=True)),
    "norms": lambda x: [np.linalg.norm(x, 1), np.linalg.norm(x, np.inf)],
    "sums": lambda x: x + x.sum() + np.mean(x) + x.prod() + np.cumsum(x) + np.std(x),
    "where": lambda x: np.where((x > 0.0) & (x < 9.0), x, 2.0 * x),
    "select": lambda x: np.select([x < 0.0, x > 3.0], [x, 3.0 + 0.0 * x], 1.0),
    "heaviside": lambda x: np.heaviside(x, 0.5) * x,
    "extrema": lambda x: np.maximum(x, 0.0) + np.minimum(x[::-1], x) + x.max() - np.min(x),
    "clip": lambda x: np.clip(x, None, 2.0) + x.clip(-1.0, 1.0),
    "interp": lambda x: np.interp(x, np.arange(4.0), [0.0, 1.0, 4.0, 9.0]),
    "interp outside": lambda x: np.interp(x, [0.0, 2.0], [1.0, 3.0], left=-1.0, right=7.0),
    "arctan2": lambda x: [np.arctan2(x[1], x[0]), np.hypot(x[0], x[1])],
    "wrapped": lambda x: (x + np.pi) % (2.0 * np.pi) - np.pi,
    "whole numbers": lambda x: np.floor(x) + np.ceil(x) + np.trunc(x) + np.rint(x) + x // 0.3,
    "remainders": lambda x: np.mod(x, 0.7) + np.fmod(x, 0.3) + x % -0.2,
    "rounded": lambda x: np.round(x, 1),
    "powers": lambda x: np.abs(x) ** 0.3 + x**3 + np.square(x) + np.cbrt(x) + 2.0**x,
    "logarithms": lambda x: np.log(np.abs(x)) + np.log1p(x * x) + np.log2(1.0 + x * x),
    "exponentials": lambda x: np.exp(-x * x) + np.expm1(0.01 * x) + np.exp2(0.1 * x),
    "hyperbolic": lambda x: np.tanh(x) + np.sinh(0.1 * x) + np.arcsinh(x) + np.cosh(0.1 * x),
    "inverses": lambda x: np.arcsin(0.1 * np.tanh(x)) + np.arctan(x) + np.sign(x),
    "outside of the domain": lambda x: np.sqrt(x) + np.log(x) + np.arccos(x),
    "truth values": lambda x: (x > 0.0) * x + ((x > 0.0) + (x > 1.0)) + np.sum(x > 0.0) + ~(x > 2),
    "any": lambda x: np.where(np.any(x > 1.0), x, -x) + np.where(np.all(x > 1.0), 1.0, x),
    "pieces": lambda x: np.concatenate((x[1:], x[:1])) + np.roll(x, 1) + np.stack((x[1], x[0])),
    "joined": lambda x: np.hstack((x, [1.0], np.append(np.diff(x), x[0]))),
    "array of numbers": lambda x: np.array([x[1], 0.0], dtype=float) + np.asarray(x, float),
    "astype": lambda x: x.astype(float) + np.array(x),
    "math": lambda x: math.atan2(x[0], x[1]) + math.sqrt(x[0] ** 2) + math.log(abs(x[1])),
    "math of numbers": lambda x: math.sin(0.3) * x + math.floor(2.5),
    "constants": lambda x: np.linalg.inv(A) @ x + np.zeros(2) + np.linspace(0.0, 1.0, 2),
    "loop over components": lambda x: [sum(v * v for v in x), abs(x[0])],
}


def points(sizes, count=60):
    generator = np.random.default_rng(1)
    # Where functions jump, tie, or have no value.
    for _ in range(count):
        yield [generator.choice([-2.0, -1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 1.5, 3.0], size)
               for size in sizes]
    for k in range(count):
        scale = 10.0 ** generator.uniform(-3.0, 2.0)
        yield [scale * generator.uniform(-1.0 if k % 2 else 0.0, 1.0, size) for size in sizes]


def test_a_traced_function_gives_the_same_numbers():
    for way, function in STRAIGHT.items():
        found = traced(function, (2,))
        assert found.function is not None, (way, found.reason)
        for (x,) in points((2,)):
            with np.errstate(all="ignore"):
                mine = np.array(found.function(x)).reshape(found.shape)
                try:
                    expected = np.asarray(function(x.copy()), float)
                except ValueError:  # math raises where NumPy returns NaN
                    assert not np.isfinite(mine).all()
                    continue
            assert expected.shape == found.shape
            np.testing.assert_allclose(mine, expected, rtol=1e-12, atol=1e-13, err_msg=way)


class Stateful:
    calls, last = 0, None

    def counted(self, x):
        self.calls += 1
        return x * self.calls

    def remembered(self, x):
        last, self.last = self.last, x
        return x if last is None else x + 1e-3 * last


def swallowed(x):
    try:
        beyond = bool(x[0] > 12.0)
    except Exception:  # whatever the symbol raises
        beyond = False
    return 0.5 * x if beyond else 0.95 * x


def swallowed_in_an_array(x):
    with contextlib.suppress(BaseException):
        float(x[0])
    return np.array([x[0], x[1]], dtype=float)


def into_memory(x):
    out = np.zeros(2)
    (ctypes.c_double * 2).from_buffer(out)
    out[:] = x
    return out


def into_a_global_buffer(x):
    BUFFER[:] = x
    return 2.0 * BUFFER


def changed(x):
    x[0] = 1.0
    return x


# The function, and a word of the reason why it is not traced.
BAD = {
    "a branch": (lambda x: x if x[0] > 12.0 else 2.0 * x, "branch"),
    "a caught refusal before an array": (swallowed_in_an_array, "float()"),
    "memory of numbers": (into_memory, "float()"),
    "float()": (lambda x: float(x[0]) * x, "float()"),
    "a hash": (lambda x: {0.3: 1.0}.get(x[0], 2.0) * x, "hash"),
    "a text": (lambda x: x if str(x[0]).startswith("-") else -x, "text"),
    "a type": (lambda x: x if type(x[0]) is np.float64 else -x, "same expression"),
    "an attribute": (lambda x: x if x[0].is_integer() else -x, "attribute is_integer"),
    "single precision": (lambda x: x.astype(np.float32) * 1.0, "float32"),
    "a counter": (Stateful().counted, "again"),
    "what it was called with": (Stateful().remembered, "same expression"),
    "random numbers": (lambda x: x + np.random.default_rng().normal(), "again"),
    "the time": (lambda x: x * math.sin(1e6 * time.perf_counter()), "again"),
    "a buffer from outside": (into_a_global_buffer, "float()"),
    "a change of its argument": (changed, "a change of its argument"),
    "a special function": (lambda x: __import__("scipy.special").special.gamma(x), "gamma"),
    "nothing": (lambda x: None, "NoneType"),
    "an exception": (lambda x: 1 / 0, "ZeroDivisionError"),
    "what is not a number": (lambda x: np.nan_to_num(x), "isnan"),
    "complex numbers": (lambda x: np.abs(x + 1j * x), "complex"),
}


def test_a_function_that_asks_for_more_is_not_traced():
    for way, (function, word) in BAD.items():
        found = traced(function, (2,))
        assert found.function is None, way
        assert word in found.reason, way
    line = swallowed.__code__.co_firstlineno + 2
    assert f"{__file__}:{line} asks for" in traced(swallowed, (2,)).reason


def test_numpy_is_itself_after_a_trace_and_in_other_threads():
    before = np.zeros, np.array, math.sin
    traced(swallowed, (2,))
    assert (np.zeros, np.array, math.sin) == before
    kinds, go, done = [], threading.Event(), threading.Event()

    def other():
        go.wait(10.0)
        kinds.append((type(np.zeros(2)), np.array([1, 2]).dtype.kind, math.sin(1.0)))
        done.set()

    def function(x):
        go.set()
        done.wait(10.0)
        return x + np.zeros(2)

    thread = threading.Thread(target=other)
    thread.start()
    assert traced(function, (2,), [[np.ones(2)]]).function is not None
    thread.join()
    assert kinds == [(np.ndarray, "i", math.sin(1.0))]


def test_a_function_of_several_arguments():
    found = traced(lambda z, v: np.outer(z, v) * z.sum(), (2, 3))
    assert found.shape == (2, 3)
    z, v = np.array([1.0, 2.0]), np.array([3.0, 4.0, 5.0])
    np.testing.assert_allclose(
        np.array(found.function(z, v)).reshape(2, 3), 3.0 * np.outer(z, v), rtol=1e-15
    )
    assert traced(lambda x, u: 2.0 * x, (1, 0)).function is not None
