"""Observers: known constants, the paper's gain, gains made for a region, refusals."""

import contextlib

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.contraction import certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.evidence import CertificateError, Evidence, NotCertifiedError
from qpmhe.certificates.properties import ObserverStability
from qpmhe.errors import OptionError, QpmheError

from .helpers import REACTOR, linear, unit_box

A, C, L = np.array([[0.9, 0.4], [-0.3, 0.8]]), np.array([[1.0, 0.0]]), np.array([[0.5], [0.1]])
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


def test_paper_observer_contracts():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    found = certify_observer(system, observer, REACTOR, rho=0.94)
    assert found.evidence is Evidence.PROVED
    assert (found.C_p < 2.0, found.cells) == (True, 1)
    np.testing.assert_allclose(found.kappa, np.sqrt(2) * 0.05)


def test_limit_of_a_scalar_observer_is_the_true_one():
    # e+ = 0.8 e + w - 0.6 v tends to (0.3 + 0.6 * 0.2) / 0.2 at most.
    found = certify_observer(
        linear(1.1, 0.5), qpmhe.Luenberger([[0.6]]), unit_box(1), sizes=(0.3, 0.2)
    )
    np.testing.assert_allclose(limit(found, [0.3], [0.2]), [2.1], rtol=2e-3)
    assert limit(found, [0.3], [0.2])[0] >= 2.1 * (1.0 - 1e-9)


def test_sum_of_squares_is_attained():
    found = certify_observer(
        linear(A, C), qpmhe.Luenberger(L), unit_box(2), sizes=([0.1, 0.02], [0.3])
    )
    step = np.hstack((A - L @ C, np.eye(2), -L))  # of error, disturbance and noise
    weight = np.zeros((5, 5))
    weight[:2, :2], weight[2:4, 2:4] = found.rho**2 * found.P, found.Q
    weight[4:, 4:] = found.R
    scale = np.linalg.inv(np.linalg.cholesky(weight)).T
    assert 0.99 < np.linalg.eigvalsh(scale.T @ step.T @ found.P @ step @ scale)[-1] <= 1.0


def test_disturbances_act_through_their_matrix():
    system = linear(np.diag([0.5, 0.9]), C, disturbance_matrix=[[1.0], [0.0]])
    found = certify_observer(
        system, qpmhe.Luenberger([[0.0], [0.0]]), unit_box(2), sizes=([1.0], [0.0])
    )
    first, second = limit(found, [1.0], [0.0])
    assert 2.0 <= first < 3.2  # sharp at the rate 0.5 ** 0.5, which the second state excludes
    assert second < 0.2


def test_synthesis_beats_the_paper_observer_and_trades_disturbance_against_noise():
    system, observer, _, _ = qpmhe.models.batch_reactor()
    sizes = [0.3, 0.3], [0.6]
    made = synthesise_gain(system, REACTOR, sizes=sizes)
    assert made.stability.evidence is Evidence.PROVED
    assert f"rate {made.stability.rho:.4g} a sample (proved)" in str(made)
    np.testing.assert_array_equal(made.observer.metric, made.stability.P)
    paper = certify_observer(system, observer, REACTOR, sizes=sizes)
    assert (limit(made.stability, *sizes) < 0.7 * limit(paper, *sizes)).all()
    noisy, disturbed = ([0.01, 0.01], [1.0]), ([1.0, 1.0], [0.01])
    quiet, loud = (
        synthesise_gain(INTEGRATOR, unit_box(2), rho=0.9, sizes=each).stability
        for each in (noisy, disturbed)
    )
    assert quiet.kappa < loud.kappa
    assert limit(quiet, *noisy).max() < limit(loud, *noisy).max()
    assert limit(quiet, *disturbed).max() > limit(loud, *disturbed).max()


def test_an_observer_that_does_not_contract_and_a_missing_gain_are_named():
    system, observer, _, _ = qpmhe.models.van_der_pol()
    with pytest.raises(NotCertifiedError, match=r"radius 1\.0\d* at \[.*synthesise_gain"):
        certify_observer(system, observer, qpmhe.Box([-2.5, -3.0], [2.5, 3.0]))
    with pytest.raises(NotCertifiedError, match="no constant gain"):
        synthesise_gain(linear(np.diag([1.1, 0.5]), [[0.0, 1.0]]), unit_box(2))


