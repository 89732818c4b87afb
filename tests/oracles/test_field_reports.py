"""What users of other tools reported publicly, on this one: docs/known-problems-of-the-field.md."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import QpmheError
from qpmhe_solvers import QP, Backend, RawSolution, SolverOptions, SolveStatus, available, create
from qpmhe_solvers.qp import band_of

from ..solvers.problems import WITH_INEQUALITIES, registered

TURN = np.pi


def linear(F, H, **options):
    return qpmhe.System(lambda x: x @ F.T, lambda x: x @ H.T, n=len(F), p=len(H), **options)


# Smoothers and covariances


def test_a_vague_start_leaves_no_negative_variance():
    """statsmodels 5044: a trend and a season of seven, from a variance of 1e6."""
    mp = pytest.importorskip("mpmath")
    n, samples = 8, 30
    F = np.zeros((n, n))
    F[:2, :2] = [[1.0, 1.0], [0.0, 1.0]]
    F[2, 2:], F[3:, 2:7] = -1.0, np.eye(5)
    G = np.eye(n)[:, :3]
    H = np.zeros((1, n))
    H[0, [0, 2]] = 1.0
    y = 50.0 + 5.0 * np.random.default_rng(0).standard_normal((samples, 1))
    system = linear(F, H, disturbance_matrix=G)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((n, 1))),
        qpmhe.QuadraticCost.from_covariances(
            prior=1e6 * np.eye(n), disturbance=0.1 * np.eye(3), noise=np.eye(1)),
        horizon=samples, initial_state=np.zeros(n),
    )
    mhe.run(y)
    found = mhe.covariances()[:-1] @ H[0] @ H[0]  # of the smoothed output
    with mp.workdps(60):  # of the stacked disturbances and measurements
        move, seen = mp.matrix(F.tolist()), mp.matrix(H.tolist())
        spread = mp.mpf(0.1) * mp.matrix((G @ G.T).tolist())
        states, powers = [mp.mpf(1e6) * mp.eye(n)], [mp.eye(n)]
        for _ in range(samples - 1):
            states.append(move * states[-1] * move.T + spread)
            powers.append(move * powers[-1])
        joint = mp.zeros(samples)
        for i in range(samples):
            for j in range(i, samples):
                joint[i, j] = joint[j, i] = (seen * powers[j - i] * states[i] * seen.T)[0]
        left = joint - joint * mp.inverse(joint + mp.eye(samples)) * joint
        right = np.array([float(left[k, k]) for k in range(samples)])
    assert (found > 0.0).all()
    np.testing.assert_allclose(found, right, rtol=1e-6)


def test_a_smoother_takes_each_step_with_its_own_length():
    """filterpy 37, 265, 278: the transition of a step is taken from the wrong sample."""
    numbers = np.random.default_rng(1)
    lengths, y = numbers.uniform(0.1, 2.0, 25), numbers.standard_normal((25, 1))

    def f(x, u):
        return np.stack((x[..., 0] + u[..., 0] * x[..., 1], x[..., 1]), axis=-1)

    system = qpmhe.System(f, lambda x, u: x[..., :1], n=2, p=1, m=1)
    P, Q, R = np.diag([4.0, 1.0]), np.diag([0.01, 0.1]), np.array([[0.5]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R),
        qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R), horizon=25,
        initial_state=[0.0, 0.0],
    )
    for value, length in zip(y, lengths, strict=True):
        estimate = mhe.update(value, [length])
    # All states at once, weighted.
    rows, side = [np.pad(np.diag([0.5, 1.0]), ((0, 0), (0, 50)))], [np.zeros(2)]
    for k in range(25):
        step = np.zeros((2, 52))
        step[:, 2 * k : 2 * k + 2] = -np.array([[1.0, lengths[k]], [0.0, 1.0]])
        step[:, 2 * k + 2 : 2 * k + 4] = np.eye(2)
        seen = np.zeros((1, 52))
        seen[0, 2 * k] = 1.0
        rows += [step / np.sqrt(np.diag(Q))[:, None], seen / np.sqrt(0.5)]
        side += [np.zeros(2), y[k] / np.sqrt(0.5)]
    right = np.linalg.lstsq(np.vstack(rows), np.concatenate(side), rcond=None)[0]
    np.testing.assert_allclose(estimate.trajectory.ravel(), right, atol=1e-11)


def test_measurements_without_noise():
    """filterpy 214: R = 0 ends in a matrix that has no factor, in some later step."""
    with pytest.raises(QpmheError, match="noise"):
        qpmhe.QuadraticCost.from_covariances(disturbance=np.eye(1), noise=[[0.0]])
    with pytest.raises(QpmheError, match="noise"):
        qpmhe.ExtendedKalman(prior=np.eye(1), disturbance=np.eye(1), noise=[[0.0]])
    for noise in (1e-10, 1e-20, 1e-30):
        covariances = {"disturbance": np.eye(1), "noise": [[noise]]}
        mhe = qpmhe.MovingHorizonEstimator(
            linear(np.eye(1), np.eye(1)), qpmhe.ExtendedKalman(prior=np.eye(1), **covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances), horizon=5, initial_state=[0.0],
        )
        y = np.random.default_rng(0).standard_normal((20, 1))
        np.testing.assert_allclose(mhe.run(y).filtered, y, atol=1e-9)


@pytest.mark.parametrize("step", [1e-2, 1e-3, 1e-4])
def test_small_steps_collapse_no_variance(step):
    """PX4-ECL 771, ArduPilot 17787: the variance of a velocity falls to zero by rounding."""
    from scipy.linalg import solve_discrete_are

    F, H = np.array([[1.0, step], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    covariances = {"disturbance": np.diag([1e-9, 1e-2]) * step, "noise": np.array([[1.0]])}
    exact = solve_discrete_are(F.T, H.T, covariances["disturbance"], covariances["noise"])
    mhe = qpmhe.MovingHorizonEstimator(
        linear(F, H), qpmhe.ExtendedKalman(prior=exact, **covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10, initial_state=[0.0, 0.0],
        max_qps=1,
    )
    numbers = np.random.default_rng(0)
    mhe.run(numbers.standard_normal((500, 1)))
    predicted = mhe.covariances()[-1]  # of the state after the newest sample
    np.testing.assert_allclose(predicted, exact, rtol=1e-6)


# Annual flow of the Nile at Aswan, 1871 to 1970, in 10^8 m^3 (Durbin and Koopman, 2012).
NILE = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180,
    799, 958, 1140, 1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833,
    701, 916, 692, 1020, 1050, 969, 831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845,
    864, 862, 698, 845, 744, 796, 1040, 759, 781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649,
    846, 812, 742, 801, 1040, 860, 874, 848, 890, 744, 749, 838, 1050, 918, 986, 797, 923, 975, 815,
    1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740,
], float)[:, None]


def test_the_variances_of_the_nile_are_the_published_ones():
    """statsmodels 6660: no likelihood at the published 15099 and 1469.1, from a diffuse start."""
    tuning = qpmhe.tune(
        linear(np.eye(1), np.eye(1)), [(NILE,)], prior=[[1e10]], disturbance=[[1e3]],
        noise=[[1e4]], initial_state=[0.0], objective="likelihood", held_out=0.0, progress=False,
    )
    assert tuning.noise[0, 0] == pytest.approx(15099.0, rel=1e-4)
    assert tuning.disturbance[0, 0] == pytest.approx(1469.1, rel=1e-4)


# Angles, delays, equal times


def heading(gate=True):
    system = qpmhe.System(
        lambda x, u: x + u, lambda x, u: (x + TURN) % (2 * TURN) - TURN, n=1, p=1, m=1,
        output_residual=qpmhe.angles(0), state_residual=qpmhe.angles(0),
    )
    covariances = {"disturbance": 1e-4 * np.eye(1), "noise": 1e-2 * np.eye(1)}
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(
            prior=np.eye(1), innovation=qpmhe.Gate() if gate else None, **covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=8, initial_state=[3.0],
    )


def test_a_gate_lets_an_angle_pass_the_half_turn():
    """robot_localization 237: the gate takes the difference before it is wrapped."""
    mhe, numbers, angle = heading(), np.random.default_rng(0), 3.0
    for _ in range(200):  # three turns, back and forth over the seam
        seen = (angle + 0.1 * numbers.standard_normal() + TURN) % (2 * TURN) - TURN
        estimate = mhe.update([seen], [0.1])
        assert estimate.rejected_sensors == () or abs(
            mhe.system.output_residual(np.array([seen]), np.array([angle]))) > 0.25
        assert abs(mhe.system.state_residual(estimate.filtered, np.array([angle]))) < 0.2
        angle += 0.1


def test_a_late_measurement_counts_as_if_it_had_come_in_time():
    """robot_localization 263, 451: it is used at the present state, or dropped."""
    y = 3.0 + 0.1 * np.arange(12) + 0.1 * np.random.default_rng(2).standard_normal(12)
    punctual, late = heading(gate=False), heading(gate=False)
    for k, value in enumerate(y):
        right = punctual.update([value], [0.1])
        found = late.update([np.nan if k in (6, 8) else value], [0.1])
    for k in (8, 6):  # and in the wrong order
        found = late.amend(k, [y[k]])
    np.testing.assert_allclose(found.trajectory, right.trajectory, rtol=0.0, atol=1e-12)
    with pytest.raises(QpmheError, match="sample"):  # before the window, and before the start
        late.amend(2, [y[2]])
    with pytest.raises(QpmheError):
        heading().amend(-1, [y[0]])


def test_a_measurement_from_before_the_start_leaves_the_covariance():
    """ethzasl_msf 159: it takes the covariance of a state before the first, which is zero."""
    first, twin = heading(gate=False), heading(gate=False)
    for y in (3.0, 3.1):
        right, _ = first.update([y], [0.1]), twin.update([y], [0.1])
    with pytest.raises(QpmheError, match="expected an integer from 0 to 1"):
        twin.amend(-1, [2.9])
    np.testing.assert_array_equal(twin.state, right.state)
    np.testing.assert_array_equal(twin.covariances(), first.covariances())
    assert (np.linalg.eigvalsh(twin.covariances()) > 0.0).all()


# NIST's data Misra1a with its certified parameters: https://www.itl.nist.gov/div898/strd/nls/.
MISRA = np.array([
    77.6, 10.07, 114.9, 14.73, 141.1, 17.94, 190.8, 23.93, 239.9, 29.61, 289.0, 35.18, 332.8, 40.02,
    378.4, 44.82, 434.8, 50.76, 477.3, 55.05, 536.8, 61.01, 593.1, 66.40, 689.1, 75.47, 760.0,
    81.78,
]).reshape(-1, 2)


@pytest.mark.parametrize("start", [[500.0, 1e-4], [250.0, 5e-4]])
def test_parameters_are_found_from_a_far_guess(start):
    """kipet 158: parameters are not found, not even from near them. NIST's two starts."""
    system = qpmhe.System(
        lambda x, u: x, lambda x, u: x[..., :1] * (1.0 - np.exp(-x[..., 1:] * u)), n=2, p=1, m=1,
        disturbances=qpmhe.Box([0.0, 0.0], [0.0, 0.0]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((2, 1))),
        qpmhe.QuadraticCost.from_covariances(
            prior=np.diag(1e8 * np.square(start)), disturbance=np.eye(2), noise=[[0.01]]),
        horizon=len(MISRA), initial_state=start, max_qps=None,
    )
    for u, y in MISRA:
        estimate = mhe.update([y], [u])
    np.testing.assert_allclose(estimate.state, [238.94212918, 5.5015643181e-4], rtol=1e-6)


