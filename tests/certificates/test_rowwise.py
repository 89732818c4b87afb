"""Bounds of single components against what is exact, and against adversaries of each component."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import Evidence, Monitor, Sizes, load, save
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.rowwise import RowwiseStep

from .helpers import box, linear, unit_cost


def bound_of(system, gain, region, w, v, **options):
    """The certified bound of a Luenberger observer, for boxes or lengths of these sizes."""
    sizes = Sizes(*(box(-np.array(s), np.array(s)) if np.ndim(s) else s for s in (w, v)))
    return bound_observer(
        system, qpmhe.Luenberger(gain), unit_cost(system.n, system.p), region, sizes=sizes,
        seconds=300.0, **options,
    )


def worst(M, G, L, w, v):
    """The exact limits of |e_i| of e+ = M e + G w - L v, for w and v in boxes."""
    power, total = np.eye(len(M)), np.zeros(len(M))
    for _ in range(5000):
        total += np.abs(power @ G) @ w + np.abs(power @ L) @ v
        power = M @ power
    return total


def test_single_components_have_their_exact_limits():
    """Of decoupled states nothing is lost, whatever their units and rates."""
    scale = np.array([1e-2, 1.0, 1e2])
    M, gain = np.diag([0.1, 0.5, 0.99]), np.diag(np.zeros(3))
    w = 0.01 * scale * np.array([5.0, 1.0, 0.02])
    bound = bound_of(linear(M, np.eye(3)), gain, box(-scale, scale), w, np.zeros(3))
    exact = worst(M, np.eye(3), gain, w, np.zeros(3))
    assert bound.evidence is Evidence.PROVED
    assert (exact <= bound.settled.box).all()
    assert (bound.settled.box <= 1.02 * exact).all()
    # The ball alone: one rate for all.
    assert bound.components(bound.limit())[0] > 3.0 * exact[0]
    after = bound.settling_samples
    assert 0.99**after * scale[2] <= 0.11 * exact[2]


@pytest.mark.slow
def test_a_stiff_state_is_bound_by_its_own_row():
    """A fast state beside a slow one, whose noise the observer takes in."""
    A, C = np.array([[0.02, 3.0], [0.0, 0.98]]), np.array([[0.0, 1.0]])
    L, w, v = np.array([[0.0], [0.1]]), np.array([1e-3, 1e-3]), np.array([0.02])
    bound = bound_of(linear(A, C), L, box([-4.0, -1.0], [4.0, 1.0]), w, v)
    exact = worst(A - L @ C, np.eye(2), L, w, v)
    ball = bound.components(bound.limit())
    assert (exact <= bound.settled.box).all()
    assert (bound.settled.box <= 1.3 * exact).all()
    assert (bound.settled.box <= ball).all()


@pytest.mark.parametrize("seed", range(6))
def test_random_linear_systems_stay_between_exact_and_ball(seed):
    rng = np.random.default_rng(seed)
    n, p = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    A = rng.standard_normal((n, n))
    A *= 0.85 / np.abs(np.linalg.eigvals(A)).max()
    G = np.eye(n) if seed % 2 else rng.standard_normal((n, 2))
    C, L = rng.standard_normal((p, n)), 0.02 * rng.standard_normal((n, p))
    system = linear(A, C, disturbance_matrix=None if seed % 2 else G)
    w, v = 0.01 * rng.uniform(size=G.shape[1]), 0.01 * rng.uniform(size=p)
    bound = bound_of(system, L, box(-np.ones(n), np.ones(n)), w, v)
    exact, found = worst(A - L @ C, G, L, w, v), bound.settled.box
    assert (exact <= found).all()
    assert (found <= bound.components(bound.limit())).all()
    # Signals of each sample count by themselves, not by their box.
    ws, vs = rng.uniform(-w, w, (5, len(w))), rng.uniform(-v, v, (5, p))
    each = bound.added(ws, vs)
    np.testing.assert_allclose(each, np.abs(ws @ G.T) + np.abs(vs @ L.T), rtol=1e-12, atol=1e-15)
    assert (each <= bound.added()).all()


def test_supports_of_lengths_boxes_and_polytopes():
    M, L = 0.5 * np.eye(2), np.array([[0.3, -0.4], [0.0, 0.2]])
    system = linear(M, np.eye(2))
    bound = bound_of(system, 0.1 * np.eye(2), box([-9.0, -9.0], [9.0, 9.0]), 0.3, 0.2)
    np.testing.assert_allclose(bound.added(), 0.3 + 0.1 * 0.2, rtol=1e-12)
    slanted = qpmhe.Polytope([[1.0, 1.0], [-1.0, -1.0]], [0.1, 0.1]) & box([-1.0, -1.0], [1.0, 1.0])
    step = RowwiseStep(system, bound.region, L, np.eye(2))
    found = step.added(slanted, slanted)
    # Of the vertices of the set, (1, -0.9) and (-1, 0.9) are the farthest for each row.
    vertices = np.array([[1.0, -0.9], [-0.9, 1.0], [1.0, -1.0], [-1.0, 1.0]])
    exact = 1.0 + np.abs(vertices @ L.T).max(axis=0)
    np.testing.assert_allclose(found, exact, rtol=1e-9)
    assert (found >= exact).all()
    away = step.added(box([0.5, 0.0], [1.0, 0.0]), 0.0)
    np.testing.assert_allclose(away, [1.0, 0.0], atol=1e-15)


# Adversaries


def fitzhugh_nagumo():
    system = qpmhe.System(
        lambda x: np.stack([
            x[..., 0] + 0.1 * (x[..., 0] - x[..., 0] ** 3 / 3 - x[..., 1] + 0.5),
            x[..., 1] + 0.008 * (x[..., 0] + 0.7 - 0.8 * x[..., 1])], -1),
        lambda x: x[..., :1], n=2, p=1)
    return system, [[0.6], [-0.3]], box([-2.5, -1.0], [2.5, 2.0]), [0.004, 0.002], [0.02], {}


def kinked():
    """Friction with a kink, seen through a kink, on a polytope."""
    system = qpmhe.System(
        lambda x: np.stack([
            0.8 * x[..., 0] + 0.1 * np.abs(x[..., 1]),
            0.7 * x[..., 1] - 0.1 * np.maximum(x[..., 0], 0.0)], -1),
        lambda x: x[..., :1] + 0.2 * np.abs(x[..., :1]), n=2, p=1)
    region = qpmhe.Polytope([[1.0, 1.0]], [1.5]) & box([-1.0, -1.0], [1.0, 1.0])
    return system, [[0.2], [0.0]], region, [0.01, 0.02], [0.02], {}


def with_inputs():
    """Inputs that multiply, and disturbances of one state, through a matrix."""
    system = qpmhe.System(
        lambda x, u: np.stack([
            0.9 * x[..., 0] + 0.1 * np.sin(x[..., 1]), (0.6 + 0.2 * u[..., 0]) * x[..., 1]], -1),
        lambda x, u: x[..., :1] * (1.0 + 0.1 * x[..., :1]), n=2, p=1, m=1,
        disturbance_matrix=[[0.1], [1.0]])
    region = box([-1.0, -1.0], [1.0, 1.0])
    return system, [[0.3], [0.1]], region, [0.05], 0.03, {"inputs": box([-1.0], [1.0])}


def three_states():
    system = qpmhe.System(
        lambda x: np.stack([
            0.1 * x[..., 0] + 2.0 * x[..., 1], 0.9 * x[..., 1] + 0.1 * np.tanh(x[..., 2]),
            0.8 * x[..., 2] - 0.05 * x[..., 1] ** 2], -1),
        lambda x: x[..., 1:], n=3, p=2)
    L = [[0.0, 0.0], [0.3, 0.1], [0.0, 0.2]]
    return system, L, box([-3.0, -1.0, -1.0], [3.0, 1.0, 1.0]), [0.01, 0.01, 0.01], [0.02, 0.01], {}


CASES = {each.__name__: each for each in (fitzhugh_nagumo, kinked, with_inputs, three_states)}


class Attack:
    """Many pairs of truth and observer at once, with every signal at its bounds."""

    def __init__(self, bound, runs, rng):
        self.bound, self.system, self.rng = bound, bound.stability.system, rng
        n, m = self.system.n, self.system.m
        points = bound.region.sample(4 * runs, rng)
        middle, points = points[0, :n], points[1:]
        away = (bound.region.upper - bound.region.lower)[:n]
        self.x = points[:runs, :n]
        # Some begin in the middle, where they stay longer.
        self.x = np.where(
            (np.arange(runs)[:, None] + 1) % 3 > 0, 0.4 * self.x + 0.6 * middle, self.x)
        self.reach = 0.1 * away
        self.z = self.x + self.reach * rng.choice([-1.0, 1.0, 0.0], self.x.shape)
        self.u = rng.choice([-1.0, 1.0], (runs, m)) if m else np.zeros((runs, 0))
        self.alive = np.ones(runs, np.bool_)
        G = self.system.disturbance_matrix
        self.G = np.eye(n) if G is None else G

    def size(self, name, directions):
        """Signals of this kind that go farthest along some directions."""
        size = getattr(self.bound.sizes, name)
        if isinstance(size, float):
            return size * directions / np.maximum(
                np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
        return np.where(directions > 0.0, size.upper, size.lower)

    def step(self, directions):
        """One sample; signals along these directions of e, (runs, n)."""
        f, h, u = self.system.f.batch, self.system.h.batch, self.u
        w = self.size("disturbance", directions @ self.G)
        v = self.size("noise", -directions @ self.bound.gain)
        inside = self.bound.region.contains
        self.alive &= inside(self.x) & inside(self.z)
        innovation = h(self.x, u) + v - h(self.z, u)
        self.x, self.z = f(self.x, u) + w @ self.G.T, f(self.z, u) + innovation @ self.bound.gain.T
        # A true state that leaves is no trajectory that the bound is about.
        self.alive &= inside(self.x)

    def adjoint(self, steps):
        """Directions (steps, runs, n) along which e moves a component at the end, linearised."""
        n, middle = self.system.n, 0.5 * (self.x + self.z)

        def phi(x):
            return self.system.f.batch(x, self.u) - self.system.h.batch(x, self.u) @ (
                self.bound.gain.T)

        M = np.stack([
            (phi(middle + each) - phi(middle - each)) / 2e-6 for each in 1e-6 * np.eye(n)
        ], axis=-1)
        end = np.eye(n)[self.rng.integers(n, size=len(M))] * self.rng.choice(
            [-1.0, 1.0], (len(M), 1))
        found = [end]
        for _ in range(steps - 1):
            found.append(np.einsum("kj,kji->ki", found[-1], M))
        return np.array(found[::-1])


@pytest.fixture(scope="module", params=CASES)
def case(request):
    system, gain, region, w, v, options = CASES[request.param]()
    bound = bound_of(system, gain, region, w, v, **options)
    assert bound.evidence is Evidence.PROVED
    assert bound.unprojected
    return bound


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["adjoint", "greedy", "random"])
def test_no_adversary_leaves_the_box(case, kind, pytestconfig):
    """Extreme, adjoint and random signals against every component, at all times."""
    runs, steps = 2_000 if pytestconfig.option.all else 600, 40
    rng = np.random.default_rng(len(kind))
    attack = Attack(case, runs, rng)
    tube = case.begun(box(-attack.reach, attack.reach))
    entering, added, n = case.entering(), case.added(), case.region.n
    directions = attack.adjoint(steps) if kind == "adjoint" else None
    nearest, counted = np.zeros(n), 0
    for t in range(steps):
        e = attack.x - attack.z
        chosen = {
            "adjoint": lambda t=t: directions[t], "greedy": lambda e=e: np.sign(e) * rng.choice(
                [0.0, 1.0], e.shape),
            "random": lambda e=e: rng.standard_normal(e.shape),
        }[kind]()
        attack.step(chosen)
        tube = case.followed(tube, entering, added, projected=False)
        e = np.abs(attack.x - attack.z)[attack.alive]
        counted += len(e)
        assert (e <= tube.box * (1.0 + 1e-12)).all()
        assert (case.length((attack.x - attack.z)[attack.alive])
                <= tube.radius * (1.0 + 1e-9)).all()
        if len(e):
            nearest = np.maximum(nearest, e.max(axis=0) / tube.box)
    assert counted > runs
    if kind == "adjoint":
        assert nearest.max() > 0.3  # the adversary is no straw man


@pytest.mark.slow
def test_the_settled_box_is_no_smaller_than_any_lasting_error(case):
    """From the truth's own start, signals that last bring no component beyond its limit."""
    rng = np.random.default_rng(3)
    attack = Attack(case, 400, rng)
    attack.z = attack.x.copy()
    directions, largest = attack.adjoint(60), np.zeros(case.region.n)
    for t in range(60):
        attack.step(directions[t])
        if attack.alive.any():
            e = np.abs(attack.x - attack.z)[attack.alive]
            largest = np.maximum(largest, e.max(axis=0))
    assert (largest <= case.settled.box).all()
    assert (largest > 0.15 * case.settled.box).any()


