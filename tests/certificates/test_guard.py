"""Guarded estimates: within twice the bound, whatever the estimate is; the nearest such point."""

from functools import cache

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import CertificateError, Monitor, Sizes
from qpmhe.certificates.guard import Guard, Guarded
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.tube import Tube
from qpmhe_solvers import Backend, RawSolution

from .helpers import box, unit_cost

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
GAIN = np.array([[0.4], [0.1]])
REGION = qpmhe.Polytope([[1.0, 1.0]], [3.0]) & box([-2.0, -2.0], [2.0, 2.0])
W, V = box([-0.02, -0.02], [0.02, 0.02]), box(-0.05, 0.05)
START = box([-0.3, -0.3], [0.3, 0.3])


def plant():
    """Linear, with a sine of its first state."""
    return qpmhe.System(
        lambda x: x @ A.T + 0.05 * np.sin(x[..., :1]) * np.array([0.0, 1.0]),
        lambda x: x[..., :1], n=2, p=1,
    )


@cache
def certified():
    return bound_observer(
        plant(), qpmhe.Luenberger(GAIN), unit_cost(2), REGION, sizes=Sizes(W, V), seconds=300.0)


@pytest.fixture(name="bound")
def fixture_bound():
    return certified()


def estimator(bound, **options):
    usual = {"horizon": 4, "initial_state": [0.0, 0.0], "max_qps": 1}
    return qpmhe.MovingHorizonEstimator(
        bound.stability.system, qpmhe.Luenberger(GAIN), options.pop("cost", unit_cost(2)),
        **(usual | options))


def plain(vectors, weight):
    return np.sqrt(np.einsum("...i,ij,...j->...", vectors, weight, vectors))


def in_set(bound, point, z, tube):
    e = point - z
    return (
        np.sqrt(e @ bound.metric @ e) <= tube.radius and (np.abs(e) <= tube.box).all()
        and bool(bound.region.contains(point - 1e-12 * np.sign(point)))
    )


@pytest.mark.slow
def test_the_guard_returns_the_nearest_point_of_the_set(bound):
    """Against a fine grid, where ball, box, the slanted side and corners of them are active."""
    guard, rng, kinds = Guard(bound, bound.stability.system), np.random.default_rng(0), set()
    P, angles = bound.metric, np.linspace(0.0, 2.0 * np.pi, 2001)
    circle = np.column_stack((np.cos(angles), np.sin(angles)))
    shares = np.linspace(0.0, 1.0, 201)[:, None, None]
    for k in range(60):
        z = rng.uniform(-0.5, 1.5, 2)
        if k % 4 == 0:  # near the slanted side
            z = np.array([1.2, 1.75]) + rng.uniform(-0.2, 0.2) * np.array([1.0, -1.0])
        radius = 0.4 * np.sqrt(np.abs(P).max())
        tube = Tube(radius, bound.components(radius) * rng.uniform(0.5, 1.0, 2))
        estimate = z + rng.standard_normal(2) * (0.2, 1.0, 100.0)[k % 3]
        found = guard(estimate, z, tube)
        assert not found.reason
        assert in_set(bound, found.point, z, tube)
        inside = in_set(bound, estimate, z, tube)
        assert found.acted != inside
        if inside:
            np.testing.assert_array_equal(found.point, estimate)
            continue
        mine = plain(found.point - estimate, P)
        # Of all points of a fine grid of the set, none is nearer.
        grid = z + (tube.radius / plain(circle, P))[:, None] * circle * shares
        grid = grid.reshape(-1, 2)
        grid = grid[(np.abs(grid - z) <= tube.box).all(axis=1) & bound.region.contains(grid)]
        nearest = plain(grid - estimate, P).min()
        assert mine <= nearest * (1.0 + 1e-9)
        assert nearest <= mine + 0.02 * tube.radius
        e = found.point - z
        kinds.add((bool(plain(e, P) > 0.999 * radius), bool((np.abs(e) > 0.999 * tube.box).any()),
                   bool(found.point.sum() > 2.999)))
    assert {(True, False, False), (False, True, False), (False, False, True)} < kinds