def test_equal_times_are_refused():
    """robot_localization 336: two estimates with one time, and a division by zero."""
    pandas = pytest.importorskip("pandas")
    times = pandas.to_timedelta([0.0, 0.1, 0.1, 0.2], unit="s")
    record = pandas.DataFrame({"y": np.ones(4)}, index=times)
    system = qpmhe.System.from_ode(lambda x: -x, lambda x: x, n=1, p=1, dt=0.1)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0), horizon=3, initial_state=[1.0],
    )
    with pytest.raises(QpmheError, match=r"twice; keep one row for each time"):
        mhe.run(record)


# Derivatives, failures, bounds


@pytest.mark.parametrize("start", [[0.0, 0.0], [1e-12, 0.0]])
def test_a_start_where_the_range_has_no_derivative(start):
    """acados 667, 1063: a start of all zeros, and a root without derivative there."""
    system = qpmhe.System(
        lambda x: x + 0.05, lambda x: np.sqrt(x[..., :1] ** 2 + x[..., 1:] ** 2), n=2, p=1)
    covariances = {"disturbance": 1e-4 * np.eye(2), "noise": 1e-4 * np.eye(1)}
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=np.eye(2), **covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10, initial_state=start,
        max_qps=3,
    )
    x = np.array([0.3, 0.3])
    for _ in range(40):
        estimate = mhe.update([np.hypot(*x)])
        x = x + 0.05
        assert np.isfinite(estimate.trajectory).all()
    assert abs(np.hypot(*estimate.state) - np.hypot(*x)) < 0.05


