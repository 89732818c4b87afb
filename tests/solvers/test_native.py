"""Solvers that keep workspaces and arrays: set up once for a structure, and nothing left over."""

import copy
import gc
import pickle
import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse

from qpmhe_solvers import SolverOptions, SolveStatus, backends, create
from qpmhe_solvers.dispatch import DispatchSolver, qpsolvers_arguments
from qpmhe_solvers.layout import Layout, Structure, Style
from qpmhe_solvers.native import Answer, NativeSolver
from qpmhe_solvers.sample_qps import contradiction, sample
from qpmhe_solvers.translations import TRANSLATIONS

from .problems import CASES, NATIVE, TIGHT, make

DISPATCHED = [
    entry.name for entry in backends()
    if getattr(entry.factory, "func", None) is DispatchSolver and entry.available
]
# One of each way to take matrices and bounds.
WAYS = sorted({"qpsolvers:clarabel", "qpsolvers:daqp", "qpsolvers:piqp", "quadprog"}
              & set(DISPATCHED))
SOLVED = SolveStatus.SOLVED
natives = pytest.mark.parametrize("name", NATIVE)


def watched(name, monkeypatch, options=None):
    """A solver, and the list of its set-ups and updates."""
    solver, calls = create(name, options), []
    for what in ("_set_up", "_update"):
        method = getattr(type(solver), what)
        monkeypatch.setattr(
            type(solver), what,
            lambda self, *given, what=what, method=method: calls.append(what)
            or method(self, *given),
        )
    return solver, calls


def parts(layout):
    """Every array of a layout, those inside of matrices too."""
    for name in ("hessian", "gradient", "matrix", "equality_matrix", "all_lower", "all_upper"):
        one = getattr(layout, name)
        inside = ("data", "indices", "indptr") if scipy.sparse.issparse(one) else ()
        yield from ((f"{name} {part}", getattr(one, part)) for part in inside)
        if not inside:
            yield name, one


def kept_by(solver):
    """The only workspace of a solver."""
    (workspace,) = solver._workspaces.values()
    return workspace


@natives
def test_a_structure_is_set_up_once(name, monkeypatch, capfd):
    solver, calls = watched(name, monkeypatch)
    for seed in range(6):
        qp = sample(7, 3, 2, bounds="all", sides="two", seed=seed)
        qp.row_lower[seed, 0], qp.row_upper[seed, 0] = -np.inf, np.inf
        assert solver.solve(qp).status is SOLVED
    assert calls == ["_set_up"] + ["_update"] * 5
    assert capfd.readouterr() == ("", "")  # of the void rows


@natives
def test_qps_of_other_weights_have_a_workspace_of_their_own(name, monkeypatch):
    # What was scaled for a projection, or found by it, spoils the QPs before and after it.
    one, other = (sample(6, 2, 1, bounds="all", sides="two", seed=seed) for seed in (0, 1))
    for array in (other.band, other.gradient):
        array *= 1e6
    alone = create(name)
    wanted = [alone.solve(one).iterations for _ in range(3)]
    solver, calls = watched(name, monkeypatch)
    for count in wanted:
        first = solver.solve(one)
        assert (first.status, first.iterations) == (SOLVED, count)
        solver.solve(other)
    assert len(solver._workspaces) == 2
    assert calls.count("_set_up") == 2


@natives
def test_few_structures_are_kept(name, monkeypatch):
    solver, calls = watched(name, monkeypatch)
    for stages in (3, 4, 5, 6, 3, 4, 5, 6, 7):
        solver.solve(sample(stages, 2))
    assert calls == ["_set_up"] * 4 + ["_update"] * 4 + ["_set_up"]
    assert len(solver._workspaces) == 4
    calls.clear()
    for stages in (4, 5, 6, 7, 3):  # the longest unused one went
        solver.solve(sample(stages, 2))
    assert calls == ["_update"] * 4 + ["_set_up"]


@natives
def test_patterns_that_are_known_do_not_pile_up(name):
    solver, rng = create(name), np.random.default_rng(0)
    for _ in range(70):
        qp = sample(8, 2, bounds="all", push=0.1)
        qp.lower[rng.random(qp.lower.shape) < 0.5] = -np.inf
        assert solver.solve(qp).status is SOLVED
    assert len(solver._known) <= 64
    assert len(solver._workspaces) <= 4


