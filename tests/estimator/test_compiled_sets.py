"""The compiled step where sets bind: feasible, never above the candidate, and as good."""

import functools

import numpy as np
import pytest
from oracles.systems import SYSTEMS, around, reactor

import qpmhe
from qpmhe.codegen.compiler import find_compiler

casadi = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

Status, Box, Polytope = qpmhe.Status, qpmhe.Box, qpmhe.Polytope
STEPS, INF = 30, np.inf
CASES = [
    ("reactor", "box"), ("van_der_pol", "polytope"), ("stirred_tank", "polytope"),
    ("tracking", "box"),
]
cases = pytest.mark.parametrize(("name", "kind"), CASES)
policies = pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])

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
    if kind == "tight":
        case.sets[kind] = [one and Box(one.lower / 2, one.upper / 2) for one in case.sets["box"]]
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


def missed_rows(sets, weights, residuals, first, share=0.0, slack=0.0):
    """The rows of W and V that (w, v) miss by more than a share of their scale, by definition."""
    found = set()
    for label, one, weight, points in zip(
        ("disturbances", "noises"), sets, weights, residuals, strict=True
    ):
        if one is None:
            continue
        rows = np.vstack((np.eye(one.dimension), one.matrix))
        low, high = np.append(one.lower, one.row_lower), np.append(one.upper, one.row_upper)
        scale = np.minimum(high - low, np.sqrt(np.diag(rows @ np.linalg.inv(weight) @ rows.T)))
        values = points @ rows.T
        for side, distance in (("lower", low - values), ("upper", values - high)):
            found |= {
                (label, int(r), side, first + int(k))
                for k, r in np.argwhere(distance > share * scale + slack)
            }
    return found


def missed(name, kind, w, v, first, share=0.0):
    case = case_of(name, kind)[0]
    weights = case.cost.disturbance, case.cost.noise
    return missed_rows(case.sets[kind][1:], weights, (w, v), first, share)


def promised(name, kind, estimate, Y, prior=None):
    """Insist on all that is promised of an estimate."""
    case, _ = case_of(name, kind)
    status, K = estimate.status, len(estimate.noises)
    first = estimate.time + 1 - K
    assert estimate.cost <= estimate.candidate_cost
    assert (Status.IMPROVED in status) != (Status.CANDIDATE in status)
    assert (Status.ROWS_DROPPED in status) == bool(estimate.dropped)
    z, window = estimate.candidate, Y[first:]
    v_z = np.array([window[i] - case.h(z[i]) for i in range(K)])
    outside = missed(name, kind, v_z @ np.asarray(case.gain).T, v_z, first)
    assert Status.CANDIDATE_OUTSIDE not in status or outside
    assert set(estimate.dropped) <= outside
    x = estimate.trajectory
    w = np.array([x[i + 1] - case.f(x[i]) for i in range(K)])
    v = np.array([window[i] - case.h(x[i]) for i in range(K)])
    if Status.IMPROVED in status:
        assert missed(name, kind, w, v, first, 1e-8) <= set(estimate.dropped)
    offset = x[0] - (z[0] if prior is None else prior)
    J = offset @ case.cost.prior @ offset
    J += sum(w[i] @ case.cost.disturbance @ w[i] + v[i] @ case.cost.noise @ v[i] for i in range(K))
    assert estimate.cost == pytest.approx(J, rel=1e-8)


def in_step(name, kind, seed=0, tolerance=1e-6, steps=STEPS, **options):
    """Run both engines on a record, compare, and give the compiled estimates."""
    case, _ = case_of(name, kind)
    Y, found = case.record(seed, steps), []
    one, other = (estimator(name, kind, engine, **options) for engine in ("python", "compiled"))
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        promised(name, kind, estimate, Y)
        same_rung(expected, estimate)
        assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
        assert estimate.cost == pytest.approx(expected.cost, rel=tolerance, abs=1e-9)
        found.append(estimate)
    return found


def same_rung(expected, estimate):
    """Whether two estimates are on one rung of the ladder, with the same rows."""
    rung = Status.IMPROVED | Status.CANDIDATE | Status.CANDIDATE_OUTSIDE | Status.ROWS_DROPPED
    assert estimate.status & rung == expected.status & rung
    assert estimate.dropped == expected.dropped


