"""States that the region fixes, such as known parameters, and inputs of zero width."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.contraction import certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.evidence import Evidence, NotCertifiedError

GAIN, SIZES = np.array([[0.5], [0.2], [0.0]]), ([0.1, 0.1, 0.0], [0.2])
REGION = qpmhe.Box([-1.0, -1.0, 0.3], [1.0, 1.0, 0.3])


def oscillator(drift=0.0, parameter=None):
    """A nonlinear oscillator whose third state is a constant parameter, unless that is given."""

    def f(x):
        a, b = x[..., 0], x[..., 1]
        more = x[..., 2] if parameter is None else parameter
        ahead = [0.9 * a + 0.2 * b, -0.2 * a + 0.8 * b + 0.1 * more * np.sin(a)]
        return np.stack(ahead if parameter is not None else [*ahead, more + drift * a], -1)

    return qpmhe.System(f, lambda x: x[..., :1], n=3 if parameter is None else 2, p=1)


def test_known_parameter_is_left_out():
    found = certify_observer(oscillator(), qpmhe.Luenberger(GAIN), REGION, sizes=SIZES)
    assert found.evidence is Evidence.PROVED
    assert any("x[2] is known" in note for note in found.notes)
    free = qpmhe.Box([-1.0, -1.0], [1.0, 1.0])
    alone = certify_observer(
        oscillator(parameter=0.3), qpmhe.Luenberger(GAIN[:2]), free, sizes=([0.1, 0.1], [0.2])
    )
    np.testing.assert_allclose(found.rho, alone.rho, rtol=1e-3)
    np.testing.assert_allclose(found.P[:2, :2], alone.P, rtol=1e-3)
    assert not found.P[2, :2].any()
    assert found.P[2, 2] > 0.0
    assert found.Q.shape == (3, 3)
    assert np.array_equal(found.gain, GAIN)


def test_gain_and_detectability_leave_it_out():
    system = oscillator()
    made = synthesise_gain(system, REGION, sizes=SIZES).stability
    assert made.evidence is Evidence.PROVED
    assert made.gain.shape == (3, 1)
    assert not made.gain[2].any()
    found = certify_detectability(system, REGION)
    assert found.evidence is Evidence.PROVED
    assert found.P.shape == (3, 3)


def test_what_moves_it_is_named():
    for drift in (0.01, 1e-14):  # samples of f do not see the latter
        with pytest.raises(NotCertifiedError, match=r"no width in x\[2\], but f moves it"):
            certify_observer(oscillator(drift), qpmhe.Luenberger(GAIN), REGION, sizes=SIZES)
    moving = qpmhe.Luenberger([[0.5], [0.2], [0.1]])
    with pytest.raises(NotCertifiedError, match=r"no width in x\[2\], but the observer's gain"):
        certify_observer(oscillator(), moving, REGION, sizes=SIZES)
    point = qpmhe.Box([0.0, 0.0, 0.3], [0.0, 0.0, 0.3])
    with pytest.raises(NotCertifiedError, match="single state"):
        certify_observer(oscillator(), qpmhe.Luenberger(0.0 * GAIN), point, sizes=SIZES)


def test_input_of_zero_width():
    system = qpmhe.System(
        lambda x, u: 0.5 * x + 0.1 * u * np.sin(x), lambda x, u: x, n=1, p=1, m=1
    )
    observer, box = qpmhe.Luenberger([[0.2]]), qpmhe.Box([-1.0], [1.0])
    found = certify_observer(system, observer, box, inputs=qpmhe.Box([2.0], [2.0]), rho=0.51)
    assert found.evidence is Evidence.PROVED
    # 0.5 - 0.2 + 0.2 cos(x) is at most 0.5.
    with pytest.raises(NotCertifiedError):
        certify_observer(system, observer, box, inputs=qpmhe.Box([2.0], [2.0]), rho=0.49)