def handed(solver, contents):
    """Have each call of the solver's own function checked: it writes into nothing."""
    run, calls = type(solver)._run, []

    def watch(handle, layout, *given):
        before = {name: array.copy() for name, array in contents(layout)}
        try:
            return run(solver, handle, layout, *given)
        finally:
            calls.append(1)
            for name, array in contents(layout):
                np.testing.assert_array_equal(array, before[name], err_msg=name)

    solver._run = watch
    return calls


@pytest.mark.parametrize("cap", [None, 2])
@pytest.mark.parametrize("name", [*NATIVE, *DISPATCHED])
def test_no_solver_writes_into_what_it_is_handed(name, cap):
    # Only because of this may matrices be kept: indices and zeros are never written again.
    for case in CASES.values():
        solver = create(name, SolverOptions(cap))
        calls = handed(solver, parts)
        for seed in range(2):
            qp, _ = make(**case, seed=seed)
            solver.solve(qp, np.full((qp.stages, qp.n), 0.1))
        assert len(calls) == 2
    solver = create(name, SolverOptions(max_iterations=200))
    handed(solver, parts)
    assert solver.solve(contradiction()).status is not SOLVED


@pytest.mark.parametrize("name", DISPATCHED)
def test_no_solver_holds_on_to_what_it_is_handed(name):
    solver, (qp, _) = create(name), make(**CASES["all kinds"])
    solver.solve(qp)
    arrays = [array for _, array in parts(kept_by(solver).layout)]
    before = [sys.getrefcount(array) for array in arrays]
    solver.solve(qp)
    gc.collect()
    assert [sys.getrefcount(array) for array in arrays] == before


def growth(solver, qps, solves=1000):
    """Bytes that solves of these QPs in turn leave behind, after some of the kind."""

    def held_after(solves):
        for k in range(solves):
            assert solver.solve(qps[k % len(qps)]).d is not None
        gc.collect()  # empties Python's lists of freed objects as well
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = held_after(60)
        return held_after(solves) - before
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NATIVE, *{"qpsolvers:daqp", "quadprog"} & set(DISPATCHED)])
def test_a_whole_solve_leaves_no_memory_behind(name):
    assert growth(create(name), [make(**CASES["boxes"])[0]], 300) < 40_000  # no array a solve


@pytest.mark.parametrize("way", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
@pytest.mark.parametrize("name", [*NATIVE, *WAYS, "auto"])
def test_a_copy_of_a_used_solver_begins_anew(name, way):
    qp, _ = make(**CASES["all kinds"])
    solver = create(name, TIGHT)
    solver.solve(qp)
    copied = way(solver)
    assert copied.options == solver.options
    assert name == "auto" or copied._workspaces == {}
    for _ in range(2):
        qp.gradient[...] *= -1.5
        wanted = create(name, TIGHT).solve(qp).d
        np.testing.assert_allclose(copied.solve(qp).d, wanted, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-6)


@natives
def test_a_workspace_that_failed_is_dropped(name, monkeypatch):
    solver, calls = watched(name, monkeypatch, SolverOptions(max_iterations=200))
    good = sample(6, 2, 2, sides="two", seed=9)
    assert solver.solve(good).status is SOLVED
    assert solver.solve(contradiction()).status is not SOLVED
    dropped = not solver._workspaces
    assert dropped or name.startswith("proxqp")  # which runs into its cap
    assert solver.solve(good).status is SOLVED
    assert calls[-1] == ("_set_up" if dropped else "_update")


@natives
def test_a_workspace_that_raised_or_brought_nan_is_dropped(name, monkeypatch):
    solver, qp = create(name), sample(6, 2, bounds="all")
    wanted, run = solver.solve(qp).d, type(solver)._run

    def failing(what):
        def called(*given):
            if isinstance(what, str):
                return run(*given)._replace(**{what: np.full(12, np.nan)})
            raise what

        return called

    for what in (KeyError("stop"), KeyboardInterrupt("stop"), "x", "duals"):
        with monkeypatch.context() as context:
            context.setattr(type(solver), "_run", failing(what))
            if isinstance(what, KeyboardInterrupt):
                with pytest.raises(KeyboardInterrupt):
                    solver.solve(qp)
            else:
                failed = solver.solve(qp).status is SolveStatus.FAILED
                assert failed == (what != "duals")
        assert not solver._workspaces
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-6)


