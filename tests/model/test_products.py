"""Products with large constant matrices: one operation, with the numbers of NumPy."""

import casadi as ca
import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.model_source import model_files
from qpmhe.model.evaluation import Evaluator, machine
from qpmhe.model.products import LEAST, has_products, operations
from qpmhe.model.second_derivatives import SecondDerivatives
from qpmhe.model.tracing import expressed
from qpmhe.tuning.likelihood import _Filter
from qpmhe.tuning.weights import Weights
from tests.codegen.cases import case

N = 24
DRAW = np.random.default_rng(0)
A = DRAW.standard_normal((N, N)) / 5.0
ROWS = np.where(np.arange(N)[:, None] % 6 == 1, 0.0, DRAW.standard_normal((N, N)))
LONG = DRAW.standard_normal((1, LEAST))
WIDE = DRAW.standard_normal((40, 2 * N))
SPARSE = DRAW.standard_normal((300, N)) * (DRAW.uniform(size=(300, N)) < 0.4)
FORMS = {
    "matrix on the left": lambda x: A @ x,
    "matrix on the right": lambda x: x @ A.T + x @ A,
    "dot": lambda x: np.dot(A, x) + x.dot(A),
    "inner": lambda x: np.inner(A, x) + np.inner(x, A),
    "tensordot": lambda x: np.tensordot(A, x, 1) + np.tensordot(x, A, ([0], [1])),
    "einsum": lambda x: np.einsum("...j,ij->...i", x, A),
    "einsum without an arrow": lambda x: np.einsum("ij, j", A, x),
    "a column": lambda x: (A @ x[..., None])[..., 0],
    "einsum of matrices": lambda x: np.einsum("ij,kj->ki", A, np.stack([x, np.sin(x)])),
    "a matrix of symbols": lambda x: A @ np.stack([x, x * x, np.sin(x)], axis=1),
    "rows of symbols": lambda x: np.outer(x[:3], x) @ A,
    "einsum of three axes": lambda x: np.einsum("abc,c->ba", A.reshape(4, 6, N), x),
    "one after another": lambda x: A @ np.tanh(A @ np.tanh(A @ x + 0.1)) + x,
    "one beside another": lambda x: (A @ np.sin(x)) * (ROWS @ x) + (A @ x)[::-1],
    "rows of zeros": lambda x: ROWS @ x,
    "one row": lambda x: LONG @ np.resize(np.append(x, x**2), LEAST),
    "one column": lambda x: LONG.T @ np.array([x[0] * x[1]]),
    "wide": lambda x: WIDE @ np.concatenate((x, np.cos(x))),
    "many zeros": lambda x: SPARSE @ x,
    "not used": lambda x: (A @ x)[:0].sum() + x,
    "in a choice": lambda x: np.where(A @ x > 0.0, A @ x, 0.1 * x),
}


def by_complex_steps(f, x):
    """The Jacobian of an analytic function."""
    return np.array([np.imag(f(x + 1e-30j * one)).ravel() / 1e-30 for one in np.eye(x.size)]).T


@pytest.mark.whole
@pytest.mark.parametrize("name", FORMS)
def test_forms_of_a_product_give_the_numbers_of_numpy(name):
    f = FORMS[name]
    found = expressed(f, (N,), products=True)
    assert not found.reason
    assert has_products(found.function) == (name not in ("not used", "one column"))
    system = qpmhe.System(
        lambda x: x, lambda x: np.asarray(f(x)).ravel(), n=N, p=np.size(f(np.ones(N)))
    )
    assert "h: traced" in system.explain()
    for size in (1.0, 1e-6, 1e6):
        x = size * DRAW.uniform(0.2, 1.0, N)
        value = f(x)
        scale = np.abs(value).max()
        np.testing.assert_allclose(system.h(x), value.ravel(), rtol=0, atol=1e-14 * scale)
        exact = by_complex_steps(f, x) if name != "in a choice" else np.where(
            (A @ x > 0.0)[:, None], A, 0.1 * np.eye(N)
        )
        slope = system.h_jacobian(x)
        np.testing.assert_allclose(slope, exact, rtol=0, atol=1e-13 * np.abs(exact).max())


def test_what_is_not_finite_stays_so():
    trace = expressed(FORMS["one beside another"], (N,), products=True).function
    assert has_products(trace)
    for value in (np.nan, np.inf, 1e300):
        x = np.full(N, 0.5)
        x[3] = value
        with np.errstate(all="ignore"):
            expected = FORMS["one beside another"](x)
        np.testing.assert_array_equal(np.isfinite(np.array(trace(x))[:, 0]), np.isfinite(expected))
    # Of such a matrix, no product is made.
    matrix = A.copy()
    matrix[3, 4] = np.nan
    assert not has_products(expressed(lambda x: matrix @ x, (N,), products=True).function)