class FailsOnce(qpmhe.solvers.Solver):
    """At its third QP: NaN, with a claim of success; then it works."""

    def __init__(self, options):
        super().__init__(options)
        self.inner, self.count = create("quadprog", options), 0

    def _solve(self, qp, start):
        self.count += 1
        if self.count == 3:
            return RawSolution(np.full(qp.size, np.nan), True)
        found = self.inner.solve(qp)
        return RawSolution(
            found.d, found.status is SolveStatus.SOLVED, 1, found.bound_duals, found.row_duals)


def test_a_failure_costs_one_step():
    """acados 1155: once failed, always failed. hpipm 9: NaN, and a status of success."""
    pytest.importorskip("quadprog")
    F, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0]])
    covariances = {"disturbance": 1e-2 * np.eye(2), "noise": 1e-2 * np.eye(1)}
    y = np.random.default_rng(0).standard_normal((15, 1))
    with registered(Backend("fails-once", FailsOnce, "theatre")):
        failed, right = (
            qpmhe.MovingHorizonEstimator(
                linear(F, H), qpmhe.Luenberger([[0.5], [0.2]]),
                qpmhe.QuadraticCost.from_covariances(prior=np.eye(2), **covariances), horizon=5,
                initial_state=[0.0, 0.0], backend=name,
            ).run(y) for name in ("fails-once", "quadprog")
        )
    assert qpmhe.Status.CANDIDATE in failed.statuses[2]
    assert np.isfinite(failed.states).all()
    assert (failed.costs <= failed.candidate_costs).all()
    np.testing.assert_allclose(failed.states[4:], right.states[4:], atol=1e-9)


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_bounds_that_change_are_used_from_the_next_estimate_on(engine):
    """GEKKO 36, do-mpc 289: bounds are those of the first solve."""
    from qpmhe.codegen.compiler import find_compiler

    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    system = linear(np.eye(1), np.eye(1), states=qpmhe.Box([0.0], [10.0]))
    covariances = {"disturbance": np.eye(1), "noise": np.eye(1)}
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=np.eye(1), **covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=5, initial_state=[1.0],
        engine=engine,
    )
    for _ in range(6):
        estimate = mhe.update([-1.0])
    assert estimate.state[0] == pytest.approx(0.0, abs=1e-9)
    mhe.set(bounds={"states": qpmhe.Box([0.5], [10.0])})
    estimate = mhe.update([-1.0])
    np.testing.assert_allclose(estimate.trajectory, 0.5, atol=1e-9)
    mhe.set(bounds={"states": qpmhe.Box([-5.0], [10.0])})
    for _ in range(6):
        estimate = mhe.update([-1.0])
    assert estimate.state[0] < -0.5


