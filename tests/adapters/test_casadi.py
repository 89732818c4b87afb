"""What only CasADi's models have: ways of writing, matrix functions, code, failed evaluations."""

import contextlib
import io
import math
import pickle
import sys
import threading

import numpy as np
import pytest

import qpmhe
from qpmhe import from_casadi
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import CompilationError, InvalidInputError, ModelError, OptionError, ShapeError
from qpmhe.model.quiet import quiet
from tests.adapters.twins import NONE, M, N, P, check, output, plain, points, rate

ca = pytest.importorskip("casadi")

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no compiler")
BOTH = [False, pytest.param(True, marks=needs_compiler)]
KNOWN = ["SX", "MX", "row", "sparse"]  # ways of writing that state their sizes


def written(way):
    """f and h in one of the ways in which CasADi's users write them."""
    if way not in KNOWN:
        finish = {"list": list, "column": lambda values: ca.vertcat(*values)}[way]
        return lambda x, u: finish(rate(x, u, ca)), lambda x, u: finish(output(x, u, ca))
    kind = ca.MX if way == "MX" else ca.SX
    x, u = (kind.sym("x", 1, N) if way == "row" else kind.sym("x", N)), kind.sym("u", M)
    made = []
    for name, entries in (("f", rate), ("h", output)):
        value = ca.vertcat(*entries(x, u, ca))
        if way == "row":
            value = value.T
        if way == "sparse":
            value = ca.sparsify(ca.vertcat(value, 0))[: value.numel()]
        made.append(ca.Function(name, [x, u], [value]))
    return made


@pytest.mark.parametrize("way", [*KNOWN, "column", "list"])
def test_ways_of_writing(way):
    sizes = {} if way in KNOWN else {"n": N, "m": M}
    system = from_casadi(*written(way), dt=0.1, compiled=False, **sizes)
    assert (system.n, system.p, system.m) == (N, P, M)
    check(system, lambda x, u: plain("rk4", x, u), *points())
    with pytest.raises((ValueError, ShapeError)):  # not broadcast
        system.f(np.zeros(N - 1), np.zeros(M))

@pytest.mark.parametrize("compiled", BOTH)
def test_matrix_functions_that_cannot_be_expanded(compiled):
    x, u = ca.MX.sym("x", 3), ca.MX.sym("u", 1)
    table = ca.interpolant("table", "bspline", [np.linspace(-4, 4, 12)], np.linspace(-4, 4, 12)**2)
    f = ca.Function("f", [x, u], [0.3 * x + ca.logsumexp(x) + u * table(x[1])])
    h = ca.Function("h", [x], [ca.vertcat(ca.logsumexp(2.0 * x), x[0])])
    system = from_casadi(f, h, compiled=compiled)
    assert system.symbolic.f.is_a("MXFunction")
    generator = np.random.default_rng(4)
    xs, us = generator.uniform(-1.0, 1.0, (5, 3)), generator.uniform(-1.0, 1.0, (5, 1))

    def values(x, u):
        ahead = 0.3 * x + np.log(np.exp(x).sum()) + u[0] * x[1] ** 2
        return ahead, np.array([np.log(np.exp(2.0 * x).sum()), x[0]])

    check(system, values, xs, us)