@pytest.mark.parametrize("max_qps", [2, None])
@policies
@cases
def test_as_good_as_the_best_backend(name, kind, infeasible, max_qps):
    active = outside = 0
    for seed in range(3):
        for estimate in in_step(name, kind, seed, infeasible=infeasible, max_qps=max_qps):
            active += estimate.solver_iterations > 0
            outside += Status.CANDIDATE_OUTSIDE in estimate.status
            assert Status.SOLVER_FAILED not in estimate.status
    assert active > 5
    assert outside > 5


@pytest.mark.parametrize("kind", PARTS)
def test_sets_of_one_kind_and_open_sides(kind):
    active = 0
    for seed in range(3):
        for max_qps in (1, None):
            for estimate in in_step("parts", kind, seed, max_qps=max_qps):
                active += estimate.solver_iterations > 0
                assert Status.SOLVER_STOPPED not in estimate.status
    assert active > 5


@policies
@pytest.mark.parametrize("name", ["reactor", "van_der_pol", "stirred_tank", "pendulum"])
def test_sets_that_the_observer_leaves_nearly_always(name, infeasible):
    """All rungs, with the same rows where the QPs have solutions; without, nothing but promises."""
    kind = "tight"
    case, _ = case_of(name, kind)
    rungs, apart = {"again": 0, "dropped": 0, "kept": 0, "nearest": 0}, 0
    for seed in range(2):
        Y = case.record(seed, STEPS)
        one, other = (
            estimator(name, kind, engine, infeasible=infeasible, max_qps=None)
            for engine in ("python", "compiled")
        )
        for y in Y:
            expected, estimate = one.update(y), other.update(y)
            promised(name, kind, estimate, Y)
            assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)
            if Status.SOLVER_STOPPED in expected.status | estimate.status:
                apart += estimate.cost != pytest.approx(expected.cost, rel=1e-6)
            else:
                same_rung(expected, estimate)
                assert estimate.cost == pytest.approx(expected.cost, rel=1e-6)
            rungs["nearest"] += estimate.nearest_points > 0
            if Status.CANDIDATE_OUTSIDE in estimate.status:
                rungs["dropped" if estimate.dropped else
                      "again" if estimate.improved else "kept"] += 1
    assert apart <= 4
    assert rungs["again"] > 2
    assert rungs["nearest"] > 2
    assert rungs["dropped" if infeasible == "drop_rows" else "kept"] > 2
    assert rungs["dropped"] > rungs["kept"] or infeasible == "keep_candidate"


@policies
@cases
def test_the_banded_backend_knows_no_inequalities(name, kind, infeasible):
    case, _ = case_of(name, kind)
    one, other = (
        estimator(name, kind, engine, infeasible=infeasible, max_qps=3, backend="banded")
        for engine in ("python", "compiled")
    )
    Y = case.record(2, STEPS)
    for y in Y:
        expected, estimate = one.update(y), other.update(y)
        promised(name, kind, estimate, Y)
        assert estimate.solver_iterations == 0
        for field in ("status", "qps", "corrections", "nearest_points", "dropped"):
            assert getattr(estimate, field) == getattr(expected, field), field
        np.testing.assert_allclose(estimate.trajectory, expected.trajectory, atol=1e-9)


@pytest.mark.parametrize("cap", [1, 2, 5])
@policies
@cases
def test_caps_on_iterations(name, kind, infeasible, cap):
    case, _ = case_of(name, kind)
    mhe = estimator(name, kind, infeasible=infeasible, max_qps=3, max_solver_iterations=cap)
    Y, flags = case.record(1, STEPS), Status(0)
    for y in Y:
        estimate = mhe.update(y)
        promised(name, kind, estimate, Y)
        solves = estimate.qps + estimate.corrections + estimate.nearest_points
        assert estimate.solver_iterations <= cap * solves
        flags |= estimate.status
    # The active rows are mostly found by a few guesses.
    assert Status.SOLVER_STOPPED in flags or cap > 1
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
        assert not missed(name, kind, estimate.disturbances, estimate.noises, 0, 1e-8)


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
        same_rung(expected, estimate)
        assert estimate.cost == pytest.approx(expected.cost, rel=1e-6, abs=1e-9)
        np.testing.assert_array_equal(np.isnan(estimate.noises), np.isnan(expected.noises))
        w, v = estimate.disturbances, estimate.noises
        first = estimate.time + 1 - len(v)
        assert missed(name, kind, w, v, first, 1e-8) <= set(estimate.dropped)


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
        if Status.IMPROVED in estimate.status and not estimate.dropped:
            assert np.abs(estimate.disturbances.sum(axis=1)).max() <= width + 1e-8
        improved += Status.IMPROVED in estimate.status
    assert improved > (STEPS / 2 if width > 1e-8 else 0)


