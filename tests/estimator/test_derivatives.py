import math

import numpy as np
import pytest

import qpmhe

NONE = np.zeros(0)


def system_of(f, n=2, **options):
    return qpmhe.System(f, lambda x: x[..., :1], n=n, p=1, **options)


def analytic(x):
    """A map of three states to three, with its Jacobian."""
    a, b, c = x
    value = [math.exp(0.3 * a) * math.sin(b), a * b / (1.0 + c * c), math.tanh(c) + math.sqrt(a)]
    square = 1.0 + c * c
    jacobian = [
        [0.3 * value[0], math.exp(0.3 * a) * math.cos(b), 0.0],
        [b / square, a / square, -2.0 * a * b * c / square**2],
        [0.5 / math.sqrt(a), 0.0, 1.0 - math.tanh(c) ** 2],
    ]
    return np.array(value), np.array(jacobian)


def analytic_batched(x):
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return np.stack(
        [np.exp(0.3 * a) * np.sin(b), a * b / (1.0 + c * c), np.tanh(c) + np.sqrt(a)], axis=-1
    )


def analytic_columns(x):
    a, b, c = x
    return np.array(
        [np.exp(0.3 * a) * np.sin(b), a * b / (1.0 + c * c), np.tanh(c) + np.sqrt(a)]
    )


def analytic_looped(x):
    a, b, c = (complex(s) if np.iscomplexobj(x) else float(s) for s in x)
    return [np.exp(0.3 * a) * np.sin(b), a * b / (1.0 + c * c), np.tanh(c) + np.sqrt(a)]


WAYS = {"batched": analytic_batched, "columns": analytic_columns, "looped": analytic_looped}


@pytest.mark.parametrize("mode", WAYS)
def test_complex_step_is_exact_to_rounding(mode):
    system = system_of(WAYS[mode], 3)
    assert system.f.mode == mode
    assert system.f_jacobian.method == "complex step"
    points = np.random.default_rng(1).uniform(0.1, 4.0, (20, 3))
    expected = np.array([analytic(x)[1] for x in points])
    singles = [system.f_jacobian(x, NONE) for x in points]
    np.testing.assert_allclose(singles, expected, rtol=1e-12, atol=1e-15)
    batch = system.f_jacobian.batch(points, np.zeros((20, 0)))
    np.testing.assert_allclose(batch, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1.0, 1e4, 1e8])
def test_complex_step_is_exact_at_any_scale(scale):
    system = system_of(lambda x: x**3 / scale**2, 2)
    x = scale * np.array([0.7, -1.3])
    np.testing.assert_allclose(
        system.f_jacobian(x, NONE), np.diag(3.0 * x**2 / scale**2), rtol=1e-13
    )


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
    "math": (
        lambda x: np.array([math.sin(x[0]), math.exp(x[1])]),
        lambda a, b: [[math.cos(a), 0], [0, math.exp(b)]],
    ),
    "arctan2": (
        lambda x: [np.arctan2(x[0], x[1]), x[0]],
        lambda a, b: [[b / (a * a + b * b), -a / (a * a + b * b)], [1, 0]],
    ),
    "sign": (
        lambda x: np.sign(x) * x**2, lambda a, b: [[2 * abs(a), 0], [0, 2 * abs(b)]]
    ),
    "conjugate": (
        lambda x: np.conj(x) * x, lambda a, b: [[2 * a, 0], [0, 2 * b]]
    ),
    "interpolation": (
        lambda x: [np.interp(x[0], [-9.0, 9.0], [-18.0, 18.0]), x[1]],
        lambda a, b: [[2, 0], [0, 1]],
    ),
}


