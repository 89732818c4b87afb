"""The compiled step where sets bind: feasible, never above the candidate, and as good."""

import functools

import numpy as np
import pytest
from oracles.systems import SYSTEMS, around, reactor

import qpmhe
from qpmhe.codegen.compiler import find_compiler

casadi = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

Status, Box, Polytope = qpmhe.Status, qpmhe.Box, qpmhe.Polytope
STEPS, INF = 30, np.inf
CASES = [
    ("reactor", "box"), ("van_der_pol", "polytope"), ("stirred_tank", "polytope"),
    ("tracking", "box"),
]
cases = pytest.mark.parametrize(("name", "kind"), CASES)

# One kind of set at a time, with sides that are open.
PARTS = {
    "W box": (None, Box([-INF, -0.03], [0.02, INF]), None),
    "W rows": (None, around([0, 0], 0.05, 0.05), None),
    "V box": (None, None, Box(-1.2, 0.15)),
    "V rows": (None, None, Polytope([[1.0], [-1.0]], [0.15, 1.2])),
    "all open": (
        None, Box([-INF, -0.05], [0.05, INF]) & around([0, 0], 0.1, 0.1),
        Box(-1.2, INF) & Polytope([[1.0]], [0.3]),
    ),
}


@functools.cache
def case_of(name, kind):
    if name == "parts":
        case = reactor()
        case.sets = PARTS
    else:
        case = SYSTEMS[name]()
    _, disturbances, noises = case.sets[kind]
    system = qpmhe.from_casadi(
        **case.symbolic(), n=case.n, compiled=False, disturbances=disturbances, noises=noises,
    )
    return case, system


def estimator(name, kind, engine="compiled", cost=None, **options):
    case, system = case_of(name, kind)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(case.gain), cost or case.cost, horizon=case.horizon,
        initial_state=case.start, engine=engine, **options,
    )
    assert mhe.engine == engine
    return mhe


def violations(name, kind, estimate):
    """How far the estimate is outside of each set that was not dropped, by the definition."""
    case, _ = case_of(name, kind)
    x = estimate.trajectory
    w, v = x[1:] - case.f(x[:-1]), np.nan_to_num(estimate.noises)
    return [
        0.0 if one is None or label in estimate.dropped else one.violation(points)
        for label, one, points in zip(
            ("disturbances", "noises"), case.sets[kind][1:], (w, v), strict=True
        )
    ]


def promised(name, kind, estimate, Y, prior=None):
    """Insist on all that is promised of an estimate."""
    case, _ = case_of(name, kind)
    assert estimate.cost <= estimate.candidate_cost
    assert (Status.IMPROVED in estimate.status) != (Status.CANDIDATE in estimate.status)
    assert (Status.SETS_DROPPED in estimate.status) == bool(estimate.dropped)
    if Status.CANDIDATE_OUTSIDE not in estimate.status:
        assert max(violations(name, kind, estimate)) <= 1e-8
    P, Q, R = case.cost.prior, case.cost.disturbance, case.cost.noise
    x, window = estimate.trajectory, Y[estimate.time + 1 - len(estimate.noises) :]
    offset = x[0] - (estimate.candidate[0] if prior is None else prior)
    J = offset @ P @ offset
    for i in range(len(x) - 1):
        w, v = x[i + 1] - case.f(x[i]), window[i] - case.h(x[i])
        J += w @ Q @ w + v @ R @ v
    if Status.PROJECTED not in estimate.status:
        assert estimate.cost == pytest.approx(J, rel=1e-8)


def in_step(name, kind, seed=0, tolerance=1e-6, steps=STEPS, **options):
    """Run both engines on a record, compare, and give the compiled estimates."""
    case, _ = case_of(name, kind)
    Y, found = case.record(seed, steps), []
    one, other = (estimator(name, kind, engine, **options) for engine in ("python", "compiled"))
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        promised(name, kind, estimate, Y)
        assert estimate.dropped == expected.dropped
        assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
        assert estimate.cost == pytest.approx(expected.cost, rel=tolerance, abs=1e-9)
        found.append(estimate)
    return found


