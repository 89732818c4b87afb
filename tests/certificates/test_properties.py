"""What was certified for one system, gain and region is not used for another."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer
from qpmhe.certificates.evidence import Evidence, MismatchError
from qpmhe.certificates.monitor import monitored_run
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.certificates.regions import beyond, bounded_region
from qpmhe.errors import SetError

COST = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)


def cube(x):
    return x**3


def output(x):
    return 1.0 * x


def cubic():
    return qpmhe.System(cube, output, n=1, p=1)


def box(side):
    return qpmhe.Box([-side], [side])


@pytest.fixture(scope="module")
def parts():
    """Detectability and stability of x^3 on [-0.3, 0.3], with the gain 0.1."""
    system, observer = cubic(), qpmhe.Luenberger([[0.1]])
    return (
        system, observer, certify_detectability(system, box(0.3), eta=0.5),
        certify_observer(system, observer, box(0.3), rho=0.6),
    )


def test_parts_of_the_same_serve_on_the_region_and_on_a_smaller_one(parts):
    system, observer, detected, observed = parts
    for side in (0.3, 0.2):
        certificate = certify(
            system, observer, COST, horizon=2, region=box(side), detectability=detected,
            stability=observed,
        )
        assert certificate.evidence is Evidence.PROVED
        assert certificate.diameter == pytest.approx(2 * side)


@pytest.mark.parametrize("which", ["detectability", "stability"])
def test_a_larger_region_is_refused(parts, which):
    system, observer, detected, observed = parts
    given = {"detectability": detected} if which == "detectability" else {"stability": observed}
    with pytest.raises(MismatchError, match=rf"{which}.*x\[0\] <= 0.3 .*0.99.*Certify it"):
        certify(system, observer, COST, horizon=2, region=box(0.99), **given)


def test_another_system_is_refused(parts):
    _, observer, detected, observed = parts
    copied = pickle.loads(pickle.dumps(detected))
    assert copied.evidence is Evidence.PROVED
    for target, given in (
        (cubic(), {"detectability": detected}), (cubic(), {"stability": observed}),
        (parts[0], {"detectability": copied}),
    ):
        with pytest.raises(MismatchError, match=r"another System object.*assumed\("):
            certify(target, observer, COST, horizon=2, region=box(0.3), **given)


def test_another_gain_is_refused(parts):
    system, _, detected, observed = parts
    for observer in (
        qpmhe.Luenberger([[0.2]]), qpmhe.OutputInjection(lambda z, v: 0.1 * v),
    ):
        with pytest.raises(MismatchError, match=r"gain \[\[0.1\]\]"):
            certify(
                system, observer, COST, horizon=2, region=box(0.3), detectability=detected,
                stability=observed,
            )


def test_a_larger_set_of_inputs_is_refused():
    system = qpmhe.System(lambda x, u: x * u[..., :1], lambda x, u: 1.0 * x, n=1, p=1, m=1)
    observer = qpmhe.Luenberger([[0.1]])
    given = {
        "detectability": certify_detectability(system, box(1.0), inputs=box(0.1), eta=0.5),
        "stability": certify_observer(system, observer, box(1.0), inputs=box(0.1), rho=0.6),
    }
    with pytest.raises(MismatchError, match=r"u\[0\] <= 0.1 .* may be 5"):
        certify(system, observer, COST, horizon=2, region=box(1.0), inputs=box(5.0), **given)
    certificate = certify(
        system, observer, COST, horizon=2, region=box(1.0), inputs=box(0.05), **given
    )
    assert certificate.evidence is Evidence.PROVED
    with pytest.raises(SetError, match="leave inputs out"):
        certify(
            system, observer, COST, horizon=2, region=certificate.region, inputs=box(5.0), **given
        )


def test_what_is_stated_by_hand_is_assumed(parts):
    _, _, detected, observed = parts
    by_hand = Detectability(0.5, 1.0, 1.0, 1.0, region=detected.region)
    assert by_hand.evidence is Evidence.ASSUMED
    assert replace(detected, c_w=0.5 * detected.c_w).evidence is Evidence.ASSUMED
    assert replace(detected, region=bounded_region(cubic(), box(9.0))).evidence is Evidence.ASSUMED
    assert replace(observed, P=2.0 * observed.P).evidence is Evidence.ASSUMED
    for weak in (detected, observed):
        with pytest.raises(ValueError, match="evidence"):
            replace(weak, c_p=1.0, evidence=Evidence.PROVED)
        with pytest.raises(ValueError, match="read-only"):
            weak.P[0, 0] = 0.0


def test_a_certificate_changed_by_hand_is_assumed(parts):
    system, observer, detected, observed = parts
    certificate = certify(
        system, observer, COST, horizon=2, region=box(0.3), detectability=detected,
        stability=observed,
    )
    other = qpmhe.QuadraticCost(prior=2.0, disturbance=1.0, noise=1.0)
    assert certificate.evidence is Evidence.PROVED
    assert replace(certificate, cost=other).evidence is Evidence.ASSUMED
    assert replace(certificate, bounds={}).evidence is Evidence.ASSUMED
    other = replace(certificate, observer=qpmhe.Luenberger([[0.9]]))
    assert other.evidence is Evidence.ASSUMED
    restored = pickle.loads(pickle.dumps(certificate))
    assert restored.evidence is Evidence.PROVED


def test_assumed_constants_keep_to_their_region():
    system, observer = cubic(), qpmhe.Luenberger([[0.1]])
    stability = ObserverStability.assumed(
        rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1, region=box(0.5)
    )
    detected = Detectability.assumed(eta=0.9, c_p=1.0, c_w=1.0, c_v=1.0)
    certificate = certify(
        system, observer, COST, horizon=2, region=box(0.5), detectability=detected,
        stability=stability,
    )
    assert certificate.evidence is Evidence.ASSUMED
    with pytest.raises(MismatchError, match="does not hold on the whole region"):
        certify(
            system, observer, COST, horizon=2, region=box(0.6), detectability=detected,
            stability=stability,
        )
    with pytest.raises(SetError, match="region is"):
        Detectability.assumed(eta=0.9, c_p=1.0, c_w=1.0, c_v=1.0, region=3)


def test_no_bound_is_violated_for_want_of_a_comparison(parts):
    """The constants for |x| <= 0.3 do not hold for |x| <= 0.99, where |3 x^2| is up to 2.9."""
    system, observer, detected, observed = parts
    x = [np.array([0.98])]
    for _ in range(4):
        x.append(x[-1] ** 3)
    honest = certify(
        system, observer, COST, horizon=2, region=box(0.3), detectability=detected,
        stability=observed,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, COST, horizon=2, initial_state=[0.9], max_qps=0
    )
    run, summary = monitored_run(honest, mhe, np.array(x[:4]))
    assert summary.applied == 0
    zeros = np.zeros((4, 1))
    bound = honest.bound(run, zeros, zeros, initial_error=[0.08], kind="weighted", source=mhe)
    assert (np.abs(np.array(x) - run.states)[:, 0] > bound).any()


def region(states, n=2):
    return bounded_region(qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=n, p=n), states)


def test_containment_of_boxes_and_polytopes():
    square, small = qpmhe.Box([-1.0, -1.0], [1.0, 1.0]), qpmhe.Box([-0.4, -0.4], [0.4, 0.4])
    diamond = qpmhe.Polytope(
        [[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0, 1.0, 1.0]
    )
    wide = qpmhe.Box([-2.0, -2.0], [2.0, 2.0])
    within = [
        (small, square), (square, square), (diamond, wide & diamond), (diamond, diamond),
        (small, diamond), (diamond & small, diamond), (diamond, wide),
    ]
    for inner, outer in within:
        assert beyond(region(inner), region(outer)) == "", (inner, outer)
    for inner, outer in ((square, small), (square, diamond), (diamond, small), (diamond, square)):
        told = beyond(region(inner), region(outer))
        # The diamond touches the square's sides, which rounding does not let be shown.
        assert told, (inner, outer)
    assert "1 x[0] + 1 x[1] <= 1 " in beyond(region(square), region(diamond))


def test_containment_is_right_at_random():
    rng = np.random.default_rng(3)
    shown = 0
    for _ in range(40):
        inner, outer = (
            qpmhe.Box([-side] * 3, [side] * 3)
            & qpmhe.Polytope(rng.standard_normal((4, 3)), 0.5 + rng.random(4))
            for side in (0.3, 3.0)
        )
        one, other = region(inner, 3), region(outer, 3)
        points = one.sample(200, rng)[:, :3]
        if beyond(one, other) == "":
            shown += 1
            assert other.contains(points).all()
    assert shown >= 1
