import copy
import pickle

import numpy as np
import pytest
import scipy.sparse

from qpmhe_solvers import QP, SolverOptions, SolveStatus, backends, create
from qpmhe_solvers.layout import Layout, Structure, Style
from qpmhe_solvers.native import NativeSolver
from qpmhe_solvers.qp import Places
from qpmhe_solvers.sample_qps import contradiction, sample

from .problems import CASES, make, of_order_one
from .test_dispatch import SparseCount, growth, patterns

NATIVE = [
    entry.name for entry in backends()
    if entry.available and entry.keeps_workspace and entry.name not in ("auto", "banded")
]
STYLES = {
    "osqp": Style("csc", triangle="upper", bounds="rows", equalities="among"),
    "clarabel": Style(
        "csc", triangle="upper", bounds="rows", equalities="among", sides=1, infinite=False
    ),
    "piqp": Style("csc", triangle="upper", infinite=False),
    "proxqp": Style("dense"),
    "daqp": Style("dense", equalities="among"),
    "proxqp_sparse": Style("csc", bounds="rows"),
}


def laid_out(style, qp):
    layout = Layout(style, Structure.of(qp), *qp.sizes)
    layout.fill(qp, layout.voids(qp))
    return layout


def full(matrix):
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


def limits(layout, dense):
    """The tightest limits that the layout puts on each constraint, checking every row."""
    normals = np.vstack((np.eye(layout.size), dense.matrix))
    low, high = np.full((2, layout.count), [[-np.inf], [np.inf]])

    def impose(row, lower, upper, constraint, sign=1.0):
        if not row.any():  # void: 0 lies between its limits
            assert lower <= 0.0 <= upper
            return
        np.testing.assert_array_equal(row, sign * normals[constraint])
        if sign < 0:
            lower, upper = -upper, -lower
        low[constraint] = max(low[constraint], lower)
        high[constraint] = min(high[constraint], upper)

    matrix, one_sided = full(layout.matrix), layout.style.sides == 1
    equal = np.count_nonzero(layout.structure.equal)
    for k, row in enumerate(matrix):
        upper = layout.upper[k]
        lower = -np.inf if one_sided else layout.lower[k]
        if one_sided and k < equal:
            lower = upper
        impose(row, lower, upper, layout.constraints[k], layout.signs[k])
    for row, level, constraint in zip(
        full(layout.equality_matrix), layout.level, layout.equalities, strict=True
    ):
        impose(row, level, level, constraint)
    if layout.boxed:
        low[: layout.size] = np.maximum(low[: layout.size], layout.box_lower)
        high[: layout.size] = np.minimum(high[: layout.size], layout.box_upper)
    return low, high


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("case", CASES)
def test_a_layout_is_that_of_plain_loops(case, style):
    for seed in range(2):
        qp, dense = make(**CASES[case], seed=seed)
        layout = laid_out(STYLES[style], qp)
        hessian = full(layout.hessian)
        if STYLES[style].triangle == "upper":
            hessian = hessian + np.triu(hessian, 1).T
        np.testing.assert_array_equal(hessian, dense.hessian)
        np.testing.assert_array_equal(layout.gradient, dense.gradient)
        low, high = limits(layout, dense)
        np.testing.assert_array_equal(low, np.concatenate((dense.lower, dense.row_lower)))
        np.testing.assert_array_equal(high, np.concatenate((dense.upper, dense.row_upper)))
        assert layout.equalities.size == (
            np.count_nonzero(layout.structure.equal) * (STYLES[style].equalities == "apart")
        )
        np.testing.assert_array_equal(
            layout.all_upper, np.concatenate((layout.box_upper, layout.upper))
        )


