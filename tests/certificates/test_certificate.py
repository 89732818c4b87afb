"""The certificate as a whole: what it is made of, what it bounds, and what it says."""

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    CertificateError,
    DecayingSums,
    Detectability,
    Evidence,
    MismatchError,
    NotCertifiedError,
    ObserverStability,
    Sizes,
    TheoremConstants,
    certify,
    certify_detectability,
    certify_observer,
    design,
)
from qpmhe.certificates.audit import about_corrections, about_cost, about_slope
from qpmhe.certificates.deadline import Deadline
from qpmhe.certificates.regions import beyond, bounded_region
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError

from .helpers import GAIN, QUESTIONS, REACTOR, box, linear, scalar, unit_box, unit_cost

FOREVER = Deadline(math.inf)


@pytest.fixture(scope="module")
def certificate():
    """The paper's example, and its certificate at rates known to be feasible."""
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    region = qpmhe.Box([0.1, -1.0], [9.0, 9.0])
    return certify(
        system, observer, cost, horizon=(1, 5, 10), region=region,
        sizes=Sizes(0.3, 0.6),
        detectability=certify_detectability(system, region, eta=0.9, weights=(0.1, 0.2)),
        stability=certify_observer(system, observer, region, rho=0.95),
    )


def test_the_reactors_constants_are_the_theorems(certificate):
    assert certificate.evidence is Evidence.PROVED
    detected, observed = certificate.detectability, certificate.stability
    for N in (1, 5, 10):
        again = TheoremConstants(
            DecayingSums(0.9, detected.c_p, detected.c_w, detected.c_v),
            DecayingSums(0.95, observed.C_p, observed.C_w, np.sqrt(0.5)),  # 1 / L_h
            about_cost(certificate.cost)[0], kappa=np.sqrt(0.005), lipschitz=np.sqrt(2.0),
            horizon=N,
        )
        assert pytest.approx(again.C, rel=1e-9) == certificate.of(N).C
    assert certificate.diameter < certificate.of(1).result.limit(0.3, 0.6)


def test_sizes_that_are_not_stated_come_from_the_cost():
    found = certify(
        linear([[0.9, 0.2], [-0.1, 0.7]], [[1.0, 0.0]], states=unit_box(2)),
        qpmhe.Luenberger([[0.4], [0.1]]), qpmhe.QuadraticCost(
            prior=np.eye(2), disturbance=np.diag([4.0, 9.0]), noise=3.0
        ), horizon=4,
    )
    assert found.evidence is Evidence.PROVED
    np.testing.assert_allclose(found.sizes.disturbance.upper, [1.5, 1.0])
    np.testing.assert_allclose(found.sizes.noise.upper, np.sqrt(3.0))
    assert "three standard deviations of the cost's inverse weights" in str(found.sizes)
    assert found.of() is found.of(4)


def test_assumed_constants_give_the_papers_bound_and_say_so():
    power = qpmhe.Power(1.0, 1.5)
    certificate = certify(
        scalar(lambda x: 0.8 * x, states=unit_box(1)),
        qpmhe.OutputInjection(lambda z, v: 0.3 * v),
        qpmhe.RobustCost(prior=power, disturbance=power, noise=power), horizon=3,
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.1),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    assert certificate.evidence is Evidence.ASSUMED
    assert certificate.of().cost.exponent == 1.5
    with pytest.raises(OptionError, match="eta is 1"):
        Detectability.assumed(eta=1.0, c_p=1.0, c_w=1.0, c_v=1.0)
    with pytest.raises(OptionError, match="no bound of the observer: its constants were stated"):
        certificate.bound(None, initial_error=1.0)


def test_json_holds_everything(certificate):
    content = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert content["evidence"] == content["detectability"]["evidence"] == "proved"
    for N, each in zip((1, 5, 10), content["paper"], strict=True):
        paper = certificate.of(N)
        assert (each["horizon"], each["C"], each["lam"]) == (N, list(paper.C), paper.lam)
        assert each["limit"] == pytest.approx(paper.result.limit(*certificate.sizes.largest))
        assert each["vacuous"] is True
    assert [each["name"] for each in content["assumptions"]] == [
        "output Lipschitz", "no correction without error", "correction bound", "cost bounds"
    ]
    far = certify(  # constants beyond the numbers
        certificate.system, certificate.observer, certificate.cost, horizon=80,
        region=certificate.region,
        detectability=Detectability.assumed(eta=1e-5, c_p=1.0, c_w=1.0, c_v=1.0),
        stability=ObserverStability.assumed(rho=1e-5, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1),
    )
    assert math.isinf(far.of().C[0])
    content = json.loads(json.dumps(far.to_dict(), allow_nan=False))
    assert (content["paper"][0]["C"][0], content["paper"][0]["vacuous"]) == (None, True)


# The theorem's assumptions