def test_near_the_observer_fewer_rows_occur(case):
    """Along a run, the box holds the truth, is within the one for all states, and often less."""
    system, n = case.stability.system, case.region.n
    rng, gained = np.random.default_rng(5), 0.0
    for _ in range(6):
        attack = Attack(case, 1, rng)
        start = box(-attack.reach, attack.reach)
        local = everywhere = case.begun(start)
        entering, added, directions = case.entering(), case.added(), attack.adjoint(15)
        for t in range(15):
            z, u = attack.z[0].copy(), attack.u[0]
            attack.step(directions[t])
            if not attack.alive[0]:
                break
            local = case.followed(local, entering, added, projected=False, observer=z, u=u)
            everywhere = case.followed(everywhere, entering, added, projected=False)
            assert (local.box <= everywhere.box * (1.0 + 1e-12)).all()
            assert (np.abs(attack.x - attack.z)[0] <= local.box).all()
            gained = max(gained, 1.0 - (local.box / everywhere.box).min())
    assert system.n == n
    assert gained > 0.01 or not case.rowwise.varies


# Projections


def test_a_projection_takes_the_box_back_to_the_ball():
    """Onto x1 <= 0 in P, it takes |e_2| from 0.05 to 0.95, and |e|_P falls."""
    P = np.array([[2.0, 1.9], [1.9, 2.0]])
    x, before = np.array([0.0, 0.0]), np.array([1.0, 0.05])
    # The nearest point with x1 = 0 in P.
    after = np.array([0.0, before[1] + P[1, 0] / P[1, 1] * before[0]])
    assert after @ P @ after < before @ P @ before
    assert abs(after[1] - x[1]) > 0.9 > 0.05

    A = np.array([[0.5, 0.1], [0.1, 0.6]])
    system = qpmhe.System(
        lambda x: x @ A.T + np.array([0.09, 0.0]), lambda x: x[..., :1], n=2, p=1,
        states=box([-2.0, -2.0], [0.2, 2.0]))
    region = system.states
    made = bound_of(system, [[0.4], [-0.2]], region, [0.05, 0.05], [0.3])
    observer = qpmhe.Luenberger(made.gain, metric=made.metric)
    bound = made.of_observer(observer, system)
    assert bound.projects
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, unit_cost(2), horizon=3, initial_state=[0.1, 0.0], max_qps=0)
    rng, x, states, outputs = np.random.default_rng(0), np.array([0.15, 0.0]), [], []
    for _ in range(60):
        states.append(x)
        outputs.append(x[:1] + rng.choice([-0.3, 0.3], 1))
        x = system.f(x, np.zeros(0))
        w = rng.choice([-0.05, 0.05], 2)
        w[0] = max(min(w[0], 0.2 - x[0]), -0.05)
        x = x + w
        assert x[0] <= 0.2
    run = mhe.run(outputs)
    acted = (run.flags & qpmhe.Status.OBSERVER_PROJECTED.value) != 0
    assert acted.sum() > 3
    band = bound.along(run, initial_error=box([-0.1, -0.1], [0.1, 0.1]))
    assert band.lost is None
    ball = bound.components(band.radius)
    half = 0.5 * (band.upper - band.lower)
    for t in np.flatnonzero(acted) + 1:
        assert (band.upper[t] - run.observer_states[t] >= np.minimum(
            ball[t], region.upper - run.observer_states[t]) * (1.0 - 1e-9)).all()
    assert (half[1:][~acted] < ball[1:][~acted] * (1.0 - 1e-3)).any()
    states = np.array([*states, x])
    assert ((band.lower <= states) & (states <= band.upper)).all()


