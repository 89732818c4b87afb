"""A QP that is held by the entries of H that may be other than 0."""

import pickle

import numpy as np
import pytest

from qpmhe_solvers import SolveStatus, create
from qpmhe_solvers.errors import InvalidInputError
from qpmhe_solvers.qp import band_of
from qpmhe_solvers.sparse_qp import Pattern, SparseQP


def random_qp(seed, stages=5, n=9):
    """With a random pattern of the states; its blocks are those of a sum of squares."""
    generator = np.random.default_rng(seed)
    there = generator.uniform(size=(n, n)) < generator.uniform(0.0, 0.5)
    A = np.where(there, generator.normal(size=(stages, n, n)), 0.0)
    own = A.transpose(0, 2, 1) @ A + np.eye(n)
    own[1:] += np.eye(n)
    columns = np.concatenate((own, -A), axis=1)
    columns[-1, n:] = 0.0
    panels = band_of(columns)
    pattern = Pattern(n, np.flatnonzero((panels != 0.0).any(axis=0)))
    qp = SparseQP(stages, pattern, pattern.order_by_states(stages))
    qp.band = panels.reshape(stages, -1)[:, pattern.places]
    qp.gradient = generator.normal(size=(stages, n))
    return qp, panels


@pytest.mark.parametrize("seed", range(12))
def test_it_is_the_qp_with_all_entries(seed):
    qp, panels = random_qp(seed)
    full = qp.full()
    assert np.array_equal(full.band, panels)
    assert np.array_equal(qp.dense(), full.dense())
    assert np.array_equal(qp.diagonal, full.diagonal)
    d = np.random.default_rng(seed).normal(size=(qp.stages, qp.n))
    assert qp.hessian_times(d) == pytest.approx(full.hessian_times(d), rel=1e-12, abs=1e-12)
    assert qp.objective(d) == pytest.approx(full.objective(d))
    for other in qp.copy(), pickle.loads(pickle.dumps(qp)):
        assert np.array_equal(other.dense(), qp.dense())
        assert np.array_equal(other.gradient, qp.gradient)


@pytest.mark.parametrize("backend", ["auto", "banded", "piqp", "clarabel"])
@pytest.mark.parametrize("seed", range(4))
def test_all_backends_solve_it(seed, backend):
    qp, _ = random_qp(seed)
    solution = create(backend).solve(qp)
    expected = np.linalg.solve(qp.dense(), -qp.gradient.ravel()).reshape(qp.stages, qp.n)
    tolerance = 1e-11 if backend in ("auto", "banded") else 1e-5
    assert solution.status is SolveStatus.SOLVED
    assert solution.d == pytest.approx(expected, rel=tolerance, abs=tolerance)


def test_one_solver_takes_both_kinds_in_turn():
    solver = create("banded")
    for seed in (0, 1, 0, 2):
        qp, _ = random_qp(seed, n=41)
        for one in qp, qp.full(), qp:
            expected = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
            assert solver.solve(one).d.ravel() == pytest.approx(expected, rel=1e-10, abs=1e-12)


def test_a_singular_one_fails():
    qp, _ = random_qp(3)
    qp.band[...] = 0.0
    assert create("auto").solve(qp).status is SolveStatus.FAILED
    qp.band[...] = np.nan
    assert create("auto").solve(qp).status is SolveStatus.FAILED


def test_what_is_no_qp_is_refused():
    with pytest.raises(InvalidInputError, match="expected a qpmhe"):
        create("banded").solve(np.eye(3))