@pytest.mark.parametrize("width", [0.0, 1e-12, 2e-10])
def test_sets_of_less_width_than_they_are_kept_to(width):
    case, _ = case_of("reactor", "polytope")
    system = qpmhe.from_casadi(
        **case.symbolic(), n=2, compiled=False,
        disturbances=Polytope([[1, 1], [-1, -1]], [width, width]),
    )
    expected, found = (
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.array([[0.05], [-0.05]])), case.cost, horizon=6,
            initial_state=case.start, engine=engine, max_qps=None, solver_tolerance=1e-9,
        ).run(case.record(0, 12))
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-8)


def in_units(name, kind, x_unit, y_unit):
    """A compiled estimator of the same case in other units."""
    case, _ = case_of(name, kind)
    S, T, functions = np.asarray(x_unit), np.asarray(y_unit), case.symbolic()
    system = qpmhe.from_casadi(
        lambda x: S * functions["f"](x / S), lambda x: T * functions["h"](x / S), n=case.n,
        compiled=False,
        **{
            label: one and qpmhe.model.sets.ConvexSet(
                one.lower * unit, one.upper * unit, one.matrix / unit, one.row_lower, one.row_upper
            )
            for label, one, unit in zip(
                ("disturbances", "noises"), case.sets[kind][1:], (S, T), strict=True
            )
        },
    )
    cost = qpmhe.QuadraticCost(
        prior=case.cost.prior / np.outer(S, S), disturbance=case.cost.disturbance / np.outer(S, S),
        noise=case.cost.noise / np.outer(T, T),
    )
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(case.gain * S[:, None] / T), cost, horizon=case.horizon,
        initial_state=case.start * S, engine="compiled", max_qps=3,
    )


@pytest.mark.parametrize(("name", "kind"), [("stirred_tank", "tight"), ("van_der_pol", "polytope")])
def test_no_unit_matters(name, kind):
    """A compiler may contract the model's operations in other ways: the same up to rounding."""
    case, _ = case_of(name, kind)
    generator, n, p = np.random.default_rng(5), case.n, case.p
    usual, Y = in_units(name, kind, np.ones(n), np.ones(p)), case.record(0, STEPS)
    expected, flags = [usual.update(y) for y in Y], Status(0)
    for _ in range(2):
        S, T = (2.0 ** generator.integers(-30, 31, size) for size in (n, p))
        other = in_units(name, kind, S, T)
        for y, one in zip(Y, expected, strict=True):
            estimate = other.update(y * T)
            np.testing.assert_allclose(
                estimate.trajectory / S, one.trajectory, rtol=1e-9,
                atol=1e-9 * np.abs(one.trajectory).max(),
            )
            assert estimate.cost == pytest.approx(one.cost, rel=1e-10)
            for field in ("status", "qps", "nearest_points", "dropped"):
                assert getattr(estimate, field) == getattr(one, field), field
            flags |= estimate.status
    assert Status.CANDIDATE_OUTSIDE in flags


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("whole", [False, True])
def test_rows_dropped_for_long_are_worth_a_warning(engine, whole):
    case, _ = case_of("pendulum", "tight")
    mhe, Y = estimator("pendulum", "tight", engine), case.record(1, STEPS)
    take = mhe.run if whole else lambda ys: [mhe.update(y) for y in ys]
    with pytest.warns(qpmhe.ObserverWarning, match="inequalities were dropped in") as caught:
        take(Y)
    assert len(caught) == 1
    assert caught[0].filename == __file__ or (engine, whole) == ("python", True)
