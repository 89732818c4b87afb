"""What only SymPy's models have: symbols, matrices, functions of time, special functions."""

import pickle

import numpy as np
import pytest
from scipy import special

from qpmhe import System, from_sympy
from qpmhe.errors import ModelError
from tests.adapters.twins import NONE, same

sympy = pytest.importorskip("sympy")
X = sympy.symbols("x1 x2")
POINTS = np.random.default_rng(0).uniform(0.5, 3.0, (6, 2))
FUNCTION = sympy.Function("g")(X[0])

WRONG = [
    ([X[0]], [X[1]], X, "one for each"),
    ([X[0] * sympy.Symbol("k"), X[1]], [X[0]], X, "k, which is neither"),
    ([X[0] > 0, X[1]], [X[0]], X, "f contains x1 > 0; expected SymPy expressions"),
    ([X[0] * sympy.Symbol("t"), X[1]], [X[0]], X, "f contains t, .*varying quantities inputs"),
    ([X[0], sympy.Symbol("x2", real=True)], [X[0]], X, "x2 has the name .* real=True"),
    ([FUNCTION, X[1]], [X[0]], X, r"f contains g\(.*unknown functions"),
    ([sympy.floor(X[0]), X[1]], [X[0]], X, r"f has the derivative .*floor\(x1\)"),
    (X, [sympy.meijerg([[], []], [[0], []], X[0])], X, "h .*contains meijerg.*Python functions"),
    (X, [X[0]], [X[0], X[0]], "x contains x1 2 times"),
    (X, [X[0]], "x1", "x contains 'x1'; expected symbols"),
    (X, [X[0]], [X[0], sympy.Symbol("b", imaginary=True)], "b is declared as not real.*real=True"),
]


@pytest.mark.whole
@pytest.mark.parametrize(("f", "h", "x", "words"), WRONG)
def test_what_does_not_fit_is_refused(f, h, x, words):
    with pytest.raises(ModelError, match=words):
        from_sympy(f, h, x)
    with pytest.raises(ModelError, match="x2 is among the states x and the inputs u"):
        from_sympy(X, [X[0]], X, [X[1]])


def test_plain_symbols_are_real():
    """|a| and sign(a) have a derivative at real a only; a positive symbol stays positive."""
    a, b = sympy.Symbol("a"), sympy.Symbol("b", positive=True)
    system = from_sympy(
        [-a * sympy.Abs(a), sympy.sqrt(b**2)], [sympy.sign(a) + b, sympy.Abs(a * b)], [a, b]
    )
    x, nothing = np.array([[-1.5, 2.0], [0.5, 1.0]]), np.empty((2, 0))
    np.testing.assert_array_equal(system.f.batch(x, nothing), [[2.25, 2.0], [-0.25, 1.0]])
    np.testing.assert_array_equal(
        system.f_jacobian.batch(x, nothing),
        [[[-3.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]],
    )
    np.testing.assert_array_equal(
        system.h_jacobian.batch(x, nothing),
        [[[0.0, 1.0], [-2.0, 1.5]], [[0.0, 1.0], [1.0, 0.5]]],
    )


def test_one_symbol_needs_no_list_and_matrices_are_taken_entry_by_entry():
    a, u = sympy.symbols("a u")
    system = from_sympy(a * u, a, a, u)
    assert (system.n, system.m, system.p) == (1, 1, 1)
    assert system.f(np.array([3.0]), np.array([2.0])).tolist() == [6.0]
    for x in (sympy.Matrix(X), sympy.Matrix([X]), sympy.MatrixSymbol("x", 2, 1)):
        system = from_sympy(sympy.Matrix([[0, 1], [2, 0]]) * sympy.Matrix(list(x)), [[x[0]]], x)
        assert system.f(np.array([3.0, 4.0]), NONE).tolist() == [4.0, 6.0]
    constant = from_sympy([X[0] + 1, sympy.Integer(1)], X, X)
    assert constant.f.batch(POINTS, np.empty((6, 0)))[:, 1].tolist() == [1.0] * 6


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
    same(pickle.loads(pickle.dumps(system)), plain, POINTS, inputs, 1e-7)
    with pytest.raises(ModelError, match=r"Derivative\(q\(t\), t\).*solve the equations"):
        from_sympy([speed], [q], [q])


def test_special_functions_are_those_of_scipy():
    a = sympy.Symbol("a")
    system = from_sympy([sympy.besselj(0, a)], [sympy.erf(a), sympy.LambertW(a)], [a])
    assert system.f.mode == system.h.mode == "batched"
    x, nothing = np.array([[0.3], [2.0]]), np.empty((2, 0))
    np.testing.assert_allclose(system.f.batch(x, nothing), special.jv(0, x))
    np.testing.assert_allclose(system.f_jacobian.batch(x, nothing)[..., 0], -special.jv(1, x))
    expected = np.hstack([special.erf(x), special.lambertw(x).real])
    np.testing.assert_allclose(system.h.batch(x, nothing), expected)
    # Below -1/e Lambert's W is complex: no value, rather than its real part.
    assert np.isnan(system.h.batch(-x, nothing)[1, 1])