def test_from_far_away_the_direction_decides(bound):
    """An estimate so far away that rounding of its distance is larger than the set."""
    guard, rng = Guard(bound, bound.stability.system), np.random.default_rng(3)
    for k in range(20):
        z, direction = rng.uniform(-0.5, 0.5, 2), rng.standard_normal(2)
        radius = 0.2 * float(np.sqrt(np.abs(bound.metric).max()))
        tube = Tube(radius, bound.components(radius) * (1.0 if k % 2 else 0.6))
        near, *far = (guard(z + size * direction, z, tube).point for size in (1e9, 1e40, 1e140))
        np.testing.assert_allclose(far, [near, near], rtol=0, atol=1e-7)


def test_no_estimate_is_farther_than_twice_the_bound_from_any_state_of_the_set(bound):
    guard, rng, P = Guard(bound, bound.stability.system), np.random.default_rng(1), bound.metric
    compared = 0
    for size in (1e-9, 0.1, 1.0, 1e3, 1e150):
        for _ in range(20):
            z = rng.uniform(-1.0, 1.0, 2)
            radius = float(10.0 ** rng.uniform(-3.0, 0.5))
            tube = Tube(radius, bound.components(radius) * rng.uniform(0.3, 1.0, 2))
            estimate = z + size * rng.standard_normal(2)
            found = guard(estimate, z, tube)
            assert not found.reason
            directions = rng.standard_normal((200, 2))
            lengths = np.sqrt(np.einsum("ki,ij,kj->k", directions, P, directions))
            truth = z + radius * directions / lengths[:, None]
            truth = truth[(np.abs(truth - z) <= tube.box).all(axis=1)]
            e = truth - found.point
            assert (np.sqrt(np.einsum("ki,ij,kj->k", e, P, e)) <= 2.0 * radius * (1 + 1e-12)).all()
            assert (np.abs(e) <= 2.0 * tube.box * (1.0 + 1e-12)).all()
            # In P, the guarded estimate is no farther from them than the estimate: RGES carries
            # over, with the root of P's condition in Euclidean lengths.
            inside = truth[bound.region.contains(truth)]
            before = plain(inside - estimate, P)
            assert (plain(inside - found.point, P) <= before * (1.0 + 1e-9)).all()
            compared += found.acted * len(inside)
    assert compared > 1000


def test_no_state_in_the_set_is_named(bound):
    guard = Guard(bound, bound.stability.system)
    tube = Tube(1e-3, np.array([1e-3, 1e-3]))
    for z in ([5.0, 0.0], [1.6, 1.6]):  # beyond a side, beyond the slanted one
        found = guard(np.zeros(2), np.array(z), tube)
        assert not found.acted
        assert "no state was found in the set" in found.reason
        np.testing.assert_array_equal(found.point, 0.0)


def hostile(estimate, rng):
    """The same sample with a state that no solver would return."""
    return np.asarray(estimate.state) + rng.choice([-1.0, 1.0], 2) * 10.0 ** rng.uniform(-3, 3)


class Hostile:
    """Stands for an estimate whose state and filtered state are anything."""

    def __init__(self, estimate, rng):
        self._estimate = estimate
        self.state, self.filtered = hostile(estimate, rng), hostile(estimate, rng)

    def __getattr__(self, name):
        return getattr(self._estimate, name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["adjoint", "random"])
def test_adversaries_and_hostile_estimates_stay_within_twice_the_bound(
    bound, kind, monkeypatch, pytestconfig
):
    """Truths with extreme signals beside estimates that are anything at all."""
    monkeypatch.setattr(qpmhe.certificates.monitor, "Estimate", object)
    system, rng, P = bound.stability.system, np.random.default_rng(2), bound.metric
    acted, runs = 0, 12 if pytestconfig.option.all else 4
    for _ in range(runs):
        mhe = estimator(bound, max_qps=0)
        watch = Monitor(bound, mhe, initial_error=START, guard=True)
        advance, entering, added = bound.begun(START), bound.entering(), bound.added()
        x = rng.choice([-0.3, 0.3], 2)
        direction = rng.standard_normal((30, 2))
        if kind == "adjoint":
            row = np.eye(2)[rng.integers(2)]
            for t in range(29, -1, -1):
                direction[t], row = row, (A - GAIN @ [[1.0, 0.0]]).T @ row
        for t in range(30):
            y = x[:1] + np.where(-direction[t] @ GAIN > 0.0, 0.05, -0.05)
            now, x = x, system.f(x, np.zeros(0)) + np.where(direction[t] > 0.0, 0.02, -0.02)
            assert bound.region.contains(x)
            reading = watch.check(Hostile(mhe.update(y), rng))
            assert not reading.unguarded
            acted += len(reading.guarded)
            errors = x - reading.state, now - reading.filtered
            boxes = [advance]
            advance = bound.followed(advance, entering, added, projected=False)
            for e, tube in zip(errors, (advance, boxes[0]), strict=True):
                assert np.sqrt(e @ P @ e) <= 2.0 * tube.radius * (1.0 + 1e-9)
                assert (np.abs(e) <= 2.0 * tube.box * (1.0 + 1e-9)).all()
            assert np.linalg.norm(x - reading.state) <= reading.error
        assert watch.moved > 10
        assert f"The guard moved estimates at {watch.moved} of 30 samples." in watch.summary()
    assert acted > 10 * runs


