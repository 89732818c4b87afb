"""What a projection onto X, in P, makes of each component's bound; by adversaries."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import Evidence, Monitor, Sizes
from qpmhe.certificates.faces import Faces
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.regions import Region
from qpmhe.errors import InvalidInputError
from qpmhe.observers.projection import NearestPoint

from .helpers import box, linear, unit_cost

FREE = np.inf


def metric_of(n, rng):
    root = rng.standard_normal((n, n)) + 0.5 * np.eye(n)
    units = 10.0 ** rng.uniform(-2.0, 2.0, n)
    return (root.T @ root) / np.outer(units, units), units


def faces_of(X, region, P, radius):
    slopes = np.sqrt(np.linalg.inv(P).diagonal())
    return Faces(X, Region(region, region.lower, region.upper), P, slopes * (1.0 + 1e-12), radius)


@pytest.mark.parametrize("sides", [1, 2, 3])
def test_no_projection_leaves_the_bounds(sides):
    """Of pairs of a truth in X and any prediction in ball and box, in any units."""
    rng, nearest_to_one = np.random.default_rng(sides), 0.0
    for k in range(16):
        n = 3
        P, units = metric_of(n, rng)
        upper = np.where(np.arange(n) < sides, units, FREE)
        X, region = box(-upper, upper), box(-units, units)
        narrow = rng.uniform(0.2, 1.0, n) * units
        errors = rng.uniform(-1.0, 1.0, (100, n)) * narrow
        if k % 2:  # on the sides of the box
            errors = np.where(rng.random(errors.shape) < 0.5, narrow * np.sign(errors), errors)
        radius = float(np.sqrt(np.einsum("ki,ij,kj->k", errors, P, errors)).max())
        faces = faces_of(X, region, P, radius)
        assert set(faces.block) <= set(range(sides))
        before = np.append(np.abs(errors), np.abs(errors @ faces.directions.T), axis=1)
        after, oblique = faces.projected(before.max(axis=0), radius)
        nearest, covariance = NearestPoint(X), np.linalg.inv(P)
        covariance = 0.5 * (covariance + covariance.T)
        truths = np.clip(rng.uniform(-1.3, 1.3, errors.shape), -1.0, 1.0) * units
        found = np.array([
            x - nearest(x - e, covariance).point for x, e in zip(truths, errors, strict=True)])
        assert (np.abs(found) <= after * (1.0 + 1e-9)).all()
        if faces.block.size:
            assert (np.abs(found @ faces.directions.T) <= oblique * (1.0 + 1e-9)).all()
        if sides == 1 and faces.block.size:
            nearest_to_one = max(nearest_to_one, (np.abs(found).max(axis=0) / after)[1:].max())
    assert sides > 1 or nearest_to_one > 0.95


def test_a_component_whose_bound_acts_alone_comes_no_farther():
    """|e_1| shrinks, and e_2 ends between itself and where e_1 is 0: both ends are reached."""
    P = np.array([[2.0, 1.9], [1.9, 2.0]])
    X, region = box([-FREE, -FREE], [0.0, FREE]), box([-2.0, -2.0], [0.0, 2.0])
    e = np.array([-1.0, -0.05])  # of the truth 0 and the prediction (1, 0.05)
    radius = float(np.sqrt(e @ P @ e))
    faces = faces_of(X, region, P, radius)
    np.testing.assert_allclose(faces.directions, [[0.95, 1.0]], rtol=1e-15)
    after, _ = faces.projected(np.array([1.0, 0.05, 0.95 + 0.05]), radius)
    np.testing.assert_allclose(after, [1.0, 1.0], rtol=1e-12)
    # In a narrower box, less than the ball allows.
    after, oblique = faces.projected(np.array([0.1, 0.05, 0.145]), radius)
    np.testing.assert_allclose(np.append(after, oblique), [0.1, 0.145, 0.145], rtol=1e-12)
    assert after[1] < faces_ball(P, radius)[1]


def faces_ball(P, radius):
    return radius * np.sqrt(np.linalg.inv(P).diagonal())


def test_faces_that_may_be_active_decide():
    """None beyond the ball's reach; the ball alone where rows or others' bounds may be active."""
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    region, reached = box([-1.0, -1.0], [1.0, 1.0]), np.array([0.1, 0.2, 0.15])
    slopes = np.sqrt(np.linalg.inv(P).diagonal())
    far = faces_of(box([-1.5, -FREE], [1.5, FREE]), region, P, 0.5)
    assert not far.reached
    after, _ = far.projected(reached[:2], 0.5)
    np.testing.assert_array_equal(after, reached[:2])
    near = 0.5 / slopes[0]
    assert not far.projected(reached[:2], 0.999 * near)[0].max() > 0.2
    np.testing.assert_allclose(far.projected(reached[:2], 1.001 * near)[0], 1.001 * near * slopes)
    slanted = qpmhe.Polytope([[1.0, 1.0]], [2.1])
    assert faces_of(slanted, region, P, 0.5).reached
    np.testing.assert_allclose(
        faces_of(slanted, region, P, 0.5).projected(reached[:2], 0.5)[0], 0.5 * slopes)
    # The row (1, 1) is 0.1 away from the region: beyond smaller balls.
    assert not faces_of(slanted, region, P, 0.9 * 0.1 / np.sqrt(np.linalg.inv(P).sum())).reached
    # Predictions farther from X than X is wide are projected by themselves: the ball alone counts.
    small = box([-1.0, -1.0], [1.0, 1.0])
    wide = float(np.sqrt(np.full(2, 2.0) @ np.abs(P) @ np.full(2, 2.0)))
    np.testing.assert_allclose(
        faces_of(small, region, P, wide).projected(np.array([0.1, 0.2]), wide)[0], wide * slopes)


# Of an observer that runs


def charging(states):
    """A slow state with bounds, and two fast ones that the output has as well."""
    decay = np.array([0.97, 0.7, 0.85])
    return qpmhe.System(
        lambda x: x * decay + 0.02 * np.sin(x[..., 1:2]) * np.array([1.0, 0.0, 1.0]),
        lambda x: x[..., :1] + 0.1 * x[..., :1] ** 3 + x[..., 1:2] + x[..., 2:], n=3, p=1,
        states=states)


@pytest.fixture(scope="module")
def projected():
    """A bound of which projections count, and the half-widths of w and v."""
    X, w, v = box([-FREE, -FREE, -FREE], [0.3, FREE, FREE]), [0.01, 0.004, 0.002], [0.1]
    region = box([-0.3, -0.5, -0.5], [0.3, 0.5, 0.5])
    bound = bound_observer(
        charging(X), qpmhe.Luenberger([[0.35], [0.02], [-0.05]]), unit_cost(3), region,
        sizes=Sizes(*(box(-np.array(each), each) for each in (w, v))), seconds=300.0)
    assert bound.evidence is Evidence.PROVED
    assert not bound.unprojected
    tubes, entering, added = [bound.begun(0.0)], bound.entering(), bound.added()
    for _ in range(60):
        tubes.append(bound.followed(tubes[-1], entering, added, projected=True))
    return bound, tubes[1:]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["adjoint", "greedy", "random"])
def test_no_adversary_leaves_the_bounds_of_a_projected_observer(projected, kind, pytestconfig):
    (bound, tubes), runs = projected, 4000 if pytestconfig.option.all else 800
    steps = len(tubes)
    system, L, rng = bound.stability.system, bound.gain, np.random.default_rng(len(kind))
    top, n = system.states.upper[0], system.n
    covariance = np.linalg.inv(bound.metric)
    middle = np.zeros((1, n))
    closed = np.asarray(system.f_jacobian.batch(middle, np.zeros((1, 0))))[0] - L @ np.asarray(
        system.h_jacobian.batch(middle, np.zeros((1, 0))))[0]
    rows = np.eye(n)[np.arange(runs) % n] * np.where(np.arange(runs) % 2, 1.0, -1.0)[:, None]
    along = [rows]
    for _ in range(steps - 1):
        along.append(along[-1] @ closed)
    x = rng.uniform(-1.0, 1.0, (runs, n)) * np.array([0.3, 0.1, 0.1])
    x[::2, 0] = top  # near the side
    z, none = x.copy(), np.zeros((runs, 0))
    alive, acted, largest = np.ones(runs, np.bool_), 0, np.zeros(n)
    w_most, v_most = bound.sizes.disturbance.upper, bound.sizes.noise.upper
    for t, tube in enumerate(tubes):
        e = x - z
        directions = {
            "adjoint": along[steps - 1 - t], "greedy": np.sign(e + 1e-9 * rows),
            "random": rng.standard_normal((runs, n))}[kind]
        w, v = np.sign(directions) * w_most, -np.sign(directions @ L) * v_most
        alive &= bound.region.contains(x) & bound.region.contains(z)
        fit = system.h.batch(x, none) + v - system.h.batch(z, none)
        z = system.f.batch(z, none) + fit @ L.T
        ahead = system.f.batch(x, none)
        w[:, 0] = np.minimum(w[:, 0], top - ahead[:, 0])  # the truth stays in X
        alive &= (np.abs(w) <= w_most).all(axis=1)
        x = ahead + w
        beyond = np.maximum(z[:, :1] - top, 0.0)
        acted += int(((beyond[:, 0] > 0.0) & alive).sum())
        z = z - beyond * covariance[0] / covariance[0, 0]  # the nearest point in P
        alive &= bound.region.contains(x)
        e = np.abs(x - z)[alive]
        assert (e <= tube.box * (1.0 + 1e-12)).all()
        assert (np.abs((x - z)[alive] @ bound.rowwise.faces.directions.T)
                <= tube.oblique * (1.0 + 1e-12)).all()
        largest = np.maximum(largest, e.max(axis=0, initial=0.0))
    assert alive.sum() > runs // 4
    assert acted > runs // 2
    assert (largest <= bound.settled.box).all()
    if kind == "adjoint":
        assert (largest > 0.4 * bound.settled.box).all()


def test_the_box_counts_in_advance_where_projections_act(projected):
    bound, tubes = projected
    faces = bound.rowwise.faces
    assert faces.block.tolist() == [0]
    ball = bound.components(bound.limit())
    assert (bound.settled.box < ball).all()
    # Near the limits where no projection acts.
    entering, added, tube = bound.entering(), bound.added(), bound.settled
    for _ in range(300):
        tube = bound.followed(tube, entering, added, projected=False)
    assert (bound.settled.box <= 1.3 * tube.box).all()
    assert "while x stays in the region" in bound.headline
    assert not bound.begins_within
    assert (tubes[-1].box <= bound.settled.box).all()


@pytest.mark.slow
def test_a_run_with_projections_has_the_bounds_of_its_monitor(projected):
    """The true states are within them."""
    bound, _ = projected
    system, rng, steps = bound.stability.system, np.random.default_rng(5), 60
    w_most, v_most = bound.sizes.disturbance.upper, bound.sizes.noise.upper
    x, measurements = [np.array([0.3, 0.0, 0.0])], []
    for _ in range(steps):
        measurements.append(system.h(x[-1]) + rng.uniform(-1.0, 1.0, 1) * v_most)
        x.append(np.minimum(system.f(x[-1]) + rng.uniform(-1.0, 1.0, 3) * w_most, 0.3))

    def estimator():
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(bound.gain, metric=bound.metric), unit_cost(3), horizon=2,
            initial_state=x[0])

    mhe = estimator()
    watch = Monitor(bound, mhe, initial_error=0.0)
    readings = [watch.check(mhe.update(y)) for y in measurements]
    run = estimator().run(np.array(measurements))
    band = bound.along(run, initial_error=0.0)
    assert (watch.lost, band.lost) == (None, None)
    assert (run.flags & qpmhe.Status.OBSERVER_PROJECTED.value).any()
    for name in ("radius", "lower", "upper", "error"):
        found = [getattr(one, name) for one in readings]
        np.testing.assert_allclose(getattr(band, name)[1:], found, rtol=1e-9)
    assert ((band.lower <= x) & (np.array(x) <= band.upper)).all()


def test_a_monitor_continues_beside_other_directions():
    """Of another search, or of before there were any: what they bound follows from the box."""
    def bound(side):
        return bound_observer(
            linear(np.diag([0.9, 0.5]), [[1.0, 0.0]], states=box([-1.0, -1.0], [1.0, 1.0])),
            qpmhe.Luenberger([[0.3], [0.0]]), unit_cost(2), box([-1.0, -side], [1.0, side]),
            sizes=Sizes(0.01, 0.02), seconds=3000.0)

    one, other = bound(0.5), bound(1.0)
    assert one.directions.shape != other.directions.shape
    mhe = qpmhe.MovingHorizonEstimator(
        one.stability.system, qpmhe.Luenberger(one.gain), unit_cost(2), horizon=2,
        initial_state=np.zeros(2))
    made, state = (Monitor(each, mhe, initial_error=0.1) for each in (other, one))
    state = state.state_dict()
    former = {name: each for name, each in state.items() if name not in ("oblique", "directions")}
    for given in (state, former):
        made.load_state_dict(given)
        found = made.state_dict()
        np.testing.assert_array_equal(found["oblique"], other.tube(1.0, found["box"]).oblique)
    same = Monitor(one, mhe, initial_error=0.1)
    with pytest.raises(InvalidInputError, match="along directions"):
        same.load_state_dict(state | {"oblique": -state["oblique"] - 1.0})


def test_a_bound_that_a_larger_ball_reaches_counts_until_the_bounds_have_settled():
    """X begins a little beyond the limit's reach, and within that of 1.05 limits."""
    def bound(X):
        return bound_observer(
            linear(np.diag([0.9, 0.5]), [[1.0, 0.0]], states=X), qpmhe.Luenberger([[0.3], [0.0]]),
            unit_cost(2), box([-1.0, -0.5], [1.0, 0.5]), sizes=Sizes(0.01, 0.02), seconds=3000.0)

    near = bound(box([-1.0, -0.5], [1.0, 0.5]))
    top = 0.5 + 1.02 * float(near.slopes[1]) * near.limit()
    beside = bound(box([-FREE, -top], [FREE, top]))
    assert beside.unprojected
    samples = beside.settling_samples
    tube = beside.begun(box(-beside.widths, beside.widths))
    entering, added = beside.entering(), beside.added()
    for _ in range(samples):
        tube = beside.followed(tube, entering, added, projected=True)
    assert (tube.box <= 1.1 * beside.settled.box).all()
