"""Where X, W and V bind, the converged sequence of QPs reaches Ipopt's constrained minimum."""

from functools import cache

import pytest

import qpmhe
from qpmhe import Status

from .systems import SYSTEMS

pytest.importorskip("casadi")
from qpmhe.studies.ipopt import IpoptEstimator

CASES = [(name, kind) for name, make in SYSTEMS.items() for kind in make().sets]
BACKENDS = [
    name
    for name in ("daqp", "piqp", "clarabel", "quadprog", "proxqp", "osqp")
    if name in qpmhe.solvers.available()
]
# Among their windows are some in which a step along a curved boundary needs several
# corrections, from a trajectory that lies on it already.
SEEDS = (11, 26, 31, 40)
STEPS = 10
BINDS = 1e-6


@cache
def minima(name, kind, seed):
    """Ipopt's estimates of a record."""
    case = SYSTEMS[name]()
    parts, common = case.parts(kind)
    ipopt = IpoptEstimator(*parts, **case.symbolic(), **common, tolerance=1e-10)
    return [ipopt.update(y) for y in case.record(seed, STEPS)]


def windows(name, kind, seed):
    """Of each window in which Ipopt gets below the candidate's cost: its data and minimum."""
    case = SYSTEMS[name]()
    Y = case.record(seed, STEPS)
    return [
        (t, Y[max(0, t + 1 - case.horizon) : t + 1], minimum)
        for t, minimum in enumerate(minima(name, kind, seed)) if minimum.improved
    ]


def check(name, kind, seed, backend, converged=False):
    case = SYSTEMS[name]()
    parts, common = case.parts(kind)
    mhe = qpmhe.MovingHorizonEstimator(
        *parts, **common, backend=backend, max_qps=None, solver_tolerance=1e-9
    )
    estimates = [mhe.update(y) for y in case.record(seed, STEPS)]
    wrong = []
    for t, Y, minimum in windows(name, kind, seed):
        ours = estimates[t]
        assert ours.dropped == ()
        assert ours.candidate_cost == pytest.approx(minimum.candidate_cost, rel=1e-13)
        J, margins = case.judged(kind, ours.trajectory, ours.candidate[0], Y)
        assert ours.cost == pytest.approx(J, rel=1e-9)
        assert min(margins) >= -1e-8
        reached = abs(ours.cost - minimum.cost) <= 1e-6 * minimum.cost
        if not reached or (converged and Status.CONVERGED not in ours.status):
            wrong.append(f"{t}: {ours.cost:.8g}, not {minimum.cost:.8g}, {ours.status!s}")
    assert not wrong


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_convergence_is_ipopts_constrained_minimum(name, kind):
    for seed in SEEDS:
        check(name, kind, seed, "auto", converged=True)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_backends_reach_the_constrained_minimum(name, kind, backend):
    check(name, kind, SEEDS[0], backend)


def test_the_sets_bind_at_the_minima():
    """Otherwise the tests above would show little."""
    bound = [0, 0, 0]
    for name, kind in CASES:
        case, kept, share = SYSTEMS[name](), 0, 0
        for seed in SEEDS:
            for _, Y, minimum in windows(name, kind, seed):
                assert minimum.message == "Solve_Succeeded"
                _, margins = case.judged(kind, minimum.trajectory, minimum.candidate[0], Y)
                assert min(margins) >= -1e-8
                kept += 1
                share += min(margins) < BINDS
                bound = [many + (one < BINDS) for many, one in zip(bound, margins, strict=True)]
        assert kept >= 0.5 * STEPS * len(SEEDS)
        assert share >= 0.25 * kept
    assert min(bound) >= 50
