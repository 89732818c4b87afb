"""Jacobians of functions as they are written: by complex steps, or by differences."""

import math

import numpy as np
import pytest

import qpmhe

NONE = np.zeros(0)
COMPLEX, DIFFERENCES = "complex step", "finite differences"


def system_of(f, n=2, **options):
    return qpmhe.System(f, lambda x: x[..., :1], n=n, p=1, **options)


def check(jacobian, points, expected, **tolerance):
    """One state at a time, and all at once."""
    points = np.array(points)
    singles = [jacobian(x, NONE) for x in points]
    np.testing.assert_allclose(singles, expected, **tolerance)
    batch = jacobian.batch(points, np.zeros((len(points), 0)))
    np.testing.assert_allclose(batch, expected, **tolerance)


def components(a, b, c):
    return [np.exp(0.3 * a) * np.sin(b), a * b / (1.0 + c * c), np.tanh(c) + np.sqrt(a)]


def slopes(a, b, c):
    e, square = math.exp(0.3 * a), 1.0 + c * c
    return [
        [0.3 * e * math.sin(b), e * math.cos(b), 0.0],
        [b / square, a / square, -2.0 * a * b * c / square**2],
        [0.5 / math.sqrt(a), 0.0, 1.0 - math.tanh(c) ** 2],
    ]


@pytest.mark.parametrize(("mode", "f"), [
    ("batched", lambda x: np.stack(components(x[..., 0], x[..., 1], x[..., 2]), axis=-1)),
    ("columns", lambda x: np.array(components(*x))),
    ("looped", lambda x: components(
        *(complex(s) if np.iscomplexobj(x) else float(s) for s in x))),
])
def test_complex_step_is_exact_to_rounding(mode, f):
    system = system_of(f, 3)
    assert (system.f.mode, system.f_jacobian.method) == (mode, COMPLEX)
    points = np.random.default_rng(1).uniform(0.1, 4.0, (20, 3))
    check(system.f_jacobian, points, [slopes(*x) for x in points], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("scale", [1.0, 1e4, 1e8])
def test_derivatives_are_accurate_at_any_scale(scale):
    x = scale * np.array([0.7, 1.3])
    system = system_of(lambda x: x**3 / scale**2)
    check(system.f_jacobian, [x], [np.diag(3.0 * x**2 / scale**2)], rtol=1e-13)
    system = system_of(
        lambda x: [math.pow(x[0] / scale, 3) * scale, 2.0 * x[1]],
        states=qpmhe.Box([0.5 * scale, 0.5 * scale], [3.0 * scale, 3.0 * scale]),
    )
    assert system.f_jacobian.method == DIFFERENCES
    check(system.f_jacobian, [x], [np.diag([3 * 0.7**2, 2.0])], rtol=1e-6, atol=1e-6)


def real_array(x):
    value = np.zeros(2)
    value[0] = x[0] ** 2
    value[1] = x[0] * x[1]
    return value


# Each with the Jacobian; none of them can carry an imaginary part to its end.
NOT_COMPLEX = {
    "abs": (
        lambda x: np.abs(x) * x[..., ::-1],
        lambda a, b: [[np.sign(a) * b, abs(a)], [abs(b), np.sign(b) * a]],
    ),
    "float": (lambda x: [float(x[0]) ** 2, x[1]], lambda a, b: [[2 * a, 0], [0, 1]]),
    "into a real array": (real_array, lambda a, b: [[2 * a, 0], [b, a]]),
    "sign": (lambda x: np.sign(x) * x**2, lambda a, b: [[2 * abs(a), 0], [0, 2 * abs(b)]]),
    "interpolation": (
        lambda x: [np.interp(x[0], [-9.0, 9.0], [-18.0, 18.0]), x[1]],
        lambda a, b: [[2, 0], [0, 1]],
    ),
    # Rows of large units hide nothing.
    "a large row": (
        lambda x: np.stack([1e6 * x[..., 0], np.abs(x[..., 1])], axis=-1),
        lambda a, b: [[1e6, 0.0], [0.0, np.sign(b)]],
    ),
}


def test_functions_that_break_the_complex_step():
    generator = np.random.default_rng(2)
    points = generator.uniform(0.2, 3.0, (10, 2)) * generator.choice([-1.0, 1.0], (10, 2))
    for case, (f, jacobian) in NOT_COMPLEX.items():
        system = system_of(f)
        assert system.f_jacobian.method == DIFFERENCES, case
        expected = np.array([jacobian(*x) for x in points])
        size = np.abs(expected).max(initial=1.0)
        check(system.f_jacobian, points, expected, rtol=1e-6, atol=1e-6 * min(size, 1e3))


def test_branches():
    """Whether NumPy orders complex numbers or not, the derivative is that of the branch taken."""
    points = np.random.default_rng(3).uniform(-2.0, 2.0, (10, 2))
    for f, slope in (
        (lambda x: np.maximum(x, 0.5) * x, lambda s: 2 * s if s > 0.5 else 0.5),
        (lambda x: np.minimum(x, 0.5) * x, lambda s: 2 * s if s < 0.5 else 0.5),
        (lambda x: np.clip(x, -0.5, 0.5), lambda s: float(-0.5 < s < 0.5)),
        (lambda x: np.where(x > 0, x**2, x), lambda s: 2 * s if s > 0 else 1),
        (lambda x: [max(x[0], 0.5), max(x[1], 0.5)], lambda s: float(s > 0.5)),
    ):
        expected = [np.diag([slope(s) for s in x]) for x in points]
        check(system_of(f).f_jacobian, points, expected, rtol=1e-6, atol=1e-6)


def test_functions_that_are_others_at_the_probes_than_where_they_are_used():
    for f, at, expected, *methods in (
        # A reaction rate is flat at one kelvin, and steep at the temperatures of use.
        (lambda x: [x[0] - 0.1 * x[0] * math.exp(10.0 - 3500.0 / x[1]), x[1]], [2.0, 350.0],
         [[0.9, -0.2 * 3500.0 / 350.0**2], [0.0, 1.0]], DIFFERENCES),
        (lambda x: np.sqrt(x - 10.0), [12.0, 14.0], np.diag([0.5 / 2**0.5, 0.25]),
         DIFFERENCES, COMPLEX),  # no value at the probes
        # Real functions of real arguments above a threshold that no probe reaches.
        (lambda x: [math.exp(float(x[0]) - 100.0) if x[0].real > 90.0 else x[0] ** 2, x[1]],
         [100.0, 1.0], np.eye(2), COMPLEX, DIFFERENCES),
    ):
        system, x = system_of(f), np.array(at)
        assert len(methods) == 1 or system.f_jacobian.method == methods[0]
        system.check(x, NONE)
        assert system.f_jacobian.method == methods[-1]
        np.testing.assert_allclose(system.f_jacobian(x, NONE), expected, rtol=1e-6, atol=1e-8)