class Odd(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return self.gain @ v + z, None


def test_observers_without_constant_gain_and_bad_options_are_named():
    system, paper, _, _ = qpmhe.models.batch_reactor()
    for observer in (
        qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
        qpmhe.OutputInjection(lambda z, v: 0.1 * v * z), Odd([0.05, 0.05]),
    ):
        words = rf"{type(observer).__name__} has no constant gain.*ObserverStability\.assumed"
        with pytest.raises(CertificateError, match=words):
            certify_observer(system, observer, REACTOR)
    for name, value, words in (
        ("rho", 1.5, "rho is"), ("sizes", (1.0, -1.0), "size of the noise is -1.0"),
        ("sizes", ([1.0, 1.0, 1.0], 1.0), r"size of the disturbance has shape \(3,\)"),
    ):
        with pytest.raises(QpmheError, match=words):
            certify_observer(system, paper, REACTOR, **{name: value})
    with pytest.raises(OptionError, match="kappa"):
        ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.0, C_v=1.0, kappa=-1.0)


# States that the region fixes, such as known parameters, and inputs of zero width.
GAIN, SIZES = np.array([[0.5], [0.2], [0.0]]), ([0.1, 0.1, 0.0], [0.2])
KNOWN = qpmhe.Box([-1.0, -1.0, 0.3], [1.0, 1.0, 0.3])


def oscillator(drift=0.0, parameter=None, way=np.stack):
    """A nonlinear oscillator whose third state is a constant parameter, unless that is given."""

    def f(x):
        a, b = x[..., 0], x[..., 1]
        more = x[..., 2] if parameter is None else parameter
        ahead = [0.9 * a + 0.2 * b, -0.2 * a + 0.8 * b + 0.1 * more * np.sin(a)]
        return way(ahead if parameter is not None else [*ahead, more + drift * a], -1)

    return qpmhe.System(f, lambda x: x[..., :1], n=3 if parameter is None else 2, p=1)


def untraced(parts, axis):
    return np.array([float(part) for part in parts])


def test_known_parameter_is_left_out():
    found = certify_observer(oscillator(), qpmhe.Luenberger(GAIN), KNOWN, rho=0.9, sizes=SIZES)
    assert found.evidence is Evidence.PROVED
    assert any("x[2] is known" in note for note in found.notes)
    alone = certify_observer(
        oscillator(parameter=0.3), qpmhe.Luenberger(GAIN[:2]), unit_box(2),
        rho=0.9, sizes=([0.1, 0.1], [0.2]),
    )
    np.testing.assert_allclose(found.P[:2, :2], alone.P, rtol=1e-3)
    assert not found.P[2, :2].any()
    assert found.P[2, 2] > 0.0
    assert found.Q.shape == (3, 3)
    assert np.array_equal(found.gain, GAIN)
    made = synthesise_gain(oscillator(), KNOWN, rho=0.9, sizes=SIZES).stability
    assert not made.gain[2].any()
    found = certify_detectability(oscillator(), KNOWN, eta=0.9)
    assert (made.evidence, found.evidence) == (Evidence.PROVED, Evidence.PROVED)
    assert (made.gain.shape, found.P.shape) == ((3, 1), (3, 3))


def test_what_moves_it_is_named():
    for drift, way in ((0.01, np.stack), (1e-14, np.stack), (0.01, untraced)):
        with pytest.raises(NotCertifiedError, match=r"no width in x\[2\], but f moves it"):
            certify_observer(
                oscillator(drift, way=way), qpmhe.Luenberger(GAIN), KNOWN, sizes=SIZES
            )
    moving = qpmhe.Luenberger([[0.5], [0.2], [0.1]])
    with pytest.raises(NotCertifiedError, match=r"no width in x\[2\], but the observer's gain"):
        certify_observer(oscillator(), moving, KNOWN, sizes=SIZES)
    point = qpmhe.Box([0.0, 0.0, 0.3], [0.0, 0.0, 0.3])
    with pytest.raises(NotCertifiedError, match="single state"):
        certify_observer(oscillator(), qpmhe.Luenberger(0.0 * GAIN), point, sizes=SIZES)


def test_input_of_zero_width():
    system = qpmhe.System(
        lambda x, u: 0.5 * x + 0.1 * u * np.sin(x), lambda x, u: x, n=1, p=1, m=1
    )
    for rho, holds in ((0.51, True), (0.49, False)):  # 0.5 - 0.2 + 0.2 cos(x) is at most 0.5
        refused = contextlib.nullcontext() if holds else pytest.raises(NotCertifiedError)
        with refused:
            found = certify_observer(
                system, qpmhe.Luenberger([[0.2]]), unit_box(1), inputs=qpmhe.Box([2.0], [2.0]),
                rho=rho,
            )
            assert found.evidence is Evidence.PROVED