def test_without_a_compiler_the_virtual_machine_evaluates(monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    (x,), (u,) = points(1)
    system = from_casadi(*written("SX"))
    np.testing.assert_allclose(system.f(x, u), plain("discrete", x, u)[0], rtol=1e-14)
    with pytest.raises(CompilationError, match="compiler"):
        from_casadi(*written("SX"), compiled=True)


X = ca.SX.sym("x", 2)
F, H = ca.Function("f", [X], [0.9 * X]), ca.Function("h", [X], [X[0]])
WRONG = [
    ((F, H), {"n": 3}, ModelError, "n is 2.*expected 3"),
    ((lambda x: x, H), {}, InvalidInputError, "n is missing"),
    ((lambda x: x[0], H), {"n": 2}, ModelError, "f is 1.*expected 2"),
    ((ca.Function("f", [ca.SX.sym("x", 2, 2)], [1.0]), H), {}, ModelError, "f "),
    ((ca.Function("f", [X], [X, X]), H), {}, ModelError, "2 outputs"),
    ((X, H), {"n": 2}, ModelError, "f is SX"),
    ((lambda x: "x", H), {"n": 2}, ModelError, "(?s)f cannot be evaluated.*System"),
    ((F, lambda x: 1 / 0), {}, ModelError, "h cannot.*ZeroDivisionError"),
    ((lambda x: x if x[0] > 0 else -x, H), {"n": 2}, ModelError, "f cannot.*casadi"),
    ((F, H), {"dt": 0.1, "method": "heun"}, OptionError, "method is 'heun'.*rk4"),
    ((F, H), {"compiled": "no"}, OptionError, "compiled is 'no'"),
]


@pytest.mark.whole
@pytest.mark.parametrize(("functions", "options", "error", "text"), WRONG)
def test_wrong_input_and_nan_fail_at_construction(functions, options, error, text):
    with pytest.raises(error, match=text):
        from_casadi(*functions, **{"compiled": False, **options})
    # math.sin turns a symbol into NaN silently.
    with pytest.raises(ModelError, match=r"expression of CasADi symbols is \[nan"):
        from_casadi(lambda x: [math.sin(x[0]), x[1]], lambda x: x[0], n=2, compiled=False)


def falling(case):
    """Models of two states whose evaluation breaks off for x0 beyond 1: f, h, and h's values."""
    x, z, q = ca.MX.sym("x", 2), ca.SX.sym("z"), ca.SX.sym("q")
    if case == "QP":  # x0 <= r <= 1, near x1
        quiet = {"print_iter": False, "print_header": False, "print_info": False}
        dense = {"h": ca.Sparsity.dense(1, 1), "a": ca.Sparsity.dense(2, 1)}
        qp = ca.conic("qp", "qrqp", dense, quiet)
        h = qp(h=1, a=ca.DM([1, 1]), g=-x[1], lba=ca.vertcat(x[0], -ca.inf),
               uba=ca.vertcat(ca.inf, 1))["x"]
        try:
            ca.jacobian(h, x)
        except RuntimeError:
            pytest.skip("this CasADi has no derivatives of QPs")

        def value(x):
            return min(max(x[0], x[1]), 1)
    else:  # raises
        root = ca.rootfinder(
            "root", "fast_newton", ca.Function("g", [z, q], [z**2 - 1 + q]), {"max_iter": 50}
        )
        h, value = root(1.0, x[0]), lambda x: math.sqrt(1 - x[0])
    f = ca.Function("f", [x], [0.9 * x])
    return f, ca.Function("h", [x], [h + 0 * x[1]]), value


def estimator(system):
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[5.0]])
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5, 0.1]), cost, horizon=3, initial_state=[0.4, 0.0], max_qps=2
    )


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize(("case", "compiled"), [
    ("QP", False), ("root", False), ("root", None),
    pytest.param("QP", True, marks=needs_compiler),
])  # fmt: skip
def test_an_evaluation_that_breaks_off_is_no_number_and_fails_a_step_only(case, compiled):
    f, h, value = falling(case)
    system = from_casadi(f, h, compiled=compiled)
    xs = np.array([[0.5, 0.2], [3.0, 0.1], [0.25, 0.3], [2.0, 0.4], [-0.2, 0.5]])
    us, bad = np.zeros((5, 0)), np.array([False, True, False, True, False])
    expected = np.array([[np.nan if k else value(x)] for x, k in zip(xs, bad, strict=True)])
    for x, y in zip(xs, expected, strict=True):
        np.testing.assert_allclose(system.h(x, NONE), y, rtol=1e-9)
        assert np.isnan(system.h_jacobian(x, NONE)).any() == np.isnan(y)
        # What can be evaluated is, whatever is asked for beside it.
        ahead, found, slope = system.evaluation.functions.kernel.stage(x, NONE)
        np.testing.assert_allclose(ahead, 0.9 * x)
        np.testing.assert_allclose(found, y, rtol=1e-9)
        np.testing.assert_allclose(slope[:2], 0.9 * np.eye(2))
    np.testing.assert_allclose(system.h.batch(xs, us), expected, rtol=1e-9)
    np.testing.assert_allclose(system.f.batch(xs, us), 0.9 * xs)
    slopes = system.h_jacobian.batch(xs, us)
    np.testing.assert_array_equal(np.isnan(slopes).any(axis=(1, 2)), bad)
    residuals = system.evaluation.residuals(np.vstack((xs, xs[:1])), np.zeros((5, 1)), us)
    np.testing.assert_allclose(residuals[:, 2:], -expected, rtol=1e-9)
    mhe = estimator(system)
    assert qpmhe.Status.IMPROVED in mhe.update([0.5]).status
    mhe.update([60.0])  # throws the observer to where h cannot be evaluated
    failed = mhe.update([0.5])
    assert qpmhe.Status.MODEL_FAILED in failed.status
    assert failed.candidate_cost == np.inf
    assert np.isfinite(failed.state).all()
    later = [mhe.update([0.5]) for _ in range(6)]
    assert qpmhe.Status.IMPROVED in later[-1].status


