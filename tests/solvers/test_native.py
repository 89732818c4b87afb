"""Solvers that keep workspaces and arrays: set up once for a structure, and nothing left over."""

import copy
import gc
import pickle
import tracemalloc

import numpy as np
import pytest

from qpmhe_solvers import SolverOptions, SolveStatus, create, native
from qpmhe_solvers.layout import QPStyle
from qpmhe_solvers.native import NativeAnswer, NativeSolver
from qpmhe_solvers.sample_qps import contradiction, sample

from .problems import CASES, EVERY, NATIVE, TIGHT, make

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


GAPS = {
    "max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "eps_duality_gap_abs": 3e-6,
    "eps_duality_gap_rel": 4e-7,
}
SETTINGS = {
    "clarabel": {
        "max_iter": 17, "tol_gap_abs": 3e-6, "tol_feas": 3e-6, "tol_gap_rel": 4e-7,
        "time_limit": 2.5,
    },
    "daqp": {"iter_limit": 18, "primal_tol": 3e-6, "dual_tol": 3e-6, "time_limit": 2.5},
    "osqp": {
        "max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "time_limit": 2.5, "check_termination": 1,
    },
    **dict.fromkeys(("piqp", "piqp_dense"), GAPS),
    **dict.fromkeys(("proxqp", "proxqp_sparse"), GAPS | {"check_duality_gap": True}),
}


@natives
def test_every_option_reaches_the_solver(name):
    solver = create(name, SolverOptions(17, 3e-6, 4e-7, time_limit=2.5))
    solver.solve(sample(6, 2, 1, bounds="all", sides="mixed"))
    (workspace,) = solver._workspaces.values()
    handle = workspace.handle
    found = handle.get_settings() if hasattr(handle, "get_settings") else handle.settings
    found = found if isinstance(found, dict) else {key: getattr(found, key) for key in dir(found)}
    assert {key: found[key] for key in SETTINGS[name]} == SETTINGS[name]


@natives
def test_a_structure_is_set_up_once_and_few_are_kept(name, monkeypatch, capfd):
    solver, calls = watched(name, monkeypatch)
    for seed in range(6):
        qp = sample(7, 3, 2, bounds="all", sides="two", seed=seed)
        qp.row_lower[seed, 0], qp.row_upper[seed, 0] = -np.inf, np.inf
        assert solver.solve(qp).status is SOLVED
    assert calls == ["_set_up"] + ["_update"] * 5
    assert capfd.readouterr() == ("", "")  # of the void rows
    calls.clear()
    for stages in (3, 4, 5, 6, 3, 4, 5, 6, 7, 4, 5, 6, 7, 3):  # the longest unused one goes
        solver.solve(sample(stages, 2))
    assert [what == "_update" for what in calls] == [0] * 4 + [1] * 4 + [0] + [1] * 4 + [0]
    for k in range(70):
        qp = sample(8, 2, bounds="all", push=0.1)
        qp.lower.flat[[j for j in range(7) if k >> j & 1]] = -np.inf
        assert solver.solve(qp).status is SOLVED
    assert (len(solver._known), len(solver._workspaces)) == (64, 4)


@natives
def test_a_series_of_infeasible_qps_is_laid_out_once(name, monkeypatch):
    made, usual = [], native.QPLayout
    monkeypatch.setattr(native, "QPLayout", lambda *given: made.append(1) or usual(*given))
    solver, fresh, qp = create(name), create(name), sample(6, 2, 1, bounds="all", sides="two")
    low, high = qp.row_lower.copy(), qp.row_upper.copy()
    for k in (1000, 1001, 1002, 0):  # bounds of 1 exclude such rows
        qp.row_lower[...], qp.row_upper[...] = low + k, high + k
        before = len(made)
        found = solver.solve(qp)
        assert len(made) - before == (k == 1000)
        fresh._layouts.clear()
        wanted = fresh.solve(qp)
        assert found.status is wanted.status
        assert (found.status is SOLVED) == (k == 0)
        if k == 0:  # two fresh solvers of ProxQP may differ in the last digits
            np.testing.assert_allclose(found.d, wanted.d, rtol=1e-5, atol=1e-6)


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


