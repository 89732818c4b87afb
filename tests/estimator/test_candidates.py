"""Where the QPs and the candidate start, the prior's mean, and which of the states is asked for."""


import numpy as np
import pytest

import qpmhe

from .plain import Record, spd
from .systems import swing

GENERATOR = np.random.default_rng(1)
P, Q, R = 0.05 * spd(GENERATOR, 2), 5.0 * spd(GENERATOR, 2), spd(GENERATOR, 1)
GAIN, START, NAN = np.array([[0.02], [0.01]]), np.array([2.0, -1.0]), np.nan
SMOOTHED = {"arrival": "smoothed"}


def seen(x):
    return x[..., :1] + 0.05 * x[..., 1:] ** 2


def record(count, missing=0.0, seed=2):
    generator = np.random.default_rng(seed)
    x, ys = np.array([0.3, 0.8]), []
    for _ in range(count):
        y = seen(x) + 0.05 * generator.standard_normal(1)
        ys.append(y if generator.random() >= missing else np.full(1, NAN))
        x = swing(x) + 0.01 * generator.standard_normal(2)
    return ys


def estimator(discount=1.0, cost=None, **options):
    cost = cost or qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=discount)
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(swing, seen, n=2, p=1), qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 4, "initial_state": START} | options,
    )


class Plain(Record):
    """The estimates of each window, of one Gauss-Newton step, with these options."""

    def __init__(self, horizon=4, warm_start=False, candidate="observer", arrival="observer",
                 **more):
        super().__init__(seen, GAIN, START, (P, Q, R), horizon, **more)
        self.warm_start, self.again = warm_start, candidate == "reinitialized"
        self.smoothed = arrival == "smoothed"
        self.prior, self.made, self.before = np.array(START), [START], None

    def cost(self, trajectory):
        own = super().cost(trajectory)
        if self.smoothed:
            at, loss = trajectory[0], self.losses[0]
            own += self.discount**self.count * (
                loss(at - self.prior, self.P) - loss(at - self.z[self.first], self.P)
            )
        return own

    def take(self, y):
        """The next sample."""
        if self.before is not None and self.count == self.horizon:
            self.prior = self.before[1]  # the former estimate of the window's first state
        self.push(swing, y)
        if self.again:  # the observer starts at the estimate made at that time
            self.observe(self.first, self.made[self.first])
        return self

    def estimate(self):
        start = self.candidate
        if self.warm_start and self.before is not None:
            # The previous estimate, moved on by the model to the present window.
            ahead = np.vstack([self.before, self.steps[-1](self.before[-1])])
            other = ahead[len(ahead) - len(start) :]
            start = other if self.cost(other) < self.cost(start) * (1 - 1e-9) else start
        return self.improved(start) if self.cost(start) > 1e-9 else start

    def check(self, estimate, last=True):
        """Compare with an estimate of the window, the last one before the next sample."""
        expected = self.estimate()
        np.testing.assert_allclose(estimate.candidate, self.candidate, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(estimate.trajectory, expected, rtol=1e-7, atol=1e-8)
        assert estimate.candidate_cost == pytest.approx(self.cost(self.candidate), rel=1e-7)
        assert estimate.cost == pytest.approx(self.cost(expected), rel=1e-7)
        assert estimate.improved is bool(self.cost(self.candidate) > 1e-9)
        if last:
            self.before = estimate.trajectory
            self.made.append(estimate.state)


@pytest.mark.parametrize(("warm_start", "candidate", "arrival"), [
    (True, "observer", "observer"), (False, "observer", "smoothed"),
    (True, "reinitialized", "smoothed"), (False, "reinitialized", "observer"),
])
def test_the_numbers_are_those_of_plain_loops(warm_start, candidate, arrival):
    options = {"warm_start": warm_start, "candidate": candidate, "arrival": arrival}
    for count, horizon, missing, discount in ((20, 4, 0.3, 0.9), (9, 1, 0.3, 1.0), (80, 5, 0.0, 1)):
        mhe = estimator(horizon=horizon, discount=discount, **options)
        kept = Plain(horizon, discount=discount, **options)
        for y in record(count, missing):
            estimate = mhe.update(y)
            kept.take(y).check(estimate)
            assert estimate.qps == 1


# The smoothed prior


def test_ipopt_with_the_prior_update_of_other_toolboxes():
    """Their prior is x[1] of the solution before, Ipopt's own; costs and states agree."""
    ca = pytest.importorskip("casadi")
    horizon = 6
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
    mhe = estimator(horizon=horizon, max_qps=None, tolerance=1e-14, **SMOOTHED)
    for y in record(20, seed=5):
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


def test_late_measurements_and_what_is_set_keep_the_windows_prior():
    ys = record(14)
    mhe, kept = estimator(**SMOOTHED), Plain(**SMOOTHED)
    for t, y in enumerate(ys):
        given = np.full(1, NAN) if t == 8 else y
        estimate = mhe.update(given)
        kept.take(given).check(estimate, last=False)
        if t == 9:
            kept.amend(8, ys[8])
            kept.check(mhe.amend(8, ys[8]), last=False)
            kept.R, kept.noise_weights = 3.0 * R, [3.0 * R] * len(kept.ys)
            estimate = mhe.set(noise_weight=3.0 * R)
        kept.check(estimate)
