"""Boxes, polytopes and intersections; soft sets and nonlinear constraints in the estimator."""

import pickle
import re

import numpy as np
import pytest

import qpmhe
from qpmhe import Box, Constraint, Polytope, Status
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError
from tests.estimation.same import assert_same

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")


def test_a_point_is_in_an_intersection_as_far_as_in_each_inequality():
    generator = np.random.default_rng(3)
    for k in range(60):
        d, lead = int(generator.integers(1, 4)), [(), (1,), (7,), (3, 4)][k % 4]
        low, high = -generator.exponential(size=(2, d)), generator.exponential(size=(2, d))
        low[generator.random((2, d)) < 0.3] = -np.inf
        rows, sides = generator.standard_normal((2, 2, d)), generator.exponential(size=(2, 2))
        whole = Box(low[0], high[0]) & Polytope(rows[0], sides[0])
        if k % 2:
            whole = Polytope(rows[1], sides[1]) & Box(low[1], high[1]) & whole
        points = 0.6 * generator.standard_normal((*lead, d))
        parts = 1 + k % 2
        missed = [
            *(points - one for one in high[:parts]), *(one - points for one in low[:parts]),
            *(points @ row.T - side for row, side in zip(rows[:parts], sides, strict=False)),
        ]
        expected = max(0.0, *(one.max() for one in missed))
        assert whole.violation(points) == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize(("units", "row"), [((1e-9, 1e9), 1e-9), ((1e-12, 1e-9), 1e12)])
def test_whether_a_set_is_empty_depends_on_no_unit(units, row):
    units = np.array(units)
    matrix = row * np.array([[1.0, 1.0], [-1.0, -0.5], [0.0, -1.0]]) / units
    made = Polytope(matrix, row * np.array([1.0, -0.9, 0.0]))
    assert (made & Box(0.1 * units, units)).dimension == 2
    with pytest.raises(SetError, match="empty"):
        made & Box([-np.inf, 0.6 * units[1]], [np.inf, np.inf])
    with pytest.raises(SetError, match="empty"):
        Polytope(matrix, row * np.array([1.0, -1.2, 0.0]))


def test_inequalities_on_unknown_components_do_not_count():
    one = Box([-1.0, -2.0, -3.0], [1.0, 2.0, np.inf]) & Polytope(
        [[1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 1.0, 1.0]], [2.5, 2.0, 3.0]
    )
    # Component 0 is out by 6, 1 by 2, 2 by 4; the rows by 8.5, 5 and 1.
    point = np.array([7.0, 4.0, -7.0])
    for known, expected in (([1, 1, 0], 8.5), ([1, 0, 1], 6.0), ([0, 0, 1], 5.0), ([0] * 3, 0.0)):
        assert one.violation(point, np.array(known, bool)) == expected
    rows = one.touched(np.array([[True, False, False], [False, False, True], [False] * 3]))
    np.testing.assert_array_equal(rows, [[1, 0, 1], [0, 1, 1], [0, 0, 0]])


# In the estimator


def f(x):
    return np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * ((1 - x[0] ** 2) * x[1] - x[0])])


def h(x):
    return np.array([x[0] + 0.1 * x[1] ** 2, x[1]])


def ball(x):
    return x[0] ** 2 + x[1] ** 2 - 2.0


def branching(x):
    return x[0] - 1.0 if x[1] > 0.0 else x[0]


def within(w, v):
    return np.array([(w[0] - 0.02) ** 2 + w[1] ** 2 - 0.004, v[0] + 0.5 * v[1] - 0.2])


COST = qpmhe.QuadraticCost.from_covariances(
    prior=0.25 * np.eye(2), disturbance=0.01 * np.eye(2), noise=0.04 * np.eye(2)
)
OBSERVER = qpmhe.Luenberger(0.1 * np.eye(2))
UNIT = Box([-1.0, -1.0], [1.0, 1.0])
SOFT = {
    "states": Box([-0.9, -np.inf], [1.0, 0.6]).soften(linear=3.0),
    "noises": Box([-0.2, -0.2], [0.1, 0.3]).soften(quadratic=[20.0, 40.0]),
    "constraints": [
        Constraint(ball, linear=4.0),
        Constraint(within, 2, linear=[10.0, 0.0], quadratic=[0.0, 30.0]),
    ],
}


