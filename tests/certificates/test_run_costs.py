"""The bound with measured costs asks whose costs they are."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.evidence import MismatchError
from qpmhe.certificates.monitor import Monitor, monitor
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.errors import InvalidInputError

COST = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
SYSTEM = qpmhe.System(lambda x: 1.1 * x, lambda x: 1.0 * x, n=1, p=1)
OBSERVER = qpmhe.Luenberger([[0.2]])
STEPS = 30


@pytest.fixture(scope="module")
def certificate():
    return certify(
        SYSTEM, OBSERVER, COST, horizon=[1, 5], region=qpmhe.Box([-100.0], [100.0]),
        detectability=Detectability.assumed(eta=0.5, c_p=1.0, c_w=2.0, c_v=1.2),
        stability=ObserverStability.assumed(rho=0.9, C_p=1.0, C_w=1.2, C_v=0.3, kappa=0.2),
    )


def estimator(horizon=5, cost=COST, **options):
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, OBSERVER, cost, horizon=horizon, initial_state=[0.0], max_qps=1, **options
    )


def record(seed=0):
    """States, measurements, disturbances and noises."""
    rng = np.random.default_rng(seed)
    w, v = 0.3 * rng.standard_normal((2, STEPS, 1))
    x = [rng.uniform(-1.0, 1.0, 1)]
    for t in range(STEPS):
        x.append(1.1 * x[-1] + w[t])
    return np.array(x), np.array(x[:-1]) + v, w, v


def measured(certificate, run, **options):
    x, _, w, v = record()
    return certificate.bound(run, w, v, initial_error=x[0], kind="measured", **options)


def test_a_run_alone_does_not_tell(certificate):
    run = estimator(1).run(record()[1])
    with pytest.raises(InvalidInputError, match="does not say its horizon and cost"):
        measured(certificate, run, horizon=5)


def test_the_sources_horizon_is_taken_and_insisted_on(certificate):
    mhe = estimator(1)
    run = mhe.run(record()[1])
    np.testing.assert_array_equal(
        measured(certificate, run, source=mhe), measured(certificate, run, horizon=1, source=mhe)
    )
    with pytest.raises(MismatchError, match="horizon is 5, but the run's estimator has 1"):
        measured(certificate, run, horizon=5, source=mhe)
    x, _, w, v = record()
    with pytest.raises(MismatchError, match="horizon is 5"):  # for the other kinds as well
        certificate.bound(run, w, v, initial_error=x[0], horizon=5, source=mhe)


def test_another_cost_system_or_observer_is_refused(certificate):
    other = qpmhe.QuadraticCost(prior=0.01, disturbance=0.01, noise=0.01)
    mhe = estimator(cost=other)
    with pytest.raises(MismatchError, match="another cost"):
        measured(certificate, mhe.run(record()[1]), source=mhe)
    mhe = qpmhe.MovingHorizonEstimator(
        SYSTEM, qpmhe.Luenberger([[0.3]]), COST, horizon=5, initial_state=[0.0]
    )
    with pytest.raises(MismatchError, match="another observer"):
        measured(certificate, mhe.run(record()[1]), source=mhe)


def test_an_estimator_that_did_not_make_the_run_is_refused(certificate):
    mhe = estimator()
    run = mhe.run(record()[1])
    fresh = estimator()
    with pytest.raises(MismatchError, match="not at the end of this run"):
        measured(certificate, run, source=fresh)
    fresh.run(record(1)[1])
    with pytest.raises(MismatchError, match="not at the end of this run"):
        measured(certificate, run, source=fresh)
    mhe.update(0.0)
    with pytest.raises(MismatchError, match="not at the end of this run"):
        measured(certificate, run, source=mhe)


def test_costs_of_broken_windows_are_not_used(certificate):
    y = record()[1]
    y[10] = np.nan
    mhe = estimator()
    run = mhe.run(y)
    found = measured(certificate, run, source=mhe)
    x, _, w, v = record()
    plain = certificate.bound(run, w, v, initial_error=x[0], horizon=5, kind="summed")
    np.testing.assert_array_equal(found[11:16], plain[11:16])
    assert (found[16:] < plain[16:]).all()


def test_a_monitor_sees_each_estimate_of_its_horizon(certificate):
    mhe = estimator(1)
    watch = Monitor(certificate, 5)
    first = mhe.update(0.1)
    assert watch.check(first).held
    with pytest.raises(MismatchError, match="of the time 0; expected 1"):
        watch.check(first)
    with pytest.raises(MismatchError, match="1 stages at time 1; expected 2"):
        watch.check(mhe.update(0.2))


def test_corrections_by_another_gain_are_seen(certificate):
    # Another gain within kappa: no bound on its size can tell.
    mhe = qpmhe.MovingHorizonEstimator(
        SYSTEM, qpmhe.Luenberger([[0.1]]), COST, horizon=5, initial_state=[0.0], max_qps=0
    )
    check = monitor(certificate, mhe.update(1.0))
    assert check.kappa
    assert check.failed == ("observer_candidate",)
    assert monitor(certificate, estimator().update(1.0)).held
