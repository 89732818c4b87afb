"""Systems, sets and costs that several files use."""

import numpy as np

import qpmhe
from qpmhe.certificates import certify, certify_detectability, certify_observer, synthesise_gain

REACTOR = qpmhe.Box([0.1, 0.0], [9.0, 9.0])
PENDULUM = qpmhe.Box([-3.0, -10.0], [3.0, 10.0])


def linear(A, C, **options):
    A, C = np.atleast_2d(A), np.atleast_2d(C)
    return qpmhe.System(
        lambda x: x @ A.T, lambda x: x @ C.T, n=A.shape[0], p=C.shape[0], **options
    )


def scalar(f=lambda x: 0.5 * x, h=lambda x: 1.0 * x, **options):
    return qpmhe.System(f, h, n=1, p=1, **options)


def box(low, high):
    return qpmhe.Box(np.atleast_1d(low), np.atleast_1d(high))


def unit_box(n):
    return qpmhe.Box(-np.ones(n), np.ones(n))


def unit_cost(n=1, p=1):
    return qpmhe.QuadraticCost(prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(p))


# What may be asked of a scalar system on a region.
GAIN = qpmhe.Luenberger([[0.1]])
QUESTIONS = {
    "detectability": certify_detectability,
    "observer": lambda system, region, **how: certify_observer(system, GAIN, region, **how),
    "gain": lambda system, region, **how: synthesise_gain(system, region, **how).stability,
    "certificate": lambda system, region, **how: certify(
        system, GAIN, unit_cost(), horizon=2, region=region, **how
    ),
}


def two_tanks():
    """Two tanks in a row with Torricelli's outflow; the second level is measured."""

    def rate(x):
        flow = np.sqrt(x) * 0.3
        out = np.empty(x.shape, x.dtype)
        out[..., 0] = 0.35 - flow[..., 0]
        out[..., 1] = flow[..., 0] - flow[..., 1]
        return out / 0.5

    return qpmhe.System.from_ode(rate, lambda x: x[..., 1:], dt=0.1, n=2, p=1)
