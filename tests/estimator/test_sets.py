import numpy as np
import pytest

import qpmhe
from qpmhe.errors import SetError


def distance_outside(box, points):
    worst = 0.0
    for point in points.reshape(-1, box.dimension):
        for value, low, high in zip(point, box.lower, box.upper, strict=True):
            worst = max(worst, low - value, value - high)
    return worst


@pytest.mark.parametrize("lead", [(), (1,), (7,), (3, 4)])
@pytest.mark.parametrize("d", [1, 2, 5])
def test_violation_is_the_largest_distance_outside(d, lead):
    generator = np.random.default_rng(d)
    for _ in range(20):
        lower = generator.standard_normal(d)
        upper = lower + generator.exponential(size=d)
        lower[generator.random(d) < 0.3] = -np.inf
        upper[generator.random(d) < 0.3] = np.inf
        box = qpmhe.Box(lower, upper)
        points = 1.5 * generator.standard_normal((*lead, d))
        assert box.violation(points) == distance_outside(box, points)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([0.0, 5.0], 0.0),
        ([-1.0, 1.0], 0.0),
        ([1.0, 1e300], 0.0),
        ([1.5, 5.0], 0.5),
        ([-3.0, 5.0], 2.0),
        ([0.0, 0.75], 0.25),
        ([-3.0, 0.0], 2.0),
        ([1.25, -3.0], 4.0),
    ],
)
def test_the_boundary_is_inside(point, expected):
    assert qpmhe.Box([-1.0, 1.0], [1.0, np.inf]).violation(np.array(point)) == expected


def test_nan_is_not_inside():
    box = qpmhe.Box([0.0, 0.0], [1.0, 1.0])
    assert not box.violation(np.array([[0.5, np.nan], [0.5, 0.5]])) <= 0.0


def test_a_box_may_be_a_point_or_everything():
    point = qpmhe.Box([0.0, 2.0], [0.0, 2.0])
    assert point.violation(np.array([0.0, 2.0])) == 0.0
    assert point.violation(np.array([0.0, 2.5])) == 0.5
    assert qpmhe.Box([-np.inf], [np.inf]).violation(np.array([1e300])) == 0.0


def test_scalars_bound_one_component():
    box = qpmhe.Box(-1, 2)
    assert box.dimension == 1
    assert box.violation(np.array([[3.5]])) == 1.5


def test_bounds_are_copies():
    lower, upper = np.zeros(2), np.ones(2)
    box = qpmhe.Box(lower, upper)
    lower[0], upper[0] = -9.0, 9.0
    np.testing.assert_array_equal(box.lower, [0.0, 0.0])
    np.testing.assert_array_equal(box.upper, [1.0, 1.0])


def test_a_box_shows_its_bounds():
    assert repr(qpmhe.Box([0, -np.inf], [1, 2])) == "Box(lower=[0.0, -inf], upper=[1.0, 2.0])"


@pytest.mark.parametrize("component", [0, 1, 2])
def test_the_empty_component_is_named(component):
    lower, upper = np.zeros(3), np.ones(3)
    lower[component] = 1.5
    with pytest.raises(SetError) as caught:
        qpmhe.Box(lower, upper)
    assert f"component {component} has lower 1.5 and upper 1.0" in str(caught.value)
    assert "lower <= upper" in str(caught.value)


# Polytopes and intersections


def plain_violation(one, point):
    """From the definition: what is missing in each inequality, one by one."""
    worst = 0.0
    for value, low, high in zip(point, one.lower, one.upper, strict=True):
        worst = max(worst, low - value, value - high)
    for row, low, high in zip(one.matrix, one.row_lower, one.row_upper, strict=True):
        value = sum(a * b for a, b in zip(row, point, strict=True))
        worst = max(worst, low - value, value - high)
    return worst


def random_polytope(generator, d, rows):
    """Rows in random directions that the origin satisfies."""
    matrix = generator.standard_normal((rows, d))
    return qpmhe.Polytope(matrix, generator.exponential(size=rows))


@pytest.mark.parametrize("lead", [(), (1,), (7,), (3, 4)])
@pytest.mark.parametrize(("d", "rows"), [(1, 1), (2, 3), (4, 2), (3, 7)])
def test_a_polytope_is_missed_by_its_worst_row(d, rows, lead):
    generator = np.random.default_rng(10 * d + rows)
    inside = []
    for _ in range(20):
        matrix, bound = generator.standard_normal((rows, d)), generator.exponential(size=rows)
        polytope = qpmhe.Polytope(matrix, bound)
        points = 0.7 * generator.standard_normal((*lead, d))
        expected = max(
            max(0.0, *(matrix @ point - bound)) for point in points.reshape(-1, d)
        )
        assert polytope.violation(points) == pytest.approx(expected, rel=1e-12, abs=1e-14)
        inside.append(expected == 0.0)
    assert False in inside
    assert lead or True in inside