def test_the_reactor_meets_the_assumptions():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    output = about_slope(system, bounded_region(system, REACTOR), "h", FOREVER)
    constants, kappa = about_cost(cost)[0], about_corrections(system, observer)[1]
    np.testing.assert_allclose([output.value, kappa.value], [np.sqrt(2), np.sqrt(2) * 0.05])
    assert output.value >= np.sqrt(2) * (1 - 1e-15)
    for name, exact in (("prior", 1.0), ("disturbance", 100.0), ("noise", 25.0)):
        low, high = getattr(constants, name)
        np.testing.assert_allclose([low, high], exact, rtol=1e-9)
        assert low <= exact * (1 + 1e-14)
        assert high >= exact * (1 - 1e-14)


def test_lipschitz_constants_of_known_maps():
    plane = qpmhe.System(
        lambda x: np.stack([0.5 * x[..., 0] ** 2, x[..., 1]], -1),
        lambda x: x[..., :1] + 3.0 * np.sin(x[..., :1]) + 0.1 * x[..., 1:] ** 2, n=2, p=1,
    )
    wide, line = box([-9.0] * 2, [9.0] * 2), box(-1.0, 2.0)
    for system, region, name, exact in (
        (plane, wide, "f", 9.0), (plane, wide, "h", np.hypot(4.0, 1.8)),
        (scalar(h=np.sin), line, "h", 1.0), (scalar(h=np.abs), line, "h", 1.0),
        (scalar(h=lambda x: np.exp(0.5 * x)), line, "h", 0.5 * np.e),
    ):
        found = about_slope(system, bounded_region(system, region), name, FOREVER)
        assert found.evidence is Evidence.PROVED
        assert exact * (1 - 1e-12) <= found.value <= exact * 1.002


HUBER = qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber(1.0))
DISCOUNTED = qpmhe.QuadraticCost(
    prior=np.eye(2), disturbance=np.eye(2), noise=1.0, discount=0.9
)
KALMAN = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)


@pytest.mark.parametrize(("cost", "words"), [(DISCOUNTED, "discount"), (HUBER, "exponent")])
def test_a_cost_without_constants_leaves_the_observers_bound(certificate, cost, words):
    found = certify(
        certificate.system, certificate.observer, cost, horizon=5, region=certificate.region,
        detectability=certificate.detectability, stability=certificate.stability,
    )
    assert found.holds
    assert not found.constants
    assert list(found.errors) == ["the theorem"]
    assert words in str(found.errors["the theorem"])
    assert found.headline.startswith("|x1 - z1| <= ")
    assert "Not certified: the theorem: the cost has no constants" in str(found)
    with pytest.raises(OptionError, match=rf"could not be certified.*{words}"):
        found.of()


# What is refused

def test_what_cannot_be_certified_is_named(certificate):
    parts = {name: getattr(certificate, name) for name in ("system", "observer", "cost", "region")}
    parts |= {"horizon": 5, "detectability": certificate.detectability}
    for arguments, error, words in (
        *(({"horizon": given}, OptionError, words) for given, words in (
            (0, "horizon"), ((), "horizon"), ("5", "horizon is '5'"), ([1, 2.5], "horizon is 2.5"),
        )),
        ({"region": None}, SetError, "region"),
        ({"region": qpmhe.Box([0.1, -np.inf], [9.0, np.inf])}, SetError, "unbounded"),
        ({"region": ([-1], [1])}, SetError, "region is"),
        ({"sizes": (0.1, 0.1)}, OptionError, r"sizes is \(0.1, 0.1\); expected Sizes\("),
        ({"cost": None}, InvalidInputError, "cost is None"),
        ({"cost": unit_cost()}, ShapeError, "for 1 states and 1 outputs; expected 2 and 1"),
        ({"observer": KALMAN}, CertificateError, "constant gain"),
        ({"observer": qpmhe.Luenberger([[-0.5], [0.5]])}, NotCertifiedError, "gain"),
        ({"observer": None}, InvalidInputError, "observer is None"),
        ({"system": linear(np.diag([0.5, 1.1]), [[1.0, 0.0]]), "region": unit_box(2),
          "observer": qpmhe.Luenberger([[0.2], [0.0]]), "detectability": None},
         NotCertifiedError, r"eigenvalue 1\.1.*not appear in the output"),
    ):
        given = parts | arguments
        with pytest.raises(error, match=words):
            certify(given.pop("system"), given.pop("observer"), given.pop("cost"), **given)
    for question in (*QUESTIONS.values(), design):
        with pytest.raises(ModelError, match="system is None"):
            question(None, unit_box(1))
    for horizon in (7, None):
        with pytest.raises(OptionError, match=r"expected one of \[1, 5, 10\]"):
            certificate.of(horizon)


# What was certified for one system, gain and region is not used for another

COST = unit_cost()


def cubic():
    return scalar(lambda x: x**3)


@pytest.fixture(scope="module")
def parts():
    """x^3 with its detectability and the stability of the gain 0.1 on [-0.3, 0.3]."""
    system = cubic()
    return system, {
        "detectability": certify_detectability(system, box(-0.3, 0.3), eta=0.5),
        "stability": certify_observer(system, GAIN, box(-0.3, 0.3), rho=0.6),
    }


