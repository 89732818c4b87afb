"""Soft sets and nonlinear constraints, hard and soft, in the estimator."""

import pickle
import re

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.certificates.audit import checked_ingredients
from qpmhe.errors import ModelError, SetError, ShapeError
from qpmhe.estimation.subproblem import Subproblem

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")

N = 6


def f(x):
    return np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * ((1 - x[0] ** 2) * x[1] - x[0])])


def h(x):
    return np.array([x[0] + 0.1 * x[1] ** 2, x[1]])


def rate(x, u):
    return np.array([x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]])


def output(x):
    return np.array([x[0] + 0.1 * x[1] ** 2, x[1]])


def ball(x):
    return x[0] ** 2 + x[1] ** 2 - 2.0


def within(w, v):
    return np.array([w[0] ** 2 + w[1] ** 2 - 0.004, v[0] + 0.5 * v[1] - 0.2])


COST = qpmhe.QuadraticCost.from_covariances(
    prior=0.25 * np.eye(2), disturbance=0.01 * np.eye(2), noise=0.04 * np.eye(2)
)
GAIN = [[0.1, 0.0], [0.0, 0.1]]


def record(steps=24, seed=1):
    rng, x, ys = np.random.default_rng(seed), np.array([1.2, 0.5]), []
    for _ in range(steps):
        ys.append(h(x) + 0.2 * rng.standard_normal(2))
        x = f(x) + 0.05 * rng.standard_normal(2)
    return np.array(ys)


def make(options=None, cost=COST, system=None, **given):
    system = system or qpmhe.System(f, h, n=2, p=2, **(options or {}))
    given = {"max_qps": None, **given}
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=N, initial_state=[1.5, 0.8], **given
    )


def estimates(options=None, ys=None, **given):
    mhe = make(options, **given)
    return [mhe.update(y) for y in (record() if ys is None else ys)]


def same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.trajectory, b.trajectory)
        np.testing.assert_array_equal(a.noises, b.noises)
        assert (a.cost, a.candidate_cost, a.status) == (b.cost, b.candidate_cost, b.status)


SOFT = {
    "states": qpmhe.Box([-0.9, -np.inf], [1.0, 0.6]).soften(linear=3.0),
    "disturbances": qpmhe.Polytope([[1.0, 1.0], [-1.0, 0.5]], [0.02, 0.01]).soften(
        linear=5.0, quadratic=100.0
    ),
    "noises": qpmhe.Box([-0.2, -0.2], [0.1, 0.3]).soften(quadratic=[20.0, 40.0]),
}
CONSTRAINTS = {
    "hard": [qpmhe.Constraint(ball), qpmhe.Constraint(within, 2)],
    "soft": [
        qpmhe.Constraint(ball, linear=4.0),
        qpmhe.Constraint(within, 2, linear=[10.0, 0.0], quadratic=[0.0, 30.0]),
    ],
}


@pytest.mark.parametrize("given", [{}, {"max_qps": 1}, {"warm_start": True, "max_qps": 2}])
def test_soft_sets_that_are_never_touched_change_no_bit(given):
    wide = {
        "states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0]).soften(linear=1e3),
        "disturbances": qpmhe.Polytope([[1.0, 2.0]], [50.0]).soften(quadratic=1e3),
        "noises": qpmhe.Box([-90.0, -90.0], [90.0, 90.0]).soften(linear=1.0, quadratic=2.0),
        "constraints": [qpmhe.Constraint(lambda x, w, v: x[0] + w[1] + v[0] - 50.0, linear=9.0)],
    }
    same(estimates(wide, **given), estimates(**given))


def test_a_hard_constraint_that_is_never_active_costs_nothing():
    options = {"constraints": [qpmhe.Constraint(lambda x, w, v: x[0] + w[1] + v[0] - 50.0)]}
    for one, other in zip(estimates(options), estimates(), strict=True):
        assert one.cost == pytest.approx(other.cost, rel=1e-12)
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-9, atol=1e-9)


