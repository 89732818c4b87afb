"""The certificate as a whole: what it is made of, what it bounds, and what it says."""

import json
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
from qpmhe.costs import CostConstants
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError

from .attacks import RELATIVE, attack_estimator
from .helpers import GAIN, QUESTIONS, box, linear, scalar, unit_box, unit_cost


@pytest.fixture(scope="module")
def certificate():
    """The paper's example, and its certificate at rates known to be feasible."""
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    region = box([0.1, -1.0], [9.0, 9.0])
    return certify(
        system, observer, cost, horizon=(1, 5, 10), region=region, sizes=Sizes(0.3, 0.6),
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
            CostConstants(2.0, (1.0, 1.0), (100.0, 100.0), (25.0, 25.0)), kappa=np.sqrt(0.005),
            lipschitz=np.sqrt(2.0), horizon=N,
        )
        assert pytest.approx(again.C, rel=1e-8) == certificate.of(N).C
    output, _, kappa, _ = certificate.assumptions
    np.testing.assert_allclose([output.value, kappa.value], [np.sqrt(2), np.sqrt(2) * 0.05])
    assert output.value >= np.sqrt(2) * (1 - 1e-15)
    for name, exact in (("prior", 1.0), ("disturbance", 100.0), ("noise", 25.0)):
        low, high = getattr(certificate.of(1).cost, name)  # rounded outward
        assert exact * (1 - 1e-9) <= low <= exact <= high <= exact * (1 + 1e-9)


def test_json_holds_everything(certificate):
    content = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert content["evidence"] == content["detectability"]["evidence"] == "proved"
    for N, each in zip((1, 5, 10), content["paper"], strict=True):
        paper = certificate.of(N)
        assert (each["horizon"], each["C"], each["lam"]) == (N, list(paper.C), paper.lam)
        assert each["limit"] == pytest.approx(paper.result.limit(*certificate.sizes.largest))
        assert (each["vacuous"], each["limit"] > certificate.diameter) == (True, True)
    assert [each["name"] for each in content["assumptions"]] == [
        "output Lipschitz", "no correction without error", "correction bound", "cost bounds"
    ]
    far = certify(  # constants beyond the numbers
        certificate.system, certificate.observer, certificate.cost, horizon=80,
        region=certificate.region,
        detectability=Detectability.assumed(eta=1e-5, c_p=1.0, c_w=1.0, c_v=1.0),
        stability=ObserverStability.assumed(rho=1e-5, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1),
    )
    content = json.loads(json.dumps(far.to_dict(), allow_nan=False))
    assert (content["paper"][0]["C"][0], content["paper"][0]["vacuous"]) == (None, True)


def test_lipschitz_constants_of_known_maps():
    stated = ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=0.1)
    plane = qpmhe.System(
        lambda x: 0.5 * x,
        lambda x: x[..., :1] + 3.0 * np.sin(x[..., :1]) + 0.1 * x[..., 1:] ** 2, n=2, p=1,
    )
    for system, region, exact in (
        (plane, box([-9.0] * 2, [9.0] * 2), np.hypot(4.0, 1.8)),
        *((scalar(h=h), box(-1.0, 2.0), exact) for h, exact in (
            (np.sin, 1.0), (np.abs, 1.0), (lambda x: np.exp(0.5 * x), 0.5 * np.e))),
    ):
        found = certify(
            system, qpmhe.Luenberger(np.zeros((system.n, 1))), unit_cost(system.n), horizon=2,
            region=region, stability=stated,
            detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.1),
        ).assumptions[0]
        assert found.evidence is Evidence.PROVED
        assert exact * (1 - 1e-12) <= found.value <= exact * 1.002


def certificate_of(name):
    """Of a model within its region, so that the QPs have inequalities."""
    if name == "linear":
        region, rates = box([-3.0, -3.0], [3.0, 3.0]), (0.85, 0.85)
        system = linear([[0.9, 0.2], [-0.1, 0.7]], [[1.0, 0.0]], states=region)
        observer = qpmhe.Luenberger([[0.4], [0.1]])
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=4.0 * np.eye(2), noise=3.0)
    else:
        system, observer, cost, _ = qpmhe.models.catalogue()[name]()
        region, rates = box([-4.4, -15.6], [4.8, 15.1]), (0.9, 0.955)
    if name == "batch_reactor":
        region, rates = box([0.1, -1.0], [9.0, 9.0]), (0.9, 0.95)
        system = qpmhe.System.from_ode(
            lambda x: (0.16 * x[..., :1] ** 2 - 0.64 * x[..., 1:]) * np.array([-2.0, 1.0]),
            lambda x: x[..., :1] + x[..., 1:], dt=0.1, method="euler", n=2, p=1, states=region,
        )
    return certify(
        system, observer, cost, horizon=4, region=region,
        detectability=certify_detectability(system, region, eta=rates[0]),
        stability=certify_observer(system, observer, region, rho=rates[1]),
    )


@pytest.mark.parametrize(
    "name", ["linear", *(pytest.param(name, marks=pytest.mark.slow)
                         for name in ("batch_reactor", "pendulum"))]
)
def test_no_closed_run_exceeds_a_bound(pytestconfig, name):
    certificate, runs = certificate_of(name), 60 if pytestconfig.option.all else 20
    paper, known, compared = attack_estimator(certificate, trials=runs, seed=1)
    assert compared > 4 * runs
    assert max(0.1, paper) < known <= 1.0 + RELATIVE  # otherwise it would be of little use
    if name == "linear":
        bound = certificate.observer_bound  # which is to claim too much
        wrong = replace(bound.stability, P=100.0 * bound.metric, rho=0.3)
        object.__setattr__(certificate, "observer_bound", replace(bound, stability=wrong))
        paper, known, _ = attack_estimator(certificate, trials=20, seed=2)
        assert paper < 1.0 < known


