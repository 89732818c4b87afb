"""QPs in any unit: what a solver is handed, and what comes back, do not depend on it."""

import numpy as np
import pytest

from qpmhe_solvers import QP, SolverOptions, SolveStatus, create
from qpmhe_solvers.sample_qps import sample
from qpmhe_solvers.scaling import Scaling

from .problems import CASES, EVERY, TIGHT, WITH_INEQUALITIES, in_units, make, of_order_one

# Methods of first order, and those that look at other residuals than ours, are less accurate.
ACCURACY = {"scs": 1e-4, "ecos": 1e-4, "qpsolvers:piqp": 1e-4, "qpsolvers:proxqp": 1e-4}
SOLVED = SolveStatus.SOLVED
ALL_KINDS = CASES["all kinds"]


def units(rng, qp, base=10.0):
    """Units of the unknowns, the cost and the rows, decades apart."""
    return [base ** rng.integers(-9, 10, size) for size in (qp.n, None, qp.rows)]


@pytest.mark.parametrize("name", EVERY)
def test_any_unit_gives_the_same_solution(name):
    for case in CASES if name != "banded" else ["no inequality", "equality rows"]:
        rng = np.random.default_rng(len(case))
        qp, dense = make(**CASES[case])
        best = dense.minimiser().reshape(qp.stages, qp.n)
        for _ in range(2):
            states, cost, rows = units(rng, qp)
            solution = create(name, TIGHT).solve(in_units(qp, states, cost, rows))
            assert solution.status is SOLVED or name == "ecos", solution.message
            if name == "banded":  # a bound that is missed is missed in any unit
                missed = in_units(qp, states, cost, rows)
                missed.upper[2, 1], missed.bounded = solution.d[2, 1] - 0.1 * states[1], True
                assert create(name).solve(missed).status is SolveStatus.UNCONSTRAINED
            accuracy = ACCURACY.get(name, 1e-5) * max(1.0, np.abs(best).max())
            np.testing.assert_allclose(solution.d / states, best, rtol=0, atol=accuracy)


@pytest.mark.parametrize("name", EVERY)
def test_powers_of_two_change_not_a_bit(name):
    for case in ("no inequality", "all kinds", "badly scaled"):
        if name == "auto" and case != "no inequality":
            continue  # it may ask banded first
        rng = np.random.default_rng(len(case))
        qp, _ = make(**CASES[case])
        if name == "banded":  # which takes QPs as they are, and pivots where there are equalities
            qp, _ = make(**{**CASES[case], "sides": "two" if qp.rows else "none"})
        plain = create(name).solve(qp)
        for _ in range(2):
            states, cost, rows = units(rng, qp, 2.0)
            solution = create(name).solve(in_units(qp, states, cost, rows))
            assert (solution.status, solution.iterations) == (plain.status, plain.iterations)
            if name.endswith("proxqp"):  # which rounds as its memory happens to be aligned
                np.testing.assert_allclose(solution.d, plain.d * states, rtol=1e-9)
                continue
            np.testing.assert_array_equal(solution.d, plain.d * states)
            if plain.bound_duals is not None and plain.row_duals is not None:
                bounds = plain.bound_duals.reshape(qp.stages, qp.n) * cost / states
                np.testing.assert_array_equal(solution.bound_duals, bounds.ravel())
                pushes = plain.row_duals.reshape(qp.stages, -1) * cost / rows
                np.testing.assert_array_equal(solution.row_duals, pushes.ravel())
            if plain.residuals is not None and case != "no inequality":
                assert solution.residuals.gap == plain.residuals.gap * cost


def test_a_solver_is_handed_numbers_of_order_one():
    rng, (qp, _) = np.random.default_rng(3), make(**ALL_KINDS)
    for _ in range(10):
        seen, _ = of_order_one(in_units(qp, *units(rng, qp)))
        diagonal = seen.band[:, :, 0]
        assert ((diagonal.max(axis=0) >= 0.5) & (diagonal.max(axis=0) < 2.0)).all()
        following = np.abs(seen.row_next[:-1]).max(axis=(0, 2))
        peaks = np.maximum(np.abs(seen.row_own).max(axis=(0, 2)), following)
        assert ((peaks >= 0.5) & (peaks < 1.0)).all()
        slope, step = np.abs(seen.gradient), np.abs(seen.gradient / diagonal)
        assert 0.5 <= min(slope.max(), step.max()) < 1.0
        again, _ = of_order_one(seen)
        np.testing.assert_array_equal(again.numbers, seen.numbers)