@needs_compiler
def test_functions_without_code_and_rootfinders_that_hide_their_failure_are_not_compiled():
    z, q, x = ca.SX.sym("z"), ca.SX.sym("q"), ca.MX.sym("x", 2)
    root = ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z + 0.1 * ca.sin(z) - q})
    f = ca.Function("f", [x], [ca.vertcat(root(0, x[0]), 0.5 * x[1])])
    with pytest.raises(CompilationError):
        from_casadi(f, H, compiled=True)
    z = from_casadi(f, H).f(np.array([0.7, 0.2]), NONE)
    assert z[0] + 0.1 * np.sin(z[0]) == pytest.approx(0.7, abs=1e-7)
    with pytest.raises(CompilationError, match="fast_newton"):
        from_casadi(*falling("root")[:2], compiled=True)


def solver_within(kind):
    """One step of x' = -x - x^3 by a solver of CasADi, as a function of (x0, x1)."""
    x, z = ca.MX.sym("x", 2), ca.MX.sym("z", 2)
    if kind in ("cvodes", "idas", "collocation"):
        solver = ca.integrator("inside", kind, {"x": x, "ode": -x - x**3}, 0, 0.1)
        return ca.Function("f", [x], [solver(x0=x)["xf"]])
    solver = ca.rootfinder("inside", kind, ca.Function("g", [z, x], [z - x + 0.1 * (z + z**3)]))
    return ca.Function("f", [x], [solver(x, x)])


@pytest.mark.whole
@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("kind", ["cvodes", "idas", "collocation", "newton", "kinsol"])
def test_a_solver_without_c_code_is_refused_by_name_before_casadi_prints(kind, nested, capfd):
    f = solver_within(kind)
    if nested:
        x = ca.MX.sym("x", 2)
        f = ca.Function("outer", [x], [f(x)], {"never_inline": True})
    with pytest.raises(CompilationError) as caught:
        from_casadi(f, H, compiled=True)
    word = "newton" if kind == "collocation" else kind
    assert f"'{word}', which f calls by the name" in str(caught.value)
    assert caught.value.__cause__ is caught.value.__context__ is None
    system = from_casadi(f, H)
    x = np.array([0.7, -0.2])
    found = system.f(x, NONE)
    if kind in ("newton", "kinsol"):
        np.testing.assert_allclose(found + 0.1 * (found + found**3), x, atol=1e-8)
    else:
        left = np.exp(-0.2)
        exact = x * np.sqrt(left / (1 + x**2 * (1 - left)))
        np.testing.assert_allclose(found, exact, atol=1e-5)
    slope, step = system.f_jacobian(x, NONE), 1e-3
    differences = [
        (system.f(x + move, NONE) - system.f(x - move, NONE)) / (2 * step)
        for move in step * np.eye(2)
    ]
    np.testing.assert_allclose(slope, np.transpose(differences), atol=1e-3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["newton", "fast_newton", "kinsol"])
def test_a_solver_that_fails_prints_nothing(kind, capfd):
    x, z, q = ca.MX.sym("x", 2), ca.SX.sym("z"), ca.SX.sym("q")
    residual = z**2 - 1 + q  # without a solution for q > 1
    root = ca.rootfinder("root", kind, {"x": z, "p": q, "g": residual}, {"max_iter": 30})
    h = ca.Function("h", [x], [root(1.0, x[0]) + 0 * x[1]])
    system = from_casadi(ca.Function("f", [x], [0.9 * x]), h, compiled=False)
    states = np.array([[3.0, 0.1], [0.5, 0.2], [1.0, 0.3]])
    for name in ("h", "h_jacobian"):
        found = getattr(system, name).batch(states, np.zeros((3, 0)))
        assert np.isnan(found[0]).all()
    mhe = estimator(system)
    for y in (0.5, 60.0, 0.5):
        mhe.update([y])
    system.model().second_derivatives.at(states, np.zeros((3, 0)), np.ones((3, 3)))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["newton", "fast_newton"])