@pytest.mark.parametrize("name", ["auto", *NATIVE, *{"quadprog"} & set(EVERY)])
def test_a_copy_of_a_used_solver_begins_anew(name):
    qp, _ = make(**CASES["all kinds"])
    solver = create(name, TIGHT)
    solver.solve(qp)
    for copied in (copy.deepcopy(solver), pickle.loads(pickle.dumps(solver))):
        assert copied.options == solver.options
        assert name == "auto" or copied._workspaces == {}
        qp.gradient[...] *= -1.5
        wanted = create(name, TIGHT).solve(qp).d
        np.testing.assert_allclose(copied.solve(qp).d, wanted, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-6)


@natives
def test_a_workspace_that_failed_is_dropped(name, monkeypatch):
    solver, calls = watched(name, monkeypatch, SolverOptions(max_iterations=200))
    qp = sample(6, 2, 2, sides="two", seed=9)
    wanted, run = solver.solve(qp).d, type(solver)._run
    assert solver.solve(contradiction()).status is not SOLVED
    dropped = not solver._workspaces
    assert dropped or name.startswith("proxqp")  # which runs into its cap
    assert solver.solve(qp).status is SOLVED
    assert calls[-1] == ("_set_up" if dropped else "_update")

    def spoilt(*given):
        answer = run(*given)
        return answer._replace(**{what: np.full_like(getattr(answer, what), np.nan)})

    def interrupted(*given):
        raise KeyboardInterrupt

    for what in ("x", "duals", None):
        with monkeypatch.context() as context:
            context.setattr(type(solver), "_run", spoilt if what else interrupted)
            if what:
                failed = solver.solve(qp).status is SolveStatus.FAILED
                assert failed == (what == "x")
            else:
                with pytest.raises(KeyboardInterrupt):
                    solver.solve(qp)
        assert not solver._workspaces
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-5)


class Kept(NativeSolver):
    """Remembers the multipliers that it is started with."""

    package, style = "numpy", QPStyle("dense")

    def __init__(self, warm_start):
        super().__init__(SolverOptions(max_iterations=1, warm_start=warm_start))
        self.starts = []

    def _set_up(self, layout):
        return None

    def _run(self, handle, layout, start, duals):
        self.starts.append(None if duals is None else duals.tolist())
        return NativeAnswer(np.zeros(layout.size), np.arange(1.0, 13.0), False, True, 1, "")


def test_multipliers_move_with_the_trajectory():
    qp, found = sample(4, 2, 1, bounds="all", sides="two"), np.arange(1.0, 13.0)
    for count in [0, 1, 3, 4]:
        solver, cold = Kept(True), Kept(False)
        solver.shift()  # before anything is kept
        for one in (solver, cold):
            one.solve(qp)
            for _ in range(count):
                one.shift()
            one.solve(qp)
            one.solve(qp)
        moved = [*found[2 * count : 8], *[0.0] * 2 * count, *found[8 + count :], *[0.0] * count]
        assert solver.starts == [None, None if count == 4 else moved, found.tolist()]
        assert cold.starts == [None] * 3


def test_multipliers_and_active_sets_of_the_last_solve_save_iterations():
    qp = sample(12, 3, 2, bounds="all", sides="two", push=5.0)
    for name in {"osqp", "daqp"} & set(NATIVE):
        counts, best = {}, create(name, TIGHT).solve(qp).d if name == "osqp" else None
        for warm in (True, False):
            solver = create(name, SolverOptions(absolute_tolerance=1e-6, warm_start=warm))
            counts[warm] = [solver.solve(qp, best).iterations for _ in range(3)]
        # osqp looks at its residuals after 25 iterations for the first time.
        assert counts[True][1:] == [25 if name == "osqp" else 1] * 2
        assert counts[False][0] > 20 + 5 * (name == "osqp")
        assert len(set(counts[False])) == 1  # nothing is left of a solve


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
    for start in (best + 100.0, np.where(best > 0, 1e6, -1e6)):
        np.testing.assert_allclose(solver.solve(qp, start).d, best, atol=1e-6)


@pytest.mark.parametrize("name", [*NATIVE, *sorted({"qpsolvers:daqp", "quadprog"} & {*EVERY})])
def test_a_solve_leaves_no_memory_behind(name):
    solver, (qp, _) = create(name), make(**CASES["boxes"])

    def held_after(solves):
        for _ in range(solves):
            assert solver.solve(qp).d is not None
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = held_after(60)
        assert held_after(300) - before < 40_000  # bytes: no array a solve
    finally:
        tracemalloc.stop()
