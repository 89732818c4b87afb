"""The Lyapunov design: constants by hand, searches for violations, what is refused and printed."""

import io
import json
import math

import numpy as np
import pytest
from rich.console import Console

import qpmhe
from qpmhe.certificates import (
    Evidence,
    MismatchError,
    NotCertifiedError,
    ObserverStability,
    SignalBounds,
    Sizes,
    design,
)
from qpmhe.cli.certify import certify
from qpmhe.errors import OptionError, SetError, ShapeError

from .attacks import RELATIVE
from .lyapunov_attacks import attack, bent_output, designed, reactor, scalar, swap, van_der_pol

# The program leaves this share of gamma for the verification; constants change by a little more.
NEAR = 2e-3


@pytest.fixture(scope="module")
def double():
    """The two-state example, its observer, and the design for a given discount."""
    system, region, sizes = swap()
    observer = qpmhe.Luenberger([[0.0], [1.1]])
    # A - K C = [[0, 1], [0, 0]] contracts by 0.5 in O = diag(1, 4).
    stability = ObserverStability(
        0.5, 2.0, 4.0, 5.0, 1.1, gain=observer.gain, P=np.diag([1.0, 4.0]), V=[[4.0 * 1.1**2]]
    )
    plan = design(
        system, region, observer=observer, sizes=sizes, discount=0.7, stability=stability
    )
    return plan, observer


def test_one_state_by_hand():
    # p (a x + w)^2 <= gamma p x^2 + q w^2 + r x^2 for all x, w: with p = 1, a^2 (1 + e) =
    # gamma + r and q = 1 + 1/e, and d^2 q + v^2 r is least for e = d / (a v).
    system, region, sizes = scalar()
    plan = design(system, region, sizes=sizes, discount=0.6)
    a, d, v = 1.2, sizes.disturbance, sizes.noise
    e = d / (a * v)
    Q, R = 1.0 + 1.0 / e, a * a * (1.0 + e) - 0.6
    P = 1.0 / (d * d * Q + v * v * R)  # the largest w and v cost 1
    assert plan.evidence is Evidence.PROVED
    np.testing.assert_allclose(
        [plan.prior[0, 0], plan.disturbance[0, 0], plan.noise[0, 0]], [P, P * Q, P * R], rtol=NEAR
    )
    assert plan.least_horizon("minimiser") == 3  # 4 * 0.6^3 = 0.864, 4 * 0.6^2 = 1.44
    assert plan.contraction(3, "minimiser") == pytest.approx(2.0 * 0.6**1.5)
    assert plan.contraction(3, "measured") == pytest.approx(0.6**1.5)
    N = 5
    S = (1.0 - 0.6**N) / 0.4
    by_hand = 2.0 * math.sqrt(S / (1.0 - 4.0 * 0.6**N) / P)
    assert plan.length(plan.limit(N, "minimiser")) == pytest.approx(by_hand, rel=NEAR)


def test_best_discount_by_hand():
    # As d + a v > v, the limit is least for gamma to 0: the last measurement alone, 2 (d + a v).
    system, region, sizes = scalar()
    plan = design(system, region, sizes=sizes)
    least = 2.0 * (0.1 + 1.2 * 0.2)
    assert least <= plan.length(plan.limit(200, "minimiser")) <= 1.02 * least
    assert plan.discount < 0.06


def two_states(gamma, a=1.1, d=0.1, v=0.2):
    # Diagonal, by the symmetry x -> diag(1, -1) x: p1 = 1, and with p2 = p the couplings are
    # 1/q = 1 - 1/(gamma p) and r = a^2 / (1/p - 1/q) - gamma; d^2 q + v^2 r is least for this p.
    k = v * a / d * math.sqrt((1.0 + 1.0 / gamma) / gamma)
    p = (1.0 + 1.0 / gamma + k) / (1.0 + gamma * k)
    q = gamma * p / (gamma * p - 1.0)
    r = a * a / (1.0 / p - 1.0 / q) - gamma
    return p, q, r, 1.0 / (d * d * q + v * v * r)


def test_two_states_by_hand(double):
    plan, _ = double
    p, q, r, scale = two_states(0.7)
    assert plan.evidence is Evidence.ASSUMED  # as the observer's stability is
    for found, expected in (
        (plan.prior, np.diag([1.0, p])), (plan.disturbance, q * np.eye(2)), (plan.noise, [[r]]),
    ):
        np.testing.assert_allclose(found, scale * np.asarray(expected), rtol=NEAR)
    assert plan.least_horizon("minimiser") == 4  # ln 4 / -ln 0.7 = 3.9
    np.testing.assert_allclose(
        plan.components(1.0), [scale**-0.5, (scale * p) ** -0.5], rtol=NEAR
    )