def plain_penalty(trajectory, ys, discount=1.0):
    """The penalty of SOFT and of the soft CONSTRAINTS, sample by sample."""
    total, count = 0.0, len(trajectory) - 1
    for i, x in enumerate(trajectory):
        factor = discount ** max(count - 1 - i, 0)
        part = 3.0 * (max(-0.9 - x[0], 0) + max(x[0] - 1.0, 0) + max(x[1] - 0.6, 0))
        part += 4.0 * max(ball(x), 0)
        if i < count:
            w, v = trajectory[i + 1] - f(x), ys[i] - h(x)
            for s in (w[0] + w[1] - 0.02, -w[0] + 0.5 * w[1] - 0.01):
                part += 5.0 * max(s, 0) + 100.0 * max(s, 0) ** 2
            for j, (low, high, price) in enumerate(((-0.2, 0.1, 20.0), (-0.2, 0.3, 40.0))):
                if np.isfinite(v[j]):
                    part += price * max(low - v[j], v[j] - high, 0) ** 2
            part += 10.0 * max(w @ w - 0.004, 0)
            if np.isfinite(v).all():
                part += 30.0 * max(v[0] + 0.5 * v[1] - 0.2, 0) ** 2
        total += factor * part
    return total


@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("max_qps", [0, 1, None])
def test_the_penalty_is_part_of_j(discount, max_qps):
    ys = record()
    ys[5, 1], ys[6], ys[11, 0] = np.nan, np.nan, np.nan
    cost = qpmhe.QuadraticCost(
        prior=COST.prior, disturbance=COST.disturbance, noise=COST.noise, discount=discount
    )
    plain = make(cost=cost, max_qps=0)
    mhe = make(SOFT | {"constraints": CONSTRAINTS["soft"]}, cost=cost, max_qps=max_qps)
    for t, y in enumerate(ys):
        estimate, observer = mhe.update(y), plain.update(y)
        window = ys[max(0, t + 1 - N) : t + 1]
        np.testing.assert_array_equal(estimate.candidate, observer.candidate)
        assert estimate.candidate_cost == pytest.approx(
            observer.cost + plain_penalty(estimate.candidate, window, discount), rel=1e-12
        )
        offset = estimate.trajectory[0] - estimate.candidate[0]
        count = len(window)
        expected = discount**count * offset @ COST.prior @ offset
        for i in range(count):
            w, v, factor = estimate.disturbances[i], estimate.noises[i], discount ** (count - 1 - i)
            there = np.isfinite(v)
            expected += factor * (w @ COST.disturbance @ w + 25.0 * v[there] @ v[there])
        expected += plain_penalty(estimate.trajectory, window, discount)
        assert estimate.cost == pytest.approx(expected, rel=1e-9)
        assert estimate.cost <= estimate.candidate_cost


@pytest.mark.parametrize("name", ["states", "disturbances", "noises", "constraints"])
def test_a_large_linear_penalty_is_exact(name):
    hard = {
        "states": qpmhe.Box([-np.inf, -np.inf], [1.5, 0.8]),
        "disturbances": qpmhe.Box([-0.04, -0.05], [0.03, 0.05]),
        "noises": qpmhe.Box([-0.3, -0.3], [0.25, 0.3]),
        "constraints": [qpmhe.Constraint(ball)],
    }[name]
    soft = (
        [qpmhe.Constraint(ball, linear=1e4)] if name == "constraints" else hard.soften(linear=1e4)
    )
    pairs = zip(
        estimates({name: hard}, project_observer=False), estimates({name: soft}), strict=True
    )
    compared = 0
    for one, other in pairs:
        if one.improved and not one.dropped:
            compared += 1
            # What is hard may be missed by rounding, which a penalty of 1e4 sees.
            assert other.cost == pytest.approx(one.cost, rel=1e-4)
            np.testing.assert_allclose(other.trajectory, one.trajectory, atol=1e-4)
    assert compared >= 15


