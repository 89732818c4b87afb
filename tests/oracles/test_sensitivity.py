"""Derivatives of estimates, against differences of estimates that were converged again."""

import tracemalloc
from typing import NamedTuple

import numpy as np
import pytest
from estimator.untraced import untraced
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe.estimation.sensitivity import NAMES

# Of the largest entry of a derivative: differences of the fourth order reach less.
ACCURACY = 1e-6
STEP = 1e-4
MATRICES = "prior_weight", "disturbance_weight", "noise_weight"


class Data(NamedTuple):
    """All that an estimate is differentiated by, with the names of `Gradient`."""

    prior: np.ndarray
    measurements: np.ndarray
    inputs: np.ndarray
    parameters: np.ndarray
    prior_weight: np.ndarray
    disturbance_weight: np.ndarray
    noise_weight: np.ndarray
    discount: np.ndarray


class Case:
    """A pendulum with a torque and an unknown damping; keywords change one thing each.

    Parameters
    ----------
    cost : callable
        Makes a cost of the weights and the discount; quadratic if left out.
    observer : callable
        Makes an observer of the prior weight; constant gains if left out.
    sets : dict
        Of the system.
    samples, horizon : int
        Length of the record and of the window.
    """

    n, p, m, k = 2, 2, 1, 1

    def __init__(
        self, cost=None, observer=None, samples=7, horizon=7, discount=1.0, seed=1, options=None,
        prior=(0.85, 0.2), weights=None, update=None, **system,
    ):
        rng = np.random.default_rng(seed)
        self.make_cost = cost or (lambda P, Q, R, discount: qpmhe.QuadraticCost(
            prior=P, disturbance=Q, noise=R, discount=discount
        ))
        self.make_observer = observer or (lambda P: qpmhe.Luenberger(0.1 * np.eye(self.n, self.p)))
        self.horizon, self.system, self.options = horizon, system, options or {}
        self.update = update or {}
        x, Y = np.array([0.9, 0.3]), []
        U = 0.5 * rng.normal(size=(samples, self.m))
        for u in U:
            Y.append(self.output(x) + 0.3 * rng.normal(size=self.p))
            x = self.step(x, np.append(u, 0.3)) + 0.1 * rng.normal(size=2)
        chosen = {
            "prior": np.array([[4.0, 0.5], [0.5, 2.0]]),
            "disturbance": np.array([[30.0, 5.0], [5.0, 20.0]]),
            "noise": np.array([[9.0, -1.0], [-1.0, 6.0]]),
        } | (weights or {})
        self.data = Data(
            np.array(prior), np.array(Y), U, np.array([0.3]),
            chosen["prior"], chosen["disturbance"], chosen["noise"], np.array(discount),
        )

    @staticmethod
    def step(x, u):
        angle, rate = x[..., 0], x[..., 1]
        torque, damping = u[..., 0], u[..., 1]
        change = -4.0 * np.sin(angle) - damping * rate + torque
        return np.stack([angle + 0.1 * rate, rate + 0.1 * change], axis=-1)

    @staticmethod
    def output(x):
        return np.stack([np.sin(x[..., 0]) + 0.2 * x[..., 1] ** 2, x[..., 1]], axis=-1)

    def estimator(self, data):
        if self.made is None:
            self.made = self.make_system()
        mhe = qpmhe.MovingHorizonEstimator(
            self.made, self.make_observer(data.prior_weight),
            self.make_cost(
                data.prior_weight, data.disturbance_weight, data.noise_weight, float(data.discount)
            ),
            horizon=self.horizon, initial_state=data.prior, max_qps=None, tolerance=1e-10,
            parameters=data.parameters, **self.options,
        )
        for t, (y, u) in enumerate(zip(data.measurements, data.inputs, strict=True)):
            mhe.update(y, u, **self.update.get(t, {}))
        return mhe

    def make_system(self):
        return qpmhe.System(
            self.step, self.output, n=self.n, p=self.p, m=self.m + self.k, **self.system
        )

    def converged(self, data):
        """The minimiser, by Newton steps to the last digits, near the estimate."""
        mhe = self.estimator(data)
        solved = mhe._engine.solved()
        trajectory = solved.trajectory
        for _ in range(8):
            found = mhe._sensitivity_of(solved._replace(trajectory=trajectory))
            trajectory = trajectory + found.step
            if np.abs(found.step).max() < 1e-14:
                break
        assert (np.abs(found.step) < 1e-12 * np.abs(trajectory).max(axis=0)).all()
        # The sequence of QPs ends at the same point: the gradient is that of J.
        size = np.abs(trajectory).max(axis=0)
        assert (np.abs(trajectory - solved.trajectory) < 1e-4 * size).all()
        return found

    def difference(self, changes):
        """The derivative of the trajectory along changes of the data."""
        # Both formulas are of the fourth order; a discount of 1 has one side.
        weights = {1.0: 8.0, -1.0: -8.0, 2.0: -1.0, -2.0: 1.0}
        if "discount" in changes and self.data.discount == 1.0:
            weights = {0.0: -25.0, 1.0: 48.0, 2.0: -36.0, 3.0: 16.0, 4.0: -3.0}
        total = 0.0
        for share, weight in weights.items():
            moved = self.data._replace(**{
                name: getattr(self.data, name) + share * STEP * change
                for name, change in changes.items()
            })
            total += weight * self.converged(moved).trajectory
        return total / (12.0 * STEP)

    def in_window(self, name, change):
        """A change of the data as a change of what is in the window."""
        if name in ("measurements", "inputs"):
            change = change[-self.horizon :]
        if name == "inputs":  # the parameters are the last inputs
            change = np.column_stack((change, np.zeros((len(change), self.k))))
        return change

    def change(self, name, rng):
        """A change of one of the data."""
        change = rng.normal(size=getattr(self.data, name).shape)
        if name in MATRICES:
            change = change + change.T
            return np.diag(np.diag(change)) if self.diagonal else change
        if name == "measurements":
            return np.where(np.isfinite(self.data.measurements), change, 0.0)
        return np.array(-1.0) if name == "discount" else change

    def check(self, names=Data._fields, one_by_one=False):
        """Compare with differences: all data together, each with the same effect, or by name."""
        rng, found = np.random.default_rng(2), self.converged(self.data)
        assert found.converged, found.warning
        changes = {}
        for name in names:
            change = self.change(name, rng)
            along = found.along(**{name: self.in_window(name, change)})
            size = np.abs(along).max()
            assert size > 1e-6, name  # a derivative of nothing shows nothing
            changes[name] = change / size
        for chosen in [[name] for name in names] if one_by_one else [names]:
            expected = self.difference({n: changes[n] for n in chosen})
            inner = {name: self.in_window(name, changes[name]) for name in chosen}
            whole = sum(
                (getattr(found, name) * change).sum(axis=tuple(range(2, 2 + change.ndim)))
                for name, change in inner.items()
            )
            most = ACCURACY * np.abs(expected).max()
            for value in (found.along(**inner), whole):
                np.testing.assert_allclose(value, expected, rtol=0.0, atol=most, err_msg=chosen)
        return found

    def with_data(self, data):
        self.data = data
        return self

    diagonal, made = False, None