def test_candidate_cost_by_hand(double):
    plan, _ = double
    p, q, r, scale = two_states(0.7)
    M = scale * (1.1**2 * q + r)
    assert plan.slope == pytest.approx(math.sqrt(M), rel=NEAR)
    entry = math.sqrt(max(1.0, 4.0 / p) / scale)
    for N in (1, 4, 9):
        decay = sum(0.7 ** (N - 1 - i) * 0.25**i for i in range(N))
        expected = 0.7 ** (N / 2) + math.sqrt(M) * entry * math.sqrt(decay)
        assert plan.contraction(N) == pytest.approx(expected, rel=NEAR)
    least = plan.least_horizon()
    assert plan.contraction(least) < 1.0 <= plan.contraction(least - 1)
    assert plan.limit(least - 1) == math.inf
    # The fixed point of one step, with what the largest w and v make of b: w in the direction
    # that O weighs most, v through the gain.
    N, rho, enters = 2 * least, 0.5, 2.0 * 0.1 + 2.0 * 1.1 * 0.2
    u = plan.limit(N)
    b, costs, truth = entry * u, 0.0, 0.7**N * u * u
    for i in range(N):
        weight = 0.7 ** (N - 1 - i)
        costs += weight * (math.sqrt(M) * b + math.sqrt(M) * 0.2) ** 2
        truth += weight
        b = rho * b + enters
    assert math.sqrt(costs) + math.sqrt(truth) == pytest.approx(u, rel=2.0 * NEAR)


@pytest.mark.parametrize(
    "make", [scalar, swap, reactor, bent_output], ids=lambda make: make.__name__
)
def test_no_run_exceeds_a_bound(make):
    plan, observer = designed(make)
    assert plan.evidence is Evidence.PROVED
    shares, compared = attack(plan, observer, trials=64)
    assert compared > 500
    assert max(shares.values()) <= 1.0 + RELATIVE
    assert shares["measured"] > 0.6  # the search is able to come near


def test_a_wrong_design_is_refuted():
    plan, observer = designed(swap)
    object.__setattr__(plan, "discount", 0.5 * plan.discount)
    shares, _ = attack(plan, observer, trials=64)
    assert shares["measured"] > 1.0


def test_the_inequality_holds_between_states():
    system, region, sizes = van_der_pol()
    plan = design(system, region, sizes=sizes)
    rng, form = np.random.default_rng(0), plan.form
    x = plan.region.sample(4000, rng)[:, :2]
    one, other = x[rng.integers(len(x), size=(2, 20_000))]
    w = 10.0 ** rng.uniform(-4.0, 1.0, (20_000, 1)) * rng.standard_normal((20_000, 2))
    nothing = np.zeros((20_000, 0))
    f, h = (
        g.batch(one, nothing) - g.batch(other, nothing) for g in (plan.system.f, plan.system.h)
    )

    def square(s, weight):
        return np.einsum("ti,ij,tj->t", s, weight, s)

    supplied = plan.discount * square(one - other, form.P) + square(w, form.Q) + square(h, form.R)
    assert (square(f + w, form.P) <= supplied * (1.0 + 1e-12)).all()


def test_the_growing_window_starts_at_the_first_guess(double):
    plan, observer = double
    mhe = estimator(plan, observer, horizon=4, max_qps=0)
    run = mhe.run(np.zeros((9, 1)))
    bound = plan.along(
        run, mhe, initial_error=[1.0, -0.5], disturbances=0.0, noises=0.0, kind="minimiser"
    )
    start = math.sqrt(plan.prior[0, 0] + 0.25 * plan.prior[1, 1])
    factor = 2.0 * 0.7 ** (0.5 * np.arange(5))
    expected = start * np.array([1.0, *factor[1:], *(factor[4] * factor[1:])])
    expected[8] = start * factor[4] ** 2
    np.testing.assert_allclose(bound[:9], expected, rtol=1e-6)
    assert bound[9] == pytest.approx(factor[4] * bound[5], rel=1e-6)