class Worst(qpmhe.solvers.Solver):
    """Of all steps that lower the objective, one that leads the last state farthest away."""

    def _solve(self, qp, start):
        inverse, g = np.linalg.inv(qp.dense()), qp.gradient.ravel()
        # Of |d - best|_H <= |best|_H, the end along the last state's largest variance.
        ends = inverse[:, -qp.n :] @ np.linalg.eigh(inverse[-qp.n :, -qp.n :])[1][:, -1]
        length = np.sqrt(ends @ qp.dense() @ ends)
        return RawSolution(-inverse @ g + 0.99 * np.sqrt(g @ inverse @ g) / length * ends, True)


def test_the_worst_that_the_verdict_accepts_is_guarded(bound):
    """A backend may lower J, and be wrong by more than twice the bound."""
    qpmhe.solvers.register(Backend("worst", Worst, "adversary"))
    try:
        mhe = estimator(
            bound, backend="worst", cost=qpmhe.QuadraticCost(
                prior=1e-3 * np.eye(2), disturbance=1e-2 * np.eye(2), noise=1.0))
        watch, x, rng = Monitor(bound, mhe, initial_error=START, guard=True), np.array([
            0.2, -0.1]), np.random.default_rng(4)
        errors, limits = np.empty((2, 20)), np.empty(20)
        for t in range(20):
            y = x[:1] + rng.choice([-0.05, 0.05], 1)
            x = bound.stability.system.f(x, np.zeros(0)) + rng.choice([-0.02, 0.02], 2)
            estimate = mhe.update(y)
            assert estimate.cost <= estimate.candidate_cost
            reading = watch.check(estimate)
            errors[:, t] = plain(x - np.array([estimate.state, reading.state]), bound.metric)
            limits[t] = 2.0 * reading.radius
            assert not reading.unguarded
    finally:
        qpmhe.solvers.unregister("worst")
    assert (errors[0] > limits).sum() > 5
    assert (errors[1] <= limits).all()
    assert watch.moved > 10


def test_usual_estimates_are_not_moved_and_nothing_feeds_back(bound):
    rng, x = np.random.default_rng(3), np.array([0.1, 0.0])
    free, watched = estimator(bound), estimator(bound)
    watch = Monitor(bound, watched, initial_error=START, guard=True)
    for _ in range(15):
        y = x[:1] + rng.uniform(-0.05, 0.05, 1)
        x = bound.stability.system.f(x, np.zeros(0)) + rng.uniform(-0.02, 0.02, 2)
        estimate = watched.update(y)
        reading = watch.check(estimate)
        np.testing.assert_array_equal(free.update(y).state, estimate.state)
        np.testing.assert_array_equal(reading.state, estimate.state)
        np.testing.assert_array_equal(reading.filtered, estimate.filtered)
        assert (reading.guarded, reading.unguarded) == ((), "")
    reading = watch.check(watched.update([np.nan]))
    assert reading.unguarded.startswith("from sample 15 on: a measurement was missing")
    assert "at 0 of 16 samples, and is off from sample 15 on: a measurem" in watch.summary()
    plain = Monitor(bound, estimator(bound), initial_error=START)
    assert plain.unguarded == "the monitor has no guard"


