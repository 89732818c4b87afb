"""Systems, sets and costs that several files use."""

import numpy as np

import qpmhe

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