def test_no_measurement_no_bound(double):
    plan, observer = double
    measurements = np.zeros((20, 1))
    measurements[6] = np.nan
    for candidate, spoilt in (("reinitialized", range(7, 11)), ("observer", range(7, 21))):
        mhe = estimator(plan, observer, horizon=4, candidate=candidate)
        bound = plan.along(mhe.run(measurements), mhe, initial_error=1.0)
        assert np.flatnonzero(np.isnan(bound)).tolist() == list(spoilt)
        if candidate == "reinitialized":  # from anywhere in the region, as 0 was from 1 off
            assert 1.0 < bound[11] / bound[4] < 30.0


def test_projection_ends_what_needs_the_observer():
    _, region, sizes = swap()
    A = np.array([[0.0, 1.0], [1.1, 0.0]])
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1,
        states=qpmhe.Box([-1.0, -1.0], [1.0, 1.0]),
    )
    observer = qpmhe.Luenberger([[0.0], [1.1]])
    plan = design(system, region, observer=observer, sizes=sizes, discount=0.7)
    mhe = estimator(plan, observer, horizon=4)
    run = mhe.run(np.full((8, 1), 2.0))
    assert qpmhe.Status.OBSERVER_PROJECTED in run.statuses[1]
    assert np.isfinite(plan.along(run, mhe, initial_error=1.0)).all()
    assert np.isnan(plan.along(run, mhe, initial_error=1.0, kind="decrease")[3:]).all()


def estimator(plan, observer, *, horizon, candidate="reinitialized", **options):
    return qpmhe.MovingHorizonEstimator(
        plan.system, observer, plan.cost(), horizon=horizon, candidate=candidate,
        initial_state=np.zeros(plan.system.n), engine="python", **options,
    )


def test_sizes_of_components_and_of_the_system():
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, states=qpmhe.Box([-5.0] * 2, [5.0] * 2),
        disturbances=qpmhe.Box([-0.1, -0.01], [0.1, 0.01]), noises=qpmhe.Box([-0.1], [0.1]),
    )
    plan = design(system)
    w = np.array([[0.1, 0.01], [0.1, -0.01]])
    costs = np.einsum("ti,ij,tj->t", w, plan.disturbance, w) + 0.01 * plan.noise[0, 0]
    assert costs.max() == pytest.approx(1.0)
    boxes = SignalBounds(system.disturbances, system.noises)
    assert np.array_equal(design(system, sizes=boxes).prior, plan.prior)


def test_units_do_not_matter():
    A, c = np.array([[0.9, 0.2], [-0.1, 0.7]]), np.array([1e6, 1e-3])
    plans = [
        design(
            qpmhe.System(
                lambda x, s=s: x @ (s[:, None] * A / s).T, lambda x, s=s: x[..., :1] / s[0], n=2,
                p=1, disturbances=qpmhe.Box(-0.1 * s, 0.1 * s), noises=qpmhe.Box([-0.1], [0.1]),
            ),
            qpmhe.Box(-5.0 * s, 5.0 * s), discount=0.8,
        )
        for s in (np.ones(2), c)
    ]
    limits = [plan.components(plan.limit(kind="minimiser")) for plan in plans]
    np.testing.assert_allclose(limits[1], c * limits[0], rtol=1e-4)


def test_disturbances_in_fewer_directions():
    A = np.array([[1.0, 0.1], [0.0, 0.9]])
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, disturbance_matrix=[[0.0], [1.0]]
    )
    region = qpmhe.Box([-5.0] * 2, [5.0] * 2)
    plan = design(
        system, region, sizes=Sizes(0.1, 0.1), observer=qpmhe.Luenberger([[0.5], [0.5]])
    )
    assert plan.disturbance.shape == (1, 1)
    assert plan.kinds == ("minimiser", "measured")
    assert "disturbance_matrix" in plan.notes[0]
    mhe = estimator(plan, qpmhe.Luenberger([[0.5], [0.5]]), horizon=plan.horizon)
    rng, x, states = np.random.default_rng(0), np.array([1.0, 0.5]), [[1.0, 0.5]]
    v = rng.uniform(-0.1, 0.1, (60, 1))
    for _ in v:
        x = A @ x + [0.0, rng.uniform(-0.1, 0.1)]
        states.append(x)
    run = mhe.run(np.array(states)[:-1, :1] + v)
    error = np.linalg.norm(run.states - states, axis=1)
    assert (error <= plan.length(plan.along(run, mhe, initial_error=[1.0, 0.5]))).all()