def made(kind=Case, **arguments):
    case = kind(**arguments)
    return case.estimator(case.data)


def test_quadratic():
    assert Case().check(one_by_one=True).exact


@pytest.mark.parametrize("discount", [0.9, 0.5])
def test_discount(discount):
    Case(discount=discount).check()


def robust(make, **weights):
    """A case whose losses are made of the weights by ``make``."""
    return Case(
        cost=lambda P, Q, R, discount: qpmhe.RobustCost(
            prior=make(P), disturbance=make(Q), noise=make(R), discount=discount
        ),
        discount=0.95, weights=weights,
    )


class PseudoHuber(qpmhe.Loss):
    """A user's loss: its second derivative is found by differences."""

    def _value(self, q):
        return 2.0 * (np.sqrt(1.0 + q) - 1.0)

    def _slope(self, q):
        return 1.0 / np.sqrt(1.0 + q)


LOSSES = {
    "huber": lambda W: qpmhe.Huber(W, threshold=0.7),
    "power 1.5": lambda W: qpmhe.Power(W, 1.5),
    "power 3": lambda W: qpmhe.Power(W, 3.0),
    "own": PseudoHuber,
    "quadratic": qpmhe.Quadratic,
}


@pytest.mark.parametrize("loss", LOSSES)
def test_losses(loss):
    robust(LOSSES[loss]).check()


