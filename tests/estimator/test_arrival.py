"""The prior's mean: the observer's state, or the previous estimate's smoothed one."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status
from qpmhe.estimation.snapshot import read, written

from .plain import Record, huber, is_minimum, quadratic
from .test_candidates import GAIN, START, P, Q, R, check_numbers, estimator, record, seen, swing
from .untraced import untraced


class Smoothed(Record):
    """The prior of a window is the former estimate of its first state, once it has moved on."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.prior = np.array(START)

    def follow(self, trajectory):
        """Take the estimate of this window in, before the next sample."""
        if self.count == self.horizon:
            self.prior = trajectory[1]

    def cost(self, trajectory):
        own = super().cost(trajectory)
        prior = self.losses[0]
        return own + self.discount**self.count * (
            prior(trajectory[0] - self.prior, self.P)
            - prior(trajectory[0] - self.z[self.first], self.P)
        )


def plain_record(horizon=4, discount=1.0, **options):
    return Smoothed(seen, GAIN, START, (P, Q, R), horizon, discount=discount, **options)


@pytest.mark.parametrize("discount", [1.0, 0.9])
@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("horizon", [1, 4, 7])
def test_one_qp_from_the_smoothed_prior(horizon, missing, discount):
    options = {"horizon": horizon, "discount": discount}
    mhe, kept = estimator(arrival="smoothed", **options), plain_record(**options)
    moved = 0
    for t, y in enumerate(record(20, missing)):
        estimate = mhe.update(y)
        kept.push(swing, y)
        trajectory = kept.candidate
        if kept.cost(trajectory) > 1e-9:
            trajectory = kept.improved(trajectory)
        check_numbers(estimate, kept, trajectory)
        moved += t >= horizon and not np.array_equal(kept.prior, kept.candidate[0])
        kept.follow(estimate.trajectory)
    assert moved > 8


def test_the_candidate_is_the_observers_and_pays_for_the_other_prior():
    ys = record(20)
    mhes = [estimator(arrival=arrival, max_qps=3) for arrival in ("observer", "smoothed")]
    before = None
    for t, y in enumerate(ys):
        plain, smoothed = (mhe.update(y) for mhe in mhes)
        np.testing.assert_array_equal(plain.candidate, smoothed.candidate)
        assert smoothed.cost <= smoothed.candidate_cost
        if t < 4:
            assert (plain.trajectory == smoothed.trajectory).all()
            assert plain.candidate_cost == smoothed.candidate_cost
        else:
            offset = smoothed.candidate[0] - before[1]
            expected = plain.candidate_cost + offset @ P @ offset
            assert smoothed.candidate_cost == pytest.approx(expected, rel=1e-12)
        before = smoothed.trajectory


def test_without_qps_the_previous_estimate_is_the_observer():
    ys = record(20, 0.2)
    runs = [estimator(arrival=arrival, max_qps=0).run(ys) for arrival in ("observer", "smoothed")]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].costs, runs[1].costs)


def test_robust_losses_are_taken_at_the_smoothed_prior():
    losses = (huber(0.05), quadratic, quadratic)
    system = qpmhe.System(swing, seen, n=2, p=1)
    cost = qpmhe.RobustCost(prior=qpmhe.Huber(P, 0.05), disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=4, initial_state=START, max_qps=None,
        tolerance=1e-13, arrival="smoothed",
    )
    kept = plain_record(losses=losses)
    for y in record(15):
        estimate = mhe.update(y)
        kept.push(swing, y)
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-7)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-7)
        assert is_minimum(kept, estimate.trajectory, 1e-4)
        kept.follow(estimate.trajectory)