@pytest.mark.parametrize("seed", [10, 12, 13, 19, 22])
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
                constraints=[qpmhe.Constraint(lambda x: x @ x - 0.1, **penalty)],
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
    ys = record()
    named = 0
    for estimate in estimates({"constraints": CONSTRAINTS["hard"]}, ys, max_qps=3):
        first = estimate.time + 1 - len(estimate.disturbances)
        missed = set()
        for i, x in enumerate(estimate.trajectory):
            values = [ball(x)]
            if i < len(estimate.disturbances):
                values += within(estimate.disturbances[i], estimate.noises[i]).tolist()
            missed |= {(j, first + i) for j, value in enumerate(values) if value > 1e-6}
        if estimate.improved:
            assert missed == {(row.row, row.time) for row in estimate.dropped}
        assert {(row.set, row.side) for row in estimate.dropped} <= {("constraints", "upper")}
        named += bool(estimate.dropped)
        assert estimate.cost <= estimate.candidate_cost
    assert named
    first = estimates({"constraints": CONSTRAINTS["hard"]}, ys, infeasible="keep_candidate")
    assert any(one.status & Status.CANDIDATE_OUTSIDE for one in first)


def test_nearest_points_are_nearest_in_the_hessian_of_j_alone(monkeypatch):
    found, plain = [], Subproblem.nearest_point

    def compared(self, problem, trial):
        band, forces = plain(self, problem, trial).band.copy(), self._forces
        self.start()
        qp = plain(self, problem, trial)
        found.append((forces is not None, np.array_equal(qp.band, band)))
        self._forces = forces
        return qp

    monkeypatch.setattr(Subproblem, "nearest_point", compared)
    estimates({"constraints": CONSTRAINTS["hard"]}, max_qps=3)
    assert any(bent for bent, _ in found)
    assert all(equal for _, equal in found)


def test_a_dropped_row_reads_well():
    row = qpmhe.DroppedRow("constraints", 2, "upper", 7)
    assert str(row) == "upper bound of constraints, row 2, at time 7"


@pytest.mark.parametrize("penalty", [{}, {"linear": 5.0}])
@pytest.mark.parametrize("bad", ["raise", "nan", "exit", "shape"])
def test_a_constraint_that_fails_far_from_the_data_never_escapes(bad, penalty):
    armed = []

    def g(x, v):
        if armed and x[0] > 1.2 and x[1] > 0.0:
            if bad == "raise":
                raise ValueError("too far")
            if bad == "exit":
                raise SystemExit
            return [1.0, 2.0, 3.0] if bad == "shape" else np.nan
        return x[0] - 1.1 + 0.1 * v[0]

    mhe = make({"constraints": [qpmhe.Constraint(g, **penalty)]})
    armed.append(True)
    failed = 0
    rng = np.random.default_rng(3)
    for y in record():
        estimate = mhe.update(y + rng.choice([0.0, 1.5]))
        assert not estimate.cost > estimate.candidate_cost
        if Status.MODEL_FAILED in estimate.status:
            failed += 1
            assert "constraints[0]" in estimate.message
        if estimate.improved:
            assert np.isfinite(estimate.cost)
    assert failed


def test_rows_on_missing_outputs_do_not_count():
    ys = record()
    ys[8:11, 1] = np.nan
    # One row on each output: the second row does not count where its output is missing.
    both = [qpmhe.Constraint(lambda v: np.array([v[0] ** 2, v[1] ** 2]) - 0.05, 2)]
    first = [qpmhe.Constraint(lambda v: v[0] ** 2 - 0.05)]
    alone = np.array(record())
    alone[:, 1] = np.nan
    for one, other in zip(
        estimates({"constraints": both}, alone), estimates({"constraints": first}, alone),
        strict=True,
    ):
        assert one.cost == pytest.approx(other.cost, rel=1e-7)
    for estimate in estimates({"constraints": both}, ys):
        if estimate.improved and not estimate.dropped:
            assert np.nanmax(estimate.noises**2) <= 0.05 + 1e-6