@pytest.mark.parametrize("case", NOT_COMPLEX)
def test_functions_that_break_the_complex_step(case):
    f, jacobian = NOT_COMPLEX[case]
    system = system_of(f)
    assert system.f_jacobian.method == "finite differences"
    generator = np.random.default_rng(2)
    points = generator.uniform(0.2, 3.0, (10, 2)) * generator.choice([-1.0, 1.0], (10, 2))
    expected = np.array([jacobian(*x) for x in points])
    singles = [system.f_jacobian(x, NONE) for x in points]
    np.testing.assert_allclose(singles, expected, rtol=1e-6, atol=1e-6)
    batch = system.f_jacobian.batch(points, np.zeros((10, 0)))
    np.testing.assert_allclose(batch, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("f", "slope"),
    [
        pytest.param(lambda x: np.maximum(x, 0.5) * x, lambda s: 2 * s if s > 0.5 else 0.5),
        pytest.param(lambda x: np.minimum(x, 0.5) * x, lambda s: 2 * s if s < 0.5 else 0.5),
        pytest.param(lambda x: np.clip(x, -0.5, 0.5), lambda s: float(-0.5 < s < 0.5)),
        pytest.param(lambda x: np.where(x > 0, x**2, x), lambda s: 2 * s if s > 0 else 1),
        pytest.param(lambda x: [max(x[0], 0.5), x[1]], None),
    ],
    ids=["maximum", "minimum", "clip", "where", "max"],
)
def test_branches(f, slope):
    # Whether NumPy orders complex numbers or not, the derivative is that of the branch taken.
    system = system_of(f)
    for x in np.random.default_rng(3).uniform(-2.0, 2.0, (10, 2)):
        expected = (
            np.diag([slope(s) for s in x])
            if slope
            else np.diag([float(x[0] > 0.5), 1.0])
        )
        np.testing.assert_allclose(system.f_jacobian(x, NONE), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1e4, 1e7])
def test_finite_differences_keep_their_accuracy_for_large_states(scale):
    system = system_of(
        lambda x: [math.pow(x[0] / scale, 3) * scale, 2.0 * x[1]],
        states=qpmhe.Box([0.5 * scale, 0.5 * scale], [3.0 * scale, 3.0 * scale]),
    )
    assert system.f_jacobian.method == "finite differences"
    x = scale * np.array([1.7, 0.9])
    np.testing.assert_allclose(
        system.f_jacobian(x, NONE), np.diag([3 * 1.7**2, 2.0]), rtol=1e-6, atol=1e-6
    )


def test_a_broken_complex_step_is_noticed_where_the_derivative_vanishes_at_the_probes():
    # A reaction rate is flat at one kelvin, and steep at the temperatures of use.
    system = system_of(lambda x: [x[0] - 0.1 * x[0] * math.exp(10.0 - 3500.0 / x[1]), x[1]])
    x = np.array([2.0, 350.0])
    system.check(x, NONE)
    np.testing.assert_allclose(
        system.f_jacobian(x, NONE), [[0.9, -0.2 * 3500.0 / 350.0**2], [0.0, 1.0]], rtol=1e-6,
        atol=1e-9,
    )


@pytest.mark.parametrize("big", [1e3, 1e6])
def test_a_row_of_large_units_hides_no_broken_complex_step(big):
    system = system_of(lambda x: np.stack([big * x[..., 0], np.abs(x[..., 1])], axis=-1))
    assert system.f_jacobian.method == "finite differences"
    np.testing.assert_allclose(
        system.f_jacobian(np.array([1.0, 2.0]), NONE), [[big, 0.0], [0.0, 1.0]], rtol=1e-6,
        atol=1e-9 * big,
    )


LINEAR = np.array([[1.0, 0.1], [-0.2, 0.9]])


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x: LINEAR @ x, id="A @ x"),
        pytest.param(lambda x: x @ LINEAR.T, id="x @ A.T"),
        pytest.param(lambda x: (LINEAR @ x.T).T, id="(A @ x.T).T"),
        pytest.param(lambda x: np.inner(LINEAR, x), id="inner(A, x)"),
        pytest.param(lambda x: [row @ x for row in LINEAR], id="list of rows"),
        pytest.param(
            lambda x: np.stack([row @ x.T for row in LINEAR], axis=-1), id="stacked rows"
        ),
        pytest.param(lambda x: [float(row @ x) for row in LINEAR], id="floats"),
    ],
)
def test_the_jacobian_of_a_linear_map_is_its_matrix(f):
    system = system_of(f)
    rtol = 1e-14 if system.f_jacobian.method == "complex step" else 1e-8
    states = np.random.default_rng(4).standard_normal((3, 2))
    np.testing.assert_allclose(system.f_jacobian(states[0], NONE), LINEAR, rtol=rtol)
    for lead in ((1,), (2,), (3,)):
        found = system.f_jacobian.batch(states[: lead[0]], np.zeros((*lead, 0)))
        np.testing.assert_allclose(found, np.broadcast_to(LINEAR, (*lead, 2, 2)), rtol=rtol)