def record(steps=24):
    rng, x, ys = np.random.default_rng(1), np.array([1.2, 0.5]), []
    for _ in range(steps):
        ys.append(h(x) + 0.2 * rng.standard_normal(2))
        x = f(x) + 0.05 * rng.standard_normal(2)
    return np.array(ys)


def make(options=None, system=None, **given):
    return qpmhe.MovingHorizonEstimator(
        system or qpmhe.System(f, h, n=2, p=2, **(options or {})), OBSERVER, COST, horizon=6,
        initial_state=[1.5, 0.8], **{"max_qps": None, **given},
    )


def test_a_large_linear_penalty_of_a_ball_is_exact_from_its_centre():
    rng, compared, ball = np.random.default_rng(19), 0, lambda x: x @ x - 0.1
    hard, soft = (
        make({"constraints": [Constraint(ball, **penalty)]}, tolerance=1e-12)
        for penalty in ({}, {"linear": 1e5})
    )
    hard.reset([0.0, 0.0])
    soft.reset([0.0, 0.0])
    for y in 0.5 * rng.normal(size=(12, 2)):
        one, other = hard.update(y), soft.update(y)
        assert other.qps < 50
        if one.improved and not one.dropped and np.array_equal(one.candidate, other.candidate):
            assert other.cost <= one.cost * (1.0 + 1e-5)
            compared += 1
    assert compared


@pytest.mark.slow
@pytest.mark.parametrize(("bad", "penalty"), [
    ("raise", {}), ("exit", {"linear": 5.0}), ("nan", {"linear": 5.0}), ("shape", {}),
])
def test_a_constraint_that_fails_far_from_the_data_never_escapes(bad, penalty):
    armed, failed = [], 0

    def g(x, v):
        np.isnan(x)  # has no form in CasADi: g is called as it is written
        if armed and x[0] > 1.2 and x[1] > 0.0:
            if bad in ("raise", "exit"):
                raise ValueError("too far") if bad == "raise" else SystemExit
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


def test_snapshots_continue_bit_for_bit_with_the_same_constraints_only():
    ys, first = record(18), make(SOFT, max_qps=3)
    first.run(ys[:11])
    first.forget_warm_start()
    second = pickle.loads(pickle.dumps(first))
    for y in ys[11:]:
        assert_same(second.update(y), first.update(y))
    soft = {"constraints": [Constraint(ball, linear=1.0)]}
    for one, other, words in (
        (soft, {"constraints": [Constraint(ball, linear=2.0)]}, "another constraints"),
        ({"states": UNIT.soften(linear=2.0)}, {"states": UNIT.soften(linear=1.0)}, "set of states"),
    ):
        mhe = make(one)
        mhe.update([1.0, 0.5])
        with pytest.raises(InvalidInputError, match=words):
            make(other).load_state_dict(mhe.state_dict())


def test_constraints_of_inputs_count_with_steps_of_any_length():
    options = {"n": 2, "p": 2, "m": 1, "dt": 0.1, "method": "euler"}
    soft, free = (
        make(system=qpmhe.System.from_ode(lambda x, u: [x[1] + u[0], -x[0]], h, **options, **more))
        for more in ({"constraints": [Constraint(lambda x, u: u[0] - 0.8, quadratic=50.0)]}, {})
    )
    for t, y in enumerate(record(5)):
        own = {"u": [0.3 * t], "dt": 0.2 if t == 2 else None}
        one, other = soft.update(y, **own), free.update(y, **own)
        missed = 0.1**2 * (t > 2) + 0.4**2 * (t > 3)  # at inputs of 0.9 and 1.2
        assert one.candidate_cost == pytest.approx(other.candidate_cost + 50.0 * missed)


def test_the_observer_is_not_projected_onto_a_soft_set():
    mhe = make({"states": Box([-0.1, -0.1], [0.1, 0.1]).soften(linear=1.0)})
    assert mhe.initial_state.tolist() == [1.5, 0.8]
    outside = Status.OBSERVER_PROJECTED | Status.CANDIDATE_OUTSIDE
    assert not any(mhe.update(y).status & outside for y in record())