@pytest.mark.parametrize("kind", [*CONSTRAINTS, "sets"])
def test_a_snapshot_continues_bit_for_bit_and_knows_what_it_is_of(kind):
    options = SOFT if kind == "sets" else {"constraints": CONSTRAINTS[kind]}
    ys = record()
    first = make(options)
    for y in ys[:11]:
        first.update(y)
    second = make(options)
    second.load_state_dict(pickle.loads(pickle.dumps(first.state_dict())))
    third = pickle.loads(pickle.dumps(first))
    # A snapshot drops what the solver keeps, in the estimator that it is taken of, too.
    expected = [first.update(y) for y in ys[11:]]
    same([second.update(y) for y in ys[11:]], expected)
    same([third.update(y) for y in ys[11:]], expected)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="another"):
        make().load_state_dict(first.state_dict())


def test_a_snapshot_of_other_penalties_or_another_g_is_refused():
    def taken(options):
        mhe = make(options)
        mhe.update([1.0, 0.5])
        return mhe.state_dict()

    soft = {"constraints": [qpmhe.Constraint(ball, linear=1.0)]}
    for other in (
        {"constraints": [qpmhe.Constraint(ball, linear=2.0)]},
        {"constraints": [qpmhe.Constraint(ball)]},
        {"constraints": [qpmhe.Constraint(lambda x: ball(x) - 0.1, linear=1.0)]},
    ):
        with pytest.raises(qpmhe.errors.InvalidInputError, match="another constraints"):
            make(other).load_state_dict(taken(soft))
    box = qpmhe.Box([-1.0, -1.0], [1.0, 1.0])
    with pytest.raises(qpmhe.errors.InvalidInputError, match="another set of states"):
        make({"states": box.soften(linear=2.0)}).load_state_dict(
            taken({"states": box.soften(linear=1.0)})
        )


def test_steps_of_another_length_and_inputs():
    def g(x, u, w):
        assert u.shape[-1] == 1
        return np.array([x[0] + 0.1 * u[0] - 0.9, w[1] - 0.02])

    for penalty in ({}, {"linear": 10.0}):
        system = qpmhe.System.from_ode(
            rate, output, dt=0.1, n=2, p=2, m=1, constraints=[qpmhe.Constraint(g, 2, **penalty)]
        )
        mhe = make(system=system, max_qps=3)
        for t, y in enumerate(record()):
            estimate = mhe.update(y, [0.1 * np.sin(t)], dt=0.15 if t == 9 else None)
            assert estimate.cost <= estimate.candidate_cost
            assert Status.MODEL_FAILED not in estimate.status


@pytest.mark.parametrize("maker", ["casadi", "jax"])
def test_models_of_other_tools(maker):
    pytest.importorskip(maker)
    options = {
        "n": 2, "p": 2, "m": 1, "dt": 0.1,
        "states": SOFT["states"], "constraints": [qpmhe.Constraint(
            lambda x, u: x[0] + u[0] - 0.8, quadratic=50.0
        )],
    }
    if maker == "casadi":
        import casadi as ca

        system = qpmhe.from_casadi(
            lambda x, u: ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]),
            lambda x: ca.vertcat(x[0] + 0.1 * x[1] ** 2, x[1]), compiled=False, **options,
        )
    else:
        import jax.numpy as jnp

        system = qpmhe.from_jax(
            lambda x, u: jnp.array([x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]]),
            lambda x: jnp.array([x[0] + 0.1 * x[1] ** 2, x[1]]), **options,
        )
    del options["dt"]
    plain = qpmhe.System.from_ode(rate, output, dt=0.1, **options)
    ours, theirs = make(system=system), make(system=plain)
    for t, y in enumerate(record(10)):
        one, other = (mhe.update(y, [0.1], dt=0.2 if t == 4 else None) for mhe in (ours, theirs))
        assert one.cost == pytest.approx(other.cost, rel=1e-7)


def test_the_observer_is_not_projected_onto_a_soft_set():
    box = qpmhe.Box([-0.1, -0.1], [0.1, 0.1])
    for estimate in estimates({"states": box.soften(linear=1.0)}):
        assert Status.OBSERVER_PROJECTED not in estimate.status
        assert Status.CANDIDATE_OUTSIDE not in estimate.status
    assert make({"states": box.soften(linear=1.0)}).initial_state.tolist() == [1.5, 0.8]


