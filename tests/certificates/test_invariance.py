"""Invariance of regions: known answers, sides that are left, and room for the observer."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.evidence import Evidence
from qpmhe.certificates.invariance import certify_invariance, inner_region
from qpmhe.certificates.regions import bounded_region
from qpmhe.errors import OptionError, ShapeError

from .helpers import linear, scalar, two_tanks, unit_box

TURN = np.pi / 6
ROTATION = 0.9 * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
DIRECTIONS = np.arange(8) * np.pi / 4
OCTAGON = qpmhe.Polytope(
    np.column_stack((np.cos(DIRECTIONS), np.sin(DIRECTIONS))), np.ones(8)
)


def test_growth_leaves_and_says_where():
    found = certify_invariance(linear(1.5, 1.0), unit_box(1))
    assert found.holds is False
    assert found.evidence is Evidence.PROVED
    assert found.text == "f reaches x1 = -1.5 through the face x1 >= -1, from x = [-1.0]"


@pytest.mark.parametrize(
    ("disturbance", "holds"), [(0.0, True), (0.4999999, True), ([0.4999999], True), (0.51, False)]
)
def test_disturbances_take_what_contraction_leaves(disturbance, holds):
    found = certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=disturbance)
    assert found.holds is holds
    assert ("disturbances" in found.text) is not holds


def test_polytope_may_stay_where_its_box_does_not():
    system = linear(ROTATION, [[1.0, 0.0]])
    assert certify_invariance(system, OCTAGON).holds is True
    found = certify_invariance(system, unit_box(2))
    assert found.holds is False
    # |cos| + |sin| of the turn, times 0.9.
    assert f"= {0.45 * (1.0 + np.sqrt(3.0)):.4g} through" in found.text.replace("-", "")


def test_inputs_count_and_a_constant_state_stays_on_its_sides():
    system = linear(np.diag([1.0, 0.5]), [[1.0, 1.0]])
    assert certify_invariance(system, unit_box(2)).holds is True
    system = qpmhe.System(lambda x, u: 0.5 * x + u, lambda x, u: x, n=1, p=1, m=1)
    for width, holds in ((0.49, True), (0.51, False)):
        found = certify_invariance(system, unit_box(1), inputs=qpmhe.Box([-width], [width]))
        assert found.holds is holds
    assert "u = [" in found.text


def test_nonlinear_system_stays_where_simulations_do():
    # 0.35 fills the first tank to 1.3611: 0.3 sqrt(x) flows out.
    tanks, level = two_tanks(), (0.35 / 0.3) ** 2
    for top, holds in ((1.001 * level, True), (0.999 * level, False)):
        found = certify_invariance(tanks, qpmhe.Box([0.2, 0.2], [top, top]))
        assert found.holds is holds


def test_what_has_no_enclosure_or_no_end_is_not_known():
    found = certify_invariance(scalar(lambda x: np.array([0.5 * float(x[0])])), unit_box(1))
    assert (found.holds, found.evidence) == (None, None)
    assert "not known" in found.text
    # The side is touched, but not left: no cell there is ever shown.
    touching = scalar(lambda x: 1.0 - 0.5 * (x - 0.3) ** 2)
    found = certify_invariance(touching, qpmhe.Box([-1.0], [1.0]), seconds=5.0)
    assert found.holds is None
    assert found.cells > 10
    # Between samples, f moves a state that the region fixes.
    bump = qpmhe.System(
        lambda x: np.stack([0.5 * x[0], np.maximum(1e-6 - np.abs(x[0] - 0.1234567), 0.0)]),
        lambda x: x, n=2, p=2,
    )
    found = certify_invariance(bump, qpmhe.Box([-1.0, 0.0], [1.0, 0.0]), seconds=5.0)
    assert found.holds is not True


def test_observer_stays_in_the_region_while_the_state_is_in_the_inner_one():
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    for states in (qpmhe.Box([-3.0, -5.0], [3.0, 5.0]), OCTAGON):
        region = bounded_region(linear(ROTATION, [[1.0, 0.0]]), states)
        inner = inner_region(region, P, 0.25)
        rng = np.random.default_rng(5)
        x = inner.sample(500, rng)
        away = rng.standard_normal((len(x), 2))
        away *= 0.25 / np.sqrt(np.einsum("ti,ij,tj->t", away, P, away))[:, None]
        assert region.contains(x + away).all()
        assert not region.contains(x + 1.3 * away).all()  # and is not smaller than that
        assert inner_region(region, P, 10.0) is None


def test_disturbance_that_does_not_fit():
    with pytest.raises(OptionError, match="disturbance is"):
        certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=-1.0)
    with pytest.raises(ShapeError, match="1 half-widths"):
        certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=[0.1, 0.1])