def test_with_a_set_x_the_limit_needs_that_no_projection_acts():
    """Only where the observer is shown to stay in X do the components have limits of their own."""
    A, w, v = np.diag([0.1, 0.9]), [0.01, 0.01], [0.01]
    half = np.array([1.0, 1.0])
    inside = bound_of(linear(A, [[0.0, 1.0]], states=box(-half, half)), [[0.0], [0.1]],
                      box(-half, half), w, v)
    assert inside.inner is not None
    assert inside.unprojected
    assert inside.begins_within
    assert "from an initial error within the limit on" in inside.headline
    tight = bound_of(linear(A, [[0.0, 1.0]], states=box(-0.1 * half, 0.1 * half)),
                     [[0.0], [0.1]], box(-0.1 * half, 0.1 * half), [0.01, 0.02], v)
    assert tight.inner is None
    assert not tight.unprojected
    np.testing.assert_array_equal(
        tight.settled.box, np.minimum(tight.components(tight.limit()), 0.2 * half * (1 + 4e-15)))
    assert (inside.settled.box < inside.components(inside.limit())).any()


# What keeps it


@pytest.mark.slow
def test_files_and_pickles_keep_the_components(tmp_path):
    system, gain, region, w, v, _ = kinked()
    bound = bound_of(system, gain, region, w, v)
    save(bound, tmp_path / "kinked.json")
    found = load(tmp_path / "kinked.json", kinked()[0], qpmhe.Luenberger(gain))
    np.testing.assert_array_equal(found.settled.box, bound.settled.box)
    assert found.headline == bound.headline
    copied = pickle.loads(pickle.dumps(bound))
    tube = copied.followed(copied.begun(0.1), copied.entering(), copied.added(), projected=False)
    other = bound.followed(bound.begun(0.1), bound.entering(), bound.added(), projected=False)
    np.testing.assert_array_equal(tube.box, other.box)


