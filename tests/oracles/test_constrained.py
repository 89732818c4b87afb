"""Where X, W and V bind, the converged sequence of QPs reaches Ipopt's constrained minimum."""

from functools import cache

import pytest

import qpmhe
from qpmhe import Status
from tests.covering import covering

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
SEEDS = (11, 26, 31)
STEPS = 10


@cache
def minima(name, kind, seed):
    """Where Ipopt gets below the candidate's cost: time, the window's data, and its estimate."""
    case = SYSTEMS[name]()
    parts, common = case.parts(kind)
    ipopt = IpoptEstimator(*parts, **case.symbolic(), **common, tolerance=1e-10)
    Y, found = case.record(seed, STEPS), []
    for t, y in enumerate(Y):
        minimum = ipopt.update(y)
        if minimum.improved:
            assert minimum.message == "Solve_Succeeded"
            found.append((t, Y[max(0, t + 1 - case.horizon) : t + 1], minimum))
    return found


def check(name, kind, seed, backend, converged=False):
    """Compare with the minima; whether the free minimum is lower, of each."""
    case = SYSTEMS[name]()
    parts, common = case.parts(kind)
    options = {"backend": backend, "max_qps": None, "solver_tolerance": 1e-9, **common}
    mhe = qpmhe.MovingHorizonEstimator(*parts, **options)
    free = qpmhe.MovingHorizonEstimator(
        qpmhe.System(case.f, case.h, n=case.n, p=case.p), *parts[1:], **options
    )
    estimates = [(mhe.update(y), free.update(y)) for y in case.record(seed, STEPS)]
    wrong, binds = [], []
    for t, Y, minimum in minima(name, kind, seed):
        ours, unbound = estimates[t]
        assert ours.dropped == ()
        assert ours.candidate_cost == pytest.approx(minimum.candidate_cost, rel=1e-13)
        J, missed = case.window(kind, ours, Y).judged(ours.trajectory)
        assert ours.cost == pytest.approx(J, rel=1e-9)
        assert missed <= 1e-8
        binds.append(unbound.cost < minimum.cost * (1.0 - 1e-5))
        reached = abs(ours.cost - minimum.cost) <= 1e-6 * minimum.cost
        if not reached or (converged and Status.CONVERGED not in ours.status):
            wrong.append(f"{t}: {ours.cost:.8g}, not {minimum.cost:.8g}, {ours.status!s}")
    assert not wrong
    return binds


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_convergence_is_ipopts_constrained_minimum(name, kind):
    binds = [one for seed in SEEDS for one in check(name, kind, seed, "auto", converged=True)]
    assert len(binds) >= 0.5 * STEPS * len(SEEDS)
    assert sum(binds) >= 0.2 * len(binds)


@covering(strength=1, case=CASES, backend=BACKENDS)
def test_backends_reach_the_constrained_minimum(case, backend):
    check(*case, SEEDS[0], backend)
