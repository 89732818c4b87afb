"""General inequalities on states, disturbances and noises: verdict, rows and estimates."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import Record, assembled, differences, spd

NONE = np.zeros(0)
GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 3)
GAIN = 0.1 * GENERATOR.standard_normal((2, 3))
C = GENERATOR.standard_normal((3, 2))
START = np.array([0.4, -0.2])
COST = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R)


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return x @ C.T + 0.1 * x[..., :1] ** 2


def roomy(kind, d):
    """A set around the origin that holds every candidate here."""
    generator = np.random.default_rng(d)
    rows = qpmhe.Polytope(generator.standard_normal((d + 1, d)), np.full(d + 1, 12.0))
    box = qpmhe.Box([-15.0] * (d - 1) + [-np.inf], [np.inf] * (d - 1) + [14.0])
    smaller = qpmhe.Box([-9.0] * d, [9.0] * d)
    return {"rows": rows, "both": box & rows, "more": rows & box & smaller}[kind]


NAMES = ("states", "disturbances", "noises")
SIZES = {"states": 2, "disturbances": 2, "noises": 3}


class Case:
    def __init__(self, names, kind, missing=0.0, horizon=4):
        self.sets = {name: roomy(kind, SIZES[name]) for name in names}
        self.system = qpmhe.System(swing, seen, n=2, p=3, **self.sets)
        self.window, self.formulation, self.subproblem = assembled(
            self.system, qpmhe.Luenberger(GAIN), COST, horizon, START
        )
        self.kept = Record(seen, GAIN, START, (P, Q, R), horizon)
        self.generator, self.missing = np.random.default_rng(2), missing

    def push(self):
        y = self.generator.standard_normal(3)
        y[self.generator.random(3) < self.missing] = np.nan
        self.window.push(y, NONE)
        self.problem = self.formulation.problem(self.window)
        self.kept.push(swing, y)

    def trajectory(self, scale):
        shape = self.window.candidate.shape
        return self.window.candidate + scale * self.generator.standard_normal(shape)

    def missed(self, trajectory):
        """The inequalities that are missed, each with its miss in the row's scale."""
        residuals, first = self.kept.residuals(trajectory), self.kept.first
        points = {
            "states": (trajectory, P), "disturbances": (residuals[:, :2], Q),
            "noises": (residuals[:, 2:], R),
        }
        found = {}
        for name, one in self.sets.items():
            values, weight = points[name]
            for k, point in enumerate(values):
                for index, row, low, high in inequalities(one):
                    if name == "noises" and row[~self.window.observed[k]].any():
                        continue
                    spread = np.sqrt(row @ np.linalg.inv(weight) @ row)
                    scale = min(spread, high - low)
                    for side, miss in (("lower", low - row @ point), ("upper", row @ point - high)):
                        if miss > 0.0:
                            found[name, index, side, first + k] = miss / scale
        return found


def inequalities(one):
    """(index, coefficients, lower, upper) of bounds and rows that are not both infinite."""
    identity = np.eye(one.dimension)
    for j in range(one.dimension):
        if np.isfinite(one.lower[j]) or np.isfinite(one.upper[j]):
            yield j, identity[j], one.lower[j], one.upper[j]
    for k, rest in enumerate(zip(one.matrix, one.row_lower, one.row_upper, strict=True)):
        yield one.dimension + k, *rest