def test_linear_maps_need_no_finite_differences():
    for f in (lambda x: LINEAR @ x, lambda x: x @ LINEAR.T, lambda x: [x[1], -x[0]]):
        assert system_of(f).f_jacobian.method == "complex step"


@pytest.mark.parametrize(
    "h",
    [
        pytest.param(lambda x: x[0] * x[1] ** 2, id="scalar"),
        pytest.param(lambda x: [x[0] * x[1] ** 2], id="list"),
        pytest.param(lambda x: x[..., :1] * x[..., 1:] ** 2, id="batched"),
        pytest.param(lambda x: math.pow(x[1], 2) * x[0], id="math"),
    ],
)
def test_jacobians_of_a_single_output(h):
    system = qpmhe.System(lambda x: x, h, n=2, p=1)
    x = np.array([[1.5, 0.5], [0.3, 2.0], [1.0, 1.0]])
    expected = np.stack([x[:, 1] ** 2, 2 * x[:, 0] * x[:, 1]], axis=-1)[:, None, :]
    np.testing.assert_allclose(system.h_jacobian.batch(x, np.zeros((3, 0))), expected, rtol=1e-6)
    np.testing.assert_allclose(system.h_jacobian(x[0], NONE), expected[0], rtol=1e-6)


@pytest.mark.parametrize(
    "f",
    [lambda x: x[0] ** 3, lambda x: math.pow(x[0], 3), lambda x: x**3],
    ids=["scalar", "math", "vector"],
)
def test_one_state(f):
    system = system_of(f, 1)
    found = system.f_jacobian.batch(np.array([[2.0], [0.5]]), np.zeros((2, 0)))
    np.testing.assert_allclose(found, [[[12.0]], [[0.75]]], rtol=1e-6)


@pytest.mark.parametrize(
    "f",
    [
        pytest.param(lambda x, u: np.sin(x) * u[..., :1] + u[..., 1:], id="batched"),
        pytest.param(lambda x, u: np.sin(x) * u[0] + u[1], id="columns"),
        pytest.param(
            lambda x, u: [math.sin(x[0]) * u[0] + u[1], math.sin(x[1]) * u[0] + u[1]], id="math"
        ),
    ],
)
def test_derivatives_are_taken_at_the_input(f):
    system = system_of(f, m=2)
    generator = np.random.default_rng(5)
    x, u = generator.standard_normal((4, 2)), generator.standard_normal((4, 2))
    expected = [np.diag(np.cos(xi) * ui[0]) for xi, ui in zip(x, u, strict=True)]
    np.testing.assert_allclose(system.f_jacobian.batch(x, u), expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(system.f_jacobian(x[1], u[1]), expected[1], rtol=1e-6, atol=1e-7)


def test_functions_without_a_value_at_the_probes_are_differenced():
    system = system_of(lambda x: np.sqrt(x - 10.0))
    assert system.f_jacobian.method == "finite differences"
    x = np.array([12.0, 14.0])
    system.check(x, NONE)
    np.testing.assert_allclose(
        system.f_jacobian(x, NONE), np.diag(0.5 / np.sqrt(x - 10.0)), rtol=1e-6
    )


def test_the_complex_step_is_given_up_where_it_fails_at_the_initial_state():
    # Real functions of real arguments above a threshold that no probe reaches.
    system = system_of(
        lambda x: [math.exp(float(x[0]) - 100.0) if x[0].real > 90.0 else x[0] ** 2, x[1]]
    )
    assert system.f_jacobian.method == "complex step"
    x = np.array([100.0, 1.0])
    system.check(x, NONE)
    assert system.f_jacobian.method == "finite differences"
    np.testing.assert_allclose(system.f_jacobian(x, NONE), np.eye(2), rtol=1e-6, atol=1e-8)


def test_differences_of_a_function_that_returns_one_array_every_time():
    a, kept = np.array([[0.5, 0.2], [0.1, 0.9]]), {}

    def f(x):
        x = np.asarray(x, np.float64)
        return np.matmul(x, a.T, out=kept.setdefault(x.shape, np.empty(x.shape)))

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    slopes = system.f_jacobian.batch(np.ones((3, 2)), np.zeros((3, 0)))
    np.testing.assert_allclose(slopes, np.broadcast_to(a, (3, 2, 2)), rtol=1e-7)
