"""Small systems that several tests of the estimator share."""

import numpy as np

import qpmhe


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def linear(A, C, **options):
    A, C = np.array(A, dtype=float), np.array(C, dtype=float)
    return qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=len(A), p=len(C), **options)


class Pendulum:
    """With methods, which pickle."""

    def __init__(self, swing, bend, untraced):
        self.swing, self.bend, self.untraced = swing, bend, untraced

    def rate(self, x, u):
        if self.untraced:
            np.isnan(x)  # has no form in CasADi
        return np.stack((x[..., 1], u[..., 0] - self.swing * np.sin(x[..., 0])), axis=-1)

    def h(self, x, u):
        return x[..., :1] + self.bend * x[..., :1] ** 2


def pendulum(engine, swing=1.0, bend=0.1, **sets):
    options = {"n": 2, "p": 1, "m": 1, "dt": 0.1, "method": "euler", **sets}
    made = Pendulum(swing, bend, engine == "untraced")
    return qpmhe.System.from_ode(made.rate, made.h, **options)
