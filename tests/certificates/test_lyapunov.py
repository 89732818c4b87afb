"""The Lyapunov design: constants by hand, adversarial runs, what is refused and printed."""

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
    OutOfTimeError,
    Sizes,
    design,
)
from qpmhe.cli.certify import certify
from qpmhe.errors import OptionError, SetError, ShapeError

from .attacks import RELATIVE, attack_design
from .helpers import box, linear

# The program leaves this share of gamma for the verification; constants change by a little more.
NEAR = 2e-3


def scalar():
    return linear(1.2, 1.0), box(-10.0, 10.0), Sizes(0.1, 0.2), [[0.8]]


def swap():
    system = linear([[0.0, 1.0], [1.1, 0.0]], [[1.0, 0.0]])
    return system, box([-10.0, -10.0], [10.0, 10.0]), Sizes(0.1, 0.2), [[0.0], [1.1]]


def reactor():
    system, observer, *_ = qpmhe.models.batch_reactor()
    return system, box([0.1, -1.0], [9.0, 9.0]), Sizes(0.03, 0.06), observer.gain


def bent_output():
    def f(x):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + 0.1 * b, 0.9 * b - 0.1 * np.sin(a)], -1)

    system = qpmhe.System(f, lambda x: x[..., :1] + 0.1 * np.sin(x[..., :1]), n=2, p=1)
    return system, box([-2.0, -2.0], [2.0, 2.0]), Sizes(0.01, 0.02), [[0.4], [0.1]]


@pytest.fixture(scope="module")
def double():
    """The two-state example's design for a given discount, and an observer."""
    system, region, sizes, gain = swap()
    return design(system, region, sizes=sizes, discount=0.7), qpmhe.Luenberger(gain)


def test_one_state_by_hand():
    # p (a x + w)^2 <= gamma p x^2 + q w^2 + r x^2 for all x, w: with p = 1, a^2 (1 + e) =
    # gamma + r and q = 1 + 1/e, and d^2 q + v^2 r is least for e = d / (a v).
    system, region, sizes, _ = scalar()
    plan = design(system, region, sizes=sizes, discount=0.6)
    a, d, v = 1.2, sizes.disturbance, sizes.noise
    e = d / (a * v)
    Q, R = 1.0 + 1.0 / e, a * a * (1.0 + e) - 0.6
    P = 1.0 / (d * d * Q + v * v * R)  # the largest w and v cost 1
    assert plan.evidence is Evidence.PROVED
    np.testing.assert_allclose(
        [plan.prior[0, 0], plan.disturbance[0, 0], plan.noise[0, 0]], [P, P * Q, P * R], rtol=NEAR
    )
    assert plan.least_horizon() == 3  # 4 * 0.6^3 = 0.864, 4 * 0.6^2 = 1.44
    assert plan.contraction(3) == pytest.approx(2.0 * 0.6**1.5)
    N = 5
    S = (1.0 - 0.6**N) / 0.4
    by_hand = 2.0 * math.sqrt(S / (1.0 - 4.0 * 0.6**N) / P)
    assert plan.length(plan.limit(N)) == pytest.approx(by_hand, rel=NEAR)
    assert plan.limit(2) == math.inf
    # As d + a v > v, the limit is least for gamma to 0: the last measurement alone, 2 (d + a v).
    best, least = design(system, region, sizes=sizes), 2.0 * (0.1 + 1.2 * 0.2)
    assert least <= best.length(best.limit(200)) <= 1.02 * least