# What is stated, and what is refused


def test_sizes_that_are_not_stated_come_from_the_cost():
    found = certify(
        linear([[0.9, 0.2], [-0.1, 0.7]], [[1.0, 0.0]], states=unit_box(2)),
        qpmhe.Luenberger([[0.4], [0.1]]), qpmhe.QuadraticCost(
            prior=np.eye(2), disturbance=np.diag([4.0, 9.0]), noise=3.0
        ), horizon=4,
    )
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
    with pytest.raises(OptionError, match="no bound of the observer: its constants were stated"):
        certificate.bound(None, initial_error=1.0)


HUBER = qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber(1.0))
DISCOUNTED = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0, discount=0.9)
FREE = qpmhe.QuadraticCost(prior=qpmhe.ObserverPrior(), disturbance=np.eye(2), noise=1.0)


def test_a_cost_without_constants_leaves_the_observers_bound(certificate):
    parts = {name: getattr(certificate, name) for name in ("region", "detectability", "stability")}
    for cost, words in ((DISCOUNTED, "discount"), (HUBER, "exponent"), (FREE, "minimum, maximum")):
        found = certify(certificate.system, certificate.observer, cost, horizon=5, **parts)
        assert (found.holds, list(found.errors)) == (True, ["the theorem"])
        assert words in str(found.errors["the theorem"])
        assert found.headline.startswith("|x1 - z1| <= ")
        assert "Not certified: the theorem: the cost has no constants" in str(found)
        with pytest.raises(OptionError, match=rf"could not be certified.*{words}"):
            found.of()


def test_what_cannot_be_certified_is_named(certificate):
    parts = {name: getattr(certificate, name) for name in ("system", "observer", "cost", "region")}
    parts |= {"horizon": 5, "detectability": certificate.detectability}
    for arguments, error, words in (
        *(({"horizon": given}, OptionError, words) for given, words in (
            (0, "horizon"), ((), "horizon"), ("5", "horizon is '5'"), ([1, 2.5], "horizon is 2.5"),
        )),
        ({"region": None}, SetError, "region"),
        ({"region": ([-1], [1])}, SetError, "region is"),
        ({"sizes": (0.1, 0.1)}, OptionError, r"sizes is \(0.1, 0.1\); expected Sizes\("),
        ({"cost": None}, InvalidInputError, "cost is None"),
        ({"cost": unit_cost()}, ShapeError, "for 1 states and 1 outputs; expected 2 and 1"),
        ({"observer": qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)},
         CertificateError, "constant gain"),
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
    with pytest.raises(OptionError, match=r"expected one of \[1, 5, 10\]"):
        certificate.of(7)
    with pytest.raises(OptionError, match="eta is 1"):
        Detectability.assumed(eta=1.0, c_p=1.0, c_w=1.0, c_v=1.0)


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
    system = qpmhe.System(lambda x, u: 0.5 * x + u * x, lambda x, u: x, n=1, p=1, m=1)
    known = certify_observer(system, GAIN, box(-1.0, 1.0), inputs=box(-0.05, 0.05), rho=0.9)
    assert certify(system, GAIN, COST, horizon=2, region=known.region, stability=known).holds
    for region, error, words in (
        (box(-1.0, 1.0), MismatchError, r"u\[0\]"), (known.region, SetError, "leave inputs out"),
    ):
        with pytest.raises(error, match=words):
            certify(
                system, GAIN, COST, horizon=2, region=region, inputs=box(-5.0, 5.0), stability=known
            )


def test_what_is_stated_or_changed_by_hand_is_assumed(parts):
    system, given = parts
    region, (detected, observed) = box(-0.3, 0.3), given.values()
    certificate = certify(system, GAIN, COST, horizon=2, region=region, **given)
    for changed in (
        Detectability(0.5, 1.0, 1.0, 1.0, region=detected.region),
        replace(detected, c_w=0.5 * detected.c_w), replace(observed, P=2.0 * observed.P),
        replace(certificate, constants={}),
    ):
        assert changed.evidence is Evidence.ASSUMED
    for name, part in given.items():
        with pytest.raises(ValueError, match="evidence"):
            replace(part, evidence=Evidence.PROVED)
        with pytest.raises(ValueError, match="read-only"):
            part.P[0, 0] = 0.0
        copied = pickle.loads(pickle.dumps(part))  # without the system
        assert (copied.evidence, copied.system) == (Evidence.PROVED, None)
        with pytest.raises(MismatchError, match="another System object"):
            certify(system, GAIN, COST, horizon=2, region=region, **{name: copied})
    stated = {"rho": 0.9, "C_p": 1.0, "C_w": 1.0, "C_v": 1.0, "kappa": 0.1}
    with pytest.raises(MismatchError, match="does not hold on the whole region"):
        certify(cubic(), GAIN, COST, horizon=2, region=box(-0.6, 0.6),
                stability=ObserverStability.assumed(**stated, region=box(-0.5, 0.5)))
    with pytest.raises(SetError, match="region is"):
        ObserverStability.assumed(**stated, region=3)


def test_figure_shows_error_and_bounds():
    axes = qpmhe.plots.error_and_bounds(
        np.arange(3.0), np.array([1.0, 0.0, 0.2]), {"one": np.full(3, 30.0)}, diameter=3.0
    )
    assert axes.get_yscale() == "log"
    labels = [text.get_text() for text in axes.get_figure().legends[0].get_texts()]
    assert labels == ["error", "one"]
    assert axes.get_ylim()[1] > 30.0
    with pytest.raises(ShapeError, match="error"):
        qpmhe.plots.error_and_bounds(np.arange(5.0), np.ones(4), {})