DIAGONAL = {
    "prior": np.diag([4.0, 2.0]), "disturbance": np.diag([30.0, 20.0]), "noise": np.diag([9.0, 6.0])
}
COMPONENTS = {
    # Where all components of a state's disturbances are far off, J has no curvature there.
    "huber": lambda W: qpmhe.Huber(W, threshold=0.7, per_component=True),
    "power 1.5": lambda W: qpmhe.Power(W, 1.5, per_component=True),
    "own": lambda W: PseudoHuber(W, per_component=True),
}


@pytest.mark.parametrize("loss", COMPONENTS)
def test_losses_by_component(loss):
    case = robust(COMPONENTS[loss], **DIAGONAL)
    case.diagonal = True
    case.check()


def symmetric(*half):
    return qpmhe.Box(-np.array(half), np.array(half))


def diamond(*half):
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    return qpmhe.Polytope(signs / np.array(half), np.ones(4))


BOUNDS = qpmhe.Box([-1.0, -1.35], [0.93, 2.0])
SETS = {
    "states": ({"states": qpmhe.Box([-1.0, -1.25], [0.93, 2.0])}, 2),
    "states polytope": ({"states": qpmhe.Polytope([[1.0, 0.1], [0.0, -1.0]], [0.95, 1.3])}, 2),
    "disturbances": ({"disturbances": symmetric(0.1, 0.12)}, 2),
    "disturbances polytope": ({"disturbances": diamond(0.15, 0.2)}, 2),
    "noises": ({"noises": symmetric(0.3, 0.25)}, 2),
    "noises polytope": ({"noises": diamond(0.35, 0.35)}, 2),
    "all": ({
        "states": qpmhe.Box([-1.0, -1.5], [0.97, 2.0]), "disturbances": symmetric(0.12, 0.2),
        "noises": diamond(0.5, 0.5),
    }, 3),
    "noise-free": ({"disturbances": symmetric(0.0, 0.2)}, 0),
    "noise-free and a bound": (
        {"disturbances": symmetric(0.0, 0.2), "states": qpmhe.Box([-1.0, -1.2], [2.0, 2.0])}, 1
    ),
    "soft states": ({"states": BOUNDS.soften(linear=2.0, quadratic=30.0)}, 0),
    "soft and exact": ({"states": BOUNDS.soften(linear=100.0, quadratic=0.0)}, 1),
    "soft disturbances": (
        {"disturbances": diamond(0.15, 0.2).soften(linear=2.0, quadratic=20.0)}, 0
    ),
    "soft noises": ({"noises": symmetric(0.3, 0.25).soften(linear=1.0, quadratic=20.0)}, 0),
}


@pytest.mark.parametrize("kind", SETS)
def test_sets(kind):
    sets, least = SETS[kind]
    found = Case(discount=0.95, **sets).check()
    assert len(found.active) >= least
    assert not found.weakly_active


@pytest.mark.parametrize(
    ("penalty", "least"),
    [({}, 1), ({"linear": 100.0}, 1), ({"linear": 2.0, "quadratic": 30.0}, 0)],
    ids=["hard", "soft and exact", "soft"],
)
def test_nonlinear_constraints_of_the_state(penalty, least):
    curved = qpmhe.Constraint(lambda x: x[..., 0] ** 2 + 0.5 * x[..., 1] ** 2 - 1.0, **penalty)
    found = Case(discount=0.95, constraints=[curved]).check()
    assert len(found.active) >= least
    assert all(row.set == "constraints" for row in found.active)


@pytest.mark.parametrize("loss", ["huber", "own"])
def test_losses_with_active_rows(loss):
    case = robust(LOSSES[loss])
    case.system = SETS["all"][0]
    assert case.check().active


G = np.array([[0.2], [1.0]])


def with_directions(**cost):
    return Case(
        disturbance_matrix=G, weights={"disturbance": np.array([[25.0]])}, discount=0.95, **cost
    )


def test_disturbance_matrix():
    with_directions().check()


def test_disturbance_matrix_with_a_loss_and_active_rows():
    case = with_directions(
        cost=lambda P, Q, R, discount: qpmhe.RobustCost(
            prior=P, disturbance=PseudoHuber(Q), noise=PseudoHuber(R), discount=discount
        ),
        disturbances=symmetric(0.07),
    )
    assert case.check().active


