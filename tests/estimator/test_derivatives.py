"""Jacobians of functions as they are written: by complex steps, or by differences."""

import math

import numpy as np
import pytest

import qpmhe

NONE = np.zeros(0)
COMPLEX, DIFFERENCES = "complex step", "finite differences"
LINEAR = np.array([[1.0, 0.1], [-0.2, 0.9]])


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
    "real": (lambda x: np.real(x) ** 2, lambda a, b: [[2 * a, 0], [0, 2 * b]]),
    "norm": (
        lambda x: [np.linalg.norm(x), x[0]],
        lambda a, b: [[a / math.hypot(a, b), b / math.hypot(a, b)], [1, 0]],
    ),
    "float": (lambda x: [float(x[0]) ** 2, x[1]], lambda a, b: [[2 * a, 0], [0, 1]]),
    "dtype": (
        lambda x: np.array([x[0] * x[1], x[1] ** 2], dtype=float),
        lambda a, b: [[b, a], [0, 2 * b]],
    ),
    "astype": (lambda x: x.astype(float) ** 2, lambda a, b: [[2 * a, 0], [0, 2 * b]]),
    "into a real array": (real_array, lambda a, b: [[2 * a, 0], [b, a]]),
    "arctan2": (
        lambda x: [np.arctan2(x[0], x[1]), x[0]],
        lambda a, b: [[b / (a * a + b * b), -a / (a * a + b * b)], [1, 0]],
    ),
    "sign": (lambda x: np.sign(x) * x**2, lambda a, b: [[2 * abs(a), 0], [0, 2 * abs(b)]]),
    "conjugate": (lambda x: np.conj(x) * x, lambda a, b: [[2 * a, 0], [0, 2 * b]]),
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


def test_the_jacobian_of_a_linear_map_is_its_matrix():
    states = np.random.default_rng(4).standard_normal((3, 2))
    for f in (
        lambda x: LINEAR @ x, lambda x: x @ LINEAR.T, lambda x: (LINEAR @ x.T).T,
        lambda x: np.inner(LINEAR, x), lambda x: [row @ x for row in LINEAR],
        lambda x: np.stack([row @ x.T for row in LINEAR], axis=-1),
        lambda x: [float(row @ x) for row in LINEAR],
    ):
        jacobian = system_of(f).f_jacobian
        rtol = 1e-14 if jacobian.method == COMPLEX else 1e-8
        for count in (1, 2, 3):  # as many as components, and others
            check(jacobian, states[:count], [LINEAR] * count, rtol=rtol)
    assert jacobian.method == DIFFERENCES  # of the last alone
    assert system_of(lambda x: [x[1], -x[0]]).f_jacobian.method == COMPLEX


def test_jacobians_of_a_single_output_and_of_one_state():
    x = np.array([[1.5, 0.5], [0.3, 2.0], [1.0, 1.0]])
    expected = np.stack([x[:, 1] ** 2, 2 * x[:, 0] * x[:, 1]], axis=-1)[:, None, :]
    for h in (
        lambda x: x[0] * x[1] ** 2, lambda x: [x[0] * x[1] ** 2],
        lambda x: x[..., :1] * x[..., 1:] ** 2, lambda x: math.pow(x[1], 2) * x[0],
    ):
        check(qpmhe.System(lambda x: x, h, n=2, p=1).h_jacobian, x, expected, rtol=1e-6)
    for f in (lambda x: x[0] ** 3, lambda x: math.pow(x[0], 3), lambda x: x**3):
        check(system_of(f, 1).f_jacobian, [[2.0], [0.5]], [[[12.0]], [[0.75]]], rtol=1e-6)


def test_derivatives_are_taken_at_the_input():
    generator = np.random.default_rng(5)
    x, u = generator.standard_normal((4, 2)), generator.standard_normal((4, 2))
    expected = [np.diag(np.cos(xi) * ui[0]) for xi, ui in zip(x, u, strict=True)]
    for f in (
        lambda x, u: np.sin(x) * u[..., :1] + u[..., 1:], lambda x, u: np.sin(x) * u[0] + u[1],
        lambda x, u: [math.sin(x[0]) * u[0] + u[1], math.sin(x[1]) * u[0] + u[1]],
    ):
        jacobian = system_of(f, m=2).f_jacobian
        np.testing.assert_allclose(jacobian.batch(x, u), expected, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(jacobian(x[1], u[1]), expected[1], rtol=1e-6, atol=1e-7)


def test_differences_of_a_function_that_returns_one_array_every_time():
    kept = {}

    def f(x):
        x = np.asarray(x, np.float64)
        return np.matmul(x, LINEAR.T, out=kept.setdefault(x.shape, np.empty(x.shape)))

    check(system_of(f).f_jacobian, np.ones((3, 2)), [LINEAR] * 3, rtol=1e-7)
