"""Redescending losses and observers that judge innovations, against Ipopt on the same true J."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .nlp import Model, Window, ca

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")

HORIZON = 4
# A stationary point as near to ours, in standard deviations of disturbance and prior, is the same.
NEARBY = 1.0
BETTER = 1e-6


class Problem:
    """A random small problem with outliers and gaps, and its J by the documentation's formulas."""

    def __init__(self, seed):
        self.draw = draw = np.random.default_rng([77, seed])
        n, p = 2, int(draw.integers(1, 4))
        self.model = Model.drawn(draw, n, p, (0.5, 1.0), 0.3, 0.05)
        self.covariances = [
            np.diag(draw.uniform(low, high, size))
            for low, high, size in ((0.05, 0.5, n), (0.01, 0.1, n), (0.01, 0.1, p))
        ]
        self.shape = (0.0, -2.0, -5.0, "huber")[seed % 4]
        self.threshold, self.per_component = draw.uniform(1.0, 2.5), bool(draw.random() < 0.5)
        self.start = draw.normal(size=n)
        prior, disturbance, weight = map(np.linalg.inv, self.covariances)
        graduation = float(draw.choice([1.0, 10.0]))
        loss = qpmhe.Huber(weight, self.threshold, self.per_component) if seed % 4 == 3 else (
            qpmhe.Barron(weight, self.shape, self.threshold, self.per_component,
                         graduation=graduation)
        )
        innovation = [
            qpmhe.Gate(reopen=int(draw.integers(1, 6))), qpmhe.HuberInnovation(),
            qpmhe.Gate(0.9, reopen=3, groups=[list(range(p))]),
        ][seed % 3]
        make = qpmhe.ExtendedKalman if draw.random() < 0.6 else qpmhe.UnscentedKalman
        names = ("prior", "disturbance", "noise")
        observer = make(
            **dict(zip(names, self.covariances, strict=True)), innovation=innovation
        )
        self.mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(self.model.f, self.model.h, n=n, p=p), observer,
            qpmhe.RobustCost(prior=prior, disturbance=disturbance, noise=loss),
            horizon=HORIZON, initial_state=self.start, max_qps=None, tolerance=1e-13,
        )

    def measurements(self, steps):
        draw, (prior, disturbance, noise) = self.draw, map(np.diag, self.covariances)
        x = self.start + np.sqrt(prior) * draw.normal(size=2)
        for _ in range(steps):
            y = self.model.h(x) + np.sqrt(noise) * draw.normal(size=noise.size)
            y += (draw.random(y.size) < 0.15) * draw.choice([-1.0, 1.0], y.size) * 4.0
            y[draw.random(y.size) < 0.1] = np.nan
            x = self.model.f(x) + np.sqrt(disturbance) * draw.normal(size=2)
            yield y

    def loss(self, v, weight):
        squares = v**2 * np.diag(weight)
        forms = ca.vertsplit(squares) if self.per_component else [ca.sum1(squares)]
        return sum(self.rho(q) for q in forms)

    def rho(self, q):
        square = self.threshold**2
        if self.shape == "huber":
            r = ca.sqrt(ca.fmax(q, 1e-300))
            return ca.if_else(q <= square, q, 2.0 * self.threshold * r - square)
        if self.shape == 0.0:
            return 2.0 * square * ca.log(1.0 + q / (2.0 * square))
        width, half = 2.0 - self.shape, self.shape / 2.0
        return square * width / half * ((1.0 + q / (square * width)) ** half - 1.0)

    def window(self, estimate, ys):
        prior, disturbance, noise = map(np.linalg.inv, self.covariances)
        return Window(
            self.model.f, self.model.h, ys, estimate.candidate[0],
            (prior, [disturbance] * len(ys), [noise] * len(ys)), loss=self.loss,
        )

    def distance(self, one, other):
        """The largest distance of two trajectories' states, in standard deviations."""
        sizes = np.sqrt(np.maximum(*map(np.diag, self.covariances[:2])))
        return float((np.abs(one - other) / sizes).max())


@pytest.mark.parametrize("seed", range(12))
def test_ipopt_finds_no_lower_stationary_point_nearby(seed):
    """From our estimate, and from the same first guess, the observer's candidate."""
    one = Problem(seed)
    ys, rejected, compared = [], 0, 0
    for y in one.measurements(25):
        estimate = one.mhe.update(y)
        ys = [*ys, y][-HORIZON:]
        rejected += bool(estimate.rejected_sensors)
        window = one.window(estimate, ys)
        ours, _ = window.judged(estimate.trajectory)
        assert ours == pytest.approx(estimate.cost, rel=1e-9, abs=1e-12)
        candidate, _ = window.judged(estimate.candidate)
        assert candidate == pytest.approx(estimate.candidate_cost, rel=1e-9, abs=1e-12)
        assert estimate.cost <= estimate.candidate_cost
        # While the first window fills, a widened loss is minimised in place of J.
        if Status.CONVERGED not in estimate.status or Status.GRADUATED in estimate.status:
            continue
        compared += 1
        for start in (estimate.trajectory, estimate.candidate):
            theirs, trajectory = window.minimum(start)
            if not math.isfinite(theirs):
                continue
            nearby = one.distance(trajectory, estimate.trajectory) < NEARBY
            if start is estimate.trajectory or nearby:
                assert theirs >= ours - BETTER * (1.0 + ours)
    assert compared > 15
    assert rejected > 0 or not one.mhe.observer.rejects