def test_singular_covariance():
    # The weight is of the factor F, which its covariance F W^-1 F' does not name alone.
    factor = np.array([[0.02], [0.1]])
    case = Case(
        cost=lambda P, Q, R, discount: qpmhe.QuadraticCost.from_covariances(
            prior=np.linalg.inv(P), disturbance=factor @ factor.T / Q[0, 0],
            noise=np.linalg.inv(R), discount=discount,
        ),
        weights={"disturbance": np.eye(1)},
    )
    case.check(names=("prior", "measurements", "inputs", "parameters", "noise_weight"))
    found, change = case.converged(case.data), np.ones((1, 1))
    inner = found.disturbance_weight.sum(axis=(-2, -1))
    size = np.asarray(case.estimator(case.data).cost.disturbance).item()
    np.testing.assert_allclose(
        size * inner, case.difference({"disturbance_weight": change}), rtol=1e-6, atol=1e-9
    )


def filtered(**arguments):
    """A case with an extended Kalman filter, whose covariance weighs the prior."""
    return Case(
        cost=lambda P, Q, R, discount: qpmhe.QuadraticCost(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R, discount=discount
        ),
        observer=lambda P: qpmhe.ExtendedKalman(
            disturbance=0.05 * np.eye(2), noise=0.1 * np.eye(2), prior=np.linalg.inv(P)
        ),
        **arguments,
    )


def test_extended_kalman_filter():
    filtered().check()


@pytest.mark.parametrize("arrival", ["observer", "smoothed"])
def test_later_windows(arrival):
    # What enters the window's prior is data: measurements behind it, and all that moves it.
    case = Case(samples=10, horizon=6)
    names = ("disturbance_weight", "noise_weight", "prior_weight")
    if arrival == "observer":
        case.check(names=names)
    changes = {name: np.random.default_rng(3).normal(size=(10, size))
               for name, size in (("measurements", 2), ("inputs", 1))}
    case.options = {"arrival": arrival}
    found = case.converged(case.data)
    for name, change in changes.items():
        change[:4] = 0.0
        if arrival == "smoothed":
            change[4:] = 0.0
            change[-1] = 1.0  # the mean is the last estimate's
        expected = case.difference({name: change})
        value = found.along(**{name: case.in_window(name, change)})
        np.testing.assert_allclose(value, expected, atol=ACCURACY * np.abs(expected).max())


def test_missing():
    case = Case(discount=0.95)
    case.data.measurements[2, 0] = case.data.measurements[4, 1] = np.nan
    case.data.measurements[5] = np.nan
    case.check()


def test_missing_with_a_loss_and_noise_bounds():
    case = robust(LOSSES["own"])
    case.system = {"noises": symmetric(0.3, 0.25)}
    case.data.measurements[2, 0] = case.data.measurements[4, 1] = np.nan
    assert case.check().active


def test_weights_of_samples():
    own = np.array([[5.0, 1.0], [1.0, 3.0]])

    def at(R, W):
        return {
            t: {"noise_weight": R, "disturbance_weight": W} for t in (1, 4)
        }

    case = Case(discount=0.95, update=at(own, 2.0 * own))
    case.data.measurements[4, 1] = np.nan
    found = case.check()
    for name, k in (("noise_weights", 0), ("disturbance_weights", 1)):
        change = np.array([[1.0, 0.3], [0.3, -0.5]])
        inner = np.zeros((7, 2, 2))
        inner[[1, 4]] = change

        def moved(share, k=k, change=change):
            chosen = [own, 2.0 * own]
            chosen[k] = chosen[k] + share * STEP * change
            return Case(discount=0.95, update=at(*chosen)).with_data(case.data)

        expected = sum(
            weight * moved(share).converged(case.data).trajectory
            for share, weight in ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0))
        ) / (12.0 * STEP)
        most = ACCURACY * np.abs(expected).max()
        np.testing.assert_allclose(found.along(**{name: inner}), expected, atol=most)
        whole = (getattr(found, name) * inner).sum(axis=(2, 3, 4))
        np.testing.assert_allclose(whole, expected, atol=most)


def test_discount_with_soft_sets_that_are_violated():
    # Penalties are discounted, too: those of the newest state are not.
    case = Case(discount=0.7, states=qpmhe.Box([-1.0, -1.2], [0.8, 2.0]).soften(quadratic=30.0))
    case.check(names=("discount",), one_by_one=True)


def turned(a, b):
    difference = a - b
    turns = np.round(difference[..., :1] / (2.0 * np.pi))
    return np.concatenate((difference[..., :1] - 2.0 * np.pi * turns, difference[..., 1:]), -1)