def test_soft_bounds_hold_in_every_window():
    """ModelPredictiveControl.jl 424: soft bounds on states stay those of the first window."""
    F, H = np.array([[1.0, 0.2], [-0.3, 0.9]]), np.array([[1.0, 0.0]])
    covariances = {"disturbance": 0.05 * np.eye(2), "noise": 0.2 * np.eye(1)}
    hard = qpmhe.Box([-0.3, -0.3], [0.4, 0.4])
    soft = hard.soften(linear=1e3)
    y = np.random.default_rng(0).standard_normal((40, 1))
    trajectories = []
    for states in (hard, soft):
        mhe = qpmhe.MovingHorizonEstimator(
            linear(F, H, states=states), qpmhe.Luenberger([[0.3], [0.1]]),
            qpmhe.QuadraticCost.from_covariances(prior=np.eye(2), **covariances), horizon=8,
            initial_state=[0.0, 0.0], max_qps=None, project_observer=False,  # the same prior
        )
        trajectories.append([mhe.update(value).trajectory for value in y])
    active = 0
    for one, other in zip(*trajectories, strict=True):
        active += bool(((one <= -0.3 + 1e-9) | (one >= 0.4 - 1e-9)).any())
        np.testing.assert_allclose(other, one, atol=1e-6)
    assert active > 20


# Solvers


def small(H, g, lower, upper, rows=(), low=(), high=()):
    """A QP of one stage."""
    qp = QP(1, len(g), len(rows))
    qp.band[0], qp.gradient[0] = band_of(np.asarray(H, float)), g
    qp.lower[0], qp.upper[0] = lower, upper
    if len(rows):
        qp.row_own[0], qp.row_lower[0], qp.row_upper[0] = rows, low, high
    return qp