class Kept(NativeSolver):
    """Remembers the multipliers that it is started with."""

    package, style = "numpy", Style("dense")

    def __init__(self, options=SolverOptions()):  # noqa: B008 (frozen)
        super().__init__(options)
        self.starts = []

    def _set_up(self, layout):
        return None

    def _update(self, handle, layout):
        pass

    def _run(self, handle, layout, start, duals):
        self.starts.append(None if duals is None else duals.copy())
        return Answer(np.zeros(layout.size), np.arange(1.0, 13.0), False, True, 1, "")


def test_multipliers_move_with_the_trajectory():
    for count in [0, 1, 2, 3, 4]:
        qp, solver = sample(4, 2, 1, bounds="all", sides="two"), Kept()
        bounds, rows = np.arange(1.0, 9.0).reshape(4, 2), np.arange(9.0, 13.0)
        moved = np.concatenate([
            np.append(one[count:], np.zeros_like(one[:count])) for one in (bounds, rows)
        ])
        solver.shift()  # before anything is kept
        solver.solve(qp)
        for _ in range(count):
            solver.shift()
        solver.solve(qp)
        solver.solve(qp)
        assert solver.starts[0] is None
        if count == 4:  # nothing is left
            assert solver.starts[1] is None
        else:
            np.testing.assert_array_equal(solver.starts[1], moved)
        np.testing.assert_array_equal(solver.starts[2], np.arange(1.0, 13.0))
        cold = Kept(SolverOptions(warm_start=False))
        cold.solve(qp)
        cold.solve(qp)
        assert cold.starts == [None, None]


def test_multipliers_and_active_sets_of_the_last_solve_save_iterations():
    qp = sample(12, 3, 2, bounds="all", sides="two", push=5.0)
    if "osqp" in NATIVE:
        best, counts = create("osqp", TIGHT).solve(qp).d, {}
        for warm in (True, False):
            solver = create("osqp", SolverOptions(absolute_tolerance=1e-6, warm_start=warm))
            counts[warm] = [solver.solve(qp, best).iterations for _ in range(3)]
        # With both at the solution there is nothing to do until the residuals are looked at.
        assert counts[True][1:] == [25, 25]
        assert counts[False][0] > 25
        assert len(set(counts[False])) == 1  # nothing is left of a solve
    if "daqp" in NATIVE:
        for warm in (True, False):
            solver = create("daqp", SolverOptions(warm_start=warm))
            first, second = (solver.solve(qp).iterations for _ in range(2))
            assert first > 20
            assert second == (1 if warm else first)


def test_a_wrong_active_set_does_not_stop_daqp():
    # One unknown and two rows a stage: more active limits than unknowns cannot be.
    pytest.importorskip("daqp")
    solver = create("daqp", TIGHT)
    for seed in range(30):
        qp, dense = make(8, 1, 2, bounds="part", sides="two", seed=seed)
        solution = solver.solve(qp)
        assert solution.status is SOLVED, solution.message
        np.testing.assert_allclose(solution.d.ravel(), dense.minimiser(), atol=1e-6)
    best = solution.d
    for start in (best, best + 100.0, best - 100.0, np.where(best > 0, 1e6, -1e6)):
        np.testing.assert_allclose(solver.solve(qp, start).d, best, atol=1e-6)


