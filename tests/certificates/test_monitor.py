"""Which hypotheses are found to hold, and for how many steps a certificate applies."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.certificate import certify
from qpmhe.certificates.monitor import Hypotheses, Monitor, monitor, monitored_run
from qpmhe.certificates.properties import Detectability, ObserverStability
from qpmhe.errors import InvalidInputError, OptionError, ShapeError

from .helpers import box

ALL = tuple(Hypotheses.__dataclass_fields__)
SETS = {"candidate_in_sets", "feasible"}
REGION = {"candidate_in_region", "estimate_in_region"}
ASSUMED = {
    "detectability": Detectability.assumed(eta=0.8, c_p=1.0, c_w=1.25, c_v=0.01),
    "stability": ObserverStability.assumed(rho=0.5, C_p=1.0, C_w=2.0, C_v=0.6, kappa=0.3),
}


def made(*, f=None, sets=None, gain=0.3, unit=1.0, side=10.0, m=0, **options):
    """A scalar system whose assumed constants are exact, with its certificate."""
    f = f or ((lambda x, u: 0.8 * x + u) if m else (lambda x: 0.8 * x))
    system = qpmhe.System(
        f, lambda x: x, n=1, p=1, m=m, **options, **(sets or {})
    )
    weight = 1.0 if unit == 1.0 else 1e-12 / unit**2
    cost = qpmhe.QuadraticCost(prior=weight, disturbance=2.0 * weight, noise=weight)
    return certify(
        system, qpmhe.Luenberger([gain]), cost, horizon=3, region=box(-side * unit, side * unit),
        inputs=box(-1.0, 1.0) if m else None, **ASSUMED,
    )


def estimator(certificate, **options):
    return qpmhe.MovingHorizonEstimator(
        certificate.system, certificate.observer, certificate.cost,
        **({"horizon": 3, "initial_state": [0.0], "max_qps": 1} | options),
    )


def missed(check):
    return {name for name in ALL if not getattr(check, name)}


def test_on_an_ordinary_run_everything_holds():
    certificate, y = made(), np.random.default_rng(0).standard_normal(20)
    run, summary = monitored_run(certificate, estimator(certificate), y)
    assert len(run) == summary.steps == summary.applied == summary.held == 20
    assert summary.first_failure is None
    assert summary.missed == dict.fromkeys(ALL, 0)
    assert str(summary) == "The certificate applied at 20 of 20 steps."
    np.testing.assert_array_equal(run.states, estimator(certificate).run(y).states)


def lost(x):
    return 0.8 * x if x[0] < 2.0 else np.full(1, np.nan)


JACOBIANS = {"f_jacobian": lambda x: np.array([[0.8]]), "h_jacobian": lambda x: np.eye(1)}


@pytest.mark.parametrize(
    ("options", "record", "applied", "failed"),
    [
        ({}, [1.0] * 4 + [np.nan] + [1.0] * 7, 4, "complete"),
        ({"gain": 0.4}, [1.0] * 5, 0, "kappa"),  # the certificate was given 0.3
        ({"f": lost, "side": 1.0, **JACOBIANS}, [0.0, 20.0, 20.0, 0.0], 2, "complete"),
    ],
)
def test_a_certificate_ends_at_the_first_failure(options, record, applied, failed):
    certificate = made(**options)
    _, summary = monitored_run(certificate, estimator(certificate, max_qps=0), record)
    assert (summary.applied, summary.first_failure) == (applied, applied)
    assert failed in summary.failed
    assert "lost (" in str(summary)
    if len(record) == 12:
        assert summary.missed["complete"] == 3  # the window holds it for three steps


def test_leaving_the_region_is_seen_one_step_later():
    certificate = made(side=1.0)
    mhe = estimator(certificate, max_qps=0)
    watch = Monitor.of(certificate, mhe)
    seen = [missed(watch.check(mhe.update(y))) for y in (0.0, 10.0, *[0.0] * 8)]
    # z(2) = 3 is the newest state of the second step, and in the window from the third on.
    assert seen[:3] == [set(), set(), REGION]
    assert seen[-1] == set()
    assert not watch.applies
    assert watch.summary().applied == 2


def test_violated_sets_are_reported_but_not_needed():
    certificate = made(sets={"noises": qpmhe.Box([-0.1], [0.1])})
    check = monitor(certificate, estimator(certificate, max_qps=0).update(5.0))
    assert missed(check) == SETS
    assert check.held
    assert check.failed == ()
    _, summary = monitored_run(
        certificate, estimator(certificate, max_qps=0), [5.0, 0.0, 0.0, 0.0, 0.0]
    )
    assert (summary.applied, summary.first_failure) == (5, None)
    for name in SETS:
        count = summary.missed[name]
        assert count > 0
        assert f"{name.replace('_', ' ')} at {count} step" in str(summary)
        assert summary.to_dict()["hypotheses"][name] == {
            "needed": False, "failed": count, "held": 5 - count,
        }
    assert "the bound needs no sets" in str(summary)


def test_a_projected_candidate_is_no_observer_trajectory():
    certificate = made(sets={"states": qpmhe.Box([-1.0], [1.0])}, gain=0.3)
    mhe = estimator(certificate)
    mhe.update(5.0)
    assert "observer_candidate" in monitor(certificate, mhe.update(0.0)).failed


@pytest.mark.parametrize("which", ["cost", "candidate_cost"])
def test_costs_that_are_not_those_of_the_trajectories_are_seen(which):
    certificate = made()
    mhe = estimator(certificate)
    mhe.update(1.0)
    estimate = mhe.update(-1.0)
    assert monitor(certificate, estimate).cost_decrease
    setattr(estimate, which, getattr(estimate, which) + 0.01)
    assert not monitor(certificate, estimate).cost_decrease
    estimate.cost = 1.01 * estimate.candidate_cost
    assert not monitor(certificate, estimate).cost_decrease


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_what_does_not_hold_is_seen_in_any_unit(unit):
    certificate = made(sets={"noises": qpmhe.Box([-unit], [unit])}, unit=unit)
    mhe = estimator(certificate)
    assert missed(monitor(certificate, mhe.update(0.9 * unit))) == set()
    estimate = mhe.update(4.0 * unit)
    assert "candidate_in_sets" in missed(monitor(certificate, estimate))
    estimate.candidate_cost *= 1.001
    assert not monitor(certificate, estimate).cost_decrease
    moved = mhe.update(0.5 * unit)
    moved.candidate[-1] += 1e-3 * unit  # a correction that is not the gain's
    assert not monitor(certificate, moved).observer_candidate


def test_inputs_belong_to_the_window_and_to_the_region():
    certificate = made(m=1)
    mhe = estimator(certificate)
    watch = Monitor.of(certificate, mhe)
    for u in (0.5, -0.5, 0.2, 0.9, 0.1):
        assert watch.check(mhe.update(0.3, [u]), [u]).held
    late = mhe.update(0.3, [1.5])
    assert missed(watch.check(late, [1.5])) == REGION
    with pytest.raises(ShapeError, match="u has shape"):
        watch.check(late)
    with pytest.raises(ShapeError, match="inputs"):
        monitor(certificate, late, np.zeros((1, 1)))
    # Other inputs than those that acted do not explain the trajectories.
    assert not monitor(certificate, late, np.zeros((3, 1))).cost_decrease
    with pytest.raises(ShapeError, match="inputs"):
        monitored_run(certificate, estimator(certificate), np.zeros(3), np.zeros((2, 1)))


def test_a_prior_from_the_observer_has_its_lower_bound():
    system = made().system
    observer = qpmhe.SteadyStateKalman(system, [0.0], disturbance=0.5, noise=1.0)
    prior = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    certificate = certify(
        system, observer, qpmhe.QuadraticCost(prior=prior, disturbance=2.0, noise=1.0), horizon=3,
        region=box(-10.0, 10.0), detectability=ASSUMED["detectability"],
    )
    y = np.random.default_rng(1).standard_normal(8)
    assert monitored_run(certificate, estimator(certificate), y)[1].applied == 8


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"horizon": 4}, OptionError, "horizon"),
        ({"candidate": "reinitialized"}, OptionError, "reinitialized"),
        ({"arrival": "smoothed"}, OptionError, "smoothed"),
    ],
)
def test_a_monitor_is_for_one_kind_of_estimator(options, error, words):
    certificate = made()
    with pytest.raises(error, match=words):
        Monitor.of(certificate, estimator(certificate, **options))


def test_a_monitor_is_for_one_estimator_from_its_start():
    certificate = made()
    with pytest.raises(InvalidInputError, match="another system"):
        Monitor.of(made(), estimator(certificate))
    used = estimator(certificate)
    used.update(0.0)
    with pytest.raises(InvalidInputError, match="reset"):
        Monitor.of(certificate, used)
