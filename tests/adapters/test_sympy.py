"""What only SymPy's models have: symbols, matrices, functions of time, special functions."""

import pickle

import numpy as np
import pytest

from adapters.twins import same
from qpmhe import System, from_sympy
from qpmhe.errors import ModelError

sympy = pytest.importorskip("sympy")
X = sympy.symbols("x1 x2")
POINTS = np.random.default_rng(0).uniform(0.5, 3.0, (6, 2))


def test_discrete_time_inputs_and_constants():
    u = sympy.Symbol("u")
    system = from_sympy(
        sympy.Matrix([X[0] * sympy.cos(X[1]) + u, sympy.Integer(1)]), [X[1], X[0] * u], X, [u]
    )
    plain = System(
        lambda x, u: np.stack(
            (x[..., 0] * np.cos(x[..., 1]) + u[..., 0], np.ones(x.shape[:-1])), axis=-1
        ),
        lambda x, u: np.stack((x[..., 1], x[..., 0] * u[..., 0]), axis=-1), n=2, p=2, m=1,
    )
    same(system, plain, POINTS, np.random.default_rng(2).standard_normal((6, 1)), 1e-7)


@pytest.mark.parametrize(
    ("f", "h", "words"),
    [
        ([X[0]], [X[1]], "one for each"),
        ([X[0] * sympy.Symbol("k"), X[1]], [X[0]], "k, which is neither"),
        (["(", X[1]], [X[0]], "expected SymPy expressions"),
        ([X[0] > 0, X[1]], [X[0]], "f contains x1 > 0; expected SymPy expressions"),
        (X, [], "h is empty"),
        ([X[0] * sympy.Symbol("t"), X[1]], [X[0]], "f contains t, .*varying quantities inputs"),
        ([X[0], sympy.Symbol("x2", real=True)], [X[0]], "x2 has the name .* real=True"),
        ([sympy.Function("g")(X[0]), X[1]], [X[0]], r"f contains g\(.*unknown functions"),
        ([sympy.I * X[0], X[1]], [X[0]], "finite real value"),
        ([X[0], X[1]], [X[0] / sympy.Integer(0)], "h is .* finite real value"),
        ([sympy.floor(X[0]), X[1]], [X[0]], r"f has the derivative .*floor\(x1\)"),
        (X, [sympy.Mod(X[0], 2)], r"h has the derivative .*Mod\(x1, 2\).*Piecewise"),
        (X, [sympy.meijerg([[], []], [[0], []], X[0])], "h .*contains meijerg.*Python functions"),
        ([sympy.Derivative(sympy.sin(X[0]), X[0]), X[1]], [X[0]], r"f contains \[Derivative"),
    ],
)
def test_what_does_not_fit_is_refused(f, h, words):
    with pytest.raises(ModelError, match=words):
        from_sympy(f, h, X)


@pytest.mark.parametrize(
    ("x", "u", "words"),
    [
        ([X[0], X[0]], [], "x contains x1 2 times"),
        (X, sympy.symbols("a a"), "u contains a 2 times"),
        (X, [X[1]], "x2 is among the states x and the inputs u"),
        ([], [], "x is empty"),
        ("x1", [], "x contains 'x1'; expected symbols"),
        ([X[0], 2], [], "x contains 2; expected symbols"),
        ([X[0], X[0] + X[1]], [], r"x contains x1 \+ x2"),
        ([X[0], sympy.Symbol("b", imaginary=True)], [], "b is declared as not real.*real=True"),
    ],
)
def test_symbols_that_do_not_fit_are_refused(x, u, words):
    with pytest.raises(ModelError, match=words):
        from_sympy([X[0], X[1]], [X[0]], x, u)


def test_plain_symbols_are_real():
    """|a| and sign(a) have a derivative at real a only; a positive symbol stays positive."""
    a, b = sympy.Symbol("a"), sympy.Symbol("b", positive=True)
    system = from_sympy(
        [-a * sympy.Abs(a), sympy.sqrt(b**2)], [sympy.sign(a) + b, sympy.Abs(a * b)], [a, b]
    )
    x = np.array([[-1.5, 2.0], [0.5, 1.0]])
    np.testing.assert_array_equal(system.f.batch(x, np.empty((2, 0))), [[2.25, 2.0], [-0.25, 1.0]])
    np.testing.assert_array_equal(
        system.f_jacobian.batch(x, np.empty((2, 0))),
        [[[-3.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]],
    )
    np.testing.assert_array_equal(
        system.h_jacobian.batch(x, np.empty((2, 0))),
        [[[0.0, 1.0], [-2.0, 1.5]], [[0.0, 1.0], [1.0, 0.5]]],
    )


def test_one_symbol_needs_no_list():
    a, u = sympy.symbols("a u")
    system = from_sympy(a * u, a, a, u)
    assert (system.n, system.m, system.p) == (1, 1, 1)
    assert system.f(np.array([3.0]), np.array([2.0])).tolist() == [6.0]
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "given")


@pytest.mark.parametrize("x", [sympy.Matrix(X), sympy.Matrix([X]), sympy.MatrixSymbol("x", 2, 1)])
def test_matrices_are_taken_entry_by_entry(x):
    system = from_sympy(sympy.Matrix([[0, 1], [2, 0]]) * sympy.Matrix(list(x)), [[x[0]]], x)
    assert system.f(np.array([3.0, 4.0]), np.empty(0)).tolist() == [4.0, 6.0]
    assert system.h(np.array([3.0, 4.0]), np.empty(0)).tolist() == [3.0]


def test_states_may_be_functions_of_time():
    t = sympy.Symbol("t")
    q, u = sympy.Function("q")(t), sympy.Function("u")(t)
    speed = q.diff(t)
    system = from_sympy([speed, -sympy.sin(q) + u], [q], [q, speed], [u], dt=0.1)
    plain = System.from_ode(
        lambda x, u: np.stack((x[..., 1], -np.sin(x[..., 0]) + u[..., 0]), axis=-1),
        lambda x, u: x[..., :1], dt=0.1, n=2, p=1, m=1,
    )
    inputs = np.random.default_rng(3).standard_normal((6, 1))
    same(system, plain, POINTS, inputs, 1e-7)
    same(pickle.loads(pickle.dumps(system)), plain, POINTS, inputs, 1e-7)
    with pytest.raises(ModelError, match=r"Derivative\(q\(t\), t\).*solve the equations"):
        from_sympy([speed], [q], [q])
    with pytest.raises(ModelError, match=r"f contains t, .*time-varying quantities inputs"):
        from_sympy([q * t], [q], [q])


def test_special_functions_are_those_of_scipy():
    from scipy import special

    a = sympy.Symbol("a")
    system = from_sympy(
        [sympy.besselj(0, a)], [sympy.erf(a), sympy.LambertW(a)], [a]
    )
    assert system.f.mode == system.h.mode == "batched"
    x = np.array([[0.3], [2.0]])
    nothing = np.empty((2, 0))
    np.testing.assert_allclose(system.f.batch(x, nothing), special.jv(0, x))
    np.testing.assert_allclose(system.f_jacobian.batch(x, nothing)[..., 0], -special.jv(1, x))
    np.testing.assert_allclose(
        system.h.batch(x, nothing), np.hstack([special.erf(x), special.lambertw(x).real])
    )
    # Below -1/e Lambert's W is complex: no value, rather than its real part.
    assert np.isnan(system.h.batch(-x, nothing)[1, 1])
