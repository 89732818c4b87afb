"""Soft sets and nonlinear constraints, hard and soft, in the estimator."""

import pickle
import re

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Constraint, Status
from qpmhe.certificates.audit import checked_ingredients
from qpmhe.errors import InvalidInputError, ModelError, SetError, ShapeError

from .same import assert_same

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")

N = 6


def f(x):
    return np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * ((1 - x[0] ** 2) * x[1] - x[0])])


def h(x):
    return np.array([x[0] + 0.1 * x[1] ** 2, x[1]])


def rate(x, u):
    return np.array([x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]])


def ball(x):
    return x[0] ** 2 + x[1] ** 2 - 2.0


def within(w, v):
    return np.array([w[0] ** 2 + w[1] ** 2 - 0.004, v[0] + 0.5 * v[1] - 0.2])


COST = qpmhe.QuadraticCost.from_covariances(
    prior=0.25 * np.eye(2), disturbance=0.01 * np.eye(2), noise=0.04 * np.eye(2)
)
GAIN = [[0.1, 0.0], [0.0, 0.1]]
SOFT = {
    "states": Box([-0.9, -np.inf], [1.0, 0.6]).soften(linear=3.0),
    "disturbances": qpmhe.Polytope([[1.0, 1.0], [-1.0, 0.5]], [0.02, 0.01]).soften(
        linear=5.0, quadratic=100.0
    ),
    "noises": Box([-0.2, -0.2], [0.1, 0.3]).soften(quadratic=[20.0, 40.0]),
    "constraints": [
        Constraint(ball, linear=4.0),
        Constraint(within, 2, linear=[10.0, 0.0], quadratic=[0.0, 30.0]),
    ],
}
HARD = {"constraints": [Constraint(ball), Constraint(within, 2)]}


def record(steps=24):
    rng, x, ys = np.random.default_rng(1), np.array([1.2, 0.5]), []
    for _ in range(steps):
        ys.append(h(x) + 0.2 * rng.standard_normal(2))
        x = f(x) + 0.05 * rng.standard_normal(2)
    return np.array(ys)


def make(options=None, system=None, **given):
    return qpmhe.MovingHorizonEstimator(
        system or qpmhe.System(f, h, n=2, p=2, **(options or {})), qpmhe.Luenberger(GAIN), COST,
        horizon=N, initial_state=[1.5, 0.8], **{"max_qps": None, **given},
    )


def estimates(options=None, ys=None, **given):
    mhe = make(options, **given)
    return [mhe.update(y) for y in (record() if ys is None else ys)]


@pytest.mark.parametrize("given", [{}, {"max_qps": 1}, {"warm_start": True, "max_qps": 2}])
def test_what_is_never_touched_changes_nothing(given):
    def far(x, w, v):
        return x[0] + w[1] + v[0] - 50.0

    wide = {
        "states": Box([-9.0, -9.0], [9.0, 9.0]).soften(linear=1e3),
        "disturbances": qpmhe.Polytope([[1.0, 2.0]], [50.0]).soften(quadratic=1e3),
        "noises": Box([-90.0, -90.0], [90.0, 90.0]).soften(linear=1.0, quadratic=2.0),
        "constraints": [Constraint(far, linear=9.0)],
    }
    plain, hard = estimates(**given), {"constraints": [Constraint(far)]}
    for soft, other, expected in zip(
        estimates(wide, **given), estimates(hard, **given), plain, strict=True
    ):
        assert_same(soft, expected)
        np.testing.assert_allclose(other.trajectory, expected.trajectory, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", [10, 19])
def test_a_large_linear_penalty_of_a_ball_is_exact_from_its_centre(seed):
    a = np.array([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.1, 0.9]])
    rng = np.random.default_rng(seed)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=0.3 * np.eye(3), disturbance=0.01 * np.eye(3), noise=0.05 * np.eye(2)
    )
    hard, soft = (
        qpmhe.MovingHorizonEstimator(
            qpmhe.System(
                lambda x: x @ a.T + 0.1 * np.sin(x), lambda x: x[..., :2], n=3, p=2,
                constraints=[Constraint(lambda x: x @ x - 0.1, **penalty)],
            ),
            qpmhe.Luenberger(0.2 * np.eye(3)[:, :2]), cost, horizon=6, initial_state=np.zeros(3),
            max_qps=None, tolerance=1e-12,
        )
        for penalty in ({}, {"linear": 1e5})
    )
    x = rng.normal(size=3) * 0.3
    for _ in range(12):
        y = x[:2] + 0.2 * rng.normal(size=2)
        x = x @ a.T + 0.1 * rng.normal(size=3)
        one, other = hard.update(y), soft.update(y)
        assert other.qps < 50
        if one.improved and not one.dropped and np.array_equal(one.candidate, other.candidate):
            assert other.cost <= one.cost * (1.0 + 1e-5)


