"""Where the candidate is outside of W or V, the converged sequence reaches Ipopt's minimum."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

ca = pytest.importorskip("casadi")

# Of a row, in units of its width or of a standard deviation.
FEASIBLE = 1e-8


class Problem:
    """A random model with X, W and V, written once for NumPy and for CasADi."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        n, p = self.n, self.p = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        self.horizon = int(rng.integers(3, 7))
        turn = rng.standard_normal((n, n))
        self.A = rng.uniform(0.6, 0.95) * turn / np.linalg.norm(turn, 2)
        self.C, self.bend = rng.standard_normal((p, n)), rng.uniform(-0.3, 0.3, (2, n))
        self.gain = 0.5 * np.linalg.pinv(self.C) + 0.1 * rng.standard_normal((n, p))
        self.cost = qpmhe.QuadraticCost(
            prior=np.diag(10.0 ** rng.uniform(-1, 1, n)),
            disturbance=np.diag(10.0 ** rng.uniform(0, 2, n)),
            noise=np.diag(10.0 ** rng.uniform(0, 2, p)),
        )
        self.X = qpmhe.Box(-rng.uniform(1.0, 3.0, n), rng.uniform(1.0, 3.0, n))
        self.W, self.V = self._box(rng, n, 0.2), self._box(rng, p, 0.4)
        self.start = 0.3 * rng.standard_normal(n)
        x, self.Y = self.start + 0.5 * rng.standard_normal(n), []
        for _ in range(self.horizon + 6):
            x = np.clip(x, self.X.lower, self.X.upper)
            self.Y.append(self.h(x, np) + rng.uniform(self.V.lower, self.V.upper))
            x = self.f(x, np) + rng.uniform(self.W.lower, self.W.upper)

    @staticmethod
    def _box(rng, size, width):
        """Bounds of which a third excludes zero."""
        middle = rng.choice([-1.0, 0.0, 0.0, 0.0, 0.0, 1.0], size) * 1.2 * width
        return qpmhe.Box(
            middle - width * rng.uniform(0.3, 1.0, size), middle + width * rng.uniform(0.3, 1.0, size)
        )

    def f(self, x, xp):
        return self.A @ x + self.bend[0] * xp.sin(2.0 * x)

    def h(self, x, xp):
        return self.C @ (x + self.bend[1] * x * x)

    def estimates(self):
        system = qpmhe.System(
            lambda x: self.f(x, np), lambda x: self.h(x, np), n=self.n, p=self.p,
            states=self.X, disturbances=self.W, noises=self.V,
        )
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(self.gain), self.cost, horizon=self.horizon,
            initial_state=np.clip(self.start, self.X.lower, self.X.upper), max_qps=None,
            solver_tolerance=1e-10, tolerance=1e-10,
        )
        return [mhe.update(y) for y in self.Y]

    def program(self):
        n, p, N = self.n, self.p, self.horizon
        x, prior, y = ca.SX.sym("x", n, N + 1), ca.SX.sym("prior", n), ca.SX.sym("y", p, N)
        offset = x[:, 0] - prior
        J, rows = offset.T @ self.cost.prior @ offset, []
        for i in range(N):
            w, v = x[:, i + 1] - self.f(x[:, i], ca), y[:, i] - self.h(x[:, i], ca)
            J += w.T @ self.cost.disturbance @ w + v.T @ self.cost.noise @ v
            rows += [w, v]
        options = {
            "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-11,
            "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 500,
        }
        program = {"x": ca.vec(x), "p": ca.veccat(prior, y), "f": J, "g": ca.vertcat(*rows)}
        return ca.nlpsol("mhe", "ipopt", program, options)

    def minimum(self, solve, candidate, Y):
        """Ipopt's J from a candidate, or infinity where it finds no feasible point."""
        N = self.horizon
        answer = solve(
            x0=candidate.ravel(), p=np.concatenate((candidate[0], np.ravel(Y))),
            lbx=np.tile(self.X.lower, N + 1), ubx=np.tile(self.X.upper, N + 1),
            lbg=np.tile(np.append(self.W.lower, self.V.lower), N),
            ubg=np.tile(np.append(self.W.upper, self.V.upper), N),
        )
        x = np.array(answer["x"]).reshape(N + 1, self.n)
        if solve.stats()["return_status"] != "Solve_Succeeded" or self.missed(x, Y) > FEASIBLE:
            return np.inf
        return float(answer["f"])

    def missed(self, x, Y):
        w = x[1:] - np.array([self.f(one, np) for one in x[:-1]])
        v = Y - np.array([self.h(one, np) for one in x[:-1]])
        weights = (self.cost.prior, self.cost.disturbance, self.cost.noise)
        return max(
            (np.maximum(box.lower - points, points - box.upper) / np.minimum(
                box.upper - box.lower, 1.0 / np.sqrt(weight.diagonal())
            )).max()
            for box, points, weight in zip(
                (self.X, self.W, self.V), (x, w, v), weights, strict=True
            )
        )


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_a_candidate_outside_leads_to_ipopts_minimum():
    reached, above, wrong = 0, 0, []
    for seed in range(60):
        problem = Problem(seed)
        N, solve = problem.horizon, problem.program()
        for t, estimate in enumerate(problem.estimates()):
            if t + 1 < N or Status.CANDIDATE_OUTSIDE not in estimate.status:
                continue
            Y = np.array(problem.Y[t + 1 - N : t + 1])
            assert estimate.cost <= estimate.candidate_cost
            minimum = problem.minimum(solve, estimate.candidate, Y)
            if minimum > estimate.candidate_cost:
                above += 1
                continue
            reached += 1
            if (
                estimate.dropped or problem.missed(estimate.trajectory, Y) > FEASIBLE
                or not estimate.cost <= minimum * (1.0 + 1e-6)
            ):
                wrong.append(
                    f"seed {seed}, time {t}: J {estimate.cost:.9g}, Ipopt's {minimum:.9g}, "
                    f"candidate's {estimate.candidate_cost:.9g}; {estimate.explain()}"
                )
    print(f"{reached} windows compared; in {above} Ipopt finds nothing below the candidate's J")
    assert wrong == []
    assert reached >= 150
