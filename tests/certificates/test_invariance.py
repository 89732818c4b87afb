"""Regions: boxes around sets, containment, invariance, and room for the observer."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import Evidence
from qpmhe.certificates.invariance import certify_invariance, inner_region
from qpmhe.certificates.regions import beyond, bounded_region
from qpmhe.errors import SetError

from .helpers import box, linear, scalar, unit_box

TURN = np.pi / 6
ROTATION = 0.9 * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
DIRECTIONS = np.arange(8) * np.pi / 4
OCTAGON = qpmhe.Polytope(np.column_stack((np.cos(DIRECTIONS), np.sin(DIRECTIONS))), np.ones(8))


def test_known_regions_stay_or_are_left():
    found = certify_invariance(linear(1.5, 1.0), unit_box(1))
    assert (found.holds, found.evidence) == (False, Evidence.PROVED)
    assert found.text == "f reaches x1 = -1.5 through the face x1 >= -1, from x = [-1.0]"
    for disturbance, holds in ((0.0, True), (0.4999999, True), ([0.4999999], True), (0.51, False)):
        found = certify_invariance(linear(0.5, 1.0), unit_box(1), disturbance=disturbance)
        assert (found.holds, "disturbances" in found.text) == (holds, not holds)
    # A polytope may stay where its box does not.
    turning = linear(ROTATION, [[1.0, 0.0]])
    assert certify_invariance(turning, OCTAGON).holds is True
    assert certify_invariance(turning, unit_box(2)).holds is False
    driven = qpmhe.System(lambda x, u: 0.5 * x + u, lambda x, u: x, n=1, p=1, m=1)
    for width, holds in ((0.49, True), (0.51, False)):
        found = certify_invariance(driven, unit_box(1), inputs=box(-width, width))
        assert found.holds is holds
    assert "u = [" in found.text
    # 0.35 fills a tank to 1.3611: 0.3 sqrt(x) flows out.
    tank, level = scalar(lambda x: x + 0.2 * (0.35 - 0.3 * np.sqrt(x))), (0.35 / 0.3) ** 2
    for top, holds in ((1.001 * level, True), (0.999 * level, False)):
        assert certify_invariance(tank, box(0.2, top)).holds is holds


def test_what_has_no_enclosure_or_no_end_is_not_known():
    found = certify_invariance(scalar(lambda x: np.array([0.5 * float(x[0])])), unit_box(1))
    assert (found.holds, found.evidence) == (None, None)
    assert "not known" in found.text
    bent = scalar(lambda x: 0.9 - 0.5 * (x - 0.3) ** 2)  # which no sample shows to leave
    assert not certify_invariance(bent, unit_box(1), disturbance=0.1 + 1e-9, seconds=2.0).holds
    # The side is touched, but not left: no cell there is ever shown.
    touching = scalar(lambda x: 1.0 - 0.5 * (x - 0.3) ** 2)
    found = certify_invariance(touching, unit_box(1), seconds=2.0)
    assert found.holds is None
    assert found.cells > 10


def test_observer_stays_in_the_region_while_the_state_is_in_the_inner_one():
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    region = bounded_region(linear(ROTATION, [[1.0, 0.0]]), OCTAGON)
    inner, rng = inner_region(region, P, 0.25), np.random.default_rng(5)
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


def test_containment_of_boxes_and_polytopes():
    def region(states):
        return bounded_region(linear(0.5 * np.eye(2), np.eye(2)), states)

    square, small, wide = unit_box(2), box([-0.4] * 2, [0.4] * 2), box([-2.0] * 2, [2.0] * 2)
    diamond = qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], [1.0] * 4)
    for inner, outer in ((small, square), (diamond, wide & diamond), (diamond & small, diamond)):
        assert beyond(region(inner), region(outer)) == "", (inner, outer)
    assert beyond(region(diamond), region(box([-0.9] * 2, [0.9] * 2)))
    assert "1 x[0] + 1 x[1] <= 1 " in beyond(region(square), region(diamond))


def test_unbounded_missing_and_misfit_regions_are_named():
    plane, driven = qpmhe.models.van_der_pol()[0], qpmhe.models.cstr()[0]
    open_triangle = qpmhe.Polytope([[1, 0], [-1, 0], [0, 1]], [1] * 3)
    for system, states, words in (
        (plane, box([0.0, 0.0], [1.0, np.inf]), r"unbounded in x\[1\]"),
        (plane, None, "there is no region"), (plane, unit_box(3), "dimension 3"),
        (plane, open_triangle, "unbounded"), (driven, unit_box(2), "has inputs"),
    ):
        with pytest.raises(SetError, match=words):
            bounded_region(system, states)