@pytest.mark.parametrize("residual", [qpmhe.angles([0]), turned], ids=["angles", "function"])
def test_angles(residual):
    class Turning(Case):
        @staticmethod
        def output(x):
            return np.stack([x[..., 0], x[..., 1]], axis=-1)

    case = Turning(
        prior=(3.1, 2.0), discount=0.95,
        state_residual=residual, output_residual=residual,
    )
    plain = Turning(prior=(3.1, 2.0), discount=0.95)
    x, Y = np.array([3.1, 2.0]), []
    for y, u in zip(case.data.measurements, case.data.inputs, strict=True):
        Y.append(x + 0.1 * (y - 0.5))
        x = case.step(x, np.append(u, 0.3))
    plain.data = plain.data._replace(measurements=np.array(Y))
    moved = np.array(Y)
    moved[::2, 0] -= 2.0 * np.pi
    case.data = case.data._replace(measurements=moved)
    found, same = case.check(), plain.check()
    for name in ("measurements", "noise_weight", "prior", "discount"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(same, name), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("kind", ["plain", "states", "all"])
def test_functions_without_an_expression(kind):
    # Of these the second derivatives are differences of Jacobians by the complex step.
    class Untraced(Case):
        step, output = (staticmethod(untraced(one)) for one in (Case.step, Case.output))

    sets = {} if kind == "plain" else SETS[kind][0]
    assert not Untraced(discount=0.95, **sets).check().exact


def test_differences_of_differences():
    class Untraced(Case):
        step = staticmethod(untraced(lambda x, u: np.real(Case.step(np.real(x), np.real(u)))))
        output = staticmethod(untraced(lambda x: np.real(Case.output(np.real(x)))))

    found, other = made(Untraced).sensitivity(), made(Case)
    solved = other._engine.solved()._replace(trajectory=found.trajectory)
    exact = other._sensitivity_of(solved)
    assert exact.exact
    assert not found.exact
    for name in ("noise_weight", "measurements", "inputs", "parameters"):
        expected = getattr(exact, name)
        most = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(getattr(found, name), expected, rtol=0.0, atol=most)


def test_steps_of_other_lengths():
    class Continuous(Case):
        @staticmethod
        def rate(x, u):
            return 10.0 * (Case.step(x, u) - x)

        def make_system(self):
            return qpmhe.System.from_ode(
                self.rate, self.output, dt=0.1, n=2, p=2, m=2, method="rk4"
            )

    Continuous(discount=0.95, update={2: {"dt": 0.05}, 5: {"dt": 0.17}}).check()


def test_parameters_that_are_estimated():
    system = qpmhe.augment_parameters(
        lambda x, u, theta: Case.step(x, np.concatenate((u, theta), axis=-1)),
        lambda x, u, theta: Case.output(x), n=2, p=2, m=1, nominal=[0.3],
        parameter_bounds=qpmhe.Box(0.0, 0.4),
    )
    case = Case()

    def estimator(data):
        weight = np.zeros((3, 3))
        weight[:2, :2], weight[2, 2] = data.prior_weight, 20.0
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.1, 0.0], [0.0, 0.1], [0.0, 0.0]]),
            qpmhe.QuadraticCost(
                prior=weight, disturbance=np.diag([30.0, 20.0, 1.0]), noise=data.noise_weight,
            ),
            horizon=7, initial_state=np.append(data.prior, 0.3), max_qps=None, tolerance=1e-10,
        )
        for y, u in zip(data.measurements, data.inputs, strict=True):
            mhe.update(y, u)
        return mhe

    def changed(name, change):
        inner = np.zeros((3,) * change.ndim)
        if name in ("prior", "prior_weight"):
            inner[tuple(slice(size) for size in change.shape)] = change
            return inner
        return change

    case.estimator, case.in_window = estimator, changed
    case.check(names=("prior", "measurements", "inputs", "prior_weight", "noise_weight"))


def linear():
    A, C = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[1.0, 0.3]])
    return A, C, qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=1)


def kalman(A, C, P, Q, R, Y, x):
    """The Kalman filter, for complex numbers too; x(t+1) and the gains of all measurements."""
    gains = []
    for y in Y:
        K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        gains = [(A - K @ C) @ one for one in gains] + [K]
        x = A @ x + K @ (y - C @ x)
        P = A @ P @ A.T + Q - K @ (C @ P @ C.T + R) @ K.T
    return x, gains


