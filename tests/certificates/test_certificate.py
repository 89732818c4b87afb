"""The certificate as a whole: what it is made of, what it bounds, and what it says."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe import certificates
from qpmhe.certificates import Detectability, Evidence, ObserverStability, Sizes, certify
from qpmhe.costs import CostConstants
from qpmhe.errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError

from .helpers import GAIN, QUESTIONS, box, linear, scalar, unit_box, unit_cost


@pytest.fixture(scope="module")
def certificate():
    """The paper's example, and its certificate at rates known to be feasible."""
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    region = box([0.1, -1.0], [9.0, 9.0])
    detected = certificates.certify_detectability(system, region, eta=0.9, weights=(0.1, 0.2))
    return certify(
        system, observer, cost, horizon=(1, 5, 10), region=region, sizes=Sizes(0.3, 0.6),
        detectability=detected,
        stability=certificates.certify_observer(system, observer, region, rho=0.95),
    )


def test_the_reactors_constants_are_the_theorems(certificate):
    assert certificate.evidence is Evidence.PROVED
    detected, observed = certificate.detectability, certificate.stability
    for N in (1, 5, 10):
        again = certificates.TheoremConstants(
            certificates.DecayingSums(0.9, detected.c_p, detected.c_w, detected.c_v),
            certificates.DecayingSums(0.95, observed.C_p, observed.C_w, np.sqrt(0.5)),  # 1 / L_h
            CostConstants(2.0, (1.0, 1.0), (100.0, 100.0), (25.0, 25.0)), kappa=np.sqrt(0.005),
            lipschitz=np.sqrt(2.0), horizon=N,
        )
        assert pytest.approx(again.C, rel=1e-8) == certificate.of(N).C
    output, _, kappa, _ = certificate.assumptions
    np.testing.assert_allclose([output.value, kappa.value], [np.sqrt(2), np.sqrt(2) * 0.05])
    for name, exact in (("prior", 1.0), ("disturbance", 100.0), ("noise", 25.0)):
        low, high = getattr(certificate.of(1).cost, name)  # rounded outward
        assert exact * (1 - 1e-9) <= low <= exact <= high <= exact * (1 + 1e-9)


def test_assumed_constants_give_the_papers_bound_and_say_so():
    power = qpmhe.Power(1.0, 1.5)
    certificate = certify(
        scalar(states=unit_box(1)), qpmhe.OutputInjection(lambda z, v: 0.3 * v),
        qpmhe.RobustCost(prior=power, disturbance=power, noise=power), horizon=3,
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.1),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    assert (certificate.evidence, certificate.of().cost.exponent) == (Evidence.ASSUMED, 1.5)
    with pytest.raises(OptionError, match="no bound of the observer: its constants were stated"):
        certificate.bound(None, initial_error=1.0)


HUBER = qpmhe.RobustCost(prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber(1.0))
DISCOUNTED = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0, discount=0.9)
FREE = qpmhe.QuadraticCost(prior=qpmhe.ObserverPrior(), disturbance=np.eye(2), noise=1.0)


def test_a_cost_without_constants_leaves_the_observers_bound(certificate):
    parts = {name: getattr(certificate, name) for name in ("region", "detectability", "stability")}
    cases = (DISCOUNTED, "discount"), (HUBER, "exponent"), (FREE, "give a weight, prior=")
    for cost, words in cases:
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
        ({"horizon": [1, 2.5]}, OptionError, "horizon is 2.5"),
        ({"region": None}, SetError, "region"),
        ({"sizes": (0.1, 0.1)}, OptionError, r"sizes is \(0.1, 0.1\); expected Sizes\("),
        ({"cost": unit_cost()}, ShapeError, "for 1 states and 1 outputs; expected 2 and 1"),
        ({"observer": qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)},
         certificates.CertificateError, "constant gain"),
        ({"observer": qpmhe.Luenberger([[-0.5], [0.5]])}, certificates.NotCertifiedError, "gain"),
        ({"observer": None}, InvalidInputError, "observer is None"),
        ({"system": linear(np.diag([0.5, 1.1]), [[1.0, 0.0]]), "region": unit_box(2),
          "observer": qpmhe.Luenberger([[0.2], [0.0]]), "detectability": None},
         certificates.NotCertifiedError, r"eigenvalue 1\.1.*not appear in the output"),
    ):
        given = parts | arguments
        with pytest.raises(error, match=words):
            certify(given.pop("system"), given.pop("observer"), given.pop("cost"), **given)
    for question in (*QUESTIONS.values(), certificates.design):
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
        "detectability": certificates.certify_detectability(system, box(-0.3, 0.3), eta=0.5),
        "stability": certificates.certify_observer(system, GAIN, box(-0.3, 0.3), rho=0.6),
    }


