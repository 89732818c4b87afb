"""Cases whose estimates are differentiated, and converged again with other data."""

from typing import NamedTuple

import numpy as np

import qpmhe
from tests.estimation.untraced import untraced

# Of the largest entry of a derivative: differences of the fourth order reach less.
ACCURACY = 1e-6
STEP = 1e-4
CENTRAL = {1.0: 8.0, -1.0: -8.0, 2.0: -1.0, -2.0: 1.0}
ONE_SIDED = {0.0: -25.0, 1.0: 48.0, 2.0: -36.0, 3.0: 16.0, 4.0: -3.0}
MATRICES = "prior_weight", "disturbance_weight", "noise_weight"
WEIGHTS = {
    "prior": np.array([[4.0, 0.5], [0.5, 2.0]]),
    "disturbance": np.array([[30.0, 5.0], [5.0, 20.0]]),
    "noise": np.array([[9.0, -1.0], [-1.0, 6.0]]),
}


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

    ``cost`` makes a cost of the weights and the discount, ``observer`` an observer of the prior
    weight, ``update`` holds arguments of single updates; other keywords are the system's.
    """

    #: How far from the minimiser Newton's method ends, as a share of the states' sizes.
    accuracy = 1e-12

    diagonal, made = False, None

    def __init__(
        self, cost=None, observer=None, samples=7, horizon=7, discount=1.0, seed=1, options=None,
        prior=(0.85, 0.2), weights=None, update=None, **system,
    ):
        rng = np.random.default_rng(seed)
        self.make_cost = cost or (lambda P, Q, R, discount: qpmhe.QuadraticCost(
            prior=P, disturbance=Q, noise=R, discount=discount
        ))
        self.make_observer = observer or (lambda P: qpmhe.Luenberger(0.1 * np.eye(2)))
        self.horizon, self.system, self.options = horizon, system, options or {}
        self.update = update or {}
        x, Y = np.array([0.9, 0.3]), []
        U = 0.5 * rng.normal(size=(samples, 1))
        for u in U:
            Y.append(self.output(x) + 0.3 * rng.normal(size=2))
            x = self.step(x, np.append(u, 0.3)) + 0.1 * rng.normal(size=2)
        self.data = Data(
            np.array(prior), np.array(Y), U, np.array([0.3]),
            *(WEIGHTS | (weights or {})).values(), np.array(discount),
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

    def make_system(self):
        return qpmhe.System(self.step, self.output, n=2, p=2, m=2, **self.system)

    def estimator(self, data=None, **options):
        """After the record; other data than the case's if given."""
        data = data or self.data
        if self.made is None:
            self.made = self.make_system()
        cost = self.make_cost(
            data.prior_weight, data.disturbance_weight, data.noise_weight, float(data.discount)
        )
        mhe = qpmhe.MovingHorizonEstimator(
            self.made, self.make_observer(data.prior_weight), cost, horizon=self.horizon,
            initial_state=data.prior, parameters=data.parameters,
            **{"max_qps": None, "tolerance": 1e-10} | self.options | options,
        )
        for t, (y, u) in enumerate(zip(data.measurements, data.inputs, strict=True)):
            mhe.update(y, u, **self.update.get(t, {}))
        return mhe

    def converged(self, data=None):
        """The minimiser, by Newton steps to the last digits, near the estimate."""
        mhe = self.estimator(data)
        solved = mhe._engine.solved()
        trajectory = solved.trajectory
        for _ in range(8):
            found = mhe._sensitivity_of(solved._replace(trajectory=trajectory))
            trajectory = trajectory + found.step
            if np.abs(found.step).max() < 1e-14:
                break
        size = np.abs(trajectory).max(axis=0)
        assert (np.abs(found.step) < self.accuracy * size).all()
        # The sequence of QPs ends at the same point: the gradient is that of J.
        assert (np.abs(trajectory - solved.trajectory) < 1e-4 * size).all()
        return found

    def difference(self, changes):
        """The derivative of the trajectory along changes of the data."""
        # Both formulas are of the fourth order; a discount of 1 has one side.
        one_sided = "discount" in changes and self.data.discount == 1.0
        return sum(
            weight * self.converged(self.data._replace(**{
                name: getattr(self.data, name) + share * STEP * change
                for name, change in changes.items()
            })).trajectory for share, weight in (ONE_SIDED if one_sided else CENTRAL).items()
        ) / (12.0 * STEP)

    def in_window(self, name, change):
        """A change of the data as a change of what is in the window."""
        if name in ("measurements", "inputs"):
            change = change[-self.horizon :]
        if name == "inputs":  # the parameters are the last inputs
            change = np.column_stack((change, np.zeros((len(change), 1))))
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
        rng, found = np.random.default_rng(2), self.converged()
        assert found.converged, found.warning
        changes = {}
        for name in names:
            change = self.change(name, rng)
            size = np.abs(found.along(**{name: self.in_window(name, change)})).max()
            assert size > 1e-6, name  # a derivative of nothing shows nothing
            changes[name] = change / size
        for chosen in [[name] for name in names] if one_by_one else [names]:
            expected = self.difference({n: changes[n] for n in chosen})
            inner = {name: self.in_window(name, changes[name]) for name in chosen}
            whole = sum(
                (getattr(found, name) * change).sum(axis=tuple(range(2, 2 + change.ndim)))
                for name, change in inner.items()
            )
            close(found.along(**inner), expected, chosen)
            close(whole, expected, chosen)
        return found


