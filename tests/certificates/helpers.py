"""Systems, sets and costs that several files use."""

import numpy as np

import qpmhe
from qpmhe.certificates import certify, certify_detectability, certify_observer, synthesise_gain
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.regions import bounded_region

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


def smooth(system, states):
    """The model with its enclosures on a region, and the region."""
    region = bounded_region(system, states)
    return SmoothModel(system, region), region


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
