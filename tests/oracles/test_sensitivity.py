"""Derivatives of estimates, against differences of estimates that were converged again."""

from typing import NamedTuple

import numpy as np
import pytest

import qpmhe

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
        assert np.abs(found.step).max() < 1e-12
        # The sequence of QPs ends at the same point: the gradient is that of J.
        assert np.abs(trajectory - solved.trajectory).max() < 1e-4
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
    "soft states": ({"states": qpmhe.Box([-1.0, -1.35], [0.93, 2.0]).soften(linear=2.0, quadratic=30.0)}, 0),
    "soft and exact": ({"states": qpmhe.Box([-1.0, -1.35], [0.93, 2.0]).soften(linear=100.0, quadratic=0.0)}, 1),
    "soft disturbances": ({"disturbances": diamond(0.15, 0.2).soften(linear=2.0, quadratic=20.0)}, 0),
    "soft noises": ({"noises": symmetric(0.3, 0.25).soften(linear=1.0, quadratic=20.0)}, 0),
}


@pytest.mark.parametrize("kind", SETS)
def test_sets(kind):
    sets, least = SETS[kind]
    found = Case(discount=0.95, **sets).check()
    assert len(found.active) >= least
    assert not found.weakly_active


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


OBSERVERS = {
    "extended Kalman": lambda P: qpmhe.ExtendedKalman(
        disturbance=0.05 * np.eye(2), noise=0.1 * np.eye(2), prior=np.linalg.inv(P)
    ),
}


@pytest.mark.parametrize("observer", OBSERVERS)
def test_observers(observer):
    make = OBSERVERS[observer]
    Case(
        cost=lambda P, Q, R, discount: qpmhe.QuadraticCost(
            prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R, discount=discount
        ),
        observer=make,
    ).check()


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