def test_kalman_filter():
    # Of a linear system the estimate is the Kalman filter's: its derivatives in closed form.
    A, C, system = linear()
    P, Q, R = np.array([[1.0, 0.2], [0.2, 0.5]]), np.diag([0.02, 0.1]), np.array([[0.3]])
    start, Y = np.array([0.5, -0.2]), np.random.default_rng(5).normal(size=(9, 1))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.1, 0.1]),
        qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R),
        horizon=9, initial_state=start,
    )
    for y in Y:
        estimate = mhe.update(y)
    expected, gains = kalman(A, C, P, Q, R, Y, start)
    np.testing.assert_allclose(estimate.state, expected, atol=1e-12)
    found = mhe.sensitivity()
    assert found.converged
    for k, K in enumerate(gains):
        np.testing.assert_allclose(found.measurements[-1, :, k], K, atol=1e-11)
    for name, covariance, place in (
        ("prior_weight", P, 0), ("disturbance_weight", Q, 1), ("noise_weight", R, 2)
    ):
        change = np.random.default_rng(6).normal(size=covariance.shape)
        change = change + change.T
        matrices = [one + 0j for one in (P, Q, R)]
        matrices[place] += 1e-30j * change  # the complex step: exact
        slope = kalman(A, C, *matrices, Y, start)[0].imag / 1e-30
        weight = np.linalg.inv(covariance)
        by_covariance = -weight @ getattr(found, name)[-1] @ weight
        np.testing.assert_allclose((by_covariance * change).sum(axis=(1, 2)), slope, atol=1e-11)


def test_kalman_filter_with_a_moving_window():
    # With the filter's covariance as prior weight every window ends at the filter's estimate.
    A, C, system = linear()
    P, Q, R = np.eye(2), np.diag([0.02, 0.1]), np.array([[0.3]])
    start, Y = np.zeros(2), np.random.default_rng(5).normal(size=(12, 1))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R),
        horizon=4, initial_state=start,
    )
    for y in Y:
        mhe.update(y)
    gains = kalman(A, C, P, Q, R, Y, start)[1][-4:]
    np.testing.assert_allclose(
        mhe.sensitivity().measurements[-1, :, :, 0], np.stack(gains, axis=1)[..., 0], atol=1e-10
    )


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@settings(deadline=None)
@given(
    seed=st.integers(0, 10**6), samples=st.integers(1, 9), horizon=st.integers(1, 9),
    kind=st.sampled_from([*SETS, ""]), loss=st.sampled_from([*LOSSES, ""]),
    discount=st.sampled_from([1.0, 0.8]),
)
def test_forward_and_adjoint_agree(seed, samples, horizon, kind, loss, discount):
    case = robust(LOSSES[loss]) if loss else Case()
    other = Case(samples=samples, horizon=horizon, discount=discount, seed=seed)
    case.data, case.horizon = other.data, horizon
    case.system = SETS[kind][0] if kind else {}
    found, rng = case.estimator(case.data).sensitivity(), np.random.default_rng(seed)
    if not found.converged:  # a matrix that is nearly singular, at times
        return
    cotangents = rng.normal(size=(3, *found.trajectory.shape))
    gradient = found.adjoint(cotangents)
    for name in NAMES:
        backward = getattr(gradient, name)
        shape = backward.shape[1:]
        change = rng.normal(size=shape)
        if "weight" in name:
            change = change + np.swapaxes(change, -1, -2)
        forward = (cotangents * found.along(**{name: change})).sum(axis=(1, 2))
        expected = (backward * change).reshape(3, -1).sum(axis=1)
        # Rows may leave no freedom: the derivatives are then rounding.
        size = np.abs(backward * change).sum() + np.abs(forward).max() + 1e-4
        np.testing.assert_allclose(forward, expected, rtol=0.0, atol=1e-7 * size, err_msg=name)


@pytest.mark.parametrize("kind", ["", "all", "filter", "smoothed"])
def test_both_engines(kind):
    make = filtered if kind == "filter" else Case
    sets = SETS["all"][0] if kind == "all" else {}
    options = {"arrival": "smoothed"} if kind == "smoothed" else {}
    found = []
    for engine in ("python", "compiled"):
        case = make(
            samples=9, horizon=6, discount=0.95, options={**options, "engine": engine}, **sets
        )
        if not sets:
            case.data.measurements[7, 0] = np.nan
        mhe = case.estimator(case.data)
        assert mhe.engine == engine
        found.append(mhe.sensitivity())
    mine, other = found
    np.testing.assert_allclose(other.trajectory, mine.trajectory, atol=1e-7)
    assert [row[:4] for row in other.active] == [row[:4] for row in mine.active]
    for name in NAMES:
        expected = getattr(mine, name)
        most = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(getattr(other, name), expected, rtol=0.0, atol=most)


