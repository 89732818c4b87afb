"""Forms in which users write models: traced, with the same values and derivatives, or explained."""

import math
import subprocess
import sys
import threading

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.model import stand_ins
from qpmhe.model.tracing import traced
from tests.estimation import spoil
from tests.estimation.same import Interruption
from tests.estimation.spoil import cost_of

from . import idioms


def points(count, seed=5):
    generator = np.random.default_rng(seed)
    for _ in range(count):
        yield generator.uniform(-3.0, 4.0, 3), generator.uniform(-2.0, 2.0, 2)


def value_of(function, x, u):
    """The value; NaN where the function raises."""
    try:
        with np.errstate(all="ignore"):
            return np.array(function(x.copy(), u.copy()), float)
    except ValueError:  # outside of a table
        return np.array(np.nan)


def test_the_corpus_has_fifty_forms_and_almost_all_are_traced():
    count = len(idioms.TRACED) + len(idioms.OTHERS)
    assert len(idioms.TRACED) >= 48
    assert len(idioms.TRACED) >= 0.9 * count


@pytest.mark.whole
@pytest.mark.parametrize("way", idioms.TRACED)
def test_an_idiom_is_traced_with_the_same_values_and_derivatives(way):
    import casadi

    function = idioms.TRACED[way]
    found = traced(function, (3, 2))
    assert found.function is not None, found.reason
    ties = [(np.array(one), np.array([0.0, -1.0])) for one in (
        (0.0, 0.0, 0.0), (-1.0, 2.0, 0.4), (3.5, -8.0, 9.0), (-0.3, 0.5, 1.2), (30.0, -20.0, 1.0),
    )]
    for x, u in [*points(8), *ties]:
        expected, mine = value_of(function, x, u), np.array(found.function(x, u))
        if not np.isfinite(expected).all():
            assert not np.isfinite(mine).all(), (x, u)
            continue
        assert expected.shape == found.shape
        mine = mine.reshape(found.shape)
        np.testing.assert_allclose(mine, expected, 1e-11, 1e-12, err_msg=f"{x}, {u}")
    columns = [casadi.SX.sym("x", 3), casadi.SX.sym("u", 2)]
    slopes = casadi.Function("j", columns, [
        casadi.jacobian(found.function(*columns), casadi.vertcat(*columns))
    ])
    for x, u in points(4):
        both, h = np.concatenate((x, u)), 1e-5
        differences = np.stack([
            (value_of(function, *np.split(both + h * e, [3])).ravel()
             - value_of(function, *np.split(both - h * e, [3])).ravel()) / (2.0 * h)
            for e in np.eye(5)
        ], axis=1)
        scale = 1.0 + np.abs(differences).max()
        np.testing.assert_allclose(np.array(slopes(x, u)), differences, 0.0, 1e-7 * scale)


@pytest.mark.whole
@pytest.mark.parametrize("way", idioms.TRACED)
def test_a_system_calls_an_idiom_on_one_state_and_on_many_with_the_same_values(way):
    function = idioms.TRACED[way]
    size = np.size(function(*next(points(1))))
    system = qpmhe.System(lambda x: 0.9 * x, function, n=3, p=size, m=2)
    assert system.derivatives["h"] == "traced", system.explain()
    x, u = (np.array(one) for one in zip(*points(6), strict=True))
    rows = np.array([np.reshape(function(*pair), size) for pair in zip(x, u, strict=True)])
    np.testing.assert_allclose(system.h.batch(x, u), rows, 1e-12, 1e-13)


@pytest.mark.parametrize("way", idioms.OTHERS)
def test_what_is_not_traced_says_what_to_write(way):
    function, words = idioms.OTHERS[way]
    system = qpmhe.System(lambda x: 0.9 * x, function, n=3, p=3, m=2)
    first, second = system.explain().splitlines()
    assert first.startswith("f: traced")
    assert f"h: not traced: {idioms.__file__}:" in second
    assert "; write " in second
    assert words in second


