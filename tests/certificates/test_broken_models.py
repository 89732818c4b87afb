"""Models that raise, are not finite, or jump are named so; wrong derivatives prove nothing."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.branch_and_bound import cover, lipschitz
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability
from qpmhe.certificates.enclosures import Enclosure, SmoothModel
from qpmhe.certificates.evidence import Evidence, NotCertifiedError
from qpmhe.certificates.inequalities import Form
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import ModelError

from .helpers import QUESTIONS, box, scalar, unit_cost


def picky(x):
    if np.any(np.real(x) > 50.0):
        raise ValueError("too large")
    return 0.5 * x


def lost(x):
    return np.where(np.real(x) > 5.0, np.nan, 0.5 * x)


@pytest.mark.parametrize("which", QUESTIONS)
def test_what_raises_or_is_not_finite_is_named_with_the_state(which):
    for letter in "fh":
        words = rf"{letter} raises ValueError at x = \[100.0\].*too large.*smaller region"
        with pytest.raises(ModelError, match=words):
            QUESTIONS[which](scalar(**{letter: picky}), box(-100.0, 100.0))
    for place in ((6.0, 10.0), (-10.0, 5.001)):
        with pytest.raises(ModelError, match=r"f is not finite at x = .*nan.*smaller region"):
            QUESTIONS[which](scalar(lost), box(*place))


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


def test_infinite_derivatives_prove_nothing_and_hide_nothing_of_other_cells():
    system = scalar(lambda x: (1e154 * x) ** 2)
    region = bounded_region(system, box(0.0, 1.0))
    model = SmoothModel(system, region)
    assert np.isnan(model.enclose(region.lower[None], region.upper[None]).error).all()
    assert not cover(model, region, Form(np.eye(1), 0.9, np.eye(1)), 50).proved
    ones, nothing = np.ones((1, 1, 1)), np.full((1, 1, 1), np.nan)
    centre = np.concatenate((ones, nothing))
    corners, error = Enclosure(
        centre, np.concatenate((0.5 * ones[None], nothing[None])),
        np.concatenate((0.0 * ones, nothing)), np.zeros((2, 1)), centre,
    ).corners()
    assert corners[0].min() - error[0].max() <= 0.5
    assert corners[0].max() + error[0].max() >= 1.5
    assert np.isnan(error[1]).all()


def compared(place):
    return lambda x: np.array([0.5 * float(x[0]) + (5.0 if x[0] > place else 0.0)])


def test_what_jumps_is_not_certified_from_its_derivatives():
    between, aside = r"but not between \[.*may jump", box(-0.973, 0.931)
    for f, seen, region, words in (
        # No sample is at a jump; in the middle of the region, one is.
        (lambda x: 0.5 * x + 5.0 * np.sign(x), 0.0, aside, between),
        (lambda x: 0.5 * x + 5.0 * np.floor(x), 0.0, aside, between),
        (compared(0.3), 0.0, aside, between),
        (compared(0.0), 1.0, box(-1.0, 1.0), r"f jumps at \[0.0\].*changes by 5"),
    ):
        for which in ("detectability", "observer"):
            with pytest.raises(NotCertifiedError, match=words):
                QUESTIONS[which](scalar(f, lambda x, c=seen: c * x), region, seconds=2.0)


def test_what_is_steep_or_kinked_is_not_said_to_jump():
    found = certify_detectability(
        scalar(lambda x: 0.5 * np.abs(x), lambda x: 0.0 * x), box(-1.0, 1.0), eta=0.8
    )
    assert found.evidence is Evidence.PROVED
    with pytest.raises(NotCertifiedError, match="not appear in the output"):
        certify_detectability(scalar(lambda x: 1e6 * x, lambda x: 0.0 * x), box(-1.0, 1.0))


@pytest.mark.parametrize(("h", "word"), [
    (lambda x: np.where(x > 0.3, 1e-9 + x, x), "h has a choice (numpy.where, if_else) that may"),
    (lambda x: x + 1e-9 * np.floor(x), "h has a jump of floor"),
    (lambda x: np.sqrt(np.maximum(x, 0.0)), "a derivative has a division by a value that may be"),
    (lambda x: np.array([float(x[0])]), "float() of a symbol"),
])
def test_what_could_not_be_enclosed_is_named(h, word):
    found = lipschitz(scalar(h=h), bounded_region(scalar(h=h), box(-0.973, 0.931)), "h", 1)
    assert found.evidence is Evidence.SAMPLED
    assert word in found.note


def test_no_proof_rests_on_a_given_derivative():
    # h(x) = x, with a derivative that is wrong where the system's own check does not look.
    wrong = scalar(h_jacobian=lambda x: np.array([[1.0 if x[0] < 3.0 else 0.01]]))
    observer, region = qpmhe.Luenberger([[0.4]]), box(4.0, 10.0)
    found = [
        certify(system, observer, unit_cost(), horizon=3, region=region)
        for system in (scalar(), wrong)
    ]
    assert found[1].evidence is Evidence.PROVED
    np.testing.assert_allclose(*(each.of().C for each in found), rtol=1e-6)