@pytest.mark.parametrize("max_qps", [2, None])
@pytest.mark.parametrize("outside", ["drop", "keep"])
@cases
def test_as_good_as_the_best_backend(name, kind, outside, max_qps):
    active = 0
    for seed in range(3):
        for estimate in in_step(name, kind, seed, outside=outside, max_qps=max_qps):
            active += estimate.solver_iterations > 0
            # The candidate is feasible for every QP: none is too hard.
            assert Status.SOLVER_STOPPED not in estimate.status
            assert Status.SOLVER_FAILED not in estimate.status
    assert active > 5


@pytest.mark.parametrize("kind", PARTS)
def test_sets_of_one_kind_and_open_sides(kind):
    active = 0
    for seed in range(3):
        for max_qps in (1, None):
            for estimate in in_step("parts", kind, seed, max_qps=max_qps):
                active += estimate.solver_iterations > 0
                assert Status.SOLVER_STOPPED not in estimate.status
    assert active > 5


@cases
def test_every_policy_keeps_its_promise(name, kind):
    """Where a projection is not feasible, backends differ in what they bring back."""
    case, _ = case_of(name, kind)
    flags = Status(0)
    for seed in range(3):
        Y = case.record(seed, STEPS)
        one, other = (
            estimator(name, kind, engine, outside="project", max_qps=2)
            for engine in ("python", "compiled")
        )
        for y in Y:
            expected, estimate = one.update(y), other.update(y)
            promised(name, kind, estimate, Y)
            flags |= estimate.status
            if Status.PROJECTED in expected.status & estimate.status:
                assert max(violations(name, kind, estimate)) <= 1e-8
                np.testing.assert_allclose(estimate.candidate, expected.candidate, atol=1e-4)
    assert Status.IMPROVED in flags


def test_projections_happen():
    flags = Status(0)
    for estimate in in_step("reactor", "box", 0, outside="project", max_qps=None):
        flags |= estimate.status
    assert Status.PROJECTED in flags


@pytest.mark.parametrize("outside", ["drop", "project", "keep"])
@cases
def test_the_banded_backend_knows_no_inequalities(name, kind, outside):
    case, _ = case_of(name, kind)
    one, other = (
        estimator(name, kind, engine, outside=outside, max_qps=3, backend="banded")
        for engine in ("python", "compiled")
    )
    Y = case.record(2, STEPS)
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        promised(name, kind, estimate, Y)
        assert estimate.solver_iterations == 0
        assert (estimate.status, estimate.qps, estimate.corrections, estimate.dropped) == (
            expected.status, expected.qps, expected.corrections, expected.dropped
        )
        np.testing.assert_allclose(estimate.trajectory, expected.trajectory, atol=1e-9)


@pytest.mark.parametrize("cap", [1, 2, 5])
@pytest.mark.parametrize("outside", ["drop", "project"])
@cases
def test_caps_on_iterations(name, kind, outside, cap):
    case, _ = case_of(name, kind)
    mhe = estimator(name, kind, outside=outside, max_qps=3, max_solver_iterations=cap)
    Y, flags = case.record(1, STEPS), Status(0)
    for y in Y:
        estimate = mhe.update(y)
        promised(name, kind, estimate, Y)
        # A projection and its corrections are solves, too.
        assert estimate.solver_iterations <= cap * (estimate.qps + estimate.corrections + 1)
        flags |= estimate.status
    assert Status.SOLVER_STOPPED in flags or outside == "project"
    assert Status.IMPROVED in flags