@pytest.mark.parametrize("style", STYLES)
def test_a_layout_has_room_for_missing_measurements(style):
    qp, _ = make(7, 3, 2, bounds="part", sides="two")
    layout = laid_out(STYLES[style], qp)
    for stage in range(6):
        other, dense = make(7, 3, 2, bounds="part", sides="two")
        other.row_lower[stage, 1], other.row_upper[stage, 1] = -np.inf, np.inf
        dense.row_lower, dense.row_upper = other.row_lower.ravel(), other.row_upper.ravel()
        assert Structure.of(other).key == Structure.of(qp).key
        for source in (other, qp, other):  # nothing is left of the one before
            layout.fill(source, layout.voids(source))
        low, high = limits(layout, dense)
        np.testing.assert_array_equal(low[21:], dense.row_lower)
        np.testing.assert_array_equal(high[21:], dense.row_upper)


@pytest.mark.parametrize("style", STYLES)
def test_multipliers_go_back_to_their_constraints(style):
    qp, _ = make(**CASES["all kinds"])
    layout = laid_out(STYLES[style], qp)
    rng = np.random.default_rng(0)
    rows, equal = (rng.standard_normal(one.size) for one in (layout.constraints, layout.equalities))
    box = rng.standard_normal(qp.size) if layout.boxed else None
    wanted = np.zeros(layout.count)
    for value, constraint, sign in zip(rows, layout.constraints, layout.signs, strict=True):
        wanted[constraint] += sign * value
    wanted[layout.equalities] += equal
    if box is not None:
        wanted[: qp.size] += box
    np.testing.assert_array_equal(layout.duals(rows, equal, box), wanted)


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


@pytest.mark.parametrize("name", NATIVE)
def test_a_structure_is_set_up_once(name, monkeypatch):
    solver, calls = watched(name, monkeypatch)
    for seed in range(6):
        qp = sample(7, 3, 2, bounds="all", sides="two", seed=seed)
        qp.row_lower[seed, 0], qp.row_upper[seed, 0] = -np.inf, np.inf
        assert solver.solve(qp).status is SolveStatus.SOLVED
    assert calls == ["_set_up"] + ["_update"] * 5


@pytest.mark.parametrize("name", NATIVE)
def test_qps_of_other_weights_have_a_workspace_of_their_own(name, monkeypatch):
    # What was scaled for a projection, or found by it, spoils the QPs before and after it.
    one = sample(6, 2, 1, bounds="all", sides="two")
    other = sample(6, 2, 1, bounds="all", sides="two", seed=1)
    for array in (other.band, other.gradient):
        array *= 1e6
    solver, calls = watched(name, monkeypatch)
    alone = create(name)
    for _ in range(3):
        first = solver.solve(one)
        assert first.status is SolveStatus.SOLVED
        assert first.iterations == alone.solve(one).iterations
        solver.solve(other)
    assert len(solver._workspaces) == 2
    assert calls.count("_set_up") == 3  # one of them for the solver that met no other QP


@pytest.mark.parametrize("name", NATIVE)
def test_few_structures_are_kept(name, monkeypatch):
    solver, calls = watched(name, monkeypatch)
    for _ in range(2):
        for stages in (3, 4, 5, 6):
            solver.solve(sample(stages, 2))
    assert calls == ["_set_up"] * 4 + ["_update"] * 4
    solver.solve(sample(7, 2))
    assert len(solver._workspaces) == 4
    calls.clear()
    for stages in (4, 5, 6, 7, 3):  # the longest unused one went
        solver.solve(sample(stages, 2))
    assert calls == ["_update"] * 4 + ["_set_up"]


@pytest.mark.parametrize("name", NATIVE)
def test_patterns_that_are_known_do_not_pile_up(name):
    solver = create(name)
    rng = np.random.default_rng(0)
    for _ in range(70):
        qp = sample(8, 2, bounds="all", push=0.1)
        qp.lower[rng.random(qp.lower.shape) < 0.5] = -np.inf
        assert solver.solve(qp).status is SolveStatus.SOLVED
    assert len(solver._known) <= 64
    assert len(solver._workspaces) <= 4


