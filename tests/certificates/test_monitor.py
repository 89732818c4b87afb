"""Which hypotheses are found to hold, and for how many steps a certificate applies."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.monitor import Hypotheses, Monitor, monitor, monitored_run
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.errors import InvalidInputError, OptionError, ShapeError

ALL = tuple(Hypotheses.__dataclass_fields__)
NEEDED = ALL[:-2]


def made(*, sets=None, gain=0.3, kappa=0.3, region=(-10.0, 10.0), prior=1.0, m=0, horizon=3):
    """A scalar system whose assumed constants are exact, with its certificate."""
    f = (lambda x, u: 0.8 * x + u) if m else (lambda x: 0.8 * x)
    system = qpmhe.System(f, lambda x: x, n=1, p=1, m=m, **(sets or {}))
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=2.0, noise=1.0)
    return certify(
        system, qpmhe.Luenberger([gain]), cost, horizon=horizon,
        region=qpmhe.Box([region[0]], [region[1]]),
        inputs=qpmhe.Box([-1.0], [1.0]) if m else None,
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=kappa),
    )


def estimator(certificate, **options):
    return qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost,
        **({"horizon": 3, "initial_state": [0.0], "max_qps": 1} | options),
    )


def values(check):
    return {name for name in ALL if not getattr(check, name)}


def test_on_an_ordinary_run_everything_holds():
    certificate = made()
    rng = np.random.default_rng(0)
    run, summary = monitored_run(certificate, estimator(certificate), rng.standard_normal(20))
    assert len(run) == summary.steps == summary.applied == summary.held == 20
    assert summary.first_failure is None
    assert summary.missed == dict.fromkeys(ALL, 0)
    assert str(summary) == "The certificate applied at 20 of 20 steps."
    again = estimator(certificate).run(np.random.default_rng(0).standard_normal(20))
    np.testing.assert_array_equal(run.states, again.states)


def test_a_missing_measurement_ends_the_certificate_and_leaves_the_window_again():
    certificate = made()
    y = np.ones(12)
    y[4] = np.nan
    _, summary = monitored_run(certificate, estimator(certificate), y)
    assert (summary.applied, summary.first_failure) == (4, 4)
    assert summary.failed == ("complete",)
    assert summary.missed["complete"] == 3  # the window holds it for three steps
    assert "lost (" in str(summary)


def test_a_correction_beyond_kappa_is_seen():
    # The certificate was given a kappa that is too small for the gain.
    certificate = made(gain=0.3, kappa=0.2)
    _, summary = monitored_run(certificate, estimator(certificate), np.ones(5))
    assert summary.applied == 0
    assert summary.failed == ("kappa",)
    certificate = made(gain=0.3, kappa=0.3)
    assert monitored_run(certificate, estimator(certificate), np.ones(5))[1].applied == 5


def test_leaving_the_region_is_seen_one_step_later():
    certificate = made(region=(-1.0, 1.0))
    mhe = estimator(certificate, max_qps=0)
    watch = Monitor.of(certificate, mhe)
    record = (0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    seen = [values(watch.check(mhe.update(y))) for y in record]
    # z(2) = 3 is the newest state of the second step, and in the window from the third on.
    both = {"candidate_in_region", "estimate_in_region"}
    assert seen[:2] == [set(), set()]
    assert seen[2] == both
    assert seen[-1] == set()
    assert not watch.applies
    assert watch.summary().applied == 2


def test_violated_sets_are_reported_but_not_needed():
    certificate = made(sets={"noises": qpmhe.Box([-0.1], [0.1])})
    mhe = estimator(certificate, max_qps=0)
    check = monitor(certificate, mhe.update(5.0))
    assert values(check) == {"candidate_in_sets", "feasible"}
    assert check.held
    assert check.failed == ()
    _, summary = monitored_run(
        certificate, estimator(certificate, max_qps=0), [5.0, 0.0, 0.0, 0.0, 0.0]
    )
    assert (summary.applied, summary.first_failure) == (5, None)
    assert summary.missed["candidate_in_sets"] > 0
    for name in ("candidate_in_sets", "feasible"):
        count = summary.missed[name]
        assert f"{name.replace('_', ' ')} at {count} step" in str(summary)
        assert summary.to_dict()["hypotheses"][name] == {
            "needed": False, "failed": count, "held": 5 - count,
        }
    assert "the bound needs no sets" in str(summary)


def test_a_projected_candidate_is_no_observer_trajectory():
    certificate = made(sets={"states": qpmhe.Box([-1.0], [1.0])}, gain=0.9, kappa=0.9)
    mhe = estimator(certificate)
    mhe.update(5.0)
    check = monitor(certificate, mhe.update(0.0))
    assert not check.observer_candidate
    assert "observer_candidate" in check.failed


@pytest.mark.parametrize("which", ["cost", "candidate_cost"])
def test_costs_that_are_not_those_of_the_trajectories_are_seen(which):
    certificate = made()
    mhe = estimator(certificate)
    mhe.update(1.0)
    estimate = mhe.update(-1.0)
    assert monitor(certificate, estimate).cost_decrease
    setattr(estimate, which, getattr(estimate, which) + 0.01)
    assert not monitor(certificate, estimate).cost_decrease


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_what_does_not_hold_is_seen_in_any_unit(unit):
    system = qpmhe.System(
        lambda x: 0.8 * x, lambda x: x, n=1, p=1, noises=qpmhe.Box([-unit], [unit])
    )
    certificate = certify(
        system, qpmhe.Luenberger([0.3]),
        qpmhe.QuadraticCost(prior=1e-12 / unit**2, disturbance=2e-12 / unit**2,
                            noise=1e-12 / unit**2),
        horizon=3, region=qpmhe.Box([-10.0 * unit], [10.0 * unit]),
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    mhe = estimator(certificate)
    assert values(monitor(certificate, mhe.update(0.9 * unit))) == set()
    estimate = mhe.update(4.0 * unit)
    assert "candidate_in_sets" in values(monitor(certificate, estimate))
    estimate.candidate_cost *= 1.001
    assert not monitor(certificate, estimate).cost_decrease
    moved = mhe.update(0.5 * unit)
    moved.candidate[-1] += 1e-3 * unit  # a correction that is not the gain's
    assert not monitor(certificate, moved).observer_candidate


def test_a_trajectory_above_the_candidates_cost_is_seen():
    certificate = made()
    mhe = estimator(certificate)
    estimate = mhe.update(1.0)
    estimate.cost = estimate.candidate_cost * 1.01
    assert not monitor(certificate, estimate).cost_decrease


def test_inputs_belong_to_the_window_and_to_the_region():
    certificate = made(m=1)
    mhe = estimator(certificate)
    watch = Monitor.of(certificate, mhe)
    for u in (0.5, -0.5, 0.2, 0.9, 0.1):
        assert watch.check(mhe.update(0.3, [u]), [u]).held
    late = mhe.update(0.3, [1.5])
    assert values(watch.check(late, [1.5])) == {"candidate_in_region", "estimate_in_region"}
    with pytest.raises(ShapeError, match="u has shape"):
        watch.check(late)
    with pytest.raises(ShapeError, match="inputs"):
        monitor(certificate, late, np.zeros((1, 1)))
    # Other inputs than those that acted do not explain the trajectories.
    assert not monitor(certificate, late, np.zeros((3, 1))).cost_decrease


def test_a_prior_from_the_observer_has_its_lower_bound():
    system = made().system
    observer = qpmhe.SteadyStateKalman(system, [0.0], disturbance=0.5, noise=1.0)
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(minimum=0.1, maximum=10.0), disturbance=2.0, noise=1.0
    )
    certificate = certify(
        system, observer, cost, horizon=3, region=qpmhe.Box([-10.0], [10.0]),
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
    )
    _, summary = monitored_run(
        certificate, estimator(certificate), np.random.default_rng(1).standard_normal(8)
    )
    assert summary.applied == 8


def test_model_failures_are_seen():
    system = qpmhe.System(
        lambda x: 0.8 * x if x[0] < 2.0 else np.full(1, np.nan), lambda x: x, n=1, p=1,
        f_jacobian=lambda x: np.array([[0.8]]), h_jacobian=lambda x: np.eye(1),
    )
    certificate = certify(
        system, qpmhe.Luenberger([0.3]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=1.0), horizon=3,
        region=qpmhe.Box([-1.0], [1.0]),
        detectability=Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
        stability=ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
    )
    mhe = estimator(certificate, max_qps=0)
    _, summary = monitored_run(certificate, mhe, [0.0, 20.0, 20.0, 0.0])
    assert summary.applied == 2
    assert "complete" in summary.failed


def test_a_monitor_is_for_one_estimator():
    certificate, other = made(), made()
    with pytest.raises(InvalidInputError, match="another system"):
        Monitor.of(other, estimator(certificate))
    with pytest.raises(OptionError, match="horizon"):
        Monitor.of(certificate, estimator(certificate, horizon=4))
    with pytest.raises(OptionError, match="reinitialized"):
        Monitor.of(certificate, estimator(certificate, candidate="reinitialized"))
    with pytest.raises(OptionError, match="smoothed"):
        Monitor.of(certificate, estimator(certificate, arrival="smoothed"))
    used = estimator(certificate)
    used.update(0.0)
    with pytest.raises(InvalidInputError, match="reset"):
        Monitor.of(certificate, used)
    with_inputs = made(m=1)
    with pytest.raises(ShapeError, match="inputs"):
        monitored_run(with_inputs, estimator(with_inputs), np.zeros(3), np.zeros((2, 1)))
