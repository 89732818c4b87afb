"""Regions: boxes around sets, containment, invariance, and room for the observer."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import Evidence
from qpmhe.certificates.invariance import certify_invariance, inner_region
from qpmhe.certificates.regions import beyond, bounded_region
from qpmhe.errors import OptionError, SetError, ShapeError

from .helpers import box, linear, scalar, unit_box

TURN = np.pi / 6
ROTATION = 0.9 * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
DIRECTIONS = np.arange(8) * np.pi / 4
OCTAGON = qpmhe.Polytope(np.column_stack((np.cos(DIRECTIONS), np.sin(DIRECTIONS))), np.ones(8))


def two_tanks():
    """Two tanks in a row with Torricelli's outflow; the second level is measured."""

    def rate(x):
        flow = np.sqrt(x) * 0.3
        out = np.empty(x.shape, x.dtype)
        out[..., 0] = 0.35 - flow[..., 0]
        out[..., 1] = flow[..., 0] - flow[..., 1]
        return out / 0.5

    return qpmhe.System.from_ode(rate, lambda x: x[..., 1:], dt=0.1, n=2, p=1)


def test_known_regions_stay_or_are_left():
    found = certify_invariance(linear(1.5, 1.0), unit_box(1))
    assert (found.holds, found.evidence) == (False, Evidence.PROVED)
    assert found.text == "f reaches x1 = -1.5 through the face x1 >= -1, from x = [-1.0]"
    for disturbance, holds in ((0.0, True), (0.4999999, True), ([0.4999999], True), (0.51, False)):
        found = certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=disturbance)
        assert found.holds is holds
        assert ("disturbances" in found.text) is not holds
    # A polytope may stay where its box does not, and a constant state stays on its sides.
    turning = linear(ROTATION, [[1.0, 0.0]])
    assert certify_invariance(turning, OCTAGON).holds is True
    found = certify_invariance(turning, unit_box(2))
    assert found.holds is False
    # |cos| + |sin| of the turn, times 0.9.
    assert f"= {0.45 * (1.0 + np.sqrt(3.0)):.4g} through" in found.text.replace("-", "")
    constant = linear(np.diag([1.0, 0.5]), [[1.0, 1.0]])
    assert certify_invariance(constant, unit_box(2)).holds is True
    driven = qpmhe.System(lambda x, u: 0.5 * x + u, lambda x, u: x, n=1, p=1, m=1)
    for width, holds in ((0.49, True), (0.51, False)):
        found = certify_invariance(driven, unit_box(1), inputs=box(-width, width))
        assert found.holds is holds
    assert "u = [" in found.text
    # 0.35 fills the first tank to 1.3611: 0.3 sqrt(x) flows out.
    level = (0.35 / 0.3) ** 2
    for top, holds in ((1.001 * level, True), (0.999 * level, False)):
        assert certify_invariance(two_tanks(), box([0.2, 0.2], [top, top])).holds is holds


def test_what_has_no_enclosure_or_no_end_is_not_known():
    found = certify_invariance(scalar(lambda x: np.array([0.5 * float(x[0])])), unit_box(1))
    assert (found.holds, found.evidence) == (None, None)
    assert "not known" in found.text
    # The side is touched, but not left: no cell there is ever shown.
    touching = scalar(lambda x: 1.0 - 0.5 * (x - 0.3) ** 2)
    found = certify_invariance(touching, unit_box(1), seconds=2.0)
    assert found.holds is None
    assert found.cells > 10
    # Between samples, f moves a state that the region fixes.
    bump = qpmhe.System(
        lambda x: np.stack([0.5 * x[0], np.maximum(1e-6 - np.abs(x[0] - 0.1234567), 0.0)]),
        lambda x: x, n=2, p=2,
    )
    found = certify_invariance(bump, box([-1.0, 0.0], [1.0, 0.0]), seconds=2.0)
    assert found.holds is not True
    for disturbance, error, words in (
        (-1.0, OptionError, "disturbance is"), ([0.1, 0.1], ShapeError, "1 half-widths"),
    ):
        with pytest.raises(error, match=words):
            certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=disturbance)


def test_observer_stays_in_the_region_while_the_state_is_in_the_inner_one():
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    for states in (box([-3.0, -5.0], [3.0, 5.0]), OCTAGON):
        region = bounded_region(linear(ROTATION, [[1.0, 0.0]]), states)
        inner = inner_region(region, P, 0.25)
        rng = np.random.default_rng(5)
        x = inner.sample(500, rng)
        away = rng.standard_normal((len(x), 2))
        away *= 0.25 / np.sqrt(np.einsum("ti,ij,tj->t", away, P, away))[:, None]
        assert region.contains(x + away).all()
        assert not region.contains(x + 1.3 * away).all()  # and is not smaller than that
        assert inner_region(region, P, 10.0) is None


def test_a_polytope_is_boxed_outward_and_sampled_inside():
    system = qpmhe.models.van_der_pol()[0]
    triangle = qpmhe.Polytope([[-1.0, 0.0], [0.0, -1.0], [3.0, 1.0]], [0.0, 0.0, 1.0])
    region = bounded_region(system, triangle)
    assert (region.lower <= 0.0).all()
    assert (region.upper >= [1.0 / 3.0, 1.0]).all()
    np.testing.assert_allclose(region.upper, [1.0 / 3.0, 1.0], rtol=1e-9)
    points = region.sample(200, np.random.default_rng(4))
    assert region.contains(points).all()
    assert (np.ptp(points, axis=0) > 0.9 * region.upper).all()
    away = region.outside(np.array([[0.3, 0.3], [0.1, 0.1]]), np.array([[0.4, 0.4], [0.2, 0.2]]))
    assert away.tolist() == [True, False]


def test_containment_of_boxes_and_polytopes():
    def region(states):
        return bounded_region(linear(0.5 * np.eye(2), np.eye(2)), states)

    square, small, wide = unit_box(2), box([-0.4] * 2, [0.4] * 2), box([-2.0] * 2, [2.0] * 2)
    diamond = qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], [1.0] * 4)
    for inner, outer in (
        (small, square), (square, square), (diamond, wide & diamond), (diamond, diamond),
        (small, diamond), (diamond & small, diamond), (diamond, wide),
    ):
        assert beyond(region(inner), region(outer)) == "", (inner, outer)
    # The diamond touches the square's sides, which rounding does not let be shown.
    for inner, outer in (
        (square, small), (square, diamond), (diamond, small), (diamond, square)
    ):
        assert beyond(region(inner), region(outer)), (inner, outer)
    assert "1 x[0] + 1 x[1] <= 1 " in beyond(region(square), region(diamond))


def test_unbounded_missing_and_misfit_regions_are_named():
    plane, driven = qpmhe.models.van_der_pol()[0], qpmhe.models.cstr()[0]
    for system, states, inputs, words in (
        (plane, box([0.0, 0.0], [1.0, np.inf]), None, r"unbounded in x\[1\]"),
        (plane, None, None, "there is no region"), (plane, unit_box(3), None, "dimension 3"),
        (plane, qpmhe.Polytope([[1, 0], [-1, 0], [0, 1]], [1] * 3), None, "unbounded"),
        (plane, unit_box(2), unit_box(1), "system has none"),
        (driven, unit_box(2), None, "has inputs"),
    ):
        with pytest.raises(SetError, match=words):
            bounded_region(system, states, inputs)
