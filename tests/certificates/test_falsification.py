"""Attempts to refute what is certified, and proof that they catch what is wrong."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import DecayingSums, certify, certify_detectability, certify_observer
from qpmhe.certificates.regions import bounded_region

from .attacks import RELATIVE, attack_detectability, attack_estimator, with_wrong_bound
from .helpers import linear

PAIRS = 300
# |0.8 - 0.15 * 2| = 0.5: all constants for the rate 0.5 are sharp.
SCALAR = linear(0.8, 2.0), qpmhe.Box([-1.0], [1.0])
# The error first grows by 3: c_p must be at least 3 / 0.5.
GROWING = linear([[0.0, 3.0], [0.0, 0.0]], [[0.0, 0.0]]), qpmhe.Box([-9.0, -1.0], [9.0, 1.0])


@pytest.mark.parametrize(("of", "claim", "ratio"), [
    (SCALAR, (0.5, 1.0, 2.0, 0.3), 1.0), (SCALAR, (0.5, 1.0, 1.6, 0.3), 1.25),
    (SCALAR, (0.5, 1.0, 2.0, 0.24), 1.25), (GROWING, (0.5, 6.0, 12.0, 0.0), 1.0),
    (GROWING, (0.5, 4.8, 12.0, 0.0), 1.25),
])
def test_known_constants_are_reached_and_a_fifth_less_is_caught(of, claim, ratio):
    found = attack_detectability(of[0], bounded_region(*of), DecayingSums(*claim), trials=PAIRS)
    assert found == pytest.approx(ratio, rel=1e-2)
    assert found <= ratio * (1.0 + RELATIVE)


def certificate_of(name):
    """Of a model within its region, so that the QPs have inequalities."""
    if name == "linear":
        region, rates = qpmhe.Box([-3.0, -3.0], [3.0, 3.0]), (0.85, 0.85)
        system = linear([[0.9, 0.2], [-0.1, 0.7]], [[1.0, 0.0]], states=region)
        observer = qpmhe.Luenberger([[0.4], [0.1]])
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=4.0 * np.eye(2), noise=3.0)
    else:
        system, observer, cost, _ = qpmhe.models.catalogue()[name]()
        region, rates = qpmhe.Box([-4.4, -15.6], [4.8, 15.1]), (0.9, 0.955)
    if name == "batch_reactor":
        region, rates = qpmhe.Box([0.1, -1.0], [9.0, 9.0]), (0.9, 0.95)
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
        wrong = with_wrong_bound(certificate)
        paper, known, _ = attack_estimator(wrong, trials=20, backends=["auto"], seed=2)
        assert paper < 1.0 < known
