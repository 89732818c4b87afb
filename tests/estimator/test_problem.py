"""Window, J with its verdict, and the QP of a step, against plain loops and dense algebra."""

import math

import numpy as np
import pytest

import qpmhe

from .plain import Record, assembled, differences, spd

NONE = np.zeros(0)
NAMES = ("states", "disturbances", "noises")


def roomy(kind, d):
    """A set around the origin that holds every candidate here, and a component without bounds."""
    generator = np.random.default_rng(d)
    box = qpmhe.Box([-20.0] * (d - 1) + [-np.inf], [np.inf] * (d - 1) + [18.0])
    rows = qpmhe.Polytope(generator.standard_normal((d + 1, d)), np.full(d + 1, 12.0))
    return {"box": box, "rows": rows, "both": rows & box}[kind]


def inequalities(one):
    """(index, coefficients, lower, upper) of bounds and rows that are not both infinite."""
    identity = np.eye(one.dimension)
    for j in range(one.dimension):
        if np.isfinite(one.lower[j]) or np.isfinite(one.upper[j]):
            yield j, identity[j], one.lower[j], one.upper[j]
    for k, rest in enumerate(zip(one.matrix, one.row_lower, one.row_upper, strict=True)):
        yield one.dimension + k, *rest


class Case:
    """What a step consists of, beside the record in plain lists."""

    def __init__(self, sizes, *, horizon=4, missing=0.0, kalman=False, sets=None):
        self.n, self.p, self.m = sizes
        self.generator = generator = np.random.default_rng(1)
        self.a, self.c = (generator.standard_normal((k, self.n)) for k in (self.n, self.p))
        self.b = generator.standard_normal((self.n, max(self.m, 1)))
        self.missing, self.sets = missing, sets or {}
        self.weights = spd(generator, self.n), spd(generator, self.n), spd(generator, self.p)
        gain, start = 0.1 * np.ones((self.n, self.p)), generator.standard_normal(self.n)
        f = (lambda x, u: self.f(x, u)) if self.m else (lambda x: self.f(x))
        system = qpmhe.System(f, self.h, n=self.n, p=self.p, m=self.m, **self.sets)
        observer, given = qpmhe.Luenberger(gain), dict(zip(
            ("prior", "disturbance", "noise"), self.weights, strict=True
        ))
        if kalman:
            observer = qpmhe.ExtendedKalman(**given)
            given["prior"] = qpmhe.ObserverPrior()
        self.window, self.formulation, self.subproblem = assembled(
            system, observer, qpmhe.QuadraticCost(**given), horizon, start
        )
        self.kept = Record(self.h, gain, start, self.weights, horizon)

    def f(self, x, u=None):
        ahead = np.sin(0.6 * x @ self.a.T)
        return ahead if u is None else ahead + u @ self.b.T

    def h(self, x):
        return x @ self.c.T + 0.1 * x[..., :1] ** 2

    def push(self):
        y, u = self.generator.standard_normal(self.p), self.generator.standard_normal(self.m)
        y[self.generator.random(self.p) < self.missing] = np.nan
        self.window.push(y, u)
        self.problem = self.formulation.problem(self.window)
        self.kept.push(lambda x: self.f(x, u if self.m else None), y)
        if self.window.prior_covariance is not None:  # the filter is judged by its own tests
            self.kept.P = np.linalg.inv(self.window.prior_covariance)
            self.kept.z[self.kept.first :] = list(self.window.candidate)

    def trajectory(self, scale=0.7):
        shape = self.window.candidate.shape
        return self.window.candidate + scale * self.generator.standard_normal(shape)

    def trials(self):
        """The candidate, whose terms are kept from sample to sample, and another trajectory."""
        yield self.problem.candidate, self.window.candidate.copy()
        trajectory = self.trajectory()
        yield self.problem.evaluate(trajectory), trajectory

    def check(self):
        kept, window = self.kept, self.window
        assert (window.time, window.length) == (len(kept.ys), kept.count)
        np.testing.assert_allclose(window.candidate, kept.candidate, rtol=1e-12, atol=1e-13)
        assert self.problem.candidate.cost == window.candidate_cost
        for trial, trajectory in self.trials():
            assert trial.cost == pytest.approx(kept.cost(trajectory), rel=1e-10)
            there = np.hstack((np.ones((kept.count, self.n), bool), window.observed))
            np.testing.assert_allclose(
                trial.residuals[there], kept.residuals(trajectory)[there], rtol=1e-10, atol=1e-12
            )
            qp = self.subproblem.at(self.problem, trial)
            for found, expected in (
                (qp.gradient, 0.5 * kept.gradient(trajectory)),
                (qp.dense(), kept.hessian(trajectory)),
            ):
                scale = np.abs(expected).max() + 1.0
                np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * scale)

    def missed(self, trajectory):
        """The inequalities that are missed, each with its miss in the row's scale."""
        residuals, found = self.kept.residuals(trajectory), {}
        points = {
            "states": trajectory, "disturbances": residuals[:, : self.n],
            "noises": residuals[:, self.n :],
        }
        for name, weight in zip(NAMES, self.weights, strict=True):
            for k, point in enumerate(points[name] if name in self.sets else ()):
                for index, row, low, high in inequalities(self.sets[name]):
                    if name == "noises" and row[~self.window.observed[k]].any():
                        continue
                    scale = min(np.sqrt(row @ np.linalg.inv(weight) @ row), high - low)
                    for side, miss in (("lower", low - row @ point), ("upper", row @ point - high)):
                        if miss > 0.0:
                            found[name, index, side, self.kept.first + k] = miss / scale
        return found

    def check_rows(self, qp, trajectory):
        """Every linearised inequality is there once, and nothing else."""
        residuals = self.kept.residuals(trajectory)
        slopes, expected = differences(self.kept.residuals, trajectory), []
        parts = {"disturbances": slice(0, self.n), "noises": slice(self.n, None)}
        for name, one in self.sets.items():
            for k in range(len(trajectory) if name == "states" else len(residuals)):
                for _, row, low, high in inequalities(one):
                    if name == "states":
                        slope, value = np.zeros(trajectory.shape), row @ trajectory[k]
                        slope[k] = row
                    else:
                        slope, value = row @ slopes[k, parts[name]], row @ residuals[k, parts[name]]
                    if name != "noises" or not row[~self.window.observed[k]].any():
                        sides = clipped(low - value, high - value)
                        expected.append(np.append(slope.ravel(), sides))
        found = [
            np.append(slope, clipped(low, high))
            for slopes, lower, upper in (
                (qp.dense_rows(), qp.row_lower, qp.row_upper), (np.eye(qp.size), qp.lower, qp.upper)
            )
            for slope, low, high in zip(slopes, lower.ravel(), upper.ravel(), strict=True)
            if np.isfinite(low) or np.isfinite(high)
        ]
        assert len(found) == len(expected)
        if expected:
            gap = np.abs(np.array(found)[:, None] - np.array(expected)[None]).max(axis=2)
            assert max(gap.min(axis=0).max(), gap.min(axis=1).max()) < 1e-9


