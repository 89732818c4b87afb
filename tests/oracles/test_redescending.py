"""Redescending losses and observers that judge innovations, against Ipopt on the same true J."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

ca = pytest.importorskip("casadi")
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")

HORIZON = 4
# A stationary point as near to ours, in standard deviations of disturbance and prior, is the same.
NEARBY = 1.0
BETTER = 1e-6


class Problem:
    """A random small problem with outliers, a gap now and then, and its J written out in CasADi."""

    def __init__(self, seed):
        self.draw = draw = np.random.default_rng([77, seed])
        self.n, self.p = n, p = 2, int(draw.integers(1, 4))
        a, b, c = draw.normal(size=(n, n)), draw.normal(size=(n, n)), draw.normal(size=(p, n))
        a *= draw.uniform(0.5, 1.0) / np.abs(np.linalg.eigvals(a)).max()
        self.a, self.b, self.c = a, b, c
        self.prior, self.disturbance, self.noise = (
            np.diag(draw.uniform(low, high, size))
            for low, high, size in ((0.05, 0.5, n), (0.01, 0.1, n), (0.01, 0.1, p))
        )
        self.kind = [("barron", 0.0), ("barron", -2.0), ("barron", -5.0), ("huber", None)][seed % 4]
        self.threshold, self.per_component = draw.uniform(1.0, 2.5), bool(draw.random() < 0.5)
        self.start = draw.normal(size=n)
        weight = np.linalg.inv(self.noise)
        name, shape = self.kind
        loss = qpmhe.Huber(weight, self.threshold, self.per_component) if name == "huber" else (
            qpmhe.Barron(weight, shape, self.threshold, self.per_component,
                         graduation=float(draw.choice([1.0, 10.0])))
        )
        cost = qpmhe.RobustCost(
            prior=np.linalg.inv(self.prior), disturbance=np.linalg.inv(self.disturbance), noise=loss
        )
        innovation = [
            qpmhe.Gate(reopen=int(draw.integers(1, 6))), qpmhe.HuberInnovation(),
            qpmhe.Gate(0.9, reopen=3, groups=[list(range(p))]),
        ][seed % 3]
        make = qpmhe.ExtendedKalman if draw.random() < 0.6 else qpmhe.UnscentedKalman
        observer = make(
            prior=self.prior, disturbance=self.disturbance, noise=self.noise, innovation=innovation
        )
        self.mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(self.f, self.h, n=n, p=p), observer, cost, horizon=HORIZON,
            initial_state=self.start, max_qps=None, tolerance=1e-13,
        )
        self.programs = {}

    def f(self, x):
        return self.a @ x + 0.3 * np.sin(self.b @ x)

    def h(self, x):
        return self.c @ x + 0.05 * (self.c @ x) ** 2

    def measurements(self, steps):
        draw, x = self.draw, self.start + np.sqrt(np.diag(self.prior)) * self.draw.normal(size=2)
        for _ in range(steps):
            y = self.h(x) + np.sqrt(np.diag(self.noise)) * draw.normal(size=self.p)
            y += (draw.random(self.p) < 0.15) * draw.choice([-1.0, 1.0], self.p) * 4.0
            y[draw.random(self.p) < 0.1] = np.nan
            x = self.f(x) + np.sqrt(np.diag(self.disturbance)) * draw.normal(size=2)
            yield y

    def loss(self, q):
        """rho of a form q, from the formulas of the documentation."""
        (name, shape), square = self.kind, self.threshold**2
        if name == "huber":
            r = ca.sqrt(ca.fmax(q, 1e-300))
            return ca.if_else(q <= square, q, 2.0 * self.threshold * r - square)
        if shape == 0.0:
            return 2.0 * square * ca.log(1.0 + q / (2.0 * square))
        width = 2.0 - shape
        return 2.0 * square * width / shape * ((1.0 + q / (square * width)) ** (shape / 2.0) - 1.0)

    def program(self, count):
        """Ipopt's solver, and J, for a window of so many samples."""
        if count not in self.programs:
            x, prior = ca.MX.sym("x", 2, count + 1), ca.MX.sym("prior", 2)
            y, there = ca.MX.sym("y", self.p, count), ca.MX.sym("there", self.p, count)
            offset = x[:, 0] - prior
            J = ca.bilin(ca.DM(np.linalg.inv(self.prior)), offset, offset)
            for i in range(count):
                f = ca.DM(self.a) @ x[:, i] + 0.3 * ca.sin(ca.DM(self.b) @ x[:, i])
                w = x[:, i + 1] - f
                J += ca.bilin(ca.DM(np.linalg.inv(self.disturbance)), w, w)
                seen = ca.DM(self.c) @ x[:, i]
                squares = (y[:, i] - seen - 0.05 * seen**2) ** 2 / np.diag(self.noise) * there[:, i]
                forms = ca.vertsplit(squares) if self.per_component else [ca.sum1(squares)]
                J += sum(self.loss(q) for q in forms)
            given = ca.veccat(prior, y, there)
            options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
                       "ipopt.tol": 1e-10, "ipopt.max_iter": 300}
            self.programs[count] = (
                ca.nlpsol("J", "ipopt", {"x": ca.vec(x), "p": given, "f": J}, options),
                ca.Function("J", [ca.vec(x), given], [J]),
            )
        return self.programs[count]

    def distance(self, one, other):
        """The largest distance of two trajectories' states, in standard deviations."""
        sizes = np.sqrt(np.maximum(np.diag(self.prior), np.diag(self.disturbance)))
        return float((np.abs(one - other) / sizes).max())


@pytest.mark.parametrize("seed", range(12))
def test_ipopt_finds_no_lower_stationary_point_nearby(seed):
    """From our estimate, and from the same first guess, the observer's candidate."""
    one = Problem(seed)
    window, rejected, compared = [], 0, 0
    for y in one.measurements(25):
        estimate = one.mhe.update(y)
        window = [*window, y][-HORIZON:]
        rejected += bool(estimate.rejected_sensors)
        ys = np.array(window)
        solve, cost = one.program(len(window))
        given = np.concatenate((
            estimate.candidate[0], np.nan_to_num(ys).ravel(), np.isfinite(ys).ravel() * 1.0
        ))

        def judged(trajectory, cost=cost, given=given):
            return float(cost(trajectory.ravel(), given))

        ours = judged(estimate.trajectory)
        assert ours == pytest.approx(estimate.cost, rel=1e-9, abs=1e-12)
        candidate = judged(estimate.candidate)
        assert candidate == pytest.approx(estimate.candidate_cost, rel=1e-9, abs=1e-12)
        assert estimate.cost <= estimate.candidate_cost
        # While the first window fills, a widened loss is minimised in place of J.
        if Status.CONVERGED not in estimate.status or Status.GRADUATED in estimate.status:
            continue
        compared += 1
        for start in (estimate.trajectory, estimate.candidate):
            answer = solve(x0=start.ravel(), p=given)
            theirs = np.array(answer["x"]).reshape(-1, 2)
            if not math.isfinite(judged(theirs)):
                continue
            nearby = one.distance(theirs, estimate.trajectory) < NEARBY
            if start is estimate.trajectory or nearby:
                assert judged(theirs) >= ours - BETTER * (1.0 + ours)
    assert compared > 15
    assert rejected > 0 or not one.mhe.observer.rejects
