"""Boxes, polytopes and intersections."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import SetError


def plain_violation(one, point):
    """From the definition: what is missing in each inequality, one by one."""
    worst = 0.0
    for value, low, high in zip(point, one.lower, one.upper, strict=True):
        worst = max(worst, low - value, value - high)
    for row, low, high in zip(one.matrix, one.row_lower, one.row_upper, strict=True):
        value = sum(a * b for a, b in zip(row, point, strict=True))
        worst = max(worst, low - value, value - high)
    return worst


@pytest.mark.parametrize("kinds", ["b", "p", "bb", "bpp", "pbb"])
def test_a_point_is_in_an_intersection_as_far_as_in_each_part(kinds):
    generator, seen = np.random.default_rng(3), set()
    for k in range(30):
        d, lead = int(generator.integers(1, 4)), [(), (1,), (7,), (3, 4)][k % 4]
        parts = []
        for kind in kinds:
            lower = np.where(generator.random(d) < 0.3, -np.inf, -generator.exponential(size=d))
            upper = np.where(generator.random(d) < 0.3, np.inf, generator.exponential(size=d))
            rows, side = generator.standard_normal((2, d)), generator.exponential(size=2)
            parts.append(qpmhe.Box(lower, upper) if kind == "b" else qpmhe.Polytope(rows, side))
        whole = parts[0]
        for part in parts[1:]:
            whole = whole & part
        points = 0.6 * generator.standard_normal((*lead, d))
        expected = max(
            plain_violation(part, point) for part in parts for point in points.reshape(-1, d)
        )
        assert whole.violation(points) == pytest.approx(expected, rel=1e-12, abs=1e-14)
        seen.add(expected > 0.0)
    assert seen == {True, False}


def test_components_that_are_bounded_and_fixed():
    given = np.zeros(2)
    box, polytope = qpmhe.Box(given, given + 1.0), qpmhe.Polytope(np.eye(2), given)
    given[:] = -9.0  # copies are kept
    assert (box.violation(given + 9.0), polytope.violation(given + 9.0)) == (0.0, 0.0)
    wide = qpmhe.Box([-np.inf, 0.0, -1.0, -np.inf], [np.inf, 0.0, np.inf, 2.0])
    np.testing.assert_array_equal(wide.bounded_components, [1, 2, 3])
    np.testing.assert_array_equal(wide.fixed_components, [1])
    # Sets that only touch are not empty.
    point = qpmhe.Box(0, 1) & qpmhe.Box([1.0], [2.0])
    np.testing.assert_array_equal(point.fixed_components, [0])
    corner = qpmhe.Box([0.0, 0.0], [1.0, 1.0]) & qpmhe.Polytope([-1.0, -1.0], -2.0)
    assert corner.violation(np.array([1.0, 1.0])) == 0.0


@pytest.mark.parametrize(("units", "row"), [((1e-9, 1e9), 1e-9), ((1e-12, 1e-9), 1e12)])
def test_whether_a_set_is_empty_depends_on_no_unit(units, row):
    units = np.array(units)
    matrix = row * np.array([[1.0, 1.0], [-1.0, -0.5], [0.0, -1.0]]) / units
    made = qpmhe.Polytope(matrix, row * np.array([1.0, -0.9, 0.0]))
    assert (made & qpmhe.Box(0.1 * units, units)).dimension == 2
    with pytest.raises(SetError, match="empty"):
        made & qpmhe.Box([-np.inf, 0.6 * units[1]], [np.inf, np.inf])
    with pytest.raises(SetError, match="empty"):
        qpmhe.Polytope(matrix, row * np.array([1.0, -1.2, 0.0]))


def test_inequalities_on_unknown_components_do_not_count():
    one = qpmhe.Box([-1.0, -2.0, -3.0], [1.0, 2.0, np.inf]) & qpmhe.Polytope(
        [[1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 1.0, 1.0]], [2.5, 2.0, 3.0]
    )
    # Component 0 is out by 6, 1 by 2, 2 by 4; the rows by 8.5, 5 and 1.
    point = np.array([7.0, 4.0, -7.0])
    for known, expected in (([1, 1, 0], 8.5), ([1, 0, 1], 6.0), ([0, 0, 1], 5.0), ([0] * 3, 0.0)):
        assert one.violation(point, np.array(known, bool)) == expected
    rows = one.touched(np.array([[True, False, False], [False, False, True], [False] * 3]))
    np.testing.assert_array_equal(rows, [[1, 0, 1], [0, 1, 1], [0, 0, 0]])