def test_a_number_with_a_new_axis_is_an_output_of_one_state():
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x: np.exp(x[..., 0])[..., None] ** 2, n=1, p=1
    )
    assert system.derivatives == {"f": "traced", "h": "traced"}
    np.testing.assert_allclose(system.h_jacobian(np.array([0.3]), np.zeros(0)), 2 * np.exp([[0.6]]))


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
def test_a_battery_with_a_curve_of_scipy_runs_in_c():
    def h(x, u):
        return idioms.PCHIP(x[..., 0])[..., None] - x[..., 1:] - 0.02 * u

    def f(x, u):
        return np.stack([x[..., 0] - 0.02 * u[..., 0], 0.9 * x[..., 1] + 0.01 * u[..., 0]], -1)

    def estimates(engine):
        mhe = spoil.estimator(
            qpmhe.System(f, h, n=2, p=1, m=1), qpmhe.Luenberger([0.4, -0.1]),
            cost_of(disturbance=10.0 * np.eye(2), noise=4.0), horizon=5, initial_state=[1.0, 0.1],
            engine=engine,
        )
        ys = 3.4 + 0.3 * np.random.default_rng(1).normal(size=30)
        return np.array([mhe.update(y, u=[0.5]).state for y in ys])

    np.testing.assert_allclose(estimates("compiled"), estimates("python"), 0.0, 1e-6)


def test_other_threads_find_numpy_as_it_is_during_a_trace():
    own = np.zeros, np.array, math.sin, type(np.zeros(2))
    seen, at, done = [], threading.Event(), threading.Event()

    def look():
        at.wait(30.0)
        import math as mine

        seen.extend((np.zeros, np.array, mine.sin, type(np.zeros(2)), max([1, 3, 2]), min(2, 1)))
        done.set()

    def model(x):
        at.set()
        assert done.wait(30.0)
        y = np.zeros(2)
        y[0] = math.sin(x[0])
        return y

    thread = threading.Thread(target=look)
    thread.start()
    found = traced(model, (2,))
    thread.join()
    assert found.function is not None, found.reason
    assert tuple(seen) == (*own, 3, 1)


def test_a_lookup_goes_on_where_the_trace_of_another_thread_has_ended():
    """It began while NumPy's class was another, and ends when it is a module again."""
    look = stand_ins._Module.__getattribute__
    assert type(np) is not stand_ins._Module
    assert look(np, "zeros") is np.zeros
    assert look(math, "pi") == math.pi


def test_python_and_scipy_are_themselves_after_a_trace():
    from scipy.interpolate import BSpline, PPoly, interp1d

    def state():
        return (max, min, PPoly.__call__, BSpline.__call__, interp1d.__call__, type(np), type(math),
                "__call__" in vars(interp1d))

    before = state()
    for name in ("max and min", "interp1d of all kinds"):
        for lines in (1, 10, 30, 60, 100, 150, 200, 300, 500, 800, 1200):
            try:
                with Interruption(lines):
                    traced(idioms.TRACED[name], (3, 2))
            except (KeyboardInterrupt, SystemError):
                pass
        traced(idioms.TRACED[name], (3, 2))
        assert state() == before


def test_a_model_is_traced_without_the_columns_of_its_source():
    """As by ``python -X no_debug_ranges``."""
    code = """if 1:
        import numpy as np, qpmhe
        def f(x):
            y = np.zeros(2)
            y[0], y[1] = x[1], np.array([x[0], 1.0]).sum()
            return y
        print(qpmhe.System(f, lambda x: x[..., :1], n=2, p=1).explain())
    """
    run = subprocess.run(
        [sys.executable, "-X", "no_debug_ranges", "-c", code], capture_output=True, text=True,
        check=True, timeout=120,
    )
    assert run.stdout.startswith("f: traced"), run.stdout
