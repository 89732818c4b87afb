"""What was certified for one system, gain and region is not used for another."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer
from qpmhe.certificates.evidence import Evidence, MismatchError
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.certificates.regions import beyond, bounded_region
from qpmhe.errors import SetError

from .helpers import box, scalar, unit_box, unit_cost

COST, OBSERVER = unit_cost(), qpmhe.Luenberger([[0.1]])
DETECTED = {"eta": 0.9, "c_p": 1.0, "c_w": 1.0, "c_v": 1.0}


def cube(x):
    return x**3


def output(x):
    return 1.0 * x


def within(side):
    return box(-side, side)


def cubic():
    return scalar(cube, output)


@pytest.fixture(scope="module")
def parts():
    """x^3 with its detectability and the stability of the gain 0.1 on [-0.3, 0.3]."""
    system = cubic()
    return system, {
        "detectability": certify_detectability(system, within(0.3), eta=0.5),
        "stability": certify_observer(system, OBSERVER, within(0.3), rho=0.6),
    }


def test_parts_of_the_same_serve_on_the_region_and_on_a_smaller_one(parts):
    system, given = parts
    for side in (0.3, 0.2):
        certificate = certify(system, OBSERVER, COST, horizon=2, region=within(side), **given)
        assert certificate.evidence is Evidence.PROVED
        assert certificate.diameter == pytest.approx(2 * side)


@pytest.mark.parametrize("which", ["detectability", "stability"])
def test_what_was_certified_of_something_else_is_refused(parts, which):
    system, given = parts
    part = given[which]
    copied = pickle.loads(pickle.dumps(part))
    assert copied.evidence is Evidence.PROVED
    for target, observer, side, used, words in (
        (system, OBSERVER, 0.99, part, rf"{which}.*x\[0\] <= 0.3 .*0.99.*Certify it"),
        (cubic(), OBSERVER, 0.3, part, r"another System object.*assumed\("),
        (system, OBSERVER, 0.3, copied, r"another System object.*assumed\("),
        (system, qpmhe.Luenberger([[0.2]]), 0.3, given["stability"], r"gain \[\[0.1\]\].*0.2"),
        (system, qpmhe.OutputInjection(lambda z, v: 0.1 * v), 0.3, given["stability"],
         "is not constant"),
    ):
        name = "stability" if used is given["stability"] else which
        with pytest.raises(MismatchError, match=words):
            certify(target, observer, COST, horizon=2, region=within(side), **{name: used})


def test_inputs_belong_to_the_region():
    system = qpmhe.System(lambda x, u: 0.5 * x + u * x, lambda x: x, n=1, p=1, m=1)
    region = bounded_region(system, within(1.0), within(0.05))
    given = {
        "detectability": certify_detectability(system, region, eta=0.9),
        "stability": certify_observer(system, OBSERVER, region, rho=0.9),
    }
    with pytest.raises(MismatchError, match=r"u\[0\]"):
        certify(
            system, OBSERVER, COST, horizon=2, region=within(1.0), inputs=within(5.0), **given
        )
    with pytest.raises(SetError, match="leave inputs out"):
        certify(system, OBSERVER, COST, horizon=2, region=region, inputs=within(5.0), **given)
    assert certify(system, OBSERVER, COST, horizon=2, region=region, **given).gain is not None


def test_what_is_stated_or_changed_by_hand_is_assumed(parts):
    system, given = parts
    detected, observed = given.values()
    certificate = certify(system, OBSERVER, COST, horizon=2, region=within(0.3), **given)
    for changed in (
        Detectability(0.5, 1.0, 1.0, 1.0, region=detected.region),
        replace(detected, c_w=0.5 * detected.c_w),
        replace(detected, region=bounded_region(cubic(), within(9.0))),
        replace(observed, P=2.0 * observed.P),
        replace(certificate, cost=qpmhe.QuadraticCost(prior=2.0, disturbance=1.0, noise=1.0)),
        replace(certificate, bounds={}),
        replace(certificate, observer=qpmhe.Luenberger([[0.9]])),
    ):
        assert changed.evidence is Evidence.ASSUMED
    for part in (detected, observed):
        with pytest.raises(ValueError, match="evidence"):
            replace(part, evidence=Evidence.PROVED)
        with pytest.raises(ValueError, match="read-only"):
            part.P[0, 0] = 0.0
    assert pickle.loads(pickle.dumps(certificate)).evidence is Evidence.PROVED


def test_assumed_constants_keep_to_their_region():
    system, given = cubic(), {
        "detectability": Detectability.assumed(**DETECTED),
        "stability": ObserverStability.assumed(
            rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1, region=within(0.5)
        ),
    }
    certificate = certify(system, OBSERVER, COST, horizon=2, region=within(0.5), **given)
    assert certificate.evidence is Evidence.ASSUMED
    with pytest.raises(MismatchError, match="does not hold on the whole region"):
        certify(system, OBSERVER, COST, horizon=2, region=within(0.6), **given)
    with pytest.raises(SetError, match="region is"):
        Detectability.assumed(**DETECTED, region=3)


def region(states):
    n = states.dimension
    return bounded_region(qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=n, p=n), states)


SQUARE, SMALL, WIDE = unit_box(2), box([-0.4] * 2, [0.4] * 2), box([-2.0] * 2, [2.0] * 2)
DIAMOND = qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], [1.0] * 4)


def test_containment_of_boxes_and_polytopes():
    for inner, outer in (
        (SMALL, SQUARE), (SQUARE, SQUARE), (DIAMOND, WIDE & DIAMOND), (DIAMOND, DIAMOND),
        (SMALL, DIAMOND), (DIAMOND & SMALL, DIAMOND), (DIAMOND, WIDE),
    ):
        assert beyond(region(inner), region(outer)) == "", (inner, outer)
    # The diamond touches the square's sides, which rounding does not let be shown.
    for inner, outer in (
        (SQUARE, SMALL), (SQUARE, DIAMOND), (DIAMOND, SMALL), (DIAMOND, SQUARE)
    ):
        assert beyond(region(inner), region(outer)), (inner, outer)
    assert "1 x[0] + 1 x[1] <= 1 " in beyond(region(SQUARE), region(DIAMOND))


def test_containment_is_right_at_random():
    rng, shown = np.random.default_rng(3), 0
    for _ in range(20):
        one, other = (
            region(box([-side] * 3, [side] * 3)
                   & qpmhe.Polytope(rng.standard_normal((4, 3)), 0.5 + rng.random(4)))
            for side in (0.3, 3.0)
        )
        if beyond(one, other) == "":
            shown += 1
            assert other.contains(one.sample(200, rng)[:, :3]).all()
    assert shown >= 1
