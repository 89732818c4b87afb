"""The active set on the banded factorisation: exact, whatever set it begins with."""

import numpy as np
import pytest

from qpmhe_solvers import QP, Backend, SolverOptions, SolveStatus, create
from qpmhe_solvers.native import NATIVE
from qpmhe_solvers.qp import ARRAYS

from .problems import make
from .test_backends import check_optimal

SOLVED = SolveStatus.SOLVED
KINDS = [
    {"bounds": "all"}, {"rows": 2, "sides": "mixed"},
    {"bounds": "all", "rows": 2, "sides": "mixed"},
    {"bounds": "part", "rows": 1, "sides": "equal"}, {"bounds": "all", "rows": 3, "sides": "two"},
]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_it_finds_the_solution_from_the_active_set_of_another_qp(kind):
    solver, exchanges = create("active_set"), []
    for seed in range(12):
        qp, dense = make(7, 3, seed=seed, decades=seed % 4, **kind)
        found = solver.solve(qp)
        expected = dense.minimiser()
        assert found.status is SOLVED, (seed, found.message)
        np.testing.assert_allclose(found.d.ravel(), expected, atol=1e-8 * np.abs(expected).max())
        check_optimal("active_set", qp, dense, found)
        again = solver.solve(qp)
        assert (again.status, again.iterations) == (SOLVED, 0)
        np.testing.assert_allclose(again.d, found.d, atol=1e-12 * np.abs(expected).max())
        exchanges.append(found.iterations)
    assert max(exchanges) >= 2


def moved(qp):
    """The same problem one stage later: stage k + 1 as stage k, the last one anew."""
    after = qp.copy()
    for name in ARRAYS:
        getattr(after, name)[:-1] = getattr(qp, name)[1:]
    return after


def test_a_shift_moves_the_set_that_it_begins_with():
    qp, _ = make(30, 2, bounds="all", seed=3)
    qp.band[:, :, 2:] = 0.0  # stages that do not depend on each other
    qp.band[:, 0, 1] = 0.0
    solver = create("active_set")
    cold = solver.solve(qp).iterations
    solver.shift()
    warm = solver.solve(moved(qp))
    solver.forget()
    forgotten = solver.solve(moved(qp))
    assert (cold >= 2, warm.iterations <= 1, forgotten.iterations >= 2) == (True, True, True)
    np.testing.assert_allclose(warm.d, forgotten.d, rtol=1e-10, atol=1e-10)
    cold_again = create("active_set", SolverOptions(warm_start=False))
    assert [cold_again.solve(qp).iterations for _ in range(2)] == [cold, cold]


def test_sets_of_two_sizes_are_kept_in_any_order():
    one, other = (make(12, n, bounds="all", seed=3)[0] for n in (2, 3))
    solver = create("active_set")
    assert min(solver.solve(qp).iterations for qp in (one, other)) >= 1
    assert [solver.solve(qp).iterations for qp in (one, one, other, other, one)] == [0] * 5


def test_new_limits_and_gradients_of_the_same_matrices_and_new_matrices():
    """One factorisation serves while H and the rows stay; a new solver gives the same answers."""
    solver, (qp, _) = create("active_set"), make(9, 3, 2, bounds="all", sides="two", seed=1)
    for name in ("gradient", "upper", "row_upper", "band", "row_own", "row_next"):
        qp = qp.copy()
        getattr(qp, name)[...] *= 1.1
        if name.endswith("upper"):
            low = getattr(qp, name.replace("upper", "lower"))
            getattr(qp, name)[...] = np.maximum(getattr(qp, name), low)
        found, fresh = solver.solve(qp), create("active_set").solve(qp)
        assert found.status is fresh.status is SOLVED
        np.testing.assert_allclose(found.d, fresh.d, atol=1e-11 * np.abs(fresh.d).max())


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-6])
def test_limits_twice_and_limits_without_a_feasible_point(unit):
    qp = QP(3, 2, 2)
    qp.band[:, :, 0] = 1.0 / unit**2
    qp.gradient = -2.0 / unit
    qp.upper[0] = unit
    qp.row_own[:, :, 0] = 1.0  # the same limit as a row, twice
    qp.row_upper[0] = unit
    for name in ("active_set", "auto"):
        found = create(name).solve(qp)
        assert found.status is SOLVED
        np.testing.assert_allclose(found.d, unit * np.array([[1, 1], [2, 2], [2, 2]]), rtol=1e-12)
    qp.row_lower[0] = 1.5 * unit
    qp.row_upper[0] = 2.0 * unit
    found = create("active_set").solve(qp)
    assert found.status is not SOLVED
    assert "infeasible" in found.message


def test_rows_of_zeros_and_equalities_that_repeat_others():
    """A constraint without a slope, at a point where its gradient vanishes."""

    def unconstrained():
        qp = QP(4, 2, 2)
        qp.band[:, :, 0] = 1.0
        qp.gradient = -2.0
        return qp

    for limit, word in ((1.0, ""), (-1e-13, ""), (-1.0, "infeasible")):
        qp = unconstrained()
        qp.row_upper[1, 0] = limit
        qp.upper = 0.5
        found = create("active_set").solve(qp)
        assert (found.status is SOLVED) == (not word)
        assert word in found.message
        if not word:
            np.testing.assert_allclose(found.d, np.full((4, 2), 0.5))
    qp = unconstrained()
    qp.lower[0] = qp.upper[0] = 1.0
    qp.row_own[0, 0] = 1.0
    qp.row_lower[0, 0] = qp.row_upper[0, 0] = 2.0  # what both bounds say already
    found = create("active_set").solve(qp)
    assert found.status is SOLVED
    np.testing.assert_allclose(found.d, [[1, 1], [2, 2], [2, 2], [2, 2]])


@pytest.mark.parametrize("vague", [1e4, 1e8, 1e10])
def test_a_vague_first_stage_changes_no_digit_of_the_rest(vague):
    qp, _ = make(9, 3, 2, bounds="all", sides="two", seed=5)
    # Information of the first stage in one direction only: the others are known by 1/vague.
    qp.band[0, 1:, :] = 0.0
    qp.band[0, 0, 1:] = 0.0
    qp.band[0, 1:, 0] = 1.0 / vague
    qp.gradient[0, 1:] = 0.01 / vague
    qp.row_own[0], qp.row_next[0] = 0.0, 0.0
    qp.row_lower[0], qp.row_upper[0] = -1.0, 1.0
    found, exact = create("active_set").solve(qp), create("quadprog").solve(qp)
    assert found.status is SOLVED
    np.testing.assert_allclose(found.d[1:], exact.d[1:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        found.d[0, 1:], np.clip(-0.01, qp.lower[0, 1:], qp.upper[0, 1:]), rtol=1e-9
    )


def test_auto_takes_it_for_large_qps_and_an_interior_point_where_it_gives_up(monkeypatch):
    qp, dense = make(40, 2, bounds="all")
    asked = []
    for name, native in NATIVE.items():
        monkeypatch.setitem(NATIVE, name, Backend(
            name, lambda options, make=native.factory: asked.append(make) or make(options), "-",
            iterate_at_cap=True,
        ))
    check_optimal("auto", qp, dense, create("auto").solve(qp))
    assert asked == []
    monkeypatch.setattr("qpmhe_solvers.auto._EXCHANGES", 1)
    check_optimal("auto", qp, dense, create("auto").solve(qp))
    assert asked
