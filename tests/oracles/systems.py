"""Nonlinear systems with sets that bind, each written once for NumPy and for CasADi."""

import numpy as np

import qpmhe

from .nlp import Window, ca


class Case:
    """A model, sets, an observer that mostly keeps within them, and random records.

    Parameters
    ----------
    step, output : callable
        f and h: (components of x, a module with sin, exp, ...) to a list of components.
    truth, start : sequence
        x(0) of the simulation, and the estimator's.
    gain : array_like
        The observer's.
    deviations : (sequence, sequence, sequence)
        Standard deviations of prior, disturbance and noise, for the weights.
    draws : (sequence, sequence)
        Disturbances and noises are drawn evenly from plus and minus these.
    sets : dict
        The sets X, W and V for each kind: "box", "polytope", and "noise_free" where W has
        components of no width.
    """

    def __init__(self, step, output, truth, start, gain, deviations, draws, sets, horizon=6):
        self.step, self.output = step, output
        self.truth, self.start = np.array(truth, float), np.array(start, float)
        self.gain, self.horizon = np.array(gain, float), horizon
        self.draws = tuple(np.array(draw) for draw in draws)
        self.n, self.p = len(truth), len(draws[1])
        prior, disturbance, noise = (np.diag(np.square(one)) for one in deviations)
        self.cost = qpmhe.QuadraticCost.from_covariances(
            prior=prior, disturbance=disturbance, noise=noise
        )
        self.sets = sets

    def f(self, x):
        return np.stack(self.step([x[..., j] for j in range(self.n)], np), axis=-1)

    def h(self, x):
        return np.stack(self.output([x[..., j] for j in range(self.n)], np), axis=-1)

    def symbolic(self):
        """f and h for CasADi."""
        return {
            name: lambda x, g=g: ca.vertcat(*g(ca.vertsplit(x), ca))
            for name, g in (("f", self.step), ("h", self.output))
        }

    def parts(self, kind):
        """System, observer, cost, and what the estimators have in common."""
        states, disturbances, noises = self.sets[kind]
        system = qpmhe.System(
            self.f, self.h, n=self.n, p=self.p,
            states=states, disturbances=disturbances, noises=noises,
        )
        common = {"horizon": self.horizon, "initial_state": self.start}
        gain = self.gain.copy()
        gain[disturbances.fixed_components] = 0.0  # or the candidate would be outside
        return (system, qpmhe.Luenberger(gain), self.cost), common

    def window(self, kind, estimate, ys):
        """The program of an estimate's window, for the judgement of trajectories."""
        P, Q, R = self.cost.prior, self.cost.disturbance, self.cost.noise
        f, h = self.symbolic().values()
        count, names = len(ys), ("states", "disturbances", "noises")
        return Window(
            lambda x, u: f(x), lambda x, u: h(x), ys, estimate.candidate[0],
            (P, [Q] * count, [R] * count), boxes={
                name: one for name, one in zip(names, self.sets[kind], strict=True)
                if one is not None
            },
        )

    def record(self, seed, steps):
        rng = np.random.default_rng(seed)
        x, Y = self.truth, []
        for _ in range(steps):
            Y.append(self.h(x) + rng.uniform(-self.draws[1], self.draws[1]))
            x = self.f(x) + rng.uniform(-self.draws[0], self.draws[0])
        return np.array(Y)


def around(center, *half):
    """The polytope sum_j |s_j - c_j| / half_j <= 1: a diamond in two dimensions."""
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * len(half))).reshape(len(half), -1).T
    rows = signs / np.array(half)
    return qpmhe.Polytope(rows, 1.0 + rows @ np.array(center, float))


def symmetric(*half):
    return qpmhe.Box(-np.array(half), np.array(half))


def reactor():
    def step(x, m):
        rate = 0.16 * x[0] ** 2 - 0.64 * x[1]
        return [x[0] - 0.2 * rate, x[1] + 0.1 * rate]

    return Case(
        step, lambda x, m: [x[0] + x[1]],
        truth=[2.8, 0.7], start=[3.2, 0.7], gain=[[0.05], [0.05]],
        deviations=([1.0, 1.0], [0.1, 0.1], [0.2]), draws=([0.15, 0.15], [0.5]),
        sets={
            "box": (
                qpmhe.Box([0.0, 0.65], [4.5, 3.5]), symmetric(0.06, 0.06), qpmhe.Box(-1.2, 0.35)
            ),
            "polytope": (
                qpmhe.Polytope([[1.0, 1.0], [0.0, -1.0]], [4.2, -0.6]),
                around([0, 0], 0.15, 0.1), qpmhe.Polytope([[1.0], [-1.0]], [0.4, 1.2]),
            ),
        },
    )