def test_hard_constraints_hold_or_are_named():
    ys, named = record(), 0
    ys[5:12, 1] = np.nan  # rows on missing outputs do not count
    for estimate in estimates(HARD, ys, max_qps=3):
        first = estimate.time + 1 - len(estimate.disturbances)
        missed = set()
        for i, x in enumerate(estimate.trajectory):
            values = [ball(x)]
            if i < len(estimate.disturbances) and np.isfinite(estimate.noises[i]).all():
                values += within(estimate.disturbances[i], estimate.noises[i]).tolist()
            missed |= {(j, first + i) for j, value in enumerate(values) if value > 1e-6}
        if estimate.improved:
            assert missed == {(row.row, row.time) for row in estimate.dropped}
        named += bool(estimate.dropped)
        assert estimate.cost <= estimate.candidate_cost
    assert named
    kept = estimates(HARD, ys, infeasible="keep_candidate")
    assert any(one.status & Status.CANDIDATE_OUTSIDE and not one.dropped for one in kept)
    row = qpmhe.DroppedRow("constraints", 2, "upper", 7)
    assert str(row) == "upper bound of constraints, row 2, at time 7"


@pytest.mark.parametrize("penalty", [{}, {"linear": 5.0}])
@pytest.mark.parametrize("bad", ["raise", "nan", "exit", "shape"])
def test_a_constraint_that_fails_far_from_the_data_never_escapes(bad, penalty):
    armed, failed = [], 0

    def g(x, v):
        if armed and x[0] > 1.2 and x[1] > 0.0:
            if bad == "raise":
                raise ValueError("too far")
            if bad == "exit":
                raise SystemExit
            return [1.0, 2.0, 3.0] if bad == "shape" else np.nan
        return x[0] - 1.1 + 0.1 * v[0]

    mhe = make({"constraints": [Constraint(g, **penalty)]})
    armed.append(True)
    rng = np.random.default_rng(3)
    for y in record():
        estimate = mhe.update(y + rng.choice([0.0, 1.5]))
        assert not estimate.cost > estimate.candidate_cost
        if Status.MODEL_FAILED in estimate.status:
            failed += 1
            assert "constraints[0]" in estimate.message
        assert np.isfinite(estimate.cost) or not estimate.improved
    assert failed


@pytest.mark.parametrize("options", [HARD, SOFT])
def test_a_snapshot_continues_bit_for_bit(options):
    ys = record(18)
    first, second = (make(options, max_qps=3) for _ in range(2))
    for y in ys[:11]:
        first.update(y)
    third = pickle.loads(pickle.dumps(first))
    second.load_state_dict(first.state_dict())
    for y in ys[11:]:
        expected = first.update(y)
        assert_same(second.update(y), expected)
        assert_same(third.update(y), expected)


BOX = Box([-1.0, -1.0], [1.0, 1.0])


def test_a_snapshot_of_other_penalties_or_another_g_is_refused():
    soft = {"constraints": [Constraint(ball, linear=1.0)]}
    for one, other, words in (
        (soft, {"constraints": [Constraint(ball, linear=2.0)]}, "another constraints"),
        (soft, {"constraints": [Constraint(ball)]}, "another constraints"),
        (soft, {"constraints": [Constraint(lambda x: ball(x) - 0.1, linear=1.0)]}, "another cons"),
        ({"states": BOX.soften(linear=2.0)}, {"states": BOX.soften(linear=1.0)}, "set of states"),
    ):
        mhe = make(one)
        mhe.update([1.0, 0.5])
        with pytest.raises(InvalidInputError, match=words):
            make(other).load_state_dict(mhe.state_dict())


def test_models_of_casadi_inputs_and_steps():
    pytest.importorskip("casadi")
    options = {
        "n": 2, "p": 2, "m": 1, "dt": 0.1, "states": SOFT["states"],
        "constraints": [Constraint(lambda x, u: x[0] + u[0] - 0.8, quadratic=50.0)],
    }

    system = qpmhe.from_casadi(
        lambda x, u: [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]],
        lambda x: [x[0] + 0.1 * x[1] ** 2, x[1]], **options,
    )
    ours, theirs = make(system=system), make(system=qpmhe.System.from_ode(rate, h, **options))
    for t, y in enumerate(record(10)):
        one, other = (mhe.update(y, [0.1], dt=0.2 if t == 4 else None) for mhe in (ours, theirs))
        assert one.cost == pytest.approx(other.cost, rel=1e-7)