@pytest.mark.parametrize("power", [-20, 14])
def test_no_unit_matters(power):
    # Powers of two: of the first state, and of the cost.
    unit = 2.0**power

    class Scaled(Case):
        @staticmethod
        def step(x, u):
            return Case.step(x / [unit, 1.0], u) * [unit, 1.0]

        @staticmethod
        def output(x):
            return Case.output(x / [unit, 1.0])

    sets = {"states": qpmhe.Box([-1.0, -1.25], [0.93, 2.0]), "disturbances": symmetric(0.15, 0.2)}
    case = Case(discount=0.95, **sets)
    sets["states"] = qpmhe.Box([-unit, -1.25], [0.93 * unit, 2.0])
    sets["disturbances"] = symmetric(0.15 * unit, 0.2)
    scaled, each = Scaled(discount=0.95, **sets), np.array([unit, 1.0])
    weights = {
        name: getattr(case.data, name) * 4.0 / (1.0 if name == "noise_weight" else
                                                np.outer(each, each))
        for name in MATRICES
    }
    scaled.data = case.data._replace(prior=case.data.prior * each, **weights)
    found, other = (one.converged(one.data) for one in (case, scaled))
    assert found.converged
    assert other.converged
    assert [row[:4] for row in other.active] == [row[:4] for row in found.active]
    assert found.active
    cotangent = np.random.default_rng(1).normal(size=found.trajectory.shape)
    mine, its = found.adjoint(cotangent), other.adjoint(cotangent / each)
    for name in ("measurements", "inputs", "discount"):
        np.testing.assert_allclose(getattr(its, name), getattr(mine, name), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(4.0 * its.noise_weight, mine.noise_weight, rtol=1e-7)
    np.testing.assert_allclose(
        4.0 * its.prior_weight / np.outer(each, each), mine.prior_weight, rtol=1e-7
    )


def test_not_converged():
    case = Case()
    case.data.measurements[...] += 0.3
    mhe = qpmhe.MovingHorizonEstimator(
        case.make_system(), case.make_observer(None), qpmhe.QuadraticCost(
            prior=case.data.prior_weight, disturbance=case.data.disturbance_weight,
            noise=case.data.noise_weight,
        ),
        horizon=7, initial_state=case.data.prior, parameters=[0.3], max_qps=1,
    )
    for y, u in zip(case.data.measurements, case.data.inputs, strict=True):
        mhe.update(y, u)
    found = mhe.sensitivity()
    assert not found.converged
    assert "has not converged" in found.warning
    assert "max_qps=None" in found.warning
    # The step says how far off it is.
    case.horizon = 7
    minimiser = case.converged(case.data).trajectory
    before = np.abs(found.trajectory - minimiser).max()
    assert np.abs(found.trajectory + found.step - minimiser).max() < 0.3 * before


def test_weakly_active():
    case = Case(states=qpmhe.Box([-1.0, -3.0], [3.0, 3.0]))
    free = case.converged(case.data).trajectory
    lower = np.array([-1.0, free[:, 1].min()])  # the state with the lowest rate touches the bound
    case = Case(states=qpmhe.Box(lower, [3.0, 3.0]))
    found = case.converged(case.data)
    assert [row.set for row in found.weakly_active] == ["states"]
    time = int(free[:, 1].argmin())
    assert f"lower bound of states, row 1, at time {time}" in found.warning


def test_no_minimiser():
    # Outputs that fold: halfway between two solutions J has a saddle.
    system = qpmhe.System(lambda x: x, lambda x: x * x, n=1, p=1)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[0.0], max_qps=None,
    )
    for _ in range(3):
        mhe.update([4.0])
    found = mhe.sensitivity()
    assert not found.converged
    assert "not positive definite" in found.warning