def test_an_error_names_a_rootfinder_whose_residual_is_no_number(kind):
    """It returns its guess, with a derivative that is finite and wrong."""
    x, z, q = ca.MX.sym("x", 2), ca.SX.sym("z"), ca.SX.sym("q")
    root = ca.rootfinder("root", kind, {"x": z, "p": q, "g": ca.log(z - 10) - q})
    h = ca.Function("h", [x], [root(0.3, x[0]) + 0 * x[1]])
    system = from_casadi(ca.Function("f", [x], [0.9 * x]), h, compiled=False)
    with pytest.raises(ModelError, match=r"h_jacobian.* within h .*fast_newton") as caught:
        estimator(system)
    assert "leave it out" not in str(caught.value)


def test_other_threads_print_while_one_is_quiet(capsys):
    before = sys.stderr
    with quiet():
        print("lost", file=sys.stderr)
        thread = threading.Thread(target=print, args=("kept",), kwargs={"file": sys.stderr})
        thread.start()
        thread.join()
        with quiet():
            print("lost", file=sys.stderr)
    assert sys.stderr is before
    print("later", file=sys.stderr)
    assert capsys.readouterr() == ("", "kept\nlater\n")


def test_a_thread_that_redirects_across_an_evaluation_finds_the_stream_itself(capsys):
    before, theirs, mine = sys.stderr, io.StringIO(), io.StringIO()
    redirected = contextlib.redirect_stderr(theirs)
    with quiet():
        redirected.__enter__()  # as a thread that is not quiet does
        with quiet():  # of the stream that has come instead, too
            print("lost", file=sys.stderr)
    assert sys.stderr is theirs
    redirected.__exit__(None, None, None)
    assert not sys.stderr.closed  # any use puts the stream itself back
    assert sys.stderr is before
    with quiet():
        redirected.__enter__()
    redirected.__exit__(None, None, None)
    with quiet():  # as does the end of another evaluation
        print("lost", file=sys.stderr)
    assert sys.stderr is before
    with contextlib.redirect_stderr(mine):
        print("kept", file=sys.stderr)
    assert (theirs.getvalue(), mine.getvalue(), capsys.readouterr().err) == ("", "kept\n", "")


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("kind", ["cvodes", "idas"])
def test_derivatives_of_an_integrator_are_taken_as_they_are(kind, timed):
    """Differences of values that an integrator computes to its tolerances are less accurate."""
    x, stiffness = ca.MX.sym("x", 2), 50
    rate = ca.vertcat(x[1], stiffness * (1 - x[0] ** 2) * x[1] - x[0])
    solver = ca.integrator("solver", kind, {"x": x, "ode": rate}, 0, 0.1)
    f = ca.Function("f", [x], [solver(x0=x)["xf"]])
    if timed:  # an ODE whose rate calls one
        system = from_casadi(ca.Function("rate", [x], [f(x) - x]), H, dt=0.1, method="euler")
    else:
        system = from_casadi(f, H)
    assert system.derivatives == {"f": "integrator", "h": "casadi"}
    assert "by CasADi, to its integrator's tolerances" in system.explain()
    mhe = estimator(system)
    assert [mhe.update([0.5]).status for _ in range(4)][-1] == qpmhe.Status.IMPROVED
    tight = ca.integrator(
        "tight", kind, {"x": x, "ode": rate}, 0, 0.1, {"abstol": 1e-13, "reltol": 1e-12})
    end = tight(x0=x)["xf"]
    slopes = ca.Function("slopes", [x], [ca.jacobian(end, x)])
    at = np.array([1.1197133695775516, 2.6171846326988435])
    expected = slopes(at).full()
    if timed:
        expected = np.eye(2) + 0.1 * (expected - np.eye(2))
    np.testing.assert_allclose(system.f_jacobian(at, NONE), expected, rtol=1e-4)


