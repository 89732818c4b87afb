"""Observers: known constants, the paper's gain, gains made for a region, refusals."""

from __future__ import annotations

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.contraction import certify_observer, synthesise_gain
from qpmhe.certificates.evidence import CertificateError, Evidence, NotCertifiedError
from qpmhe.certificates.properties import ObserverStability
from qpmhe.errors import OptionError

from .attacks import attack_observer
from .test_detectability import REACTOR, linear, unit_box

TANK_AREA, TANK_DT = 0.5, 0.1


def two_tanks():
    """Two tanks in a row with Torricelli's outflow; the second level is measured."""

    def rate(x):
        flow = np.sqrt(x) * 0.3
        out = np.empty(x.shape, x.dtype)
        out[..., 0] = 0.35 - flow[..., 0]
        out[..., 1] = flow[..., 0] - flow[..., 1]
        return out / TANK_AREA

    return qpmhe.System.from_ode(rate, lambda x: x[..., 1:], dt=TANK_DT, n=2, p=1)


TANKS = qpmhe.Box([0.2, 0.2], [2.0, 2.0])


def test_scalar_observer_has_the_known_constants():
    system, observer = linear(1.1, 0.5), qpmhe.Luenberger([[0.6]])
    found = certify_observer(system, observer, unit_box(1), rho=0.81)  # |1.1 - 0.3| = 0.8
    assert found.evidence is Evidence.PROVED
    np.testing.assert_allclose(
        [found.C_p, found.C_w, found.C_v, found.kappa], [1.0, 1 / 0.81, 0.6 / 0.81, 0.6], rtol=1e-6
    )
    assert found.kappa >= 0.6
    with pytest.raises(NotCertifiedError) as caught:
        certify_observer(system, observer, unit_box(1), rho=0.79)
    np.testing.assert_allclose(caught.value.smallest_rate, 0.8, atol=2e-3)


@pytest.mark.parametrize("rho", [0.94, 0.95])
def test_paper_observer_contracts(rho):
    system, observer, _, _ = qpmhe.models.batch_reactor()
    found = certify_observer(system, observer, REACTOR, rho=rho)
    assert found.evidence is Evidence.PROVED
    if rho == 0.95:
        # An independent program found P = I there.
        np.testing.assert_allclose(found.C_p, 1.0, atol=1e-6)
        np.testing.assert_allclose(found.C_v, np.sqrt(2) * 0.05 / 0.95, rtol=1e-4)
    np.testing.assert_allclose(found.kappa, np.sqrt(2) * 0.05)


@pytest.mark.parametrize("name", ["reactor", "tanks", "pendulum"])
def test_errors_keep_to_the_bound(name):
    if name == "reactor":
        (system, observer, _, _), box = qpmhe.models.batch_reactor(), REACTOR
    elif name == "tanks":
        system, box = two_tanks(), TANKS
        observer = synthesise_gain(system, box, rho=0.95).observer
    else:
        (system, observer, _, _), box = qpmhe.models.pendulum(), qpmhe.Box([-3, -10], [3, 10])
    found = certify_observer(system, observer, box)
    assert found.evidence is Evidence.PROVED
    attack = attack_observer(
        system, found.region, observer.gain, found.sums, trials=200, polish=10
    )
    assert not attack.refuted
    assert attack.compared > 1000


def test_linear_observer_reaches_its_spectral_radius():
    A, C, L = np.array([[0.9, 0.4], [-0.3, 0.8]]), np.array([[1.0, 0.0]]), np.array([[0.5], [0.1]])
    radius = np.abs(np.linalg.eigvals(A - L @ C)).max()
    found = certify_observer(linear(A, C), qpmhe.Luenberger(L), unit_box(2), rho=radius + 0.002)
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError):
        certify_observer(linear(A, C), qpmhe.Luenberger(L), unit_box(2), rho=radius - 0.002)


def test_synthesis_beats_the_paper_observer():
    system = qpmhe.models.batch_reactor()[0]
    made = synthesise_gain(system, REACTOR)
    assert made.stability.evidence is Evidence.PROVED
    assert made.stability.rho < 0.9
    again = certify_observer(system, made.observer, REACTOR, rho=made.stability.rho)
    assert again.evidence is Evidence.PROVED


def test_weights_trade_disturbance_against_noise():
    system = linear(np.array([[1.0, 0.1], [0.0, 1.0]]), [[1.0, 0.0]])
    quiet = synthesise_gain(system, unit_box(2), rho=0.9, weights=(1.0, 10.0)).stability
    loud = synthesise_gain(system, unit_box(2), rho=0.9, weights=(10.0, 1.0)).stability
    assert quiet.C_v < loud.C_v
    assert quiet.C_w > loud.C_w


def test_casadi_system_is_certified_alike():
    pytest.importorskip("casadi")
    from qpmhe.models.batch_reactor import casadi_output, casadi_rate

    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, dt=0.1, method="euler", n=2, compiled=False
    )
    found = certify_observer(system, qpmhe.Luenberger([0.05, 0.05]), REACTOR, rho=0.95)
    assert found.evidence is Evidence.PROVED
    np.testing.assert_allclose(found.C_p, 1.0, atol=1e-6)


def test_observer_that_does_not_contract_is_shown_where():
    system, observer, _, _ = qpmhe.models.van_der_pol()
    with pytest.raises(NotCertifiedError, match=r"spectral radius 1\.0\d* at \[") as caught:
        certify_observer(system, observer, qpmhe.Box([-2.5, -3.0], [2.5, 3.0]))
    assert "synthesise_gain" in str(caught.value)
    made = synthesise_gain(system, qpmhe.Box([-2.5, -3.0], [2.5, 3.0]), rho=0.85)
    assert made.stability.evidence is Evidence.PROVED


def test_undetectable_system_has_no_gain():
    with pytest.raises(NotCertifiedError, match="no constant gain"):
        synthesise_gain(linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), unit_box(2))


def test_observers_without_constant_gain_are_named():
    system = qpmhe.models.batch_reactor()[0]
    eye = np.eye(2)
    for observer in (
        qpmhe.ExtendedKalman(prior=eye, disturbance=eye, noise=np.eye(1)),
        qpmhe.OutputInjection(lambda z, v: 0.1 * v * z),
    ):
        with pytest.raises(CertificateError, match="no constant gain") as caught:
            certify_observer(system, observer, REACTOR)
        assert type(observer).__name__ in str(caught.value)
        assert "ObserverStability.assumed" in str(caught.value)

    class Odd(qpmhe.Luenberger):
        def correct(self, z, v, sample):
            return self.gain @ v + z, None

    with pytest.raises(CertificateError, match="Odd has no constant gain"):
        certify_observer(system, Odd([0.05, 0.05]), REACTOR)


def test_bad_options():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    with pytest.raises(OptionError, match="rho is"):
        certify_observer(system, observer, REACTOR, rho=1.5)
    with pytest.raises(OptionError, match="weights"):
        certify_observer(system, observer, REACTOR, weights=(1.0, 0.0))
    with pytest.raises(OptionError, match="kappa"):
        ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=-1.0)