def clipped(low, high):
    """Sides, infinite ones as large numbers."""
    return np.clip([low, high], -1e6, 1e6)


@pytest.mark.parametrize("kalman", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("sizes", [(1, 1, 0), (3, 2, 1), (2, 3, 2)])
def test_cost_gradient_and_hessian_of_growing_and_sliding_windows(sizes, missing, kalman):
    for horizon in (1, 4):
        case = Case(sizes, horizon=horizon, missing=missing, kalman=kalman)
        for _ in range(horizon + 3):
            case.push()
            case.check()


@pytest.mark.parametrize(
    ("sizes", "horizon", "kalman"), [((2, 2, 1), 3, False), ((1, 1, 0), 66, True)]
)
def test_windows_that_slide_to_the_front_of_their_memory(sizes, horizon, kalman):
    case = Case(sizes, horizon=horizon, missing=0.02, kalman=kalman)
    for t in range(2 * max(64, horizon) + horizon + 10):
        case.push()
        if t % 64 < 5 and (horizon == 3 or t in (128, 132, 195)):
            case.check()


# Sets


@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("kind", ["box", "rows", "both"])
@pytest.mark.parametrize("names", [*((name,) for name in NAMES), NAMES], ids="-".join)
def test_verdict_and_rows(names, kind, missing):
    sizes = {"states": 2, "disturbances": 2, "noises": 3}
    sets = {name: roomy(kind, sizes[name]) for name in names}
    case, inside = Case((2, 3, 0), missing=missing, sets=sets), set()
    for _ in range(6):
        case.push()
        assert case.problem.candidate.violation == 0.0
        for trial, trajectory in case.trials():
            case.check_rows(case.subproblem.at(case.problem, trial), trajectory)
        for scale in (0.1, 3.0, 7.0, 40.0):
            trajectory = case.trajectory(scale)
            trial, missed = case.problem.evaluate(trajectory), case.missed(trajectory)
            expected = max(missed.values(), default=0.0)
            assert trial.violation == pytest.approx(expected, rel=1e-10, abs=1e-12)
            assert set(case.problem.missed_rows(trial)) == set(missed)
            cost = math.inf if missed else case.kept.cost(trajectory)
            assert trial.cost == pytest.approx(cost, rel=1e-10)
            inside.add(not missed)
    assert inside == ({True} if names == ("noises",) and missing == 1.0 else {True, False})


def filled(observer, samples=3, cost=1.0, horizon=4, start=1.0, f=lambda x: 0.5 * x, **options):
    """Window, problem and subproblem of one state that is measured, after measurements of 1."""
    system = qpmhe.System(f, options.pop("h", lambda x: x), n=1, p=1, **options)
    weights = qpmhe.QuadraticCost(prior=cost, disturbance=cost, noise=cost)
    window, formulation, subproblem = assembled(
        system, observer, weights, horizon, np.full(1, start), project=False
    )
    for _ in range(samples):
        window.push(np.ones(1), NONE)
    return window, formulation, subproblem


def test_the_last_state_counts_and_rounding_does_not():
    states = qpmhe.Box([-100.0], [30.0])
    window, formulation, _ = filled(qpmhe.Luenberger([0.1]), 6, states=states)
    for stage in (0, 2, 4):
        for beyond in (-1e-3, -1e-12, 1e-12, 1e-6):
            trajectory = window.candidate.copy()
            trajectory[stage] = 30.0 + beyond
            cost = formulation.problem(window).evaluate(trajectory).cost
            assert math.isfinite(cost) is (beyond < 1e-9)


def test_sides_that_the_candidate_violates_are_left_out_and_come_back():
    box = qpmhe.Box([-2.0], [2.0])
    window, formulation, subproblem = filled(
        qpmhe.Luenberger([0.8]), 0, horizon=2, start=0.0, f=lambda x: 0.8 * x,
        states=box, disturbances=box, noises=box,
    )
    missing = []
    for y in (0.5, 0.5, 9.0, 0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 0.0, 0.0):
        window.push(np.array([y]), NONE)
        problem, candidate = formulation.problem(window), window.candidate.copy()
        missed = set(problem.missed_rows(problem.candidate))
        assert (problem.evaluate(candidate).cost == math.inf) is bool(missed)
        relaxed = problem.without_violated()
        assert math.isfinite(relaxed.evaluate(candidate).cost)
        for far in (-30.0, 30.0):
            left = relaxed.missed_rows(relaxed.evaluate(candidate + far))
            assert set(left) == set(problem.missed_rows(problem.evaluate(candidate + far))) - missed
        qp = subproblem.at(relaxed, relaxed.candidate)
        sides = (
            (candidate, qp.lower, qp.upper),
            (window.residuals, qp.row_lower[:-1], qp.row_upper[:-1]),
        )
        for points, lower, upper in sides:
            np.testing.assert_array_equal(lower, np.where(points < -2.0, -np.inf, -2.0 - points))
            np.testing.assert_array_equal(upper, np.where(points > 2.0, np.inf, 2.0 - points))
        missing.append([int(np.isinf(side).sum()) for _, *both in sides for side in both])
    assert np.max(missing, axis=0).min() > 0
    assert missing[0] == missing[-1] == [0, 0, 0, 0]


def test_noise_free_rows_are_never_left_out():
    for fixed in (0.0, 0.3):
        box = qpmhe.Box([fixed, -0.1], [fixed, 0.1])
        system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=2, p=2, disturbances=box)
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(2))
        window, formulation, _ = assembled(
            system, qpmhe.Luenberger(np.eye(2)), cost, 4, np.ones(2)
        )
        for _ in range(3):
            window.push(np.array([4.0, -4.0]), NONE)
        problem = formulation.problem(window)
        relaxed = problem.without_violated()
        assert {row.row for row in problem.missed_rows(problem.candidate)} == {0, 1}
        assert {row.row for row in relaxed.missed_rows(problem.candidate)} == {0}
        # A trial is rolled out along them.
        trial = relaxed.evaluate(window.candidate.copy())
        np.testing.assert_allclose(trial.residuals[:, 0], fixed, atol=1e-15)


