"""The audit of assumptions: known constants, and counterexamples with their numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.audit import audit
from qpmhe.certificates.evidence import Evidence
from qpmhe.errors import InvalidInputError

from .test_detectability import REACTOR, linear, unit_box


def test_reactor_passes():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    report = audit(system, observer, cost, REACTOR)
    assert report.violated == ()
    assert all(finding.evidence is Evidence.PROVED for finding in report.findings)
    kappa = report["correction bound"].value
    np.testing.assert_allclose([report.lipschitz, kappa], [np.sqrt(2), np.sqrt(2) * 0.05])
    assert report.lipschitz >= np.sqrt(2) * (1 - 1e-15)
    for found, exact in (
        (report.constants.prior, 1.0), (report.constants.disturbance, 100.0),
        (report.constants.noise, 25.0),
    ):
        np.testing.assert_allclose(found, exact, rtol=1e-9)
        assert found[0] <= exact * (1 + 1e-14)
        assert found[1] >= exact * (1 - 1e-14)
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
    cost = qpmhe.QuadraticCost(prior=np.eye(1), disturbance=np.eye(1), noise=np.eye(1))
    report = audit(system, qpmhe.Luenberger([0.1]), cost, qpmhe.Box([-1.0], [2.0]))
    assert report["output Lipschitz"].evidence is Evidence.PROVED
    assert exact * (1 - 1e-12) <= report.lipschitz <= exact * 1.002


def unit_cost(n=1, p=1):
    return qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(p))


def test_the_slope_of_a_kinked_output_is_proved():
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: np.abs(x), n=1, p=1)
    report = audit(system, qpmhe.Luenberger([0.1]), unit_cost(), qpmhe.Box([-1.0], [1.0]))
    finding = report["output Lipschitz"]
    assert finding.evidence is Evidence.PROVED
    np.testing.assert_allclose(finding.value, 1.0)


def test_correction_without_error_has_a_counterexample():
    def biased(z, v):
        return 0.1 * v + np.where(z > 0.5, 0.01, 0.0)

    report = audit(
        linear(0.5, 1.0), qpmhe.OutputInjection(biased), unit_cost(), unit_box(1)
    )
    finding = report["no correction without error"]
    assert finding.holds is False
    assert finding.counterexample["z"][0] > 0.5
    assert finding.counterexample["L"].tolist() == [0.01]
    assert "0.01" in finding.text
    assert finding in report.violated


def test_kappa_of_a_nonlinear_correction_is_sampled():
    report = audit(
        linear(0.5, 1.0), qpmhe.OutputInjection(lambda z, v: 0.3 * np.tanh(v)), unit_cost(),
        unit_box(1),
    )
    finding = report["correction bound"]
    assert finding.evidence is Evidence.SAMPLED
    assert 0.29 < report["correction bound"].value <= 0.3
    assert report["no correction without error"].evidence is Evidence.SAMPLED


def test_a_gain_that_follows_from_measurements_has_no_bound():
    system, _, cost, _ = qpmhe.models.batch_reactor()
    eye = np.eye(2)
    observer = qpmhe.ExtendedKalman(prior=eye, disturbance=0.01 * eye, noise=0.04 * np.eye(1))
    finding = audit(system, observer, cost, REACTOR)["correction bound"]
    assert finding.holds is None
    assert "kappa" in finding.text


def test_costs_without_constants():
    robust = qpmhe.RobustCost(prior=np.eye(1), disturbance=np.eye(1), noise=qpmhe.Huber(np.eye(1)))
    discounted = qpmhe.QuadraticCost(
        prior=np.eye(1), disturbance=np.eye(1), noise=np.eye(1), discount=0.9
    )
    for cost, word in ((robust, "exponent"), (discounted, "discount")):
        report = audit(linear(0.5, 1.0), qpmhe.Luenberger([0.1]), cost, unit_box(1))
        assert report.constants is None
        assert report["cost bounds"].holds is False
        assert word in report["cost bounds"].text


def test_map_that_leaves_its_set_is_shown_where():
    system = qpmhe.System(
        lambda x: 1.5 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.0], [1.0])
    )
    finding = audit(system, qpmhe.Luenberger([1.0]), unit_cost())["states stay in X"]
    assert finding.holds is False
    x = finding.counterexample["x"]
    assert abs(x[0]) <= 1.0
    np.testing.assert_allclose(finding.counterexample["f(x)"], 1.5 * x)
    np.testing.assert_allclose(finding.counterexample["missed by"], 0.5)
    inner = qpmhe.System(
        lambda x: 0.5 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.0], [1.0])
    )
    finding = audit(inner, qpmhe.Luenberger([0.1]), unit_cost())["states stay in X"]
    assert finding.holds is True
    assert finding.evidence is Evidence.SAMPLED


def test_candidates_in_sets_are_left_to_the_monitor():
    system = qpmhe.System(
        lambda x: 0.5 * x, lambda x: x, n=1, p=1, disturbances=qpmhe.Box([-0.1], [0.1])
    )
    finding = audit(system, qpmhe.Luenberger([0.2]), unit_cost(), unit_box(1))[
        "candidate in the sets"
    ]
    assert finding.holds is None
    assert "monitor" in finding.text