def test_many_estimators_at_once():
    system = qpmhe.System(f, h, n=2, p=2, **SOFT, constraints=CONSTRAINTS["hard"])
    starts = np.array([[1.5, 0.8], [0.9, 0.2], [0.2, -0.3]])
    options = {"horizon": N, "max_qps": 3}
    batch = qpmhe.BatchEstimator(
        system, qpmhe.Luenberger(GAIN), COST, members=3, initial_states=starts, **options
    )
    singles = [
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(GAIN), COST, initial_state=start, **options
        ) for start in starts
    ]
    for y in record(9):
        found = batch.update(np.tile(y, (3, 1)))
        np.testing.assert_array_equal(
            found.states, [mhe.update(y).state for mhe in singles]
        )


@pytest.mark.parametrize(("options", "words"), [
    ({"states": SOFT["states"]}, "a soft set of states"),
    ({"noises": SOFT["noises"]}, "a soft set of noises"),
    ({"constraints": CONSTRAINTS["hard"]}, "nonlinear constraints"),
])
def test_what_does_not_have_them_says_so_by_name(options, words):
    from qpmhe.codegen.library import uncovered
    from qpmhe.estimation.settings import Settings
    from qpmhe.studies.ipopt import IpoptEstimator

    observer = qpmhe.Luenberger(GAIN)
    system = qpmhe.System(f, h, n=2, p=2, **options)
    system.symbolic = object()  # as if it had a CasADi form
    assert words in uncovered(system, observer, COST, Settings(N, "auto", 1))
    with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
        checked_ingredients(system, observer, COST)
    pytest.importorskip("casadi")
    with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
        IpoptEstimator(
            system, observer, COST, f=f, h=h, horizon=N, initial_state=np.array([1.0, 0.0])
        )


BOX = qpmhe.Box([0.0, 0.0], [1.0, 1.0])


@pytest.mark.parametrize(("make_it", "error", "text"), [
    (lambda: BOX.soften(), SetError, "row 0 of the soft set has no penalty"),
    (lambda: BOX.soften(linear=0.0), SetError, "pass linear > 0 or quadratic > 0"),
    (lambda: BOX.soften(linear=[1.0, 0.0]), SetError, "row 1 of the soft set"),
    (lambda: BOX.soften(linear=-1.0), SetError, "linear is -1.0; expected finite numbers >= 0"),
    (lambda: BOX.soften(quadratic=np.inf), SetError, "quadratic is inf"),
    (lambda: BOX.soften(linear=[1.0, 2.0, 3.0]), SetError, "linear has shape (3,)"),
    (lambda: BOX.soften(linear="much"), qpmhe.errors.InvalidInputError, "linear is 'much'"),
    (lambda: BOX.soften(linear=1.0) & BOX, SetError, "intersect sets first and soften"),
    (lambda: BOX & BOX.soften(linear=1.0), SetError, "intersect sets first and soften"),
    (lambda: qpmhe.Box([1.0], [0.0]).soften(linear=1.0), SetError, "the box is empty"),
    (lambda: qpmhe.Constraint(3.0), ModelError, "g is 3.0; expected a function"),
    (lambda: qpmhe.Constraint(ball, 0), ShapeError, "size is 0; expected an integer >= 1"),
    (lambda: qpmhe.Constraint(ball, linear=0.0), SetError, "leave the constraint hard"),
    (lambda: qpmhe.Constraint(ball, linear=-2.0), SetError, "linear is -2.0"),
    (lambda: qpmhe.Constraint(within, 2, linear=[1, 2, 3]), SetError, "linear has shape (3,)"),
    (lambda: qpmhe.Constraint(lambda z: z), ModelError, "has the parameter z; expected only x"),
    (lambda: qpmhe.Constraint(lambda *x: x), ModelError, "g has the parameter *x"),
    (lambda: qpmhe.Constraint(lambda: 1.0), ModelError, "g takes no argument"),
    (lambda: qpmhe.Constraint(lambda u: u), ModelError, "g takes u, so that no estimate"),
    (lambda: qpmhe.Constraint(np.sin), ModelError, "which can be passed by name"),
    (lambda: make({"constraints": [ball]}), SetError, "expected a list of qpmhe.Constraint"),
    (lambda: make({"constraints": 3}), SetError, "constraints holds 3; expected a list"),
    (lambda: make({"constraints": [qpmhe.Constraint(lambda x, u: x[0])]}), ModelError,
     "constraints[0] takes u, but the system has no inputs"),
    (lambda: make({"constraints": [qpmhe.Constraint(lambda x: x, 3)]}), ModelError,
     "constraints[0] returned shape (2,)"),
    (lambda: make({"constraints": [qpmhe.Constraint(lambda x: np.log(x[0] - 3.0))]}), ModelError,
     "constraints[0] is [nan] at the initial state"),
    (lambda: make({"states": qpmhe.Box([0.0], [1.0]).soften(linear=1.0)}), SetError,
     "states has dimension 1; expected 2"),
    (lambda: make({"noises": 3}), SetError, "noises is 3"),
])  # fmt: skip
def test_bad_input_is_refused(make_it, error, text):
    with np.errstate(all="ignore"), pytest.raises(error, match=re.escape(text)):
        make_it()