@pytest.mark.parametrize("compiled", BOTH)
@pytest.mark.parametrize("way", ["function", "inner", "mapped"])
def test_assertions_hold(way, compiled):
    """A state at which one fails has no value, however the model is evaluated."""
    x = ca.MX.sym("x", 2)
    checked = x.attachAssert(x[0] > -1, "below the sensor")
    inner = ca.Function("inner", [x], [checked[0] + 0.1 * checked[1] ** 2])
    h = {
        "function": inner,
        "inner": ca.Function("h", [x], [ca.if_else(x[1] > 9, 0, inner(x), True)]),
        "mapped": ca.Function("h", [x], [ca.sum2(inner.map(2)(ca.horzcat(x, x))) / 2]),
    }[way]
    system = from_casadi(F, h, compiled=compiled)
    xs, us = np.array([[0.5, 1.0], [-2.0, 1.0], [2.0, 0.0]]), np.zeros((3, 0))
    expected = np.array([[0.6], [np.nan], [2.0]])
    for x, y in zip(xs, expected, strict=True):
        np.testing.assert_allclose(system.h(x, NONE), y)
    np.testing.assert_allclose(system.h.batch(xs, us), expected)
    np.testing.assert_allclose(system.f.batch(xs, us), 0.9 * xs)


def test_an_expression_is_compared_with_the_function_on_numbers():
    ca = pytest.importorskip("casadi")

    def other_for_symbols(x):
        return 0.9 * x if isinstance(x, ca.DM) else 0.8 * x

    with pytest.raises(ModelError, match=r"f returns .* and its expression of CasADi symbols is"):
        qpmhe.from_casadi(other_for_symbols, lambda x: x, n=1, compiled=False)
    with pytest.raises(ModelError, match=r"h returns .* write one formula for both"):
        qpmhe.from_casadi(lambda x: x, other_for_symbols, n=1, compiled=False)
    for fine in (lambda x: ca.sqrt(x - 5.0), lambda x: ca.if_else(x > 0.5, x, -x), ca.log):
        qpmhe.from_casadi(fine, lambda x: x, n=1, compiled=False)


def test_a_model_that_overflows_is_compared_without_a_warning():
    """Warnings are errors here; other components are compared as ever."""
    def model(x):
        return ca.vertcat(ca.exp(1e3 * x[0]), 0.5 * x[1])

    system = from_casadi(model, lambda x: x[1], n=2, p=1)
    assert system.f(np.array([0.0, 4.0])).tolist() == [1.0, 2.0]

    def another(x):
        return ca.vertcat(ca.exp(1e3 * x[0]), (0.5 if isinstance(x, ca.DM) else 0.6) * x[1])

    with pytest.raises(ModelError, match="one formula for both"):
        from_casadi(another, lambda x: x[1], n=2, p=1)


def test_auto_chooses_once_and_a_pickle_has_the_choice():
    def kinetics(x):
        one, two, three = 0.04 * x[0], 1e4 * x[1] * x[2], 3e7 * x[1] ** 2
        return ca.vertcat(two - one, one - two - three, three)

    options = {"dt": 1.0, "n": 3, "p": 1, "scales": [1.0, 3e-5, 1.0], "compiled": False}
    made = from_casadi(kinetics, lambda x: x[2], method="auto", tolerance=1e-3, **options)
    assert (made.method, made.steps) == ("radau", 1)
    words = made.explain().split("step: ")[1].splitlines()
    assert words[0].startswith("radau with 1 substep, the cheapest")
    assert len(words) == 12
    other = from_casadi(kinetics, lambda x: x[2], method="radau", **options)
    x = np.array([0.9, 2e-5, 0.1])
    np.testing.assert_array_equal(made.f(x), other.f(x))
    assert pickle.loads(pickle.dumps(made)).method == "radau"


@pytest.mark.parametrize(("options", "words"), [
    ({"method": "auto"}, "method is 'auto', but dt is missing"),
    ({"method": "radau"}, "method is 'radau', but dt is missing"),
    ({"steps": 3}, "steps is 3, but dt is missing"),
    ({"method": "auto", "dt": 0.1, "steps": 2}, "method='auto' chooses steps"),
    ({"dt": 0.1, "tolerance": 1e-6}, "tolerance is 1e-06, but method is 'rk4'"),
])
def test_bad_arguments_of_auto(options, words):
    with pytest.raises(OptionError, match=words):
        from_casadi(lambda x: -x, lambda x: x, n=1, compiled=False, **options)