def test_convergence_is_the_dense_minimum_of_every_window():
    horizon, ys = 5, record(25)
    roots = [np.linalg.cholesky(weight).T for weight in (P, Q, R)]
    prior, window, estimate = np.array(START), [], None
    mhe = estimator(horizon=horizon, max_qps=None, tolerance=1e-14, arrival="smoothed")

    def residuals(flat):
        x = flat.reshape(-1, 2)
        w, v = x[1:] - swing(x[:-1]), np.array(window) - seen(x[:-1])
        return np.concatenate(
            [roots[0] @ (x[0] - prior), (w @ roots[1].T).ravel(), (v @ roots[2].T).ravel()]
        )

    for y in ys:
        if len(window) == horizon:
            prior = estimate.trajectory[1]
            del window[0]
        window.append(y)
        estimate = mhe.update(y)
        start = estimate.candidate.ravel()
        found = least_squares(residuals, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert estimate.cost == pytest.approx(2.0 * found.cost, rel=1e-9)
        np.testing.assert_allclose(estimate.trajectory.ravel(), found.x, atol=1e-5)


def test_ipopt_with_the_prior_update_of_other_toolboxes():
    """Their prior is x[1] of the solution before, Ipopt's own; costs and states agree."""
    ca = pytest.importorskip("casadi")
    horizon, ys = 6, record(25, seed=5)
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-11}

    def program(count):
        x, y, before = ca.SX.sym("x", 2, count + 1), ca.SX.sym("y", 1, count), ca.SX.sym("b", 2)
        cost = (x[:, 0] - before).T @ ca.DM(P) @ (x[:, 0] - before)
        for i in range(count):
            a, b = x[0, i], x[1, i]
            w = x[:, i + 1] - ca.vertcat(a + 0.2 * b, 0.9 * b - 0.2 * ca.sin(a))
            v = y[0, i] - (a + 0.05 * b**2)
            cost += w.T @ ca.DM(Q) @ w + v * float(R[0, 0]) * v
        parameters = ca.vertcat(before, ca.vec(y))
        return ca.nlpsol("mhe", "ipopt", {"x": ca.vec(x), "p": parameters, "f": cost}, options)

    programs = [program(count) for count in range(1, horizon + 1)]
    prior, solution, data = np.array(START), None, []
    mhe = estimator(horizon=horizon, max_qps=None, tolerance=1e-14, arrival="smoothed")
    for y in ys:
        if len(data) == horizon:
            prior = solution[1]
            del data[0]
        data.append(y)
        estimate = mhe.update(y)
        found = programs[len(data) - 1](
            x0=estimate.candidate.ravel(), p=np.concatenate((prior, np.ravel(data)))
        )
        solution = np.array(found["x"]).reshape(-1, 2)
        assert estimate.cost == pytest.approx(float(found["f"]), rel=1e-6)
        np.testing.assert_allclose(estimate.trajectory, solution, atol=1e-5)


def test_a_late_measurement_keeps_the_windows_prior():
    ys = record(12)
    mhe, kept = estimator(arrival="smoothed"), plain_record()
    for t, y in enumerate(ys):
        given = np.full(1, np.nan) if t == 8 else y
        estimate = mhe.update(given)
        kept.push(swing, given)
        if t == 9:
            kept.amend(8, ys[8])
            estimate = mhe.amend(8, ys[8])
        check_numbers(estimate, kept, kept.improved(kept.candidate))
        kept.follow(estimate.trajectory)


def test_what_is_set_for_the_whole_window_keeps_its_prior():
    ys = record(14)
    mhe, other = estimator(arrival="smoothed"), plain_record()
    for t, y in enumerate(ys):
        estimate = mhe.update(y)
        other.push(swing, y)
        if t == 9:
            estimate = mhe.set(noise_weight=3.0 * R)
            other.R, other.noise_weights = 3.0 * R, [3.0 * R] * len(other.ys)
        check_numbers(estimate, other, other.improved(other.candidate))
        other.follow(estimate.trajectory)


def test_after_a_reset_the_prior_is_the_initial_state():
    ys = record(12)
    used, new = estimator(arrival="smoothed"), estimator(arrival="smoothed")
    used.run(ys)
    used.reset()
    for y in ys:
        assert (used.update(y).trajectory == new.update(y).trajectory).all()