def test_small_products_are_scalar_operations():
    n = int(np.sqrt(LEAST)) - 1
    small = expressed(lambda x: A[:n, :n] @ x, (n,), products=True).function
    assert small.is_a("SXFunction")
    large = expressed(lambda x: A @ x, (N,), products=True).function
    assert operations(large) < 5 * N
    assert not has_products(expressed(lambda x: A @ x, (N,)).function)
    banded = np.eye(300) + 0.1 * np.eye(300, k=1)
    assert not has_products(expressed(lambda x: banded @ x, (300,), products=True).function)


@pytest.mark.parametrize("name", ["layered rk4", "layered euler", "layered radau", "layered"])
def test_a_step_of_a_rate_has_the_slopes_and_the_curvature_of_its_scalar_form(name):
    system = case(name).system
    model = system.symbolic
    assert has_products(model.f)
    assert has_products(model.h)
    scalar = type(model)(
        model.f.expand(), model.h.expand(), model.n, model.p, model.m, model.dt, model.how
    )
    x, u = DRAW.standard_normal((5, 3)), DRAW.standard_normal((5, 1))
    for which in ("f", "h", "f_jacobian", "h_jacobian"):
        one, other = (
            Evaluator(machine(each, False)).one(which, x, u) for each in (model, scalar)
        )
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)
    if model.is_implicit:
        return
    second = SecondDerivatives(system.model())
    assert second.exact
    forces = DRAW.standard_normal((5, 5))
    found = second.at(x, u, forces)

    def slope(x, u):
        joint = np.concatenate((system.f_jacobian(x, u), system.h_jacobian(x, u)), axis=-2)
        return forces[0] @ joint

    for j, move in enumerate(1e-5 * np.eye(3)):
        rise = (slope(x[0] + move, u[0]) - slope(x[0] - move, u[0])) / 2e-5
        np.testing.assert_allclose(found.own[0][:, j], rise, rtol=0, atol=1e-8)


def test_weights_are_tuned_in_scalar_form():
    weights = Weights(np.eye(3), 0.1 * np.eye(3), 0.1 * np.eye(2))
    assert _Filter(case("layered").system, weights, None).has_adjoint


def test_a_dense_map_of_a_hundred_states_is_traced():
    n = 100
    matrix = np.linalg.qr(DRAW.standard_normal((n, n)))[0]
    system = qpmhe.System(lambda x: matrix @ x + 0.1 * np.sin(x), lambda x: x[:2], n=n, p=2)
    assert "f: traced" in system.explain()
    x = DRAW.standard_normal(n)
    expected = matrix + np.diag(0.1 * np.cos(x))
    np.testing.assert_allclose(system.f_jacobian(x), expected, rtol=0, atol=1e-15)
    text = model_files(system.symbolic)["model.c"]
    assert text.count(";") < 40 * n


GRAPHS = {
    "matrix on the left": lambda x, u: 0.9 * ca.mtimes(A, x) + ca.sin(x) * x[0] + u[0],
    "matrix on the right": lambda x, u: ca.mtimes(ca.tanh(x).T, A).T + u[1] * x,
    "one after another": lambda x, u: ca.mtimes(A, ca.tanh(ca.mtimes(A, x) + u[0])) - x,
    "a choice": lambda x, u: ca.if_else(x[0] > 0.0, ca.mtimes(A, x), 2.0 * x) + ca.fmax(x, u[0]),
    "parts": lambda x, u: ca.vertcat(*ca.vertsplit(ca.mtimes(A, x))) + ca.sum1(x) * u[0],
    "a square": lambda x, u: ca.mtimes(A, ca.reshape(ca.mtimes(A, x), 4, 6).T.reshape((-1, 1))),
}


@pytest.mark.whole
@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("name", GRAPHS)
def test_products_of_casadi_are_one_operation(name, nested):
    x, u = ca.MX.sym("x", N), ca.MX.sym("u", 2)
    graph = ca.Function("f", [x, u], [GRAPHS[name](x, u)])
    f = ca.Function("outer", [x, u], [graph(x, u) + 0.5 * x]) if nested else GRAPHS[name]
    value = f(x, u)
    exact = ca.Function("exact", [x, u], [value, ca.jacobian(value, x)])
    system = qpmhe.from_casadi(f, lambda x: x[:2], n=N, m=2, compiled=False)
    assert has_products(system.symbolic.f)
    for size in (1e-6, 1.0, 1e6):
        at, given = size * DRAW.standard_normal(N), size * DRAW.standard_normal(2)
        for found, expected in zip(
            (system.f(at, given), system.f_jacobian(at, given)), exact(at, given), strict=True
        ):
            expected = np.array(expected).reshape(found.shape)
            scale = np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * scale)


def test_a_layer_of_jax_is_one_operation():
    jnp = pytest.importorskip("jax.numpy")
    system = qpmhe.from_jax(
        lambda x: 0.9 * x + jnp.tanh(jnp.array(A) @ x), lambda x: x[:1], n=N, p=1
    )
    assert has_products(system.symbolic.f)