FREE = [-np.inf, -np.inf], [np.inf, np.inf]
# 2 x1² + 4 x2² - 2 x1, x1 + x2 = 1, x >= 0: the multiplier of x2 >= 0 is zero.
WEAKLY = small(np.diag([2.0, 4.0]), [-2.0, 0.0], [0.0, 0.0], FREE[1], [[1.0, 1.0]], [1.0], [1.0])
# Some bounds are infinite.
PARTLY = small(
    np.diag([2.0, 2, 2, 1, 1]), [-0.4336, 0.0, -8.22650076, -0.13518331, -0.41793948],
    [-0.5, -0.2, 2.88827712, -np.inf, -0.039049], [0.5, 0.2, 5.8577581, np.inf, 0.17278432],
    [[1, 0, -0.06914037, 1, 0], [0, 1, -0.05080404, 0, 1]], [0.0, 0.0], [0.0, 0.0],
)
ONE_SIDED = small(np.eye(2), [0.0, 0.0], [-1.0, -np.inf], [np.inf, 1.0])
# The same equality three times.
TRIPLE = small(2.0 * np.eye(2), [-2.0, -4.0], *FREE, 3 * [[1.0, 1.0]], 3 * [2.0], 3 * [2.0])
# A cost of 1e-4: ordered unknowns, all terms divided by 200,000.
WEIGHTS, PULLS = np.arange(1.0, 11.0), np.array([4.0, 2, -2, 3, 3, 7, 3, 11, 10, 14])
ORDERED = small(
    np.diag(WEIGHTS / 2e5), -PULLS / 2e5, np.full(10, -np.inf), np.full(10, np.inf),
    np.eye(10)[:-1] - np.eye(10)[1:], np.full(9, -np.inf), np.zeros(9),
)
# Flows of thousands with variances of ten thousands, which are to add up.
FLOWS = np.array([
    24347.5410, 7743.3586, 4957.3505, 5588.0308, 1445.2660, 3002.4793, 643.5833, 240.3561])
SPREADS = np.array([2280147.0, 428471, 184644, 472915, 45151, 124546, 25157, 30286])
SUM = np.array([1.0, -1, -1, -1, -1, -1, -1, -1])
BALANCE = small(
    np.diag(1.0 / SPREADS), -FLOWS / SPREADS, np.full(8, -np.inf), np.full(8, np.inf),
    [SUM, np.eye(8)[1]], [0.0, 0.0], [0.0, np.inf],
)


def partly():
    """By its KKT system: both equalities, and x5 at its upper bound."""
    fixed = np.vstack((PARTLY.dense_rows(), np.eye(5)[4]))
    matrix = np.block([[PARTLY.dense(), fixed.T], [fixed, np.zeros((3, 3))]])
    side = np.concatenate((-PARTLY.gradient.ravel(), [0.0, 0.0, 0.17278432]))
    found = np.linalg.solve(matrix, side)
    assert found[-1] > 0.0
    return found[:5]


def ordered():
    """Means of neighbours that are out of order, weighted, until none is."""
    blocks = [[w, b / w, 1] for w, b in zip(WEIGHTS, PULLS, strict=True)]
    k = 0
    while k + 1 < len(blocks):
        (w, x, many), (v, z, more) = blocks[k : k + 2]
        if x > z:
            blocks[k : k + 2] = [[w + v, (w * x + v * z) / (w + v), many + more]]
            k = max(k - 1, 0)
        else:
            k += 1
    return np.concatenate([np.full(many, x) for _, x, many in blocks])


# Curvatures of 1e-10 and 1e10; the first state is known: both its bounds are 1.1.
MIXED = small(np.diag([1e-10, 1e10]), [-1.0, -1.0], *FREE)
FIXED = small(np.diag([2.0, 1.0, 1.0]), [-1.0, 0.5, -3.0], [1.1, -5.0, -5.0], [1.1, 5.0, 5.0],
              [[1.0, 1.0, 1.0]], [0.5], [0.5])


def far():
    """A QP with one active row, and 1e8 for limits that do not exist; and its solution."""
    numbers = np.random.default_rng(2)
    factor, rows, x = numbers.normal(size=(10, 8)), numbers.normal(size=(6, 8)), np.ones(8)
    H, limits = factor.T @ factor / 8.0, np.full(6, 1e8)
    limits[0] = rows[0] @ x
    gradient = -H @ x - 0.3 * rows[0]
    return small(H, gradient, np.full(8, -1e8), np.full(8, 1e8), rows, -limits.clip(1e8), limits), x