def test_parts_serve_on_the_region_and_on_a_smaller_one_alone(parts):
    system, given = parts
    for side in (0.3, 0.2):
        certificate = certify(system, GAIN, COST, horizon=2, region=box(-side, side), **given)
        assert certificate.evidence is Evidence.PROVED
        assert certificate.diameter == pytest.approx(2 * side)
    detected, stability = given.values()
    for target, observer, side, used, words in (
        (system, GAIN, 0.99, stability, r"stability.*x\[0\] <= 0.3 .*0.99.*Certify it"),
        (system, GAIN, 0.99, detected, "detectability.*Certify it"),
        (cubic(), GAIN, 0.3, stability, r"another System object.*assumed\("),
        (cubic(), GAIN, 0.3, detected, r"another System object.*assumed\("),
        (system, qpmhe.Luenberger([[0.2]]), 0.3, stability, r"gain \[\[0.1\]\].*0.2"),
        (system, qpmhe.OutputInjection(lambda z, v: 0.1 * v), 0.3, stability, "is not constant"),
    ):
        name = "detectability" if used is detected else "stability"
        with pytest.raises(MismatchError, match=words):
            certify(target, observer, COST, horizon=2, region=box(-side, side), **{name: used})


def test_inputs_belong_to_the_region():
    system = qpmhe.System(lambda x, u: 0.5 * x + u * x, lambda x: x, n=1, p=1, m=1)
    region = bounded_region(system, box(-1.0, 1.0), box(-0.05, 0.05))
    given = {"stability": certify_observer(system, GAIN, region, rho=0.9)}
    wide = {"inputs": box(-5.0, 5.0)} | given
    with pytest.raises(MismatchError, match=r"u\[0\]"):
        certify(system, GAIN, COST, horizon=2, region=box(-1.0, 1.0), **wide)
    with pytest.raises(SetError, match="leave inputs out"):
        certify(system, GAIN, COST, horizon=2, region=region, **wide)
    assert certify(system, GAIN, COST, horizon=2, region=region, **given).holds


def test_what_is_stated_or_changed_by_hand_is_assumed(parts):
    system, given = parts
    detected, observed = given.values()
    certificate = certify(system, GAIN, COST, horizon=2, region=box(-0.3, 0.3), **given)
    for changed in (
        Detectability(0.5, 1.0, 1.0, 1.0, region=detected.region),
        replace(detected, c_w=0.5 * detected.c_w),
        replace(observed, P=2.0 * observed.P),
        replace(certificate, constants={}),
    ):
        assert changed.evidence is Evidence.ASSUMED
    for part in (detected, observed):
        with pytest.raises(ValueError, match="evidence"):
            replace(part, evidence=Evidence.PROVED)
        with pytest.raises(ValueError, match="read-only"):
            part.P[0, 0] = 0.0
        copied = pickle.loads(pickle.dumps(part))  # without the system
        assert (copied.evidence, copied.system) == (Evidence.PROVED, None)
        name = "detectability" if part is detected else "stability"
        with pytest.raises(MismatchError, match="another System object"):
            certify(system, GAIN, COST, horizon=2, region=box(-0.3, 0.3), **{name: copied})
    stated = {"stability": ObserverStability.assumed(
        rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1, region=box(-0.5, 0.5)
    )}
    with pytest.raises(MismatchError, match="does not hold on the whole region"):
        certify(cubic(), GAIN, COST, horizon=2, region=box(-0.6, 0.6), **stated)
    with pytest.raises(SetError, match="region is"):
        Detectability.assumed(eta=0.9, c_p=1.0, c_w=1.0, c_v=1.0, region=3)


def test_containment_of_boxes_and_polytopes():
    def region(states):
        return bounded_region(linear(0.5 * np.eye(2), np.eye(2)), states)

    square, small, wide = unit_box(2), box([-0.4] * 2, [0.4] * 2), box([-2.0] * 2, [2.0] * 2)
    diamond = qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], [1.0] * 4)
    for inner, outer in (
        (small, square), (square, square), (diamond, wide & diamond), (diamond, diamond),
        (small, diamond), (diamond & small, diamond), (diamond, wide),
    ):
        assert beyond(region(inner), region(outer)) == "", (inner, outer)
    # The diamond touches the square's sides, which rounding does not let be shown.
    for inner, outer in (
        (square, small), (square, diamond), (diamond, small), (diamond, square)
    ):
        assert beyond(region(inner), region(outer)), (inner, outer)
    assert "1 x[0] + 1 x[1] <= 1 " in beyond(region(square), region(diamond))


def test_figure_shows_error_and_bounds():
    axes = qpmhe.plots.error_and_bounds(
        np.arange(3.0), np.array([1.0, 0.0, 0.2]), {"one": np.full(3, 30.0)},
        diameter=3.0,
    )
    assert axes.get_yscale() == "log"
    labels = [text.get_text() for text in axes.get_figure().legends[0].get_texts()]
    assert labels == ["error", "one"]
    assert axes.get_ylim()[1] > 30.0
    with pytest.raises(ShapeError, match="error"):
        qpmhe.plots.error_and_bounds(np.arange(5.0), np.ones(4), {})