def test_the_observer_is_not_projected_onto_a_soft_set():
    soft = {"states": Box([-0.1, -0.1], [0.1, 0.1]).soften(linear=1.0)}
    for estimate in estimates(soft):
        assert Status.OBSERVER_PROJECTED not in estimate.status
        assert Status.CANDIDATE_OUTSIDE not in estimate.status
    assert make(soft).initial_state.tolist() == [1.5, 0.8]


@pytest.mark.parametrize(("name", "words"), [
    ("states", "a soft set of states"), ("noises", "a soft set of noises"),
    ("constraints", "nonlinear constraints"),
])
def test_what_does_not_have_them_says_so_by_name(name, words):
    from qpmhe.codegen.library import uncovered
    from qpmhe.estimation.settings import Settings
    from qpmhe.studies.ipopt import IpoptEstimator

    observer, system = qpmhe.Luenberger(GAIN), qpmhe.System(f, h, n=2, p=2, **{name: SOFT[name]})
    system.symbolic = object()  # as if it had a CasADi form
    assert words in uncovered(system, observer, COST, Settings(N, "auto", 1))
    with pytest.raises(InvalidInputError, match=words):
        checked_ingredients(system, observer, COST)
    pytest.importorskip("casadi")
    with pytest.raises(InvalidInputError, match=words):
        IpoptEstimator(
            system, observer, COST, f=f, h=h, horizon=N, initial_state=np.array([1.0, 0.0])
        )


WRONG = [
    (lambda: BOX.soften(), SetError, "row 0 of the soft set has no penalty"),
    (lambda: BOX.soften(linear=0.0), SetError, "pass linear > 0 or quadratic > 0"),
    (lambda: BOX.soften(linear=-1.0), SetError, "linear is -1.0; expected finite numbers >= 0"),
    (lambda: BOX.soften(quadratic=np.inf), SetError, "quadratic is inf"),
    (lambda: BOX.soften(linear=[1.0, 2.0, 3.0]), SetError, "linear has shape (3,)"),
    (lambda: BOX.soften(linear="much"), InvalidInputError, "linear is 'much'"),
    (lambda: BOX & BOX.soften(linear=1.0), SetError, "intersect sets first and soften"),
    (lambda: Constraint(3.0), ModelError, "g is 3.0; expected a function"),
    (lambda: Constraint(ball, 0), ShapeError, "size is 0; expected an integer >= 1"),
    (lambda: Constraint(ball, linear=0.0), SetError, "leave the constraint hard"),
    (lambda: Constraint(within, 2, linear=[1, 2, 3]), SetError, "linear has shape (3,)"),
    (lambda: Constraint(lambda z: z), ModelError, "has the parameter z; expected only x"),
    (lambda: Constraint(lambda: 1.0), ModelError, "g takes no argument"),
    (lambda: Constraint(lambda u: u), ModelError, "g takes u, so that no estimate"),
    (lambda: Constraint(np.sin), ModelError, "which can be passed by name"),
    (lambda: make({"constraints": [ball]}), SetError, "expected a list of qpmhe.Constraint"),
    (lambda: make({"constraints": 3}), SetError, "constraints holds 3; expected a list"),
    (lambda: make({"constraints": [Constraint(lambda x, u: x[0])]}), ModelError,
     "constraints[0] takes u, but the system has no inputs"),
    (lambda: make({"constraints": [Constraint(lambda x: x, 3)]}), ModelError,
     "constraints[0] returned shape (2,)"),
    (lambda: make({"constraints": [Constraint(lambda x: np.log(x[0] - 3.0))]}), ModelError,
     "constraints[0] is [nan] at the initial state"),
    (lambda: make({"states": Box([0.0], [1.0]).soften(linear=1.0)}), SetError,
     "states has dimension 1; expected 2"),
    (lambda: make({"noises": 3}), SetError, "noises is 3"),
    (lambda: make({"state_residual": qpmhe.angles([0]), "states": SOFT["states"]}), SetError,
     "bounds an angle"),
]  # fmt: skip


def test_bad_input_is_refused():
    for make_it, error, text in WRONG:
        with np.errstate(all="ignore"), pytest.raises(error, match=re.escape(text)):
            make_it()