def test_a_function_may_bind_what_it_needs():
    level = 2.0
    for g in (
        lambda x, level=level: x[0] ** 2 + x[1] ** 2 - level,
        lambda x: [x[0] ** 2 + x[1] ** 2 - level],
        lambda x: (x * x).sum(axis=-1, keepdims=True) - level,
    ):
        found = estimates({"constraints": [qpmhe.Constraint(g, linear=9.0)]})
        expected = estimates({"constraints": [qpmhe.Constraint(ball, linear=9.0)]})
        for one, other in zip(found, expected, strict=True):
            assert one.cost == pytest.approx(other.cost, rel=1e-8)


@pytest.mark.parametrize("write", [
    lambda x, w, v: [x[0] * w[1] + v[0], np.sin(x[1]) + v[1]],
    lambda v, x, w: np.stack((x[..., 0] * w[..., 1], np.sin(x[..., 1])), -1) + v,
    lambda w, v, x: [float(x[0] * w[1] + v[0]), float(np.sin(x[1]) + v[1])],
])  # fmt: skip
def test_functions_are_evaluated_however_they_are_written(write):
    system = qpmhe.System(f, h, n=2, p=2, constraints=[qpmhe.Constraint(write, 2)])
    rng = np.random.default_rng(0)
    functions = system.constraints
    for count in (1, 2, 3, 6):
        x, r = rng.standard_normal((count + 1, 2)), rng.standard_normal((count, 4))
        found = functions.values(x, np.zeros((count, 0)), r)
        for i in range(count):
            expected = [x[i, 0] * r[i, 1] + r[i, 2], np.sin(x[i, 1]) + r[i, 3]]
            np.testing.assert_allclose(found[i], expected, rtol=1e-14)
        assert not found[-1].any()
        minus = rng.standard_normal((count, 4, 2))
        own, following = functions.linearised(x, np.zeros((count, 0)), r, minus)
        for i in range(count):
            by_x = np.array([[r[i, 1], 0.0], [0.0, np.cos(x[i, 1])]])
            by_w = np.array([[0.0, x[i, 0]], [0.0, 0.0]])
            np.testing.assert_allclose(
                own[i], by_x + by_w @ minus[i, :2] + minus[i, 2:], rtol=1e-6, atol=1e-8
            )
            np.testing.assert_allclose(following[i], by_w, rtol=1e-6, atol=1e-8)