@pytest.mark.parametrize("unit", [1e160, 1e-140])
def test_units_of_a_constraint_decide_nothing(unit):
    """Nor do those in which squares of its values are not finite."""
    made = [
        make({"constraints": [Constraint(lambda x, k=k: k * (ball(x) + 0.5))]})
        for k in (1.0, unit)
    ]
    for y in record():
        one, other = (mhe.update(y) for mhe in made)
        assert one.status == other.status
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-6, atol=1e-6)


WRONG = [
    (lambda: UNIT.soften(), SetError, "row 0 of the soft set has no penalty"),
    (lambda: UNIT & UNIT.soften(linear=1.0), SetError, "intersect sets first and soften"),
    (lambda: Constraint(ball, linear=0.0), SetError, "leave the constraint hard"),
    (lambda: Constraint(lambda z: z), ModelError, "has the parameter z; expected only x"),
    (lambda: make({"constraints": [ball]}), SetError, "expected a list of qpmhe.Constraint"),
    (lambda: make({"constraints": [None]}), SetError, "constraints holds None; expected a list"),
    (lambda: make({"constraints": [Constraint(lambda x, u: x[0])]}), ModelError,
     "constraints[0] takes u, but the system has no inputs"),
    (lambda: make({"constraints": [Constraint(lambda x: np.log(x[0] - 3.0))]}), ModelError,
     "constraints[0] is [nan] at the initial state"),
    (lambda: make({"constraints": [Constraint(branching)]}, engine="compiled"), OptionError,
     "constraints[0] has no C form ("),
    (lambda: make({"state_residual": qpmhe.angles([0]), "states": SOFT["states"]}), SetError,
     "bounds an angle"),
]


def test_bad_input_is_refused():
    for make_it, error, text in WRONG:
        with np.errstate(all="ignore"), pytest.raises(error, match=re.escape(text)):
            make_it()


@pytest.mark.parametrize("penalty", [{}, {"quadratic": 20.0}], ids=["hard", "soft"])
def test_a_constraint_is_evaluated_as_an_expression_where_it_has_one(penalty):
    """With the values and derivatives of the function, also with sensors missing."""
    def g(x, v):
        return x[0] - 1.1 + 0.1 * v[0] * x[1]

    def written(x, v):
        np.isnan(x)  # has no form in CasADi
        return g(x, v)

    one, other = (make({"constraints": [Constraint(each, **penalty)]}) for each in (g, written))
    own = one._engine.system.constraints
    assert own.is_traced
    assert not other._engine.system.constraints.is_traced
    np.testing.assert_array_equal(own._touched, [[True, False]])  # of v
    for t, y in enumerate(record(16)):
        y = np.where([t % 5 == 2, False], np.nan, y)
        found, expected = one.update(y), other.update(y)
        np.testing.assert_allclose(found.trajectory, expected.trajectory, 0.0, 1e-5)
        assert found.cost == pytest.approx(expected.cost, rel=1e-5)
        assert found.cost <= found.candidate_cost


def test_a_constraint_that_changes_is_found():
    most = [1.1]
    mhe = make({"constraints": [Constraint(lambda x: x[0] - most[0])]})
    ys = record(24)
    mhe.run(ys[:6])
    most[0] = 0.7
    words = r"constraints\[0\] has changed since it was traced"
    with pytest.warns(qpmhe.errors.EngineWarning, match=words):
        mhe.run(ys[6:])
    assert mhe.time == 24
    assert not mhe._engine.system.constraints.is_traced


@pytest.mark.parametrize("soft", [False, True])
def test_a_system_with_other_sets_leaves_the_first_as_it_is(soft):
    box = qpmhe.Box([-1.0], [1.0])
    given = box.soften(linear=3.0) if soft else box
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=given)
    other = system.with_sets({"states": None})
    assert other.states is None
    assert not other.soft
    wider = system.with_sets({"states": qpmhe.Box([-2.0], [2.0])})
    found = [one.soft["states"].convex if one.soft else one.states for one in (system, wider)]
    assert [one.upper.tolist() for one in found] == [[1.0], [2.0]]
    with pytest.raises(AttributeError, match="with_sets"):
        system.states = None