@cases
def test_other_options_with_sets(name, kind):
    case, _ = case_of(name, kind)
    weights = {"prior": case.cost.prior, "disturbance": case.cost.disturbance,
               "noise": case.cost.noise}
    in_step(name, kind, 1, max_qps=0)
    in_step(name, kind, 1, max_qps=None, warm_start=True)
    # The candidate hangs on the estimate before: what differs adds up.
    mhe = estimator(name, kind, candidate="reinitialized", warm_start=True)
    Y = case.record(1, STEPS)
    for y in Y:
        promised(name, kind, mhe.update(y), Y)
    discounted = qpmhe.QuadraticCost(**weights, discount=0.8)
    one, other = (
        estimator(name, kind, engine, cost=discounted, max_qps=None)
        for engine in ("python", "compiled")
    )
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-6, abs=1e-9)
        assert max(violations(name, kind, estimate)) <= 1e-8


@pytest.mark.parametrize(("name", "kind"), [("stirred_tank", "polytope"), ("tracking", "box")])
def test_missing_and_late_samples_with_sets(name, kind):
    case, _ = case_of(name, kind)
    generator, Y = np.random.default_rng(4), case.record(3, STEPS)
    one, other = (
        estimator(name, kind, engine, max_qps=None) for engine in ("python", "compiled")
    )
    for t, y in enumerate(Y):
        spoilt = np.where(generator.random(case.p) < 0.4, np.nan, y)
        pair = [one.update(spoilt), other.update(spoilt)]
        if t % 3 == 2:
            pair = [mhe.amend(t - 1, Y[t - 1]) for mhe in (one, other)]
        expected, estimate = pair
        assert estimate.dropped == expected.dropped
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-6, abs=1e-9)
        np.testing.assert_array_equal(np.isnan(estimate.noises), np.isnan(expected.noises))
        w = estimate.disturbances
        assert case.sets[kind][1].violation(w) <= 1e-8 or "disturbances" in estimate.dropped


@pytest.mark.parametrize("far", [1e20, 1e200, 1e300])
def test_bounds_that_are_all_but_infinite(far):
    case, system = case_of("parts", "all open")
    wide = qpmhe.from_casadi(
        **case.symbolic(), n=2, compiled=False,
        disturbances=Box([-far, -0.05], [0.05, far]) & around([0, 0], 0.1, 0.1),
        noises=Box(-1.2, far) & Polytope([[1.0]], [0.3]),
    )
    one, other = (
        qpmhe.MovingHorizonEstimator(
            each, qpmhe.Luenberger(case.gain), case.cost, horizon=case.horizon,
            initial_state=case.start, engine="compiled", max_qps=2,
        )
        for each in (system, wide)
    )
    for y in case.record(0, STEPS):
        expected, estimate = one.update(y), other.update(y)
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-6)


@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-8])
def test_sets_of_almost_no_width(width):
    """However narrow, nothing worse than the candidate comes out."""
    case, _ = case_of("reactor", "polytope")
    system = qpmhe.from_casadi(
        **case.symbolic(), n=2, compiled=False,
        disturbances=Polytope([[1, 1], [-1, -1], [1, 0], [-1, 0]], [width, width, 0.1, 0.1]),
        noises=Polytope([[1.0], [-1.0]], [0.4, 1.2]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.array([[0.05], [-0.05]])), case.cost, horizon=6,
        initial_state=case.start, engine="compiled", max_qps=2,
    )
    improved = 0
    for y in case.record(0, STEPS):
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        if "disturbances" not in estimate.dropped:
            assert np.abs(estimate.disturbances.sum(axis=1)).max() <= width + 1e-8
        improved += Status.IMPROVED in estimate.status
    assert improved > (STEPS / 2 if width > 1e-8 else 0)


@pytest.mark.parametrize("width", [0.0, 1e-12, 1e-9])
def test_sets_of_less_width_than_they_are_kept_to(width):
    case, _ = case_of("reactor", "polytope")
    system = qpmhe.from_casadi(
        **case.symbolic(), n=2, compiled=False,
        disturbances=Polytope([[1, 1], [-1, -1]], [width, width]),
    )
    with pytest.raises(qpmhe.errors.OptionError, match="disturbances has a direction of zero"):
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.array([[0.05], [-0.05]])), case.cost, horizon=6,
            initial_state=case.start, engine="compiled",
        )