def test_a_guard_is_the_same_beside_the_compiled_step(bound):
    """Of noises beyond the stated ones, which the observer follows less than the estimates."""
    readings, moved = {}, {}
    for engine in ("python", "compiled"):
        mhe = estimator(bound, engine=engine, cost=qpmhe.QuadraticCost(
            prior=1e-3 * np.eye(2), disturbance=np.eye(2), noise=1e6))
        watch, rng = Monitor(bound, mhe, initial_error=START, guard=True, sizes=Sizes(
            box([-1e-3, -1e-3], [1e-3, 1e-3]), box(-1e-3, 1e-3))), np.random.default_rng(5)
        readings[engine] = [watch.check(mhe.update(rng.uniform(-0.2, 0.2, 1))) for _ in range(20)]
        moved[engine] = [each.guarded for each in readings[engine]]
    assert moved["python"] == moved["compiled"]
    assert sum(map(bool, moved["python"])) > 5
    for one, other in zip(*readings.values(), strict=True):
        np.testing.assert_allclose(one.state, other.state, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.filtered, other.filtered, rtol=1e-9, atol=1e-12)


def test_a_guard_that_was_off_stays_off(bound, monkeypatch):
    """Where no state is in the set, it is off though the observer's bound is not lost."""
    mhe = estimator(bound)
    watch = Monitor(bound, mhe, initial_error=1e-6, guard=True)
    monkeypatch.setattr(Guard, "__call__", lambda _, x, *__: Guarded(x, False, "nothing is left"))
    reading = watch.check(mhe.update([0.1]))
    assert reading.lost is None
    assert reading.unguarded == "from sample 0 on: nothing is left"
    following = Monitor(bound, mhe, initial_error=1e-6, guard=True)
    following.load_state_dict(watch.state_dict())
    assert following.unguarded == watch.unguarded
    plain = Monitor(bound, mhe, initial_error=1e-6)
    following = Monitor(bound, mhe, initial_error=1e-6, guard=True)
    following.load_state_dict(plain.state_dict())
    assert following.unguarded == ""


def test_where_nothing_is_proved_in_advance_there_is_no_guard(bound):
    for options, words in (
        ({"candidate": "reinitialized"}, "restarts the observer at each sample"),
        ({"restart": True}, "restart=True"),
        ({"infeasible": "restore"}, "infeasible='restore'"),
    ):
        with pytest.raises(CertificateError, match=f"there is no guard: .*{words}"):
            Monitor(bound, estimator(bound, **options), initial_error=START, guard=True)
    gaussian = bound_observer(
        bound.stability.system, qpmhe.Luenberger(GAIN),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=1e4 * np.eye(2), noise=400.0), REGION,
        seconds=300.0)
    assert gaussian.sizes.deviations
    assert "guarded" in bound.headline
    assert gaussian.headline.endswith("x_hat is within |x_hat - z| + b along a run")
    with pytest.raises(CertificateError, match="Gaussian noises are not bounded"):
        Monitor(gaussian, estimator(bound), initial_error=START, guard=True)
    stated = Monitor(gaussian, estimator(bound), initial_error=START, guard=True,
                     sizes=Sizes(W, V))
    assert stated.unguarded == ""


@pytest.mark.parametrize(("options", "words"), [
    ({"constraints": [qpmhe.Constraint(lambda x: x[:1] ** 2 - 4.0)]},
     "nonlinear constraints, whose set need not be convex"),
    ({"state_residual": qpmhe.angles([0])}, "angles among its states"),
    ({"f": lambda x: np.array([0.5 * float(x[0])])}, "the observer's bound is sampled, not proved"),
])
def test_systems_without_a_convex_set_or_a_proof_have_no_guard(options, words):
    """Their observer has a bound, which a monitor without a guard gives."""
    system = qpmhe.System(**{"f": lambda x: 0.5 * x, "h": lambda x: 1.0 * x, "n": 1, "p": 1}
                          | options)
    observer, cost = qpmhe.Luenberger([[0.1]]), unit_cost()
    found = bound_observer(
        system, observer, cost, box(-1.0, 1.0), sizes=Sizes(box(-0.01, 0.01), box(-0.01, 0.01)))
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=2, initial_state=[0.0])
    assert np.isfinite(Monitor(found, mhe, initial_error=0.1).check(mhe.update([0.1])).error)
    mhe.reset()
    with pytest.raises(CertificateError, match=f"there is no guard: .*{words}"):
        Monitor(found, mhe, initial_error=0.1, guard=True)