def test_two_states_by_hand(double):
    # Diagonal, by the symmetry x -> diag(1, -1) x: p1 = 1, and with p2 = p the couplings are
    # 1/q = 1 - 1/(gamma p) and r = a^2 / (1/p - 1/q) - gamma; d^2 q + v^2 r is least for this p.
    gamma, a, d, v = 0.7, 1.1, 0.1, 0.2
    k = v * a / d * math.sqrt((1.0 + 1.0 / gamma) / gamma)
    p = (1.0 + 1.0 / gamma + k) / (1.0 + gamma * k)
    q = gamma * p / (gamma * p - 1.0)
    r = a * a / (1.0 / p - 1.0 / q) - gamma
    scale = 1.0 / (d * d * q + v * v * r)
    plan, _ = double
    assert plan.evidence is Evidence.PROVED
    for found, expected in (
        (plan.prior, np.diag([1.0, p])), (plan.disturbance, q * np.eye(2)), (plan.noise, [[r]]),
    ):
        np.testing.assert_allclose(found, scale * np.asarray(expected), rtol=NEAR)
    assert plan.least_horizon() == 4  # ln 4 / -ln 0.7 = 3.9
    np.testing.assert_allclose(
        plan.components(1.0), [scale**-0.5, (scale * p) ** -0.5], rtol=NEAR
    )


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize(
    "make", [scalar, swap, reactor, bent_output], ids=lambda make: make.__name__
)
def test_no_run_exceeds_a_bound(make, pytestconfig, monkeypatch):
    """With --all, 10,000 adversarial runs of four systems."""
    monkeypatch.setattr(qpmhe.System, "trace_fault", lambda *_: "")  # compared elsewhere
    system, region, sizes, gain = make()
    plan = design(system, region, sizes=sizes)
    assert plan.evidence is Evidence.PROVED
    trials = 2500 if pytestconfig.option.all else 100
    shares, compared = attack_design(plan, gain, trials=trials)
    assert compared > 10 * trials
    assert max(shares.values()) <= 1.0 + RELATIVE
    assert shares["measured"] > 0.5  # the search is able to come near
    if make is swap:
        object.__setattr__(plan, "discount", 0.5 * plan.discount)
        assert attack_design(plan, gain, trials=100)[0]["measured"] > 1.0


def test_the_inequality_holds_between_states():
    system, sizes = qpmhe.models.van_der_pol().system, Sizes(0.01, 0.02)
    plan = design(system, box([-1.5, -1.5], [1.5, 1.5]), sizes=sizes, discount=0.9)
    rng, nothing = np.random.default_rng(0), np.zeros((20_000, 0))
    one, other = rng.uniform(-1.5, 1.5, (2, 20_000, 2))
    w = 10.0 ** rng.uniform(-4.0, 1.0, (20_000, 1)) * rng.standard_normal((20_000, 2))
    f, h = (
        g.batch(one, nothing) - g.batch(other, nothing) for g in (plan.system.f, plan.system.h)
    )
    ahead, start, supplied, seen = (
        np.einsum("ti,ij,tj->t", s, weight, s) for s, weight in (
            (f + w, plan.prior), (one - other, plan.prior), (w, plan.disturbance), (h, plan.noise)
        )
    )
    assert (ahead <= (plan.discount * start + supplied + seen) * (1.0 + 1e-12)).all()


def estimator(plan, observer, *, horizon=4, candidate="reinitialized", **options):
    return qpmhe.MovingHorizonEstimator(
        plan.system, observer, plan.cost(), horizon=horizon, candidate=candidate,
        initial_state=np.zeros(plan.system.n), engine="python", **options,
    )


def test_the_growing_window_starts_at_the_first_guess(double):
    plan, observer = double
    mhe = estimator(plan, observer, max_qps=0)
    bound = plan.along(
        mhe.run(np.zeros((9, 1))), mhe, initial_error=[1.0, -0.5], disturbances=0.0, noises=0.0,
        kind="minimiser",
    )
    start = math.sqrt(plan.prior[0, 0] + 0.25 * plan.prior[1, 1])
    factor = 2.0 * 0.7 ** (0.5 * np.arange(5))
    expected = start * np.array([1.0, *factor[1:], *(factor[4] * factor[1:])])
    np.testing.assert_allclose(bound[:9], expected, rtol=1e-6)
    assert bound[9] == pytest.approx(factor[4] * bound[5], rel=1e-6)


def test_units_do_not_matter():
    A, plans = np.array([[0.9, 0.2], [-0.1, 0.7]]), []
    for c in (np.ones(2), np.array([1e6, 1e-3])):
        system = linear(
            c[:, None] * A / c, [[1.0 / c[0], 0.0]], states=box(-5.0 * c, 5.0 * c),
            disturbances=box(-0.1 * c, 0.1 * c), noises=box(-0.1, 0.1),
        )
        plan = design(system, discount=0.8)
        corners = np.array([[0.1, 0.1], [0.1, -0.1]]) * c
        costs = np.einsum("ti,ij,tj->t", corners, plan.disturbance, corners)
        assert costs.max() + 0.01 * plan.noise[0, 0] == pytest.approx(1.0)
        plans.append(plan.components(plan.limit()) / c)
    np.testing.assert_allclose(plans[1], plans[0], rtol=1e-4)