def close(found, expected, what=None, accuracy=ACCURACY):
    most = accuracy * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=most, err_msg=str(what))


class PseudoHuber(qpmhe.Loss):
    """A user's loss: its second derivative is found by differences."""

    def value(self, q):
        return 2.0 * (np.sqrt(1.0 + q) - 1.0)

    def slope(self, q):
        return 1.0 / np.sqrt(1.0 + q)


def robust(make, diagonal=False, **arguments):
    """A case whose losses are made of the weights by ``make``."""
    case = Case(
        cost=lambda P, Q, R, discount: qpmhe.RobustCost(
            prior=make(P), disturbance=make(Q), noise=make(R), discount=discount
        ), discount=0.95, **arguments,
    )
    case.diagonal = diagonal
    return case


def missing(case):
    case.data.measurements[2, 0] = case.data.measurements[4, 1] = np.nan
    return case


def symmetric(*half):
    return qpmhe.Box(-np.array(half), np.array(half))


def diamond(*half):
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    return qpmhe.Polytope(signs / np.array(half), np.ones(4))


def curved(**penalty):
    return {"constraints": [
        qpmhe.Constraint(lambda x: x[..., 0] ** 2 + 0.5 * x[..., 1] ** 2 - 1.0, **penalty)
    ]}


BOUNDS = qpmhe.Box([-1.0, -1.35], [0.93, 2.0])
SETS = {
    "states": ({"states": qpmhe.Box([-1.0, -1.25], [0.93, 2.0])}, 2),
    "states polytope": ({"states": qpmhe.Polytope([[1.0, 0.1], [0.0, -1.0]], [0.95, 1.3])}, 2),
    "disturbances": ({"disturbances": diamond(0.15, 0.2)}, 2),
    "noises": ({"noises": symmetric(0.3, 0.25)}, 2),
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
    "constraint": (curved(), 1), "exact constraint": (curved(linear=100.0), 1),
    "soft constraint": (curved(linear=2.0, quadratic=30.0), 0),
}
ALL = SETS["all"][0]
DIAGONAL = {name: np.diag(np.diag(weight)) for name, weight in WEIGHTS.items()}
LOSSES = {
    "huber": lambda W, **options: qpmhe.Huber(W, threshold=0.7, **options),
    "power 1.5": lambda W, **options: qpmhe.Power(W, 1.5, **options),
    "own": PseudoHuber,
    "quadratic": qpmhe.Quadratic,
}


class Untraced(Case):
    """Whose second derivatives are differences of Jacobians, themselves by differences."""

    accuracy = 1e-9

    step, output = (staticmethod(untraced(one)) for one in (Case.step, Case.output))


class Continuous(Case):
    @staticmethod
    def rate(x, u):
        return 10.0 * (Case.step(x, u) - x)

    def make_system(self):
        return qpmhe.System.from_ode(self.rate, self.output, dt=0.1, n=2, p=2, m=2, method="rk4")


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
