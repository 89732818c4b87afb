"""Implicit steps in single precision against double precision: they converge, and how exactly."""

import ctypes

import casadi as ca
import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import compiled_library, find_compiler
from qpmhe.codegen.model_source import model_files, model_source
from qpmhe.codegen.single import in_single_precision
from qpmhe.codegen.templates import prologue, template
from qpmhe.model.implicit_steps import COLLOCATIONS
from tests.model.test_implicit_steps import arrhenius, kinetics

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


def pendulum(x):
    return [x[1], -ca.sin(x[0]) - 0.1 * x[1]]


def library_of(model, real):
    """The model's library in C of this precision."""
    files = model_files(model)
    if real is np.float32:
        head = (
            "#include <stdint.h>\ntypedef float mhe_real;\n"
            f"#define MHE_NX {model.n}\n#define MHE_NY {model.p}\n#define MHE_NU {model.m}\n"
        )
        body = prologue() + model_source(model, single=True) + template("model_api.c")
        files = {"model.c": head + in_single_precision(body)}
    return compiled_library(files, "model.c")


def stepped(model, x):
    """The next states in C of single precision, without their derivatives."""
    x, u, found = np.ascontiguousarray(x), np.zeros((len(x), 1), np.float32), np.empty_like(x)
    library_of(model, np.float32).mhe_values(
        ctypes.c_int64(len(x)), *(ctypes.c_void_p(one.ctypes.data) for one in (x, u)), None,
        ctypes.c_float(model.dt), ctypes.c_void_p(found.ctypes.data), None,
    )
    return found


def linearized(model, x, real):
    """The next states and their derivatives, in C of this precision."""
    library = library_of(model, real)
    count, n = x.shape
    x, u = np.ascontiguousarray(x, real), np.zeros((count, 1), real)
    found, slopes = np.zeros((count, n), real), np.zeros((count, n, n), real)
    pointer = ctypes.c_void_p
    length = (ctypes.c_float if real is np.float32 else ctypes.c_double)(model.dt)
    library.mhe_jacobians(
        ctypes.c_int64(count), pointer(x.ctypes.data), pointer(u.ctypes.data), None, length,
        pointer(found.ctypes.data), None, pointer(slopes.ctypes.data), None,
    )
    return found.astype(float), slopes.astype(float)


@pytest.mark.parametrize("method", list(COLLOCATIONS))
@pytest.mark.parametrize(("rate", "low", "high", "dt", "within"), [
    (pendulum, [-1.0, -1.0], [1.0, 1.0], 0.1, 1e-6),
    (arrhenius, [0.4, 340.0, 300.0], [0.6, 355.0, 320.0], 0.05, 1e-5),
    (kinetics, [0.6, 1e-6, 0.01], [1.0, 5e-5, 0.2], 1.0, 1e-4),
], ids=["pendulum", "reactor", "robertson"])
def test_single_precision_has_the_step_of_double_precision(rate, low, high, dt, within, method):
    x = ca.SX.sym("x", len(low))
    model = qpmhe.from_casadi(
        ca.Function("rate", [x], [ca.vertcat(*rate(ca.vertsplit(x)))]),
        ca.Function("h", [x], [x[0]]), dt=dt, method=method, compiled=False,
    ).symbolic
    # States that single precision has, too.
    states = np.random.default_rng(0).uniform(low, high, (300, len(low))).astype(np.float32)
    (values, slopes), (others, other_slopes) = (
        linearized(model, states, real) for real in (np.float64, np.float32)
    )
    assert np.isfinite(values).all()
    assert np.isfinite(others).all()
    sizes = np.abs(values).max(axis=0)
    assert (np.abs(others - values) < within * sizes).all()
    # In units of the states' sizes.
    off = np.abs(other_slopes - slopes) * sizes / sizes[:, None]
    assert off.max() < within * np.abs(slopes * sizes / sizes[:, None]).max()


def test_single_precision_holds_rates_whose_squares_it_does_not():
    """A state that follows another one at once was up to 6 times as far off as it is large."""
    x = ca.SX.sym("x", 2)
    model = qpmhe.from_casadi(
        ca.Function("rate", [x], [ca.vertcat(-1e20 * (x[0] - x[1]), -x[1] * x[1])]),
        ca.Function("h", [x], [x[0]]), dt=0.5, method="radau", compiled=False,
    ).symbolic
    states = np.array([[1.0, 1.0], [1.0, 0.5], [2.0, 1.0]], np.float32)
    found = stepped(model, states)
    np.testing.assert_allclose(found, found[:, [1, 1]], rtol=1e-5)
    np.testing.assert_allclose(found, linearized(model, states, np.float64)[0], rtol=1e-5)