def test_disturbances_in_fewer_directions():
    A = np.array([[1.0, 0.1], [0.0, 0.9]])
    system = linear(A, [[1.0, 0.0]], disturbance_matrix=[[0.0], [1.0]])
    plan = design(system, box([-5.0] * 2, [5.0] * 2), sizes=Sizes(0.1, 0.1))
    assert plan.disturbance.shape == (1, 1)
    mhe = estimator(plan, qpmhe.Luenberger([[0.5], [0.5]]), horizon=plan.horizon)
    rng, states = np.random.default_rng(0), [np.array([1.0, 0.5])]
    for _ in range(60):
        states.append(A @ states[-1] + [0.0, rng.uniform(-0.1, 0.1)])
    run = mhe.run(np.array(states)[:-1, :1] + rng.uniform(-0.1, 0.1, (60, 1)))
    error = np.linalg.norm(run.states - states, axis=1)
    assert (error <= plan.length(plan.along(run, mhe, initial_error=[1.0, 0.5]))).all()


def test_what_was_not_certified_is_no_bound_for_a_window(double):
    system = qpmhe.System(
        lambda x, u: 0.8 * x + 0.1 * np.sin(x) * u, lambda x, u: x, n=1, p=1, m=1
    )
    plan = design(
        system, box(-2.0, 2.0), inputs=box(-1.0, 1.0), sizes=Sizes(0.1, 0.1), discount=0.6,
        horizon=4,
    )
    assert plan.horizon == 4
    mhe = estimator(plan, qpmhe.Luenberger([[0.5]]), horizon=3)
    run = mhe.run(np.zeros((20, 1)), np.where(np.arange(20) == 5, 1.5, 0.5)[:, None])
    bound = plan.along(run, mhe, initial_error=box(-0.5, 0.25))
    assert np.flatnonzero(np.isnan(bound)).tolist() == [6, 7, 8]
    assert bound[0] == pytest.approx(0.5 * math.sqrt(plan.prior[0, 0]))
    measurements, mhe = np.zeros((20, 1)), estimator(*double)
    measurements[6] = np.nan
    bound = double[0].along(mhe.run(measurements), mhe, initial_error=1.0)
    assert np.flatnonzero(np.isnan(bound)).tolist() == [7, 8, 9, 10]
    assert 1.0 < bound[11] / bound[4] < 30.0  # from anywhere in the region, as 0 was from 1 off


def test_the_command_prints_the_code_and_reports_it(tmp_path):
    # At 70 columns: what is to be pasted must not be broken.
    console, report = Console(file=io.StringIO(), width=70), tmp_path / "certificate.json"
    certify(console, "batch_reactor", "0.1:9,-1:9", "20", report, with_design=True)
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
    # The search finds its way to rates that this horizon is long enough for.
    assert content["least_horizon"] < 20


def test_bad_input_is_refused(double):
    plan, observer = double
    system, region, sizes, _ = swap()
    mhe = estimator(plan, observer)
    run = mhe.run(np.zeros((3, 1)))

    def along(estimator=mhe, initial_error=1.0, **options):
        return plan.along(run, estimator, initial_error=initial_error, **options)

    hidden = linear(1.1 * np.eye(2), [[0.0, 0.0]])
    for asked, error, words in (
        (lambda: design(system, region), SetError, "how large"),
        (lambda: design(system, region, sizes=sizes, discount=1.0), OptionError, "discount"),
        (lambda: design(system, region, sizes=sizes, horizon=0), OptionError, "horizon"),
        (lambda: design(system, region, sizes=sizes, seconds=1e-9), OutOfTimeError, "more seconds"),
        (lambda: design(hidden, region, sizes=sizes), NotCertifiedError, "detectable"),
        (lambda: along(kind="decrease"), OptionError, "kind"),
        (lambda: along(initial_error=np.zeros(3)), ShapeError, "initial_error"),
        (lambda: along(noises=np.zeros((4, 1))), ShapeError, "samples"),
        (lambda: along(estimator(plan, observer, arrival="smoothed")), MismatchError, "arrival"),
        (lambda: along(estimator(plan, observer, candidate="observer")), MismatchError,
         "running observer's"),
        (lambda: design(swap()[0], region, sizes=sizes, discount=0.7).along(
            run, mhe, initial_error=1.0), MismatchError, "another system"),
    ):
        with pytest.raises(error, match=words):
            asked()
