"""The audit of assumptions: known constants, and counterexamples with their numbers."""

import json

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.audit import audit
from qpmhe.certificates.evidence import Evidence
from qpmhe.errors import InvalidInputError

from .helpers import REACTOR, box, linear, unit_cost

HALF, LIPSCHITZ, KAPPA = linear(0.5, 1.0), "output Lipschitz", "correction bound"
UNMOVED = "no correction without error"


def bounded(slope, **sets):
    return qpmhe.System(lambda x: slope * x, lambda x: x, n=1, p=1, **sets)


def test_reactor_passes():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    report = audit(system, observer, cost, REACTOR)
    assert report.violated == ()
    assert all(finding.evidence is Evidence.PROVED for finding in report.findings)
    found = [report.lipschitz, report[KAPPA].value]
    np.testing.assert_allclose(found, [np.sqrt(2), np.sqrt(2) * 0.05])
    assert report.lipschitz >= np.sqrt(2) * (1 - 1e-15)
    for name, exact in (("prior", 1.0), ("disturbance", 100.0), ("noise", 25.0)):
        low, high = getattr(report.constants, name)
        np.testing.assert_allclose([low, high], exact, rtol=1e-9)
        assert low <= exact * (1 + 1e-14)
        assert high >= exact * (1 - 1e-14)
    assert report.constants.exponent == 2.0
    assert json.loads(json.dumps(report.to_dict()))[0]["evidence"] == "proved"
    with pytest.raises(InvalidInputError, match="'output Lipschitz'"):
        report["L_h"]


@pytest.mark.parametrize(
    ("h", "exact"),
    [(lambda x: np.sin(x), 1.0), (lambda x: x * x, 4.0), (lambda x: np.exp(0.5 * x), 0.5 * np.e)],
)
def test_lipschitz_constant_of_known_maps(h, exact):
    system = qpmhe.System(lambda x: 0.5 * x, h, n=1, p=1)
    report = audit(system, qpmhe.Luenberger([0.1]), unit_cost(), box(-1.0, 2.0))
    assert report[LIPSCHITZ].evidence is Evidence.PROVED
    assert exact * (1 - 1e-12) <= report.lipschitz <= exact * 1.002


FINDINGS = {  # system, observer, cost, then the finding with what it holds, rests on and says
    "L(z, 0) is not 0": (
        HALF, qpmhe.OutputInjection(lambda z, v: 0.1 * v + np.where(z > 0.5, 0.01, 0.0)), None,
        UNMOVED, False, Evidence.PROVED, "L(z, 0) = [0.01] at z = ["),
    "L(z, v) of a function": (
        HALF, qpmhe.OutputInjection(lambda z, v: 0.3 * np.tanh(v)), None,
        KAPPA, True, Evidence.SAMPLED, "kappa = 0.3,"),
    "L(z, v) unbounded": (
        HALF, qpmhe.OutputInjection(lambda z, v: np.where(v > 0.0, np.inf, 0.0)), None,
        KAPPA, False, Evidence.SAMPLED, "kappa is infinite"),
    "gain that varies": (
        HALF, qpmhe.ExtendedKalman(prior=1.0, disturbance=0.01, noise=0.04), None,
        KAPPA, None, None, "kappa"),
    "Huber": (
        HALF, None, qpmhe.RobustCost(prior=1.0, disturbance=1.0, noise=qpmhe.Huber(1.0)),
        "cost bounds", False, Evidence.PROVED, "exponent"),
    "discount": (
        HALF, None, qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0, discount=0.9),
        "cost bounds", False, Evidence.PROVED, "discount"),
    "W": (
        bounded(0.5, disturbances=box(-0.1, 0.1)), None, None,
        "candidate in the sets", None, None, "monitor"),
}


@pytest.mark.parametrize("case", FINDINGS)
def test_findings_say_whether_they_hold_and_why(case):
    system, observer, cost, name, holds, evidence, words = FINDINGS[case]
    report = audit(
        system, observer or qpmhe.Luenberger([0.1]), cost or unit_cost(), box(-1.0, 1.0)
    )
    finding = report[name]
    assert (finding.holds, finding.evidence) == (holds, evidence)
    assert words in finding.text
    assert (finding in report.violated) == (holds is False)
    assert (report.constants is None) == (name == "cost bounds")


def test_the_slope_of_a_kinked_output_is_proved():
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: np.abs(x), n=1, p=1)
    report = audit(system, qpmhe.Luenberger([0.1]), unit_cost(), box(-1.0, 1.0))
    finding = report["output Lipschitz"]
    assert finding.evidence is Evidence.PROVED
    np.testing.assert_allclose(finding.value, 1.0)