def test_the_parts_of_a_polytope():
    polytope = qpmhe.Polytope([[1.0, -2.0], [0.0, 3.0], [0.0, -1.0]], [4.0, 5.0, 6.0])
    assert polytope.dimension == 2
    np.testing.assert_array_equal(polytope.matrix, [[1.0, -2.0], [0.0, 3.0], [0.0, -1.0]])
    np.testing.assert_array_equal(polytope.row_upper, [4.0, 5.0, 6.0])
    assert np.all(polytope.row_lower == -np.inf)
    assert polytope.bounded_components.size == polytope.fixed_components.size == 0
    assert "3 rows" in repr(polytope)
    assert repr(polytope).startswith("Polytope(")


def test_a_single_row_may_be_a_vector():
    polytope = qpmhe.Polytope([1.0, 2.0], 3.0)
    assert polytope.matrix.shape == (1, 2)
    assert polytope.violation(np.array([1.0, 1.0])) == 0.0
    assert polytope.violation(np.array([2.0, 1.0])) == 1.0


def test_the_numbers_of_a_polytope_are_copies():
    matrix, bound = np.eye(2), np.ones(2)
    polytope = qpmhe.Polytope(matrix, bound)
    matrix[0, 0], bound[0] = 9.0, 9.0
    np.testing.assert_array_equal(polytope.matrix, np.eye(2))
    np.testing.assert_array_equal(polytope.row_upper, [1.0, 1.0])


@pytest.mark.parametrize("component", [0, 1])
def test_nan_is_in_no_polytope(component):
    point = np.array([0.0, 0.0])
    point[component] = np.nan
    assert not qpmhe.Polytope([[1.0, 1.0]], [1.0]).violation(point) <= 0.0


def test_components_of_a_box():
    box = qpmhe.Box([-np.inf, 0.0, -1.0, -np.inf], [np.inf, 0.0, np.inf, 2.0])
    np.testing.assert_array_equal(box.bounded_components, [1, 2, 3])
    np.testing.assert_array_equal(box.fixed_components, [1])
    assert box.matrix.shape == (0, 4)


@pytest.mark.parametrize("kinds", ["bb", "bp", "pb", "pp", "bpp", "pbb"])
def test_a_point_is_in_an_intersection_as_far_as_in_each_part(kinds):
    generator = np.random.default_rng(3)
    seen = set()
    for _ in range(30):
        parts = []
        for kind in kinds:
            lower = np.where(generator.random(3) < 0.3, -np.inf, -generator.exponential(size=3))
            upper = np.where(generator.random(3) < 0.3, np.inf, generator.exponential(size=3))
            parts.append(
                qpmhe.Box(lower, upper) if kind == "b" else random_polytope(generator, 3, 2)
            )
        both = parts[0]
        for part in parts[1:]:
            both = both & part
        assert both.dimension == 3
        assert both.matrix.shape == (2 * kinds.count("p"), 3)
        point = 0.6 * generator.standard_normal(3)
        expected = max(plain_violation(part, point) for part in parts)
        assert both.violation(point) == pytest.approx(expected, rel=1e-12, abs=1e-14)
        seen.add(expected > 0.0)
    assert seen == {True, False}


def test_intersections_leave_their_parts_alone():
    box, polytope = qpmhe.Box([-1.0, -2.0], [1.0, np.inf]), qpmhe.Polytope([[1.0, 1.0]], [1.5])
    both = box & polytope & qpmhe.Box([-9.0, -1.0], [0.5, 9.0])
    assert isinstance(both, qpmhe.ConvexSet)
    np.testing.assert_array_equal(both.lower, [-1.0, -1.0])
    np.testing.assert_array_equal(both.upper, [0.5, 9.0])
    np.testing.assert_array_equal(box.upper, [1.0, np.inf])
    assert box.matrix.shape == (0, 2)
    np.testing.assert_array_equal(polytope.lower, [-np.inf, -np.inf])


def test_sets_that_only_touch_are_not_empty():
    point = qpmhe.Box([0.0], [1.0]) & qpmhe.Box([1.0], [2.0])
    np.testing.assert_array_equal(point.fixed_components, [0])
    corner = qpmhe.Box([0.0, 0.0], [1.0, 1.0]) & qpmhe.Polytope([[-1.0, -1.0]], [-2.0])
    assert corner.violation(np.array([1.0, 1.0])) == 0.0


def test_inequalities_on_unknown_components_do_not_count():
    one = qpmhe.Box([-1.0, -2.0, -3.0], [1.0, 2.0, np.inf]) & qpmhe.Polytope(
        [[1.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 1.0, 1.0]], [2.5, 2.0, 3.0]
    )
    # Component 0 is out by 6, 1 by 2, 2 by 4; the rows by 8.5, 5 and 1.
    point = np.array([7.0, 4.0, -7.0])
    known = {
        (True, True, True): 8.5,
        (True, True, False): 8.5,
        (True, False, True): 6.0,
        (False, True, True): 5.0,
        (False, False, True): 5.0,
        (False, True, False): 2.0,
        (True, False, False): 6.0,
        (False, False, False): 0.0,
    }
    for mask, expected in known.items():
        assert one.violation(point, np.array(mask)) == expected
    masks = np.array([[False] * 3, [False, True, False], [False] * 3])
    assert one.violation(np.tile(point, (3, 1)), masks) == 2.0
    rows = one.touched(np.array([[True, False, False], [False, False, True], [False] * 3]))
    np.testing.assert_array_equal(
        rows, [[True, False, True], [False, True, True], [False, False, False]]
    )