# Models that cannot be evaluated everywhere


def root_or_nan(x):
    return np.sqrt(x)


def root_or_raise(x):
    return np.array([math.sqrt(x[0])])


@pytest.mark.parametrize("root", [root_or_nan, root_or_raise, lambda x: x / (x > 0)])
@pytest.mark.parametrize("where", ["f", "h"])
def test_a_trajectory_without_model_costs_infinitely(root, where):
    with np.errstate(all="ignore"):
        window, formulation, _ = filled(qpmhe.Luenberger([0.1]), 4, **{where: root})
        for stage, value in ((0, -1.0), (3, -1.0), (0, np.nan), (2, np.inf), (4, 1e200)):
            trajectory = np.maximum(window.candidate, 0.1)
            assert math.isfinite(formulation.problem(window).evaluate(trajectory).cost)
            trajectory[stage] = value
            assert formulation.problem(window).evaluate(trajectory).cost == math.inf


@pytest.mark.parametrize(
    "jacobian",
    [
        lambda x: np.array([[0.5 / np.sqrt(x[0])]]),  # infinite
        lambda x: [[x[0] / (x[0] * abs(x[0]) ** 0.5) / 2]],  # NaN
        lambda x: [[0.5 / float(x[0]) ** 0.5]],  # raises
    ],
)
def test_there_is_no_qp_where_there_is_no_jacobian(jacobian):
    with np.errstate(all="ignore"):
        window, formulation, subproblem = filled(
            qpmhe.Luenberger([0.1]), f=root_or_nan, f_jacobian=jacobian
        )
        problem, trajectory = formulation.problem(window), np.ones((4, 1))
        assert subproblem.at(problem, problem.evaluate(trajectory)) is not None
        for stage in (0, 1, 2):
            trajectory = np.ones((4, 1))
            trajectory[stage] = 0.0
            trial = problem.evaluate(trajectory)
            assert np.isfinite(trial.cost)
            assert subproblem.at(problem, trial) is None