@pytest.mark.parametrize("stop", [1, 4, 5, 11])
def test_snapshots_keep_the_prior(stop):
    ys = record(16)
    whole, loaded = estimator(arrival="smoothed"), estimator(arrival="smoothed")
    whole.run(ys[:stop])
    loaded.load_state_dict(whole.state_dict())
    assert whole.covariances().tolist() == loaded.covariances().tolist()
    for y in ys[stop:]:
        one, two = whole.update(y), loaded.update(y)
        assert (one.trajectory == two.trajectory).all()
        assert (one.cost, one.candidate_cost) == (two.cost, two.candidate_cost)


@pytest.mark.parametrize("stop", [3, 9])
def test_snapshots_of_another_arrival_or_without_its_prior_are_refused(stop):
    mhe = estimator(arrival="smoothed")
    mhe.run(record(stop))
    state = read(mhe.state_dict())
    with pytest.raises(qpmhe.errors.InvalidInputError, match="another arrival"):
        estimator().load_state_dict(written(state))
    prior = state["window"]["smoothed_prior"]
    assert (prior is None) == (stop == 3)
    for damaged in (None if prior is not None else START, np.full(2, np.nan), START[:1]):
        state["window"]["smoothed_prior"] = damaged
        with pytest.raises(qpmhe.errors.InvalidInputError, match="damaged"):
            mhe.load_state_dict(written(state))
    before = mhe.update([0.1]).trajectory
    assert np.isfinite(before).all()


def test_a_failed_stage_leaves_a_finite_prior_and_the_promise():
    broken = [False]

    def fragile(x):
        if broken[0]:
            raise ValueError("out of range")
        return swing(x)

    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(untraced(fragile), seen, n=2, p=1), qpmhe.Luenberger(GAIN),
        qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R), horizon=4, initial_state=START,
        arrival="smoothed",
    )
    failed = 0
    for t, y in enumerate(record(25)):
        broken[0] = t in (7, 8, 15)
        estimate = mhe.update(y)
        failed += Status.MODEL_FAILED in estimate.status
        assert estimate.cost <= estimate.candidate_cost
        assert np.isfinite(estimate.trajectory).all()
    assert failed >= 3
    assert estimate.improved


class Short(qpmhe.Quadratic):
    """A loss that a prior may have at its own state only."""

    def cost(self, residuals, weights):
        if np.abs(residuals).max() > 0.0:
            raise ValueError("too far")
        return super().cost(residuals, weights)


def test_a_prior_that_the_loss_cannot_weigh_is_not_taken():
    cost = qpmhe.RobustCost(prior=Short(P), disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(swing, seen, n=2, p=1), qpmhe.Luenberger(GAIN), cost, horizon=3,
        initial_state=START, arrival="smoothed",
    )
    mhe._engine._trajectory = None
    for y in record(12):
        estimate = mhe.update(y)
        assert np.isfinite(estimate.candidate_cost)
        assert estimate.cost <= estimate.candidate_cost
        # As if it had been improved: the next window's prior is elsewhere.
        mhe._engine._trajectory += 0.1
    assert mhe._engine._window.smoothed_prior is not None


@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
def test_the_promise_holds_in_sets(infeasible, candidate):
    system = qpmhe.System(
        swing, seen, n=2, p=1, states=qpmhe.Box([-0.4, -0.7], [2.0, 0.7]),
        disturbances=qpmhe.Box([-0.05, 0.0], [0.05, 0.0]), noises=qpmhe.Box([-0.3], [0.3]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R),
        horizon=4, initial_state=[1.0, -0.5], max_qps=2, infeasible=infeasible,
        candidate=candidate, arrival="smoothed",
    )
    improved = 0
    for y in record(40, 0.1):
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        improved += estimate.improved
        if estimate.improved and not estimate.dropped:
            assert system.states.violation(estimate.trajectory) <= 1e-8
            assert system.disturbances.violation(estimate.disturbances) <= 1e-8
    assert improved > 20