@pytest.mark.parametrize("name", NATIVE)
def test_no_solver_writes_into_what_it_is_handed(name):
    # Indices, and the zeros of dense arrays, are never written again.
    for case in CASES.values():
        solver = create(name)
        for seed in range(3):
            qp, _ = of_order_one(make(**case, seed=seed)[0])
            solver.solve(qp, np.full((qp.stages, qp.n), 0.1))
            if not solver._workspaces:
                continue
            (kept, *_) = list(solver._workspaces.values())[::-1]
            fresh = laid_out(solver.style, qp)
            for one in ("hessian", "matrix", "equality_matrix", "all_upper", "all_lower"):
                ours, theirs = getattr(kept.layout, one), getattr(fresh, one)
                if scipy.sparse.issparse(ours):
                    for part in ("data", "indices", "indptr"):
                        np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part))
                else:
                    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("name", NATIVE)
def test_sparse_matrices_are_made_once_for_a_structure(name, monkeypatch):
    qp, _ = make(**CASES["all kinds"])
    solver, count = create(name), SparseCount(monkeypatch)
    solver.solve(qp)
    count.made = 0
    for _ in range(3):
        qp.gradient[...] += 0.1
        assert solver.solve(qp).status is SolveStatus.SOLVED
    assert count.made == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", NATIVE)
def test_our_part_leaves_no_memory_behind(name):
    solver, qps = create(name), patterns(12)
    for qp in qps:
        solver.solve(qp)
    held = {id(one.layout) for one in solver._workspaces.values()}
    assert len(held) <= 4
    assert growth(create(name), [make(**CASES["boxes"])[0]], 300) < 40_000