def test_the_monitor_has_the_box_that_the_run_has():
    system, gain, region, w, v, _ = fitzhugh_nagumo()
    bound = bound_of(system, gain, region, w, v)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(gain), unit_cost(2), horizon=3, initial_state=[-1.0, 0.2],
        max_qps=1)
    start, rng, x, y = box([-0.1, -0.1], [0.1, 0.1]), np.random.default_rng(0), [-0.95, 0.15], []
    for _ in range(25):
        y.append(np.atleast_1d(x[0]) + rng.uniform(-0.02, 0.02, 1))
        x = system.f(np.asarray(x), np.zeros(0)) + rng.uniform(-1.0, 1.0, 2) * w
    watch = Monitor(bound, mhe, initial_error=start)
    readings = [watch.check(mhe.update(each)) for each in y[:12]]
    resumed = Monitor(bound, mhe, initial_error=start)
    resumed.load_state_dict(watch.state_dict())
    readings += [resumed.check(mhe.update(each)) for each in y[12:]]
    mhe.reset()
    band = bound.along(mhe.run(y), initial_error=start)
    for t, reading in enumerate(readings):
        np.testing.assert_allclose(reading.lower, band.lower[t + 1], rtol=1e-12)
        np.testing.assert_allclose(reading.upper, band.upper[t + 1], rtol=1e-12)
        assert reading.error == pytest.approx(band.error[t + 1], rel=1e-12)
    ball = replace(bound, rowwise=None).along(mhe.run(y), initial_error=start)
    assert (band.upper - band.lower <= (ball.upper - ball.lower) * (1.0 + 1e-12)).all()
    assert (band.upper - band.lower)[-1, 0] < 0.9 * (ball.upper - ball.lower)[-1, 0]