def pendulum():
    def step(x, m):
        return [x[0] + 0.1 * x[1], x[1] - 0.1 * (4.0 * m.sin(x[0]) + 0.3 * x[1])]

    return Case(
        step, lambda x, m: [m.sin(x[0])],
        truth=[1.0, 0.2], start=[1.1, 0.2], gain=[[0.05], [0.1]],
        deviations=([0.5, 0.5], [0.05, 0.2], [0.12]), draws=([0.05, 0.2], [0.4]),
        sets={
            "box": (symmetric(1.14, 2.26), symmetric(0.032, 0.065), qpmhe.Box(-0.8, 0.32)),
            "polytope": (
                qpmhe.Polytope([[1.0, 0.3], [0.0, -1.0]], [1.18, 2.26]),
                around([0, 0], 0.06, 0.125), qpmhe.Polytope([[1.0], [-1.0]], [0.33, 0.8]),
            ),
            "noise_free": (
                qpmhe.Polytope([[1.0, 0.3], [0.0, -1.0]], [1.18, 2.3]), symmetric(0.0, 0.0),
                qpmhe.Box(-0.8, 0.34),
            ),
        },
    )


def stirred_tank():
    """Exothermic reaction: scaled concentration and temperature, two outputs."""

    def step(x, m):
        rate = x[0] * m.exp(8.0 * (1.0 - 1.0 / x[1]))
        return [
            x[0] + 0.1 * (1.0 - x[0] - rate), x[1] + 0.1 * (1.3 - 1.3 * x[1] + 0.3 * rate),
        ]

    return Case(
        step, lambda x, m: [x[1], x[0] * x[1]],
        truth=[0.26, 1.13], start=[0.34, 1.17], gain=[[0.0, 0.05], [0.05, 0.0]],
        deviations=([0.2, 0.1], [0.03, 0.02], [0.05, 0.1]),
        draws=([0.03, 0.02], [0.1, 0.2]),
        sets={
            "box": (
                qpmhe.Box([0.22, 1.0], [0.5, 1.2]), symmetric(0.015, 0.01),
                qpmhe.Box([-0.3, -0.6], [0.097, 0.185]),
            ),
            "polytope": (
                qpmhe.Box([0.1, 0.8], [1.0, 1.5]) & qpmhe.Polytope([[-1.0, 1.0]], [0.96]),
                around([0, 0], 0.02, 0.015),
                qpmhe.Polytope([[1.0, 0.2], [0.2, 1.0], [-1, -1]], [0.12, 0.19, 0.6]),
            ),
        },
    )


def tracking():
    """Range and bearing of a vehicle."""

    def step(x, m):
        return [x[0] + 0.2 * x[2], x[1] + 0.2 * x[3], x[2], x[3]]

    def output(x, m):
        return [m.sqrt(x[0] ** 2 + x[1] ** 2), m.arctan2(x[1], x[0])]

    return Case(
        step, output,
        truth=[2.8, 1.8, -0.2, 0.2], start=[2.9, 2.2, 0.0, 0.1],
        gain=[[0.05, -0.05], [0.05, 0.1], [0.02, -0.02], [0.02, 0.05]],
        deviations=([0.5, 0.5, 0.5, 0.5], [0.1, 0.1, 0.2, 0.2], [0.2, 0.1]),
        draws=([0.02, 0.02, 0.1, 0.1], [0.4, 0.2]),
        sets={
            "box": (
                qpmhe.Box([0.5, 2.0, -0.15, -0.4], [3.2, 6.0, 0.4, 0.2]),
                symmetric(0.055, 0.055, 0.024, 0.022), qpmhe.Box([-1.5, -0.5], [0.27, 0.17]),
            ),
            "polytope": (
                qpmhe.Polytope([[0, 0, 1, 1], [-1, -1, 0, 0], [0, 0, -1, 0]], [0.3, -4.0, 0.3]),
                around([0, 0, 0, 0], 0.16, 0.16, 0.06, 0.05),
                qpmhe.Polytope([[1, 0.5], [0, 1], [-1, -1]], [0.32, 0.18, 1.5]),
            ),
            "noise_free": (
                qpmhe.Box([0.5, 2.0, -0.3, -0.4], [3.2, 6.0, 0.4, 0.3]),
                symmetric(0.0, 0.0, 0.024, 0.022) & qpmhe.Polytope([[0, 0, 1, 1]], [0.03]),
                qpmhe.Box([-1.5, -0.5], [0.3, 0.19]),
            ),
        },
    )


SYSTEMS = {
    "reactor": reactor, "pendulum": pendulum, "stirred_tank": stirred_tank, "tracking": tracking,
}