@pytest.mark.parametrize("way", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
@pytest.mark.parametrize("name", [*NATIVE, "auto"])
def test_a_copy_of_a_used_solver_begins_anew(name, way):
    qp, _ = make(**CASES["all kinds"])
    solver = create(name, SolverOptions(absolute_tolerance=1e-9))
    solver.solve(qp)
    copied = way(solver)
    assert copied.options == solver.options
    if name != "auto":
        assert copied._workspaces == {}
    for _ in range(2):
        qp.gradient[...] *= -1.5
        wanted = create(name, SolverOptions(absolute_tolerance=1e-9)).solve(qp).d
        np.testing.assert_allclose(copied.solve(qp).d, wanted, rtol=0, atol=1e-6)
        np.testing.assert_allclose(solver.solve(qp).d, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", NATIVE)
def test_a_workspace_that_failed_is_dropped(name, monkeypatch):
    solver, calls = watched(name, monkeypatch, SolverOptions(max_iterations=200))
    good = sample(6, 2, 2, sides="two", seed=9)
    assert solver.solve(good).status is SolveStatus.SOLVED
    assert solver.solve(contradiction()).status is not SolveStatus.SOLVED
    dropped = not solver._workspaces
    assert dropped or name.startswith("proxqp")  # which runs into its cap
    assert solver.solve(good).status is SolveStatus.SOLVED
    assert calls[-1] == ("_set_up" if dropped else "_update")


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt])
@pytest.mark.parametrize("name", NATIVE)
def test_a_workspace_that_raised_is_dropped(name, error, monkeypatch):
    solver, qp = create(name), sample(6, 2, bounds="all")
    wanted = solver.solve(qp)

    def raising(*given):
        raise error("stop")

    with monkeypatch.context() as context:
        context.setattr(type(solver), "_run", raising)
        if error is KeyError:
            assert solver.solve(qp).status is SolveStatus.FAILED
        else:
            with pytest.raises(KeyboardInterrupt):
                solver.solve(qp)
    assert not solver._workspaces
    np.testing.assert_allclose(solver.solve(qp).d, wanted.d, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", NATIVE)
def test_numbers_that_are_not_finite_are_not_kept(name, monkeypatch):
    solver, qp = create(name), sample(6, 2, bounds="all")
    run = type(solver)._run
    for part in ("x", "duals"):
        with monkeypatch.context() as context:
            context.setattr(
                type(solver), "_run",
                lambda *given, part=part: run(*given)._replace(**{part: np.full(12, np.nan)}),
            )
            solver.solve(qp)
        assert not solver._workspaces
        assert solver.solve(qp).status is SolveStatus.SOLVED


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
        from qpmhe_solvers.native import Answer

        self.starts.append(None if duals is None else duals.copy())
        told = np.arange(1.0, layout.count + 1.0)
        return Answer(np.zeros(layout.size), told, False, True, 1, "")


def test_multipliers_move_with_the_trajectory():
    qp = sample(4, 2, 1, bounds="all", sides="two")
    told = np.arange(1.0, 13.0)  # eight bounds, four rows

    def moved(stages):
        bounds, rows = np.zeros(8), np.zeros(4)
        for k in range(4 - stages):
            bounds[2 * k : 2 * k + 2] = told[2 * (k + stages) : 2 * (k + stages) + 2]
            rows[k] = told[8 + k + stages]
        return np.concatenate((bounds, rows))

    for count in range(4):
        solver = Kept()
        solver.shift()  # before anything is kept
        solver.solve(qp)
        for _ in range(count):
            solver.shift()
        solver.solve(qp)
        solver.solve(qp)
        assert solver.starts[0] is None
        np.testing.assert_array_equal(solver.starts[1], moved(count))
        np.testing.assert_array_equal(solver.starts[2], told)
    for _ in range(4):
        solver.shift()
    solver.solve(qp)
    assert solver.starts[-1] is None
    cold = Kept(SolverOptions(warm_start=False))
    cold.solve(qp)
    cold.solve(qp)
    assert cold.starts == [None, None]


def test_multipliers_of_the_last_solve_save_osqp_iterations():
    pytest.importorskip("osqp")
    qp = sample(12, 3, 2, bounds="all", sides="two", push=5.0)
    best = create("osqp", SolverOptions(absolute_tolerance=1e-9)).solve(qp).d
    counts = {}
    for warm in (True, False):
        solver = create("osqp", SolverOptions(absolute_tolerance=1e-6, warm_start=warm))
        counts[warm] = [solver.solve(qp, best).iterations for _ in range(3)]
    # With both at the solution there is nothing to do until the residuals are looked at.
    assert counts[True][1:] == [25, 25]
    assert counts[False][0] > 25
    assert len(set(counts[False])) == 1  # nothing is left of a solve


def test_the_active_set_of_the_last_solve_saves_daqp_iterations():
    pytest.importorskip("daqp")
    qp = sample(12, 3, 2, bounds="all", sides="two", push=5.0)
    for warm in (True, False):
        solver = create("daqp", SolverOptions(warm_start=warm))
        first, second = (solver.solve(qp).iterations for _ in range(2))
        assert first > 20
        assert second == (1 if warm else first)


def test_a_wrong_active_set_does_not_stop_daqp():
    # One unknown and two rows a stage: more active limits than unknowns cannot be.
    pytest.importorskip("daqp")
    solver = create("daqp", SolverOptions(absolute_tolerance=1e-9))
    for seed in range(30):
        qp, dense = make(8, 1, 2, bounds="part", sides="two", seed=seed)
        solution = solver.solve(qp)
        assert solution.status is SolveStatus.SOLVED, solution.message
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
    capped = SolverOptions(cap)
    for seed, push in enumerate((0.0, 0.1, 0.5, 1.0, 3.0)):
        qp = sample(4, 2, 1, bounds=bounds, sides=sides, push=push, seed=seed)
        needed = create("daqp").solve(qp).iterations
        native, generic = (
            create(name, capped).solve(qp) for name in ("daqp", "qpsolvers:daqp")
        )
        expected = SolveStatus.SOLVED if needed <= cap else SolveStatus.FAILED
        assert (native.status, generic.status) == (expected, expected)
        assert native.iterations == min(needed, cap)


OPTIONS = SolverOptions(
    max_iterations=17, absolute_tolerance=3e-6, relative_tolerance=4e-7, time_limit=2.5
)
SETTINGS = {
    "clarabel": (
        lambda handle: handle.get_settings(),
        {"max_iter": 17, "tol_gap_abs": 3e-6, "tol_feas": 3e-6, "tol_gap_rel": 4e-7,
         "time_limit": 2.5, "verbose": False},
    ),
    "daqp": (
        lambda handle: handle.settings,
        {"iter_limit": 18, "primal_tol": 3e-6, "dual_tol": 3e-6, "time_limit": 2.5},
    ),
    "osqp": (
        lambda handle: handle.settings,
        {"max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "time_limit": 2.5,
         "check_termination": 1, "verbose": 0},
    ),
}
for one in ("piqp", "piqp_dense", "proxqp", "proxqp_sparse"):
    SETTINGS[one] = (
        lambda handle: handle.settings,
        {"max_iter": 17, "eps_abs": 3e-6, "eps_rel": 4e-7, "eps_duality_gap_abs": 3e-6,
         "eps_duality_gap_rel": 4e-7, "check_duality_gap": True},
    )


@pytest.mark.parametrize("name", NATIVE)
def test_every_option_reaches_the_solver(name):
    solver = create(name, OPTIONS)
    solver.solve(sample(6, 2, 1, bounds="all", sides="mixed"))
    (workspace,) = solver._workspaces.values()
    read, wanted = SETTINGS[name]
    settings = read(workspace.handle)
    for key, value in wanted.items():
        given = settings[key] if isinstance(settings, dict) else getattr(settings, key)
        assert given == value, key


def test_osqp_looks_at_its_residuals_in_time():
    pytest.importorskip("osqp")
    for cap, expected in ((24, 1), (25, 25), (None, 25)):
        solver = create("osqp", SolverOptions(cap))
        solver.solve(sample(6, 2))
        (workspace,) = solver._workspaces.values()
        assert workspace.handle.settings.check_termination == expected


def test_piqp_factorises_by_stages():
    pytest.importorskip("piqp")
    solver = create("piqp")
    solver.solve(sample(6, 2))
    (workspace,) = solver._workspaces.values()
    assert workspace.handle.settings.kkt_solver.name == "sparse_multistage"


@pytest.mark.parametrize("name", NATIVE)
def test_void_rows_do_not_make_a_solver_talk(name, capfd):
    solver = create(name)
    for stage in range(3):
        qp = sample(5, 2, 2, bounds="all", sides="two")
        qp.row_lower[stage], qp.row_upper[stage] = -np.inf, np.inf
        assert solver.solve(qp).status is SolveStatus.SOLVED
    assert capfd.readouterr() == ("", "")


def test_all_numbers_of_a_qp_are_in_one_array():
    qp, _ = make(**CASES["all kinds"])
    for one in (qp, qp.copy(), pickle.loads(pickle.dumps(qp)), copy.deepcopy(qp)):
        one.gradient = np.asfortranarray(one.gradient + 1.0)  # is written, not exchanged
        one.row_lower -= 0.5
        places = Places.of(*one.sizes)
        np.testing.assert_array_equal(one.all_lower, np.append(one.lower, one.row_lower))
        np.testing.assert_array_equal(one.all_upper, np.append(one.upper, one.row_upper))
        np.testing.assert_array_equal(one.limits, np.append(one.all_lower, one.all_upper))
        assert one.numbers[places.one] == 1.0
        for start, array in (
            (0, one.band), (places.gradient, one.gradient), (places.own, one.row_own),
            (places.own + one.row_own.size, one.row_next),
        ):
            np.testing.assert_array_equal(one.numbers[start : start + array.size], array.ravel())


def test_faults_of_huge_numbers_are_not_made_up():
    qp = QP(2, 2, 1)
    qp.gradient[...] = 1e200  # whose squares overflow
    with np.errstate(all="ignore"):
        assert qp.fault() == ""
    qp.gradient[...] = 0.0
    qp.gradient[0, 0] = np.inf
    assert "not finite" in qp.fault()
    qp.gradient[0, 0], qp.row_upper[0] = 0.0, np.nan
    assert "not finite" in qp.fault()
    qp.gradient[...], qp.row_upper[0] = 0.0, -np.inf
    assert qp.fault() == ""
    qp.row_lower[0] = 0.0
    assert "a lower bound is above its upper bound" in qp.fault()