def test_a_scale_is_held_while_it_fits():
    scaling, (qp, _) = Scaling(held=True), make(**ALL_KINDS)
    first = scaling.scale(qp)
    gradient, band = qp.gradient.copy(), qp.band.copy()
    for factor in (1.0, 0.01, 3.0, 0.0):
        qp.gradient[...] = factor * gradient
        qp.lower[...] = qp.row_lower[...] = -1.0
        assert scaling.scale(qp) is first
    qp.band[...] = 1e-4 * band
    assert scaling.scale(qp) is not first
    qp.gradient[...], qp.band[...] = gradient, band
    assert scaling.scale(qp) is first  # both stay at hand
    scaling.forget()
    assert scaling.scale(qp) is not first
    qp, scaling = QP(3, 2, 1), Scaling(held=True)
    qp.band[:, :, 0] = 1.0
    first = scaling.scale(qp)
    qp.gradient[...] = 1.0  # a unit that only zeros set is not held
    assert scaling.scale(qp) is not first


@pytest.mark.parametrize("name", EVERY)
def test_nothing_is_left_of_other_scales_after_forget(name):
    qp, _ = make(**ALL_KINDS)
    other = in_units(qp, np.array([1.0, 3.0, 0.2]), 20.0, np.array([5.0, 0.3]))
    used, fresh = (create(name, SolverOptions(max_iterations=4)) for _ in range(2))
    used.solve(other)
    used.forget()
    one, two = used.solve(qp), fresh.solve(qp)
    assert one.status is two.status
    if one.d is not None:  # compiled code may round by the place of its arrays in memory
        np.testing.assert_allclose(one.d, two.d, rtol=0, atol=1e-13)
    for size in (1e-300, 1e200):  # numbers of any size are contained
        qp.band, qp.gradient = size * other.band, size * other.gradient
        solution = create(name, SolverOptions(max_iterations=50)).solve(qp)
        assert solution.d is None or np.isfinite(solution.d).all()


def test_a_stage_that_is_known_least_is_solved_for_beside_others():
    # As the last state, which no measurement sees, beside very accurate ones.
    qp = QP(3, 1)
    qp.bounded = False
    qp.band[:, 0, 0] = 1e8, 1e8, 1e-2
    qp.gradient[:, 0] = 7e13, 7e13, 7e3
    for name in {"piqp", "clarabel", "daqp", "quadprog"} & set(EVERY):
        np.testing.assert_allclose(create(name).solve(qp).d, -7e5, rtol=1e-3)


def test_a_badly_scaled_qp_does_not_end_the_process():
    # Handed over as it is, highs ends its process at this one.
    pytest.importorskip("highspy")
    qp, _ = make(2, 3, 2, seed=406, bounds="all", sides="mixed")
    qp = in_units(qp, np.array([1e-8, 1.0, 1e9]), 0.01, np.array([1.0, 1e-8]))
    assert create("highs", SolverOptions(time_limit=10.0), isolated=True).solve(qp).status is SOLVED


def impossible(far):
    """An infeasible QP that asks for far more than the good ones: rows that exclude each other."""
    qp = sample(6, 2, 2, bounds="all", sides="two", seed=8)
    qp.row_own[2], qp.row_next[2] = 1.0, 0.0
    qp.row_lower[2], qp.row_upper[2] = [far, -2.0 * far], [2.0 * far, -far]
    return qp


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_an_infeasible_qp_leaves_no_scale_to_the_next_one(name):
    """In its units the next QP's tolerance is loose: PIQP called errors of 2e-3 solved."""
    for far in (50.0, 300.0, 1000.0):
        for push in (1.0, 0.1, 0.03):
            qp = sample(6, 2, 2, bounds="all", sides="two", seed=9, push=push)
            solver, fresh = create(name), create(name)
            assert solver.solve(impossible(far)).status is not SolveStatus.SOLVED
            found, wanted = solver.solve(qp), fresh.solve(qp)
            assert found.status is wanted.status
            # Two fresh solvers of ProxQP may differ in the last digits.
            np.testing.assert_allclose(found.d, wanted.d, rtol=0, atol=1e-7)


def test_a_cap_keeps_the_scale_of_what_it_stops():
    """There such answers are usual, and the next QP starts from the last multipliers."""
    pytest.importorskip("osqp")
    solver = create("osqp", SolverOptions(max_iterations=3))
    for seed in range(3):
        qp = sample(6, 2, 2, bounds="all", sides="two", push=1.0 + 0.01 * seed)
        assert solver.solve(qp).status is SolveStatus.STOPPED
    assert len(solver._workspaces) == 1
