"""Systems of SymPy expressions beside the same ones written with NumPy."""

import pickle
import sys

import numpy as np
import pytest

from qpmhe import System
from qpmhe.errors import InvalidInputError, ModelError
from qpmhe.models.batch_reactor import batch_reactor

sympy = pytest.importorskip("sympy")
X = sympy.symbols("x1 x2")
POINTS = np.random.default_rng(0).uniform(0.5, 3.0, (6, 2))


def same(one, other, u, tolerance=1e-12):
    for name in ("f", "h", "f_jacobian", "h_jacobian"):
        mine, theirs = getattr(one, name), getattr(other, name)
        np.testing.assert_allclose(
            mine.batch(POINTS, u), theirs.batch(POINTS, u), rtol=tolerance, err_msg=name,
            atol=tolerance,
        )
        np.testing.assert_allclose(mine(POINTS[0], u[0]), theirs(POINTS[0], u[0]), atol=tolerance)


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_the_reactor_is_the_reactor(method):
    reaction = sympy.Rational(16, 100) * X[0] ** 2 - sympy.Rational(64, 100) * X[1]
    system = System.from_sympy(
        [-2 * reaction, reaction], X[0] + X[1], X, dt=0.1, method=method
    )
    plain = batch_reactor(method).system
    same(system, plain, np.empty((6, 0)))
    assert system.derivatives == {"f": "given", "h": "given"}
    same(pickle.loads(pickle.dumps(system)), plain, np.empty((6, 0)))


def test_discrete_time_inputs_and_constants():
    u = sympy.Symbol("u")
    system = System.from_sympy(
        sympy.Matrix([X[0] * sympy.cos(X[1]) + u, sympy.Integer(1)]), [X[1], X[0] * u], X, [u]
    )
    plain = System(
        lambda x, u: np.stack(
            (x[..., 0] * np.cos(x[..., 1]) + u[..., 0], np.ones(x.shape[:-1])), axis=-1
        ),
        lambda x, u: np.stack((x[..., 1], x[..., 0] * u[..., 0]), axis=-1), n=2, p=2, m=1,
    )
    same(system, plain, np.random.default_rng(2).standard_normal((6, 1)), 1e-7)


def test_one_state():
    x = sympy.Symbol("x")
    system = System.from_sympy([x**2 / 2], [x], [x])
    assert system.f_jacobian.batch(np.array([[3.0]]), np.empty((1, 0))).tolist() == [[[3.0]]]


@pytest.mark.parametrize(
    ("f", "h", "words"),
    [
        ([X[0]], [X[1]], "one for each"),
        ([X[0] * sympy.Symbol("k"), X[1]], [X[0]], "k, which is neither"),
        (["(", X[1]], [X[0]], "expected SymPy expressions"),
    ],
)
def test_what_does_not_fit_is_refused(f, h, words):
    with pytest.raises(ModelError, match=words):
        System.from_sympy(f, h, X)


def test_without_sympy_there_is_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(InvalidInputError, match="pip install sympy"):
        System.from_sympy([X[0]], [X[0]], [X[0]])
