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