RIGHT = {
    "pounce 324": (MIXED, np.array([1e10, 1e-10])),
    "hpmpc 8": (FIXED, np.array([1.1, -2.05, 1.45])),
    "Clarabel.rs 216": far(),
    "Clarabel.cpp 36": (WEAKLY, np.array([1.0, 0.0])),
    "qpsolvers 321": (PARTLY, partly()),
    "qpsolvers 160": (ONE_SIDED, np.zeros(2)),
    "pounce 326": (TRIPLE, np.array([0.5, 1.5])),
    "cvxpy 1489": (ORDERED, ordered()),
    "osqp-r 38": (BALANCE, FLOWS - SPREADS * SUM * (SUM @ FLOWS) / SPREADS.sum()),
}
# Interior points stop before a weakly active bound; ecos solves a cone program, less accurately.
LEFT = {"clarabel": 3e-4, "cvxopt": 5e-4, "piqp": 3e-4, "ecos": 3e-4}


@pytest.mark.parametrize("report", RIGHT)
@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_small_qps_that_solvers_stumbled_over(name, report):
    qp, right = RIGHT[report]
    found = create(name, SolverOptions()).solve(qp)
    if name == "cvxopt" and report == "pounce 326":  # it needs rows of full rank, and says so
        assert (found.status, found.d) == (SolveStatus.FAILED, None)
        return
    assert found.status in (SolveStatus.SOLVED, SolveStatus.INACCURATE), found.message
    size = np.abs(right) if report == "pounce 324" else np.abs(right).max() + 1.0
    left = next((gap for kind, gap in LEFT.items() if kind in name), 1e-5)
    assert (np.abs(found.d.ravel() - right) < left * size).all(), found.d


@pytest.mark.parametrize("name", WITH_INEQUALITIES)
def test_an_infeasible_qp_with_one_infinite_bound_is_never_solved(name):
    """osqp 43: x1 + 2 x2 = 2, x1 >= 1, x2 >= 2 runs into the cap."""
    qp = small(np.diag([2.0, 4.0]), [0.0, 0.0], [1.0, 2.0], FREE[1], [[1.0, 2.0]], [2.0], [2.0])
    found = create(name, SolverOptions(200)).solve(qp)
    assert found.status in (SolveStatus.STOPPED, SolveStatus.FAILED)
    if found.d is not None:
        assert np.abs(found.d).max() < 1e3
    if name == "osqp":
        assert (found.message, found.d) == ("primal infeasible", None)


@pytest.mark.parametrize("name", [name for name in available() if "clarabel" in name])
def test_a_limit_that_comes_and_goes(name):
    """Clarabel.rs 218: an infinite limit in an update ends in a numerical error."""
    kept = create(name, SolverOptions())
    for k in range(6):
        qp = small(np.eye(2), [-1.0, -2.0], *FREE, [[1.0, 1.0]], [-np.inf],
                   [np.inf if k % 2 else 1.0])
        right = [1.0, 2.0] if k % 2 else [0.0, 1.0]
        found = kept.solve(qp)
        assert found.status is SolveStatus.SOLVED
        np.testing.assert_allclose(found.d[0], right, atol=1e-6)


@pytest.mark.parametrize("name", ["osqp", "scs", "proxqp", "auto"])
def test_no_estimate_is_below_its_bound(name):
    """osqp 250, 609: x below its lower bound by the solver's tolerance, which grows with x."""
    if name not in available():
        pytest.skip(f"{name} is not installed")
    covariances = {"disturbance": 1e3 * np.eye(2), "noise": 1e4 * np.eye(1)}
    mhe = qpmhe.MovingHorizonEstimator(
        linear(0.9 * np.eye(2), np.array([[1.0, 1.0]]), states=qpmhe.Box([0.0, 0.0], 2 * [np.inf])),
        qpmhe.ExtendedKalman(prior=1e4 * np.eye(2), **covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10,
        initial_state=[1000.0, 1.0], backend=name,
    )
    lowest = np.inf
    for y in 50.0 * np.abs(np.random.default_rng(0).standard_normal((60, 1))):
        lowest = min(lowest, mhe.update(y).trajectory.min())
    assert lowest == 0.0  # reached, and kept to the last bit
