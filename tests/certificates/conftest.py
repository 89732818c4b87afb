"""Systems with certificates that several files use, made once."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.contraction import certify_detectability, certify_observer
from qpmhe.certificates.sizes import Sizes

REACTOR_BOX = ([0.1, -1.0], [9.0, 9.0])


@pytest.fixture(scope="session")
def reactor():
    """The paper's example, and its certificate at rates known to be feasible."""
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    region = qpmhe.Box(*REACTOR_BOX)
    certificate = certify(
        system, observer, cost, horizon=(1, 5, 10), region=region,
        sizes=Sizes(0.3, 0.6),
        detectability=certify_detectability(system, region, eta=0.9, weights=(0.1, 0.2)),
        stability=certify_observer(system, observer, region, rho=0.95),
    )
    return certificate, scenario


@pytest.fixture(scope="session")
def linear():
    """A linear system, certified with the rates that the search takes."""
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1,
        states=qpmhe.Box([-10.0, -10.0], [10.0, 10.0]),
    )
    observer = qpmhe.Luenberger([[0.4], [0.1]])
    cost = qpmhe.QuadraticCost(
        prior=np.diag([1.0, 2.0]), disturbance=np.diag([4.0, 9.0]), noise=3.0
    )
    return certify(system, observer, cost, horizon=4)
