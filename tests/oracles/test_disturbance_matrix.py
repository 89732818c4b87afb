"""Disturbances of lower dimension than the state, against Ipopt and python-control."""

import numpy as np
import pytest

import qpmhe

from .nlp import Window, ca, times
from .test_kalman import spd

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
STEPS, HORIZON = 10, 5


class Curved:
    """A random nonlinear system with x+ = f(x) + G w, sets that bind, and a record."""

    def __init__(self, seed, kind="matrix"):
        rng = np.random.default_rng(seed)
        n, p = self.n, self.p = int(rng.integers(2, 5)), int(rng.integers(1, 3))
        r = int(rng.integers(1, n))
        a = rng.standard_normal((n, n))
        self.A = 0.8 * a / np.abs(np.linalg.eigvals(a)).max()
        self.bent, self.C = 0.15 * rng.standard_normal((n, n)), rng.standard_normal((p, n))
        self.curve, self.G = 0.03 * rng.standard_normal((p, n)), rng.standard_normal((n, r))
        self.P, self.Q, self.R = (0.3 * spd(rng, k) for k in (n, r, p))
        self.start = rng.standard_normal(n)
        x, ys = self.start + 0.5 * rng.standard_normal(n), []
        for _ in range(STEPS):
            ys.append(self.h(x) + 0.5 * rng.standard_normal(p))
            x = self.f(x) + self.G @ (0.4 * rng.standard_normal(r))
        self.Y, self.kind, self.sets = np.array(ys), kind, {}
        if kind == "sets":
            self.sets = {
                "states": _box(rng, n, 1.8), "disturbances": _box(rng, r, 0.3),
                "noises": _box(rng, p, 1.2),
            }

    def f(self, x, u=None):
        return times(self.A, x) + times(self.bent, (ca.sin if isinstance(x, ca.SX) else np.sin)(x))

    def h(self, x, u=None):
        return times(self.C, x) + times(self.curve, x * x)

    def estimator(self, observer=None, **options):
        """With G itself, or with the singular covariance G Q G'."""
        covariances = {"prior": self.P, "disturbance": self.Q, "noise": self.R}
        given = {"disturbance_matrix": self.G}
        if self.kind == "covariance":
            given, covariances["disturbance"] = {}, self.G @ self.Q @ self.G.T
        return qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda x: self.f(x), lambda x: self.h(x), n=self.n, p=self.p,
                         **given, **self.sets),
            observer or qpmhe.ExtendedKalman(**covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances),
            initial_state=self.start, max_qps=None, **options,
        )

    def window(self, estimate):
        count = len(estimate.disturbances)
        P, Q, R = map(np.linalg.inv, (self.P, self.Q, self.R))
        return Window(
            self.f, self.h, self.Y[estimate.time + 1 - count : estimate.time + 1],
            estimate.candidate[0], (P, [Q] * count, [R] * count), matrix=self.G,
            boxes={name: [one] * (count + 1) for name, one in self.sets.items()},
        )


def _box(rng, size, half):
    return qpmhe.Box(-half * rng.uniform(0.7, 1.3, size), half * rng.uniform(0.7, 1.3, size))


@pytest.mark.parametrize("kind", ["matrix", "covariance", "sets"])
@pytest.mark.parametrize("seed", range(12))
def test_convergence_is_ipopts_minimum(seed, kind):
    case = Curved(seed, kind)
    mhe, reached = case.estimator(horizon=HORIZON, solver_tolerance=1e-9), 0
    for y in case.Y:
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
        window, x = case.window(estimate), estimate.trajectory
        assert estimate.cost == pytest.approx(window.judged(x)[0], rel=1e-9)
        d = x[1:] - case.f(x[:-1])
        w = np.linalg.lstsq(case.G, d.T, rcond=None)[0].T
        assert np.abs(w @ case.G.T - d).max() <= 1e-13 * (1.0 + np.abs(x).max())
        expected = d if kind == "covariance" else w
        np.testing.assert_allclose(estimate.disturbances, expected, rtol=0, atol=1e-8)
        minimum, _ = window.minimum(estimate.candidate)
        if minimum < estimate.candidate_cost:
            assert estimate.dropped == ()
            assert estimate.cost == pytest.approx(minimum, rel=1e-6)
            reached += 1
    assert reached >= (1 if kind == "sets" else STEPS)


def test_a_disturbance_of_python_control_takes_as_many_lines_as_there():
    """Its optimal estimation problem takes three lines beside the system."""
    ct = pytest.importorskip("control")
    opt = pytest.importorskip("control.optimal")
    A, B = np.array([[0.9, 0.2], [-0.1, 0.95]]), np.array([[0.0, 1.0], [1.0, 0.5]])
    P, Q, R = np.eye(2), [[0.01]], 0.04 * np.eye(2)
    rng, times = np.random.default_rng(0), np.arange(8)
    plant = ct.ss(A, B, np.eye(2), 0, True)  # a control and a disturbance
    U = np.vstack((np.sin(times), 0.1 * rng.standard_normal(8)))
    Y = ct.input_output_response(plant, times, U).outputs + 0.2 * rng.standard_normal((2, 8))

    trajectory_cost = opt.gaussian_likelihood_cost(plant, np.array(Q), R)
    problem = opt.OptimalEstimationProblem(
        plant, times, trajectory_cost, terminal_cost=lambda guess, x: (guess - x) @ (guess - x)
    )
    theirs = problem.compute_estimate(Y, U[:1], X0=np.zeros(2), print_summary=False)

    system = qpmhe.from_control(ct.ss(A, B[:, :1], np.eye(2), 0, True), disturbance_matrix=B[:, 1:])
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
    cost = qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R)
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=8, initial_state=[0, 0])

    for y, u in zip(Y.T, U[:1].T, strict=True):
        estimate = mhe.update(y, u)
    np.testing.assert_allclose(estimate.trajectory[:-1], theirs.states.T, atol=1e-4)
    np.testing.assert_allclose(estimate.disturbances[:-1], theirs.inputs.T[:-1], atol=1e-4)


@pytest.mark.parametrize("seed", [3, 15, 16, 17, 26, 37])
def test_where_no_step_from_the_observer_helps_the_search_goes_on_from_its_roll_out(seed):
    case = Curved(seed)
    case.bent *= 6.0
    gain = 0.5 * np.random.default_rng(seed).standard_normal((case.n, case.p))
    mhe = case.estimator(qpmhe.Luenberger(gain), horizon=8)
    for y in case.Y:
        estimate = mhe.update(y)
        assert estimate.improved
        assert estimate.cost < estimate.candidate_cost