@pytest.mark.parametrize("cap", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("bounds", ["none", "part", "all"])
@pytest.mark.parametrize("sides", ["none", "two", "mixed"])
def test_both_forms_of_daqp_stop_behind_the_same_iteration(sides, bounds, cap):
    # From limits that do not bind to those that mostly do.
    pytest.importorskip("daqp")
    for seed, push in enumerate((0.0, 0.1, 0.5, 1.0, 3.0)):
        qp = sample(4, 2, 1, bounds=bounds, sides=sides, push=push, seed=seed)
        needed = create("daqp").solve(qp).iterations
        native, generic = (
            create(name, SolverOptions(cap)).solve(qp) for name in ("daqp", "qpsolvers:daqp")
        )
        expected = SOLVED if needed <= cap else SolveStatus.FAILED
        assert (native.status, generic.status) == (expected, expected)
        assert native.iterations == min(needed, cap)


GAPS = {
    "max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "eps_duality_gap_abs": 3e-6,
    "eps_duality_gap_rel": 4e-7, "check_duality_gap": True,
}
SETTINGS = {
    "clarabel": {
        "max_iter": 17, "tol_gap_abs": 3e-6, "tol_feas": 3e-6, "tol_gap_rel": 4e-7,
        "time_limit": 2.5, "verbose": False,
    },
    "daqp": {"iter_limit": 18, "primal_tol": 3e-6, "dual_tol": 3e-6, "time_limit": 2.5},
    "osqp": {
        "max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "time_limit": 2.5,
        "check_termination": 1, "verbose": 0,
    },
    **dict.fromkeys(("piqp", "piqp_dense", "proxqp", "proxqp_sparse"), GAPS),
}


def settings(solver):
    """A function of a name of the settings of a solver's own."""
    handle = kept_by(solver).handle
    found = handle.get_settings() if hasattr(handle, "get_settings") else handle.settings
    return found.get if isinstance(found, dict) else lambda key: getattr(found, key)


@natives
def test_every_option_reaches_the_solver(name):
    options = {"max_iterations": 17, "absolute_tolerance": 3e-6, "relative_tolerance": 4e-7}
    solver = create(name, SolverOptions(**options, time_limit=2.5))
    qp = sample(6, 2, 1, bounds="all", sides="mixed")
    solver.solve(qp)
    assert SETTINGS[name] == {key: settings(solver)(key) for key in SETTINGS[name]}
    if "time_limit" in SETTINGS[name]:  # anew for each solve
        solver.time_limit = 30.0
        solver.solve(qp)
        assert settings(solver)("time_limit") == 30.0


def test_what_a_few_solvers_are_asked_for():
    for name, cap, key, expected in (
        # osqp looks at its residuals in time, piqp factorises by stages.
        ("osqp", 24, "check_termination", 1), ("osqp", 25, "check_termination", 25),
        ("osqp", None, "check_termination", 25), ("piqp", None, "kkt_solver", "sparse_multistage"),
    ):
        if name in NATIVE:
            solver = create(name, SolverOptions(cap))
            solver.solve(sample(6, 2))
            found = settings(solver)(key)
            assert getattr(found, "name", found) == expected


@pytest.mark.parametrize("name", [name for name, how in TRANSLATIONS.items() if how.time_limit])
def test_the_translation_sets_each_time_limit(name):
    pytest.importorskip("qpsolvers")
    solver, given = DispatchSolver(name, SolverOptions(time_limit=60.0)), []

    def solve_problem(problem, name, **words):
        given.append(words[TRANSLATIONS[name].time_limit])
        raise RuntimeError("that will do")

    solver._solve_problem = solve_problem
    for limit in (60.0, 2.5, 30.0):
        solver.time_limit = limit
        solver.solve(sample(6, 2))
    assert given == [60.0, 2.5, 30.0]


@pytest.mark.parametrize("missing", ["z", "y", "z_box"])
def test_missing_multipliers_are_not_made_up(missing):
    qp, _ = make(**CASES["all kinds"])
    layout = Layout(Style("dense", sides=1), Structure.of(qp, exact=True), *qp.sizes)
    arguments = qpsolvers_arguments(layout, False)
    usual = {
        "z": np.ones(len(arguments[3])), "y": np.ones(len(arguments[5])),
        "z_box": np.ones(layout.size),
    }
    for value in (usual[missing], None, np.zeros(1)):
        solver = object.__new__(DispatchSolver)
        solver.name, solver._keywords = "", {}
        solver._translation = SimpleNamespace(start=False)
        answer = SimpleNamespace(x=None, found=True, extras={}, **usual | {missing: value})
        solver._solve_problem = lambda *_, answer=answer, **__: answer
        found = solver._run(None, layout, None, None).duals
        assert (found is None) == (value is not usual[missing])


def test_every_solver_of_the_table_can_be_named():
    assert {name.removeprefix("qpsolvers:") for name in DISPATCHED} <= set(TRANSLATIONS)
    names = {entry.name for entry in backends()}
    for name in TRANSLATIONS:
        assert (f"qpsolvers:{name}" in names) == (name not in DISPATCHED and name in names)
