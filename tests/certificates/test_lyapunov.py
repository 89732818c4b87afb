"""The Lyapunov design: constants by hand, adversarial runs, what is refused and printed."""

import io
import json
import math
from itertools import cycle, islice

import numpy as np
import pytest
from rich.console import Console

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Evidence, MismatchError, Sizes, design
from qpmhe.cli.certify import certify
from qpmhe.errors import OptionError, SetError, ShapeError
from qpmhe.estimation.run import Run
from qpmhe.model.model import Model

from .helpers import box, linear

# The program leaves this share of gamma for the verification; constants change by a little more.
NEAR = 2e-3


def scalar():
    return linear(1.2, 1.0), box(-10.0, 10.0), Sizes(0.1, 0.2), [[0.8]]


def swap():
    system = linear([[0.0, 1.0], [1.1, 0.0]], [[1.0, 0.0]])
    return system, box([-10.0, -10.0], [10.0, 10.0]), Sizes(0.1, 0.2), [[0.0], [1.1]]


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
    by_hand = 2.0 * math.sqrt((1.0 - 0.6**5) / 0.4 / (1.0 - 4.0 * 0.6**5) / P)
    assert plan.length(plan.limit(5)) == pytest.approx(by_hand, rel=NEAR)
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
    np.testing.assert_allclose(plan.components(1.0), np.power([scale, scale * p], -0.5), rtol=NEAR)


def drawn(rng, steps, width, largest):
    """Vectors of any kind whose lengths are at most, and often all, the largest."""
    noise = (
        rng.standard_normal((steps, width)), rng.choice([-1.0, 1.0], (steps, width)),
        np.tile(rng.choice([-1.0, 1.0], width), (steps, 1)),
        rng.standard_normal((steps, width)) * (rng.random((steps, 1)) < 0.1),
    )[rng.integers(4)]
    lengths = np.linalg.norm(noise, axis=1, keepdims=True)
    longest = lengths if rng.random() < 0.5 else lengths.max()
    return largest * noise / np.maximum(longest, 1e-300)


def attack(plan, gain, *, trials, steps=15):
    """The largest error as a share of each bound of a design, and how many were compared.

    The state is kept in the region. Half of the disturbances are turned against the estimate. Runs
    count while the estimates are in the region; as a minimiser's, while J is at most the truth's.
    """
    rng, system, region, nothing = np.random.default_rng(0), plan.system, plan.region, np.zeros(0)
    middle, half = 0.5 * (region.upper + region.lower), 0.5 * (region.upper - region.lower)
    shares, compared = {"minimiser": 0.0, "measured": 0.0}, 0
    estimators = [
        estimator(
            plan, qpmhe.Luenberger(gain), horizon=N, max_qps=cap, project_observer=False,
            engine="compiled",
        ) for N in sorted({3, min(plan.horizon, 12)}) for cap in (0, 1, 2, None)
    ]
    for mhe in islice(cycle(estimators), trials):
        start, other = middle + 0.7 * half * rng.uniform(-1.0, 1.0, (2, system.n))
        guess = start + 10.0 ** rng.uniform(-3.0, 0.0) * (other - start)
        w = drawn(rng, steps, system.n, plan.sizes.disturbance)
        v = drawn(rng, steps, system.p, plan.sizes.noise)
        x, estimates, pushes = [start], [], rng.random() < 0.5
        mhe.reset(guess)
        for t in range(steps):
            gap = x[t] - mhe.state
            if pushes and gap.any():
                w[t] = np.linalg.norm(w[t]) * gap / np.linalg.norm(gap)
            estimates.append(mhe.update(system.h(x[t], nothing) + v[t]))
            ahead = np.asarray(system.f(x[t], nothing))
            x.append(np.clip(ahead + w[t], region.lower, region.upper))
            w[t] = x[t + 1] - ahead
        x, run = np.array(x), Run.of(guess, estimates)
        inside = [region.contains(np.vstack((e.candidate, e.trajectory))).all() for e in estimates]
        least = [e.cost <= true_cost(plan, e, x, w, v) for e in estimates]
        error = square(run.states - x, plan.prior) ** 0.5
        for kind in shares:
            bound = plan.along(
                run, mhe, initial_error=start - guess, disturbances=w, noises=v, kind=kind
            )[1:]
            counts = np.logical_and(inside, least) if kind == "minimiser" else np.array(inside)
            counts = np.logical_and.accumulate(counts) & (bound > 1e-9)
            ratio = error[1:][counts] / bound[counts]
            shares[kind] = max(shares[kind], float(ratio.max(initial=0.0)))
            compared += ratio.size
    return shares, compared


def square(vectors, weight):
    return np.einsum("ti,ij,tj->t", vectors, weight, vectors)


