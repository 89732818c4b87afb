"""The bound with measured costs asks whose costs they are."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.evidence import MismatchError
from qpmhe.certificates.monitor import Monitor, monitor
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.errors import InvalidInputError

from .helpers import box, linear, unit_cost

COST, SYSTEM, OBSERVER = unit_cost(), linear(1.1, 1.0), qpmhe.Luenberger([[0.2]])
CHEAP = qpmhe.QuadraticCost(prior=0.01, disturbance=0.01, noise=0.01)
RNG = np.random.default_rng(0)
W, V = 0.3 * RNG.standard_normal((2, 30, 1))
X = [RNG.uniform(-1.0, 1.0, 1)]
for disturbance in W:
    X.append(1.1 * X[-1] + disturbance)
Y = np.array(X[:-1]) + V


@pytest.fixture(scope="module")
def certificate():
    return certify(
        SYSTEM, OBSERVER, COST, horizon=[1, 5], region=box(-100.0, 100.0),
        detectability=Detectability.assumed(eta=0.5, c_p=1.0, c_w=2.0, c_v=1.2),
        stability=ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.2, C_v=0.3, kappa=0.2),
    )


def estimator(horizon=5, cost=COST, observer=OBSERVER, **options):
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, observer, cost, horizon=horizon, initial_state=[0.0], **({"max_qps": 1} | options)
    )


def bound(certificate, run, kind="measured", **options):
    return certificate.bound(run, W, V, initial_error=X[0], kind=kind, **options)


def test_the_sources_horizon_is_taken(certificate):
    mhe = estimator(1)
    run = mhe.run(Y)
    np.testing.assert_array_equal(
        bound(certificate, run, source=mhe), bound(certificate, run, horizon=1, source=mhe)
    )
    with pytest.raises(InvalidInputError, match="does not say its horizon and cost"):
        bound(certificate, run, horizon=5)
    for kind in ("measured", "paper"):
        with pytest.raises(MismatchError, match="horizon is 5, but the run's estimator has 1"):
            bound(certificate, run, kind, horizon=5, source=mhe)


def test_another_estimator_is_refused(certificate):
    for options in ({"cost": CHEAP}, {"observer": qpmhe.Luenberger([[0.3]])}):
        mhe = estimator(**options)
        with pytest.raises(MismatchError, match=f"another {next(iter(options))}"):
            bound(certificate, mhe.run(Y), source=mhe)
    mhe, fresh, other = estimator(), estimator(), estimator()
    run = mhe.run(Y)
    other.run(-Y)
    mhe.update(0.0)
    for source in (fresh, other, mhe):
        with pytest.raises(MismatchError, match="not at the end of this run"):
            bound(certificate, run, source=source)


def test_costs_of_broken_windows_are_not_used(certificate):
    y, mhe = Y.copy(), estimator()
    y[10] = np.nan
    run = mhe.run(y)
    found = bound(certificate, run, source=mhe)
    plain = bound(certificate, run, "summed", horizon=5)
    np.testing.assert_array_equal(found[11:16], plain[11:16])
    assert (found[16:] < plain[16:]).all()


def test_a_monitor_sees_each_estimate_of_its_horizon(certificate):
    mhe, watch = estimator(1), Monitor(certificate, 5)
    first = mhe.update(0.1)
    assert watch.check(first).held
    with pytest.raises(MismatchError, match="of the time 0; expected 1"):
        watch.check(first)
    with pytest.raises(MismatchError, match="1 stages at time 1; expected 2"):
        watch.check(mhe.update(0.2))


def test_corrections_by_another_gain_are_seen(certificate):
    # Another gain within kappa: no bound on its size can show it.
    mhe = estimator(observer=qpmhe.Luenberger([[0.1]]), max_qps=0)
    check = monitor(certificate, mhe.update(1.0))
    assert check.kappa
    assert check.failed == ("observer_candidate",)
    assert monitor(certificate, estimator().update(1.0)).held