@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("kind", ["rows", "more"])
@pytest.mark.parametrize("names", [NAMES, *((name,) for name in NAMES)], ids="-".join)
def test_the_verdict(names, kind, missing):
    case, inside = Case(names, kind, missing), set()
    for _ in range(6):
        case.push()
        assert case.problem.candidate.violation == 0.0
        for scale in (0.1, 3.0, 7.0, 20.0):
            trajectory = case.trajectory(scale)
            trial, missed = case.problem.evaluate(trajectory), case.missed(trajectory)
            expected = max(missed.values(), default=0.0)
            assert trial.violation == pytest.approx(expected, rel=1e-10, abs=1e-12)
            assert set(case.problem.missed_rows(trial)) == set(missed)
            if missed:
                assert trial.cost == math.inf
            else:
                assert trial.cost == pytest.approx(case.kept.cost(trajectory), rel=1e-10)
            inside.add(not missed)
    assert inside == ({True} if names == ("noises",) and missing == 1.0 else {True, False})


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("kind", ["rows", "both", "more"])
@pytest.mark.parametrize("names", [NAMES, *((name,) for name in NAMES)], ids="-".join)
def test_rows_and_bounds_of_the_qp(names, kind, missing):
    case = Case(names, kind, missing)
    for _ in range(5):
        case.push()
        candidate, trajectory = case.window.candidate.copy(), case.trajectory(0.5)
        check_qp(case, case.subproblem.at(case.problem, case.problem.candidate), candidate)
        trial = case.problem.evaluate(trajectory)
        check_qp(case, case.subproblem.at(case.problem, trial), trajectory)


def check_qp(case, qp, trajectory):
    """Every linearised inequality is there once, and nothing else."""
    residuals = case.kept.residuals(trajectory)
    slopes, expected = differences(case.kept.residuals, trajectory), []
    parts = {"disturbances": slice(0, 2), "noises": slice(2, 5)}
    for name, one in case.sets.items():
        for k in range(len(trajectory)) if name == "states" else range(len(residuals)):
            for _, row, low, high in inequalities(one):
                if name == "states":
                    slope, value = np.zeros(trajectory.shape), row @ trajectory[k]
                    slope[k] = row
                else:
                    slope, value = row @ slopes[k, parts[name]], row @ residuals[k, parts[name]]
                if name != "noises" or not row[~case.window.observed[k]].any():
                    expected.append((slope.ravel(), low - value, high - value))
    matrix, identity = qp.dense_rows(), np.eye(qp.size)
    found = [
        (matrix[k], low, high)
        for k, (low, high) in enumerate(
            zip(qp.row_lower.ravel(), qp.row_upper.ravel(), strict=True)
        )
        if np.isfinite(low) or np.isfinite(high)
    ]
    found += [
        (identity[k], low, high)
        for k, (low, high) in enumerate(zip(qp.lower.ravel(), qp.upper.ravel(), strict=True))
        if np.isfinite(low) or np.isfinite(high)
    ]
    assert len(found) == len(expected)
    if expected:
        gap = np.abs(as_rows(found)[:, None] - as_rows(expected)[None]).max(axis=2)
        assert gap.min(axis=0).max() < 1e-9
        assert gap.min(axis=1).max() < 1e-9


def as_rows(inequalities):
    """Coefficients and sides of each in a row, an infinite side as a large number."""
    return np.array(
        [np.append(slope, np.clip([low, high], -1e6, 1e6)) for slope, low, high in inequalities]
    )


# The estimator

BACKENDS = [
    name for name in qpmhe.solvers.available() if qpmhe.solvers.backend(name).inequalities
]


def as_polytope(lower, upper):
    """The box as rows."""
    d = len(lower)
    return qpmhe.Polytope(
        np.vstack([np.eye(d), -np.eye(d)]), np.concatenate([upper, -np.array(lower)])
    )


BOUNDS = {
    "states": ([-0.3, -0.35], [0.4, 0.2]),
    "disturbances": ([-0.15, -0.2], [0.2, 0.15]),
    "noises": ([-1.7, -0.76, -0.66], [0.64, 0.49, 1.14]),
}
MEASURED = np.clip(0.7 * np.random.default_rng(3).standard_normal((12, 3)), -1.1, 1.1)


def estimator(sets, backend="auto", **options):
    system = qpmhe.System(swing, seen, n=2, p=3, **sets)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.3 * GAIN), COST, backend=backend,
        **{"horizon": 4, "initial_state": [0.2, -0.1], "max_qps": 8, "solver_tolerance": 1e-9}
        | options,
    )