def test_parts_serve_on_the_region_and_on_a_smaller_one_alone(parts):
    system, given = parts
    certificate = certify(system, GAIN, COST, horizon=2, region=box(-0.2, 0.2), **given)
    assert certificate.evidence is Evidence.PROVED
    assert certificate.diameter == pytest.approx(0.4)
    # The content counts, not the System object.
    assert certify(cubic(), GAIN, COST, horizon=2, region=box(-0.2, 0.2), **given).holds
    detected, stability = given.values()
    for target, observer, side, used, words in (
        (system, GAIN, 0.99, stability, r"stability.*x\[0\] <= 0.3 .*0.99.*Certify it"),
        (system, GAIN, 0.99, detected, "detectability.*Certify it"),
        (scalar(lambda x: x**3 + 1e-12 * x), GAIN, 0.3, stability,
         r"another system: f differs.*assumed\("),
        (system, qpmhe.Luenberger([[0.2]]), 0.3, stability, r"gain \[\[0.1\]\].*0.2"),
        (system, qpmhe.OutputInjection(lambda z, v: 0.1 * v), 0.3, stability, "is not constant"),
    ):
        name = "detectability" if used is detected else "stability"
        with pytest.raises(certificates.MismatchError, match=words):
            certify(target, observer, COST, horizon=2, region=box(-side, side), **{name: used})


def test_inputs_belong_to_the_region():
    system = qpmhe.System(lambda x, u: 0.5 * x + u * x, lambda x, u: x, n=1, p=1, m=1)
    inputs = box(-0.05, 0.05)
    known = certificates.certify_observer(system, GAIN, unit_box(1), inputs=inputs, rho=0.9)
    given = {"horizon": 2, "stability": known}
    assert certify(system, GAIN, COST, region=known.region, **given).holds
    with pytest.raises(certificates.MismatchError, match=r"u\[0\]"):
        certify(system, GAIN, COST, region=unit_box(1), inputs=box(-5.0, 5.0), **given)


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
    with pytest.raises(ValueError, match="evidence"):
        replace(detected, evidence=Evidence.PROVED)
    with pytest.raises(ValueError, match="read-only"):
        observed.P[0, 0] = 0.0
    copied = pickle.loads(pickle.dumps(detected))  # without the system
    assert (copied.evidence, copied.system) == (Evidence.PROVED, None)


@pytest.mark.parametrize("kappa", [10.0, 1e32])
def test_a_prior_by_the_observer_has_the_constants_of_its_bounds(certificate, kappa):
    system, region = certificate.system, certificate.region
    covariances = {"disturbance": 0.01 * np.eye(2), "noise": [[0.04]]}
    observer = qpmhe.SteadyStateKalman(
        system, [1.5, 3.0], prior=np.diag([4.0, 0.25]), **covariances
    )
    cost = qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(kappa), **covariances)
    found = certify(
        system, observer, cost, horizon=10, region=region, sizes=Sizes(0.3, 0.6),
        detectability=certificate.detectability, seconds=20,
    )
    assert (found.errors, found.evidence) == ({}, Evidence.PROVED)
    low, high = found.of().cost.prior
    assert (low, high) == pytest.approx((0.25 / kappa, 4.0 * kappa), rel=1e-9)
    assert low <= 0.25 / kappa
    assert high >= 4.0 * kappa
    # Every weight of a run is within them, and the constants are those of the theorem.
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=[0.1, 4.5], max_qps=2
    )
    for y in 4.0 + np.random.default_rng(0).standard_normal(30):
        mhe.update([y])
        values = np.linalg.eigvalsh(mhe._engine.solved().problem.prior.weight)
        assert low <= values[0] <= values[-1] <= high
    own = replace(
        found.of(), cost=CostConstants(
            2.0, (0.25 / kappa, 4.0 * kappa), found.of().cost.disturbance, found.of().cost.noise
        ),
    )
    assert pytest.approx(own.C, rel=1e-8) == found.of().C
    assert np.isfinite(own.C).all()