def true_cost(plan, estimate, x, w, v):
    """J of the truth, with the prior of an estimate's window."""
    K, t = len(estimate.trajectory) - 1, estimate.time + 1
    own = square((x[t - K] - estimate.candidate[0])[None], plan.prior)[0]
    stages = square(w[t - K : t], plan.disturbance) + square(v[t - K : t], plan.noise)
    return plan.discount**K * own + plan.discount ** np.arange(K - 1.0, -1.0, -1.0) @ stages


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize(
    "make", [scalar, swap, bent_output], ids=lambda make: make.__name__
)
def test_no_run_exceeds_a_bound(make, pytestconfig, monkeypatch):
    """Adversarial runs of three systems, each sample the worst of many."""
    monkeypatch.setattr(Model, "fault", lambda *_: "")  # compared elsewhere
    system, region, sizes, gain = make()
    plan = design(system, region, sizes=sizes)
    assert plan.evidence is Evidence.PROVED
    trials = 600 if pytestconfig.option.all else 100
    shares, compared = attack(plan, gain, trials=trials)
    assert compared > 10 * trials
    assert max(shares.values()) <= 1.0 + 1e-9
    assert shares["measured"] > 0.5  # the search is able to come near
    if make is swap:
        object.__setattr__(plan, "discount", 0.5 * plan.discount)
        assert attack(plan, gain, trials=100)[0]["measured"] > 1.0


def estimator(plan, observer, *, horizon=4, candidate="reinitialized", **options):
    return qpmhe.MovingHorizonEstimator(
        plan.system, observer, plan.cost(), horizon=horizon, candidate=candidate,
        initial_state=np.zeros(plan.system.n), **{"engine": "python"} | options,
    )


@pytest.mark.slow
def test_what_was_not_certified_is_no_bound_for_a_window(double):
    system = qpmhe.System(
        lambda x, u: 0.8 * x + 0.1 * np.sin(x) * u, lambda x, u: x, n=1, p=1, m=1
    )
    plan = design(
        system, box(-2.0, 2.0), inputs=box(-1.0, 1.0), sizes=Sizes(0.1, 0.1), discount=0.6
    )
    mhe = estimator(plan, qpmhe.Luenberger([[0.5]]), horizon=3)
    run = mhe.run(np.zeros((20, 1)), np.where(np.arange(20) == 5, 1.5, 0.5)[:, None])
    bound = plan.along(run, mhe, initial_error=box(-0.5, 0.25))
    assert np.flatnonzero(np.isnan(bound)).tolist() == [6, 7, 8]
    assert bound[0] == pytest.approx(0.5 * math.sqrt(plan.prior[0, 0]))
    mhe, measurements = estimator(*double), np.where(np.arange(20) == 6, np.nan, 0.0)
    bound = double[0].along(mhe.run(measurements), mhe, initial_error=1.0)
    assert np.flatnonzero(np.isnan(bound)).tolist() == [7, 8, 9, 10]
    assert 1.0 < bound[11] / bound[4] < 30.0  # from anywhere in the region, as 0 was from 1 off


@pytest.mark.slow
def test_the_command_prints_the_code_and_reports_it(tmp_path):
    # At 70 columns: what is to be pasted must not be broken.
    console, report = Console(file=io.StringIO(), width=70), tmp_path / "certificate.json"
    certify(console, "batch_reactor", "0.1:9,-1:9", "20", report, with_design=True)
    printed = console.file.getvalue()
    system, observer, _, _ = qpmhe.models.batch_reactor()
    names = {"qpmhe": qpmhe, "system": system, "observer": observer, "initial_state": [1.0, 1.0]}
    code = printed[printed.index("cost = "):]
    exec(code[: code.index("\n)\n", code.index("mhe = ")) + 3], names)
    content = json.loads(report.read_text())["design"]
    assert content["evidence"] == "proved"
    assert names["mhe"].horizon == content["horizon"] == 20
    assert names["cost"].prior.tolist() == content["prior"]
    # The search finds its way to rates that this horizon is long enough for.
    assert content["least_horizon"] < 20


def test_bad_input_is_refused(double):
    (plan, observer), (system, region, sizes, _) = double, swap()
    mhe = estimator(plan, observer)
    run = mhe.run(np.zeros((3, 1)))

    def along(estimator=mhe, **options):
        return plan.along(run, estimator, initial_error=1.0, **options)

    hidden = linear(1.1 * np.eye(2), [[0.0, 0.0]])
    for asked, error, words in (
        (lambda: design(system, region), SetError, "how large"),
        (lambda: design(system, region, sizes=sizes, discount=1.0), OptionError, "discount"),
        (lambda: design(system, region, sizes=sizes, seconds=1e-9), certificates.OutOfTimeError,
         "more seconds"),
        (lambda: design(hidden, region, sizes=sizes), certificates.NotCertifiedError, "detectable"),
        (lambda: along(noises=np.zeros((4, 1))), ShapeError, "samples"),
        (lambda: along(estimator(plan, observer, candidate="observer")), MismatchError,
         "running observer's"),
        (lambda: design(swap()[0], region, sizes=sizes, discount=0.7).along(
            run, mhe, initial_error=1.0), MismatchError, "another system"),
    ):
        with pytest.raises(error, match=words):
            asked()