def test_inputs_outside_of_what_was_certified():
    system = qpmhe.System(
        lambda x, u: 0.8 * x + 0.1 * np.sin(x) * u, lambda x, u: x, n=1, p=1, m=1
    )
    region, sizes = qpmhe.Box([-2.0], [2.0]), Sizes(0.1, 0.1)
    plan = design(
        system, region, inputs=qpmhe.Box([-1.0], [1.0]), sizes=sizes, horizon=4,
        observer=qpmhe.Luenberger([[0.5]]),
    )
    assert plan.horizon == 4
    mhe = estimator(plan, qpmhe.Luenberger([[0.5]]), horizon=3)
    inputs = np.where(np.arange(20) == 5, 1.5, 0.5)[:, None]
    run = mhe.run(np.zeros((20, 1)), inputs)
    for kind in plan.kinds:
        bound = plan.along(run, mhe, initial_error=qpmhe.Box([-0.5], [0.25]), kind=kind)
        assert np.flatnonzero(np.isnan(bound)).tolist() == [6, 7, 8]
        assert bound[0] == pytest.approx(0.5 * math.sqrt(plan.prior[0, 0]))


def test_the_code_is_python(double):
    plan, observer = double
    names = {
        "qpmhe": qpmhe, "system": plan.system, "observer": observer, "initial_state": [0.0, 0.0]
    }
    exec(plan.code(), names)
    mhe = names["mhe"]
    assert mhe.horizon == plan.horizon
    plan.along(mhe.run(np.zeros((3, 1))), mhe, initial_error=1.0)  # accepts the very numbers
    content = json.loads(json.dumps(plan.to_dict(), allow_nan=False))
    assert content["discount"] == 0.7
    assert content["least_horizon"]["minimiser"] == 4


def test_the_command_prints_the_code_and_reports_it(tmp_path):
    # At 70 columns: what is to be pasted must not be broken.
    console = Console(file=io.StringIO(), width=70)
    report = tmp_path / "certificate.json"
    certify(console, "batch_reactor", "0.1:9,-1:9", "20", report, design=True)
    printed = console.file.getvalue()
    system, observer, _, scenario = qpmhe.models.batch_reactor()
    names = {
        "qpmhe": qpmhe, "system": system, "observer": observer,
        "initial_state": scenario.initial_estimate,
    }
    code = printed[printed.index("cost = "):]
    exec(code[: code.index("\n)\n", code.index("mhe = ")) + 3], names)
    content = json.loads(report.read_text())["design"]
    assert content["evidence"] == "proved"
    assert names["mhe"].horizon == content["horizon"] == 20
    assert names["cost"].prior.tolist() == content["prior"]


def test_bad_input_is_refused(double):
    plan, observer = double
    system, region, sizes = swap()
    with pytest.raises(SetError, match="how large"):
        design(system, region)
    for discount in (0.0, 1.0, math.nan):
        with pytest.raises(OptionError, match="discount"):
            design(system, region, sizes=sizes, discount=discount)
    with pytest.raises(OptionError, match="horizon"):
        design(system, region, sizes=sizes, horizon=0)
    hidden = qpmhe.System(lambda x: 1.1 * x, lambda x: 0.0 * x[..., :1], n=2, p=1)
    with pytest.raises(NotCertifiedError, match="detectable"):
        design(hidden, region, sizes=sizes)
    with pytest.raises(OptionError, match="kind"):
        plan.limit(kind="best")
    with pytest.raises(OptionError, match="measured"):
        plan.limit(kind="measured")
    with pytest.raises(OptionError, match="candidate"):
        plan.limit(candidate="none")
    alone = design(system, region, sizes=sizes, discount=0.7)
    with pytest.raises(OptionError, match="observer"):
        alone.contraction()
    mhe = estimator(plan, observer, horizon=4)
    run = mhe.run(np.zeros((3, 1)))
    with pytest.raises(MismatchError, match="system"):
        alone.along(run, mhe, initial_error=1.0)
    with pytest.raises(ShapeError, match="initial_error"):
        plan.along(run, mhe, initial_error=np.zeros(3))
    with pytest.raises(ShapeError, match="samples"):
        plan.along(run, mhe, initial_error=1.0, noises=np.zeros(4))
    other = estimator(plan, observer, horizon=4, arrival="smoothed")
    with pytest.raises(MismatchError, match="arrival"):
        plan.along(run, other, initial_error=1.0)
    other = estimator(plan, qpmhe.Luenberger([[0.1], [0.1]]), horizon=4)
    plan.along(run, other, initial_error=1.0)  # measured: any observer will do
    with pytest.raises(MismatchError, match="gain"):
        plan.along(run, other, initial_error=1.0, kind="decrease")