def test_refusals():
    class Own(qpmhe.QuadraticCost):
        def stage_costs(self, residuals, weights):
            return 2.0 * super().stage_costs(residuals, weights)

    def own(P, Q, R, discount):
        return Own(prior=P, disturbance=Q, noise=R)

    with pytest.raises(qpmhe.errors.InvalidInputError, match="Own has no second derivatives"):
        made(cost=own).sensitivity()
    curved = qpmhe.Constraint(lambda x, w: x[..., 0] ** 2 + w[..., 1] ** 2 - 0.9)
    with pytest.raises(qpmhe.errors.InvalidInputError, match="row 0 of the nonlinear constraints"):
        made(constraints=[curved]).sensitivity()
    inactive = qpmhe.Constraint(lambda x: x[..., 0] ** 2 + x[..., 1] ** 2 - 40.0)
    assert made(constraints=[inactive]).sensitivity().converged

    mhe = made()
    found = mhe.sensitivity()
    with pytest.raises(qpmhe.errors.ShapeError, match="cotangent has shape"):
        found.adjoint(np.zeros((3, 2)))
    with pytest.raises(qpmhe.errors.OptionError, match="noise_covariance"):
        found.along(noise_covariance=np.eye(2))
    with pytest.raises(qpmhe.errors.ShapeError, match="noise_weight has shape"):
        found.along(noise_weight=np.eye(3))
    with pytest.raises(AttributeError, match="state"):
        found.state  # noqa: B018
    mhe.reset()
    with pytest.raises(qpmhe.errors.InvalidInputError, match="no estimate yet"):
        mhe.sensitivity()


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_what_was_handed_out_stays(engine):
    case = robust(qpmhe.Huber)
    case.data, case.horizon = Case(samples=12).data, 5
    case.options = {"engine": engine}
    case.data.measurements[10, 0] = np.nan  # the window then has weights of its samples
    mhe = case.estimator(case.data)
    first, cotangent = mhe.sensitivity(), np.ones((6, 2))
    expected = {name: getattr(first.adjoint(cotangent), name) for name in NAMES}
    for _ in range(40):  # until the window's arrays are full, and move
        mhe.update([0.3, 0.1], [0.2])
        mhe.sensitivity()
    gradient = first.adjoint(cotangent)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(gradient, name), expected[name])


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_the_estimator_goes_on_as_its_twin(engine):
    case = Case(samples=12, horizon=5, options={"engine": engine}, **SETS["all"][0])
    case.data.measurements[...] = case.data.measurements.mean(axis=0)
    twin, mhe = (case.estimator(case.data._replace(
        measurements=case.data.measurements[:3], inputs=case.data.inputs[:3]
    )) for _ in range(2))
    for y, u in zip(case.data.measurements[3:], case.data.inputs[3:], strict=True):
        expected, estimate = twin.update(y, u), mhe.update(y, u)
        np.testing.assert_array_equal(estimate.trajectory, expected.trajectory)
        found = mhe.sensitivity()
        for one in (found.trajectory, found.step, found.adjoint([1.0, 0.0]).noise_weights):
            one[...] = np.nan


def test_rows_that_were_dropped_do_not_hold():
    case = Case(states=qpmhe.Box([-1.0, -1.2], [2.0, 2.0]), noises=symmetric(1.5, 1.5))
    mhe = case.estimator(case.data)
    estimate = mhe.update([6.0, 6.0], [0.0])
    assert qpmhe.Status.ROWS_DROPPED in estimate.status
    found = mhe.sensitivity()
    np.testing.assert_allclose(found.trajectory, estimate.trajectory, atol=1e-12)
    dropped = {row[:4] for row in estimate.dropped}
    assert dropped.isdisjoint(row[:4] for row in found.active)


def test_newest_state():
    found = made().sensitivity()
    whole = np.zeros(found.trajectory.shape)
    whole[-1] = [1.0, 2.0]
    np.testing.assert_array_equal(
        found.adjoint([1.0, 2.0]).noise_weight, found.adjoint(whole).noise_weight
    )


def test_time_grows_with_the_window():
    # One factorisation of a banded matrix: no array has the square of the window's length.
    case = Case(samples=200, horizon=200, **SETS["noise-free"][0])
    mhe = qpmhe.MovingHorizonEstimator(
        case.make_system(), case.make_observer(None), qpmhe.QuadraticCost(
            prior=case.data.prior_weight, disturbance=case.data.disturbance_weight,
            noise=case.data.noise_weight,
        ),
        horizon=200, initial_state=case.data.prior, parameters=[0.3], max_qps=1,
    )
    for y, u in zip(case.data.measurements, case.data.inputs, strict=True):
        mhe.update(y, u)
    tracemalloc.start()
    mhe.sensitivity().adjoint(np.ones(2)).measurements  # noqa: B018
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 8 * (201 * 2) ** 2