def test_disturbances_of_lower_dimension():
    ys = record()
    observer = qpmhe.Luenberger(GAIN)

    def costs(disturbance, **options):
        cost = qpmhe.QuadraticCost(prior=COST.prior, disturbance=disturbance, noise=COST.noise)
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(f, h, n=2, p=2, **options), observer, cost, horizon=N,
            initial_state=[1.5, 0.8], max_qps=None,
        )
        found = [mhe.update(y) for y in ys]
        assert all(one.cost <= one.candidate_cost for one in found)
        return np.array([one.cost for one in found]), found

    matrix = [[0.0], [1.0]]
    bounds = {"linear": 5.0, "quadratic": 40.0}
    by_set, _ = costs(
        [[100.0]], disturbance_matrix=matrix,
        disturbances=qpmhe.Box([-0.02], [0.03]).soften(**bounds),
    )
    by_function, _ = costs([[100.0]], disturbance_matrix=matrix, constraints=[
        qpmhe.Constraint(lambda w: np.array([w[0] - 0.03, -0.02 - w[0]]), 2, **bounds)
    ])
    fixed, _ = costs(100.0 * np.eye(2), disturbances=qpmhe.Box([0, -np.inf], [0, np.inf]),
                     constraints=[qpmhe.Constraint(
                         lambda w: np.array([w[1] - 0.03, -0.02 - w[1]]), 2, **bounds)])
    none, _ = costs([[100.0]], disturbance_matrix=matrix)
    assert (by_set > none + 1e-6).sum() > 5
    np.testing.assert_allclose(by_function, by_set, rtol=1e-6)
    np.testing.assert_allclose(fixed, by_set, rtol=1e-6)
    _, hard = costs([[100.0]], disturbance_matrix=matrix, constraints=[
        qpmhe.Constraint(lambda x, w: w[0] ** 2 - 0.03**2 + 0.0 * x[0])
    ])
    held = [one for one in hard if one.improved and not one.dropped]
    assert len(held) > 10
    assert all(np.abs(one.disturbances).max() <= 0.03 + 1e-6 for one in held)


def test_residuals_that_wrap():
    # Measurements with whole turns added are the same measurements.
    ys, turns = record(), np.random.default_rng(0).integers(-2, 3, (24, 2))
    options = {
        "output_residual": qpmhe.angles([0, 1], period=2.0), "noises": SOFT["noises"],
        "constraints": [qpmhe.Constraint(lambda x, v: x[0] + v[0] ** 2 - 1.1, linear=6.0)],
    }
    for one, other in zip(
        estimates(options, ys), estimates(options, ys + 2.0 * turns), strict=True
    ):
        assert one.cost == pytest.approx(other.cost, rel=1e-7)
    with pytest.raises(SetError, match="bounds an angle"):
        qpmhe.System(
            f, h, n=2, p=2, state_residual=qpmhe.angles([0]), states=SOFT["states"]
        )


def test_what_changes_while_running():
    hard = qpmhe.Box([-0.2, -0.2], [0.2, 0.3])
    options = {"noises": hard, "constraints": CONSTRAINTS["soft"], "states": SOFT["states"]}
    mhe = make(options, max_qps=3)
    for t, y in enumerate(record(12)):
        given = {}
        if t == 4:
            given["bounds"] = {
                "noises": qpmhe.Box([-0.3, -0.3], [0.3, 0.3]),
                "states": qpmhe.Box([-1.0, -1.0], [1.0, 1.0]),
            }
        if t == 6:
            given = {"noise_weight": 9.0 * np.eye(2), "disturbance_weight": 50.0 * np.eye(2)}
        estimate = mhe.update(y, **given)
        assert estimate.cost <= estimate.candidate_cost
    mhe.set(disturbance_weight=80.0 * np.eye(2))
    estimate = mhe.update([1.0, 0.5])
    assert estimate.cost <= estimate.candidate_cost


def test_augmented_models_refuse_them_by_name():
    system = qpmhe.System.from_ode(
        rate, output, dt=0.1, n=2, p=2, m=1, constraints=CONSTRAINTS["hard"]
    )
    with pytest.raises(qpmhe.errors.InvalidInputError, match="nonlinear constraints"):
        qpmhe.noisy_inputs(system)
    with pytest.raises(SetError, match="is soft; an augmented model takes hard ones only"):
        qpmhe.augment_parameters(
            lambda x, theta: f(x) * theta, lambda x, theta: h(x), n=2, p=2, nominal=[1.0],
            states=SOFT["states"],
        )
