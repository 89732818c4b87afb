"""Observers: known constants, the paper's gain, gains made for a region, refusals."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.contraction import certify_observer, synthesise_gain
from qpmhe.certificates.evidence import CertificateError, Evidence, NotCertifiedError
from qpmhe.certificates.observer_bound import ObserverBound
from qpmhe.certificates.properties import ObserverStability
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import OptionError, QpmheError

from .attacks import RELATIVE, attack_observer
from .helpers import PENDULUM, REACTOR, TANKS, linear, two_tanks, unit_box

VAN_DER_POL = qpmhe.Box([-2.5, -3.0], [2.5, 3.0])
A, C, L = np.array([[0.9, 0.4], [-0.3, 0.8]]), np.array([[1.0, 0.0]]), np.array([[0.5], [0.1]])
RADIUS = float(np.abs(np.linalg.eigvals(A - L @ C)).max())
INTEGRATOR = linear([[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]])


def limit(found, w, v):
    """What the bounds on the components tend to for disturbances and noises within boxes."""
    squares = np.square(w) @ np.diag(found.Q) + np.square(v) @ np.diag(found.R)
    return np.sqrt(squares / (1.0 - found.rho**2) * np.diag(np.linalg.inv(found.P)))


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


def test_linear_observer_reaches_its_spectral_radius():
    system, observer = linear(A, C), qpmhe.Luenberger(L)
    found = certify_observer(system, observer, unit_box(2), rho=RADIUS + 0.002)
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError):
        certify_observer(system, observer, unit_box(2), rho=RADIUS - 0.002)


@pytest.mark.parametrize("casadi", [False, True])
@pytest.mark.parametrize("rho", [0.94, 0.95])
def test_paper_observer_contracts(rho, casadi):
    system, observer, _, _ = qpmhe.models.batch_reactor()
    if casadi:
        pytest.importorskip("casadi")
        from qpmhe.models.batch_reactor import casadi_output, casadi_rate

        system = qpmhe.from_casadi(
            casadi_rate, casadi_output, dt=0.1, method="euler", n=2, compiled=False
        )
    found = certify_observer(system, observer, REACTOR, rho=rho)
    assert found.evidence is Evidence.PROVED
    assert found.C_p < 2.0
    np.testing.assert_allclose(found.kappa, np.sqrt(2) * 0.05)


@pytest.mark.parametrize("name", ["reactor", "tanks", "pendulum"])
def test_errors_keep_to_the_bound(name):
    if name == "tanks":
        system, box = two_tanks(), TANKS
        observer = synthesise_gain(system, box, rho=0.95).observer
    else:
        model, box = {
            "reactor": (qpmhe.models.batch_reactor, REACTOR),
            "pendulum": (qpmhe.models.pendulum, PENDULUM),
        }[name]
        system, observer, _, _ = model()
    found = certify_observer(system, observer, box)
    assert found.evidence is Evidence.PROVED
    share, compared = attack_observer(
        system, found.region, observer.gain, found.sums, trials=200
    )
    assert share <= 1.0 + RELATIVE
    assert compared > 1000


@pytest.mark.parametrize("sizes", [(0.3, 0.2), ([0.3], [0.2])])
def test_limit_of_a_scalar_observer_is_the_true_one(sizes):
    # e+ = 0.8 e + w - 0.6 v tends to (0.3 + 0.6 * 0.2) / 0.2 at most.
    found = certify_observer(
        linear(1.1, 0.5), qpmhe.Luenberger([[0.6]]), unit_box(1), sizes=sizes
    )
    np.testing.assert_allclose(limit(found, [0.3], [0.2]), [2.1], rtol=2e-3)
    assert limit(found, [0.3], [0.2])[0] >= 2.1 * (1.0 - 1e-9)


def test_sum_of_squares_holds_and_is_attained():
    sizes = [0.1, 0.02], [0.3]
    system, observer = linear(A, C), qpmhe.Luenberger(L)
    found = certify_observer(system, observer, unit_box(2), sizes=sizes)
    step = np.hstack((A - L @ C, np.eye(2), -L))  # of error, disturbance and noise
    weight = np.zeros((5, 5))
    weight[:2, :2], weight[2:4, 2:4] = found.rho**2 * found.P, found.Q
    weight[4:, 4:] = found.R
    scale = np.linalg.inv(np.linalg.cholesky(weight)).T
    largest = np.linalg.eigvalsh(scale.T @ step.T @ found.P @ step @ scale)[-1]
    assert 0.99 < largest <= 1.0
    other = certify_observer(system, observer, unit_box(2), sizes=([0.1, 0.02], [0.001]))
    assert np.linalg.norm(limit(found, *sizes)) < 0.95 * np.linalg.norm(limit(other, *sizes))


def test_disturbances_act_through_their_matrix():
    system = linear(np.diag([0.5, 0.9]), C, disturbance_matrix=[[1.0], [0.0]])
    found = certify_observer(
        system, qpmhe.Luenberger([[0.0], [0.0]]), unit_box(2), sizes=([1.0], [0.0])
    )
    first, second = limit(found, [1.0], [0.0])
    assert 2.0 <= first < 3.2  # sharp at the rate 0.5 ** 0.5, which the second state excludes
    assert second < 0.2


def test_synthesis_beats_the_paper_observer():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    sizes = [0.3, 0.3], [0.6]
    made = synthesise_gain(system, REACTOR, sizes=sizes)
    assert made.stability.evidence is Evidence.PROVED
    paper = certify_observer(system, observer, REACTOR, sizes=sizes)
    assert (limit(made.stability, *sizes) < 0.7 * limit(paper, *sizes)).all()


def test_sizes_trade_disturbance_against_noise():
    noisy, disturbed = ([0.01, 0.01], [1.0]), ([1.0, 1.0], [0.01])
    quiet, loud = (
        synthesise_gain(INTEGRATOR, unit_box(2), rho=0.9, sizes=sizes).stability
        for sizes in (noisy, disturbed)
    )
    assert quiet.kappa < loud.kappa
    assert limit(quiet, *noisy).max() < limit(loud, *noisy).max()
    assert limit(quiet, *disturbed).max() > limit(loud, *disturbed).max()


def test_observer_that_does_not_contract_is_shown_where():
    system, observer, _, _ = qpmhe.models.van_der_pol()
    with pytest.raises(NotCertifiedError, match=r"radius 1\.0\d* at \[.*synthesise_gain"):
        certify_observer(system, observer, VAN_DER_POL)
    made = synthesise_gain(system, VAN_DER_POL, rho=0.85)
    assert made.stability.evidence is Evidence.PROVED


def test_a_gain_made_for_x_is_projected_in_its_metric_and_its_bound_holds_there():
    region = qpmhe.Box([-2.5, -3.5], [2.5, 3.5])
    system = qpmhe.System.from_ode(
        lambda x: np.array([x[1], (1.0 - x[0] ** 2) * x[1] - x[0]]), lambda x: x[:1], dt=0.1, n=2,
        p=1, states=region,
    )
    sizes = qpmhe.certificates.Sizes(0.0, 0.3)
    made = synthesise_gain(system, region, sizes=(0.01, 0.3))
    x, start, rng = [np.array([2.2, -0.5])], np.array([-2.4, 3.4]), np.random.default_rng(0)
    for _ in range(60):
        x.append(system.f(x[-1], np.zeros(0)))
    truth = np.array(x)
    y = truth[:-1, :1] + rng.choice([-0.3, 0.3], (60, 1))
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1))
    for observer, holds in ((made.observer, True), (qpmhe.Luenberger(made.observer.gain), False)):
        run = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=4, initial_state=start, max_qps=0
        ).run(y)
        bound = ObserverBound(
            made.stability, bounded_region(system, region), sizes, observer.metric
        )
        band = bound.along(run, initial_error=truth[0] - start)
        assert (run.flags & qpmhe.Status.OBSERVER_PROJECTED.value).any()
        assert (band.lost is None) is holds


def test_undetectable_system_has_no_gain():
    with pytest.raises(NotCertifiedError, match="no constant gain"):
        synthesise_gain(linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), unit_box(2))


class Odd(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return self.gain @ v + z, None


@pytest.mark.parametrize(
    "observer",
    [
        qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
        qpmhe.OutputInjection(lambda z, v: 0.1 * v * z), Odd([0.05, 0.05]),
    ],
)
def test_observers_without_constant_gain_are_named(observer):
    words = rf"{type(observer).__name__} has no constant gain.*ObserverStability\.assumed"
    with pytest.raises(CertificateError, match=words):
        certify_observer(qpmhe.models.batch_reactor()[0], observer, REACTOR)


def test_bad_options():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    for name, value, words in (
        ("rho", 1.5, "rho is"), ("sizes", (1.0, -1.0), "size of the noise is -1.0"),
        ("sizes", ([1.0, 1.0, 1.0], 1.0), r"size of the disturbance has shape \(3,\)"),
    ):
        with pytest.raises(QpmheError, match=words):
            certify_observer(system, observer, REACTOR, **{name: value})
    with pytest.raises(OptionError, match="kappa"):
        ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=-1.0)