@pytest.fixture(scope="module")
def boxed_estimates():
    """Converged estimates with each set written as a box, and how often it binds."""
    result = {}
    for name in NAMES:
        boxed, free = estimator({name: qpmhe.Box(*BOUNDS[name])}), estimator({})
        result[name] = [boxed.update(y) for y in MEASURED]
        binding = [
            estimate.cost > free.update(y).cost * (1 + 1e-6)
            for estimate, y in zip(result[name], MEASURED, strict=True)
        ]
        assert sum(binding) >= (2 if name == "noises" else 6)
    return result


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_box_written_as_rows_gives_the_same_estimates(backend, name, boxed_estimates):
    rows = estimator({name: as_polytope(*BOUNDS[name])}, backend)
    for y, one in zip(MEASURED[:8], boxed_estimates[name][:8], strict=True):
        other = rows.update(y)
        assert one.dropped == other.dropped == ()
        assert other.cost == pytest.approx(one.cost, rel=2e-4)
        np.testing.assert_allclose(other.trajectory, one.trajectory, atol=3e-3)
        assert other.cost <= other.candidate_cost


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_half_plane_across_the_states(backend):
    plane = qpmhe.Polytope([[1.0, 1.0]], [0.35])
    mhe, active = estimator({"states": plane}, backend, max_qps=3), 0
    for y in MEASURED[:10]:
        estimate = mhe.update(y)
        assert estimate.dropped == ()
        sums = estimate.trajectory.sum(axis=1)
        assert sums.max() <= 0.35 + 1e-8
        assert estimate.cost <= estimate.candidate_cost
        active += sums.max() > 0.35 - 1e-4
    assert active >= 4


def test_a_polytope_of_noises_holds_where_its_outputs_are_there():
    polytope = qpmhe.Polytope([[1.0, 1.0, 0.0], [0.0, 0.0, -1.0]], [1.2, 1.1])
    mhe = estimator({"noises": polytope})
    judged = []
    for t, y in enumerate(MEASURED):
        y = y.copy()
        if t % 3 == 0:
            y[1] = np.nan
        estimate = mhe.update(y)
        assert estimate.dropped == ()
        for noise in estimate.noises:
            rows = [noise[0] + noise[1] - 1.2, -noise[2] - 1.1]
            judged += [row for row in rows if np.isfinite(row)]
    assert max(judged) <= 1e-8
    assert len(judged) > 60


@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
def test_an_observer_that_leaves_a_polytope(infeasible, project):
    sets = {"states": qpmhe.Polytope([[1.0, -1.0]], [0.5])}
    mhe = estimator(sets, infeasible=infeasible, project_observer=project)
    ys = MEASURED.copy()
    ys[4] = 30.0 * np.array([1.0, -1.0]) @ GAIN / np.linalg.norm(GAIN) ** 2
    seen = Status(0)
    for y in ys:
        estimate = mhe.update(y)
        seen |= estimate.status
        assert estimate.cost <= estimate.candidate_cost
        inside = (estimate.trajectory @ [1.0, -1.0]).max() <= 0.5 + 1e-8
        assert inside or estimate.dropped or not (project or estimate.improved)
    assert (Status.OBSERVER_PROJECTED in seen) is (Status.CANDIDATE_OUTSIDE not in seen) is project
    assert infeasible == "drop_rows" or Status.ROWS_DROPPED not in seen


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-9, 1e9), (1e9, 1e6), (1e-12, 1e-9)])
@pytest.mark.parametrize("row", [1e-9, 1.0, 1e12])
def test_whether_a_polytope_is_empty_depends_on_no_unit(units, row):
    units = np.array(units)
    matrix = row * np.array([[1.0, 1.0], [-1.0, -0.5], [0.0, -1.0]]) / units
    made = qpmhe.Polytope(matrix, row * np.array([1.0, -0.9, 0.0]))
    assert (made & qpmhe.Box(0.1 * units, units)).dimension == 2
    with pytest.raises(qpmhe.errors.SetError, match="empty"):
        made & qpmhe.Box([-np.inf, 0.6 * units[1]], [np.inf, np.inf])
    with pytest.raises(qpmhe.errors.SetError, match="empty"):
        qpmhe.Polytope(matrix, row * np.array([1.0, -1.2, 0.0]))
