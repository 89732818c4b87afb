"""Models that raise, are not finite, or jump are named so; wrong derivatives prove nothing."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.branch_and_bound import output_lipschitz
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.evidence import Evidence, NotCertifiedError
from qpmhe.certificates.inequalities import euclidean_constants
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import ModelError

COST = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
GAIN = qpmhe.Luenberger([[0.1]])


def box(low, high):
    return qpmhe.Box([low], [high])


def scalar(f=lambda x: 0.5 * x, h=lambda x: 1.0 * x, **options):
    return qpmhe.System(f, h, n=1, p=1, **options)


def picky(x):
    if np.any(np.real(x) > 50.0):
        raise ValueError("too large")
    return 0.5 * x


def lost(x):
    return np.where(np.real(x) > 5.0, np.nan, 0.5 * x)


QUESTIONS = {
    "detectability": lambda s, r: certify_detectability(s, r),
    "observer": lambda s, r: certify_observer(s, GAIN, r),
    "synthesis": lambda s, r: synthesise_gain(s, r),
    "certificate": lambda s, r: certify(s, GAIN, COST, horizon=2, region=r),
}


@pytest.mark.parametrize("which", QUESTIONS)
@pytest.mark.parametrize("letter", ["f", "h"])
def test_a_function_that_raises_is_told_with_the_state(which, letter):
    with pytest.raises(
        ModelError, match=rf"{letter} raises ValueError at x = \[100.0\].*too large.*smaller region"
    ):
        QUESTIONS[which](scalar(**{letter: picky}), box(-100.0, 100.0))


def test_a_function_with_a_branch_that_no_sample_takes_is_not_proved():
    def sliver(x):
        if x[0] > 0.1234 and x[0] < 0.1235:
            raise ValueError("in between")
        return np.array([0.5 * x[0]])

    region = bounded_region(scalar(sliver), box(0.0, 1.0))
    points = region.sample(400, np.random.default_rng(20210829))[:, 0]
    assert not ((points > 0.1233) & (points < 0.1236)).any()
    found = certify_detectability(scalar(sliver), region)
    assert found.evidence is Evidence.SAMPLED
    assert "the truth of a comparison" in found.notes[0]


@pytest.mark.parametrize("which", list(QUESTIONS))
@pytest.mark.parametrize("place", [(6.0, 10.0), (-10.0, 10.0), (-10.0, 5.001)])
def test_what_is_not_finite_is_refused(which, place):
    with pytest.raises(ModelError, match=r"f is not finite at x = .*nan.*smaller region"):
        QUESTIONS[which](scalar(lost), box(*place))


@pytest.mark.parametrize("f", [
    lost, lambda x: np.maximum(0.5 * x, lost(x)), lambda x: 0.5 * x + 0.1 * lost(x) ** 2,
])
def test_nothing_is_enclosed_where_the_value_is_not_a_number(f):
    system = scalar(f)
    model = SmoothModel(system, bounded_region(system, box(-10.0, 10.0)))
    assert model.reason == ""
    for low, high in ((6.0, 10.0), (4.0, 7.0)):
        with pytest.raises(ModelError, match="not finite"):
            model.enclose(np.array([[low]]), np.array([[high]]))
    assert np.isfinite(model.enclose(np.array([[-9.0]]), np.array([[4.0]])).error).all()


@pytest.mark.parametrize(
    "f",
    [
        lambda x: 0.5 * x + 5.0 * np.sign(x),
        lambda x: 0.5 * x + 5.0 * np.floor(x),
        lambda x: np.array([0.5 * float(x[0]) + (5.0 if x[0] > 0.3 else 0.0)]),
    ],
)
def test_what_jumps_is_not_certified_from_its_derivatives(f):
    for ask in (
        lambda s, r: certify_detectability(s, r, eta=0.9, seconds=2.0),
        lambda s, r: certify_observer(s, GAIN, r, rho=0.9, seconds=2.0),
        lambda s, r: certify_observer(s, GAIN, r, seconds=2.0),
    ):
        with pytest.raises(NotCertifiedError, match=r"but not between \[.*may jump"):
            ask(scalar(f, lambda x: 0.0 * x), box(-0.973, 0.931))  # no sample is at a jump


@pytest.mark.parametrize(("h", "word"), [
    (lambda x: np.where(x > 0.3, 1e-9 + x, x), "h has a choice (numpy.where, if_else) that may"),
    (lambda x: x + 1e-9 * np.floor(x), "h has a jump of floor"),
    (lambda x: np.sqrt(np.maximum(x, 0.0)), "a derivative has a division by a value that may be"),
])
def test_what_could_not_be_enclosed_is_named(h, word):
    found = output_lipschitz(scalar(h=h), bounded_region(scalar(h=h), box(-0.973, 0.931)), None, 1)
    assert found.evidence is Evidence.SAMPLED
    assert word in found.note


def test_what_is_steep_or_kinked_is_not_said_to_jump():
    found = certify_detectability(
        scalar(lambda x: 0.5 * np.abs(x), lambda x: 0.0 * x), box(-1.0, 1.0), eta=0.8
    )
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError, match="not in the output"):
        certify_detectability(scalar(lambda x: 1e6 * x, lambda x: 0.0 * x), box(-1.0, 1.0))


def wrong_slope(slope):
    """h(x) = x, with a derivative that is wrong where the system's own check does not look."""
    return scalar(h_jacobian=lambda x: np.array([[1.0 if x[0] < 3.0 else slope]]))


def test_no_proof_rests_on_a_given_derivative():
    observer, region = qpmhe.Luenberger([[0.4]]), box(4.0, 10.0)
    right, wrong = (
        certify(system, observer, COST, horizon=3, region=region)
        for system in (scalar(), wrong_slope(0.01))
    )
    assert wrong.evidence is Evidence.PROVED
    np.testing.assert_allclose(wrong.of().C, right.of().C, rtol=1e-6)


def test_the_slope_of_the_output_is_that_of_the_enclosure():
    region = box(4.0, 10.0)
    for system in (scalar(), wrong_slope(0.01)):
        found = output_lipschitz(system, bounded_region(system, region))
        assert found.evidence is Evidence.PROVED
        assert 1.0 <= found.value <= 1.0 + 1e-9
    system = scalar(h=lambda x: np.array([float(x[0])]))  # it cannot be enclosed
    assert output_lipschitz(system, bounded_region(system, region)).evidence is Evidence.SAMPLED


def test_an_output_weight_below_zero_by_rounding_is_no_weight():
    c_p, c_w, c_v = euclidean_constants(np.eye(1), np.array([[-1e-9]]), 0.5)
    assert (c_p, c_w) == pytest.approx((1.0, 2.0))
    assert 0.0 < c_v < 1e-3
