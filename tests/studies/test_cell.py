"""What a worker makes of a cell, against plain NumPy on estimators that are run by hand."""

import numpy as np
import pytest

import qpmhe
from qpmhe.models.loading import find
from qpmhe.studies import cell as module
from qpmhe.studies import metrics
from qpmhe.studies.cell import OBSERVER, Task, compute
from qpmhe.studies.experiment import Source
from qpmhe.studies.row import Cell

ALL = frozenset({"accuracy", "time", "covariance"})
ODD = "tests/studies/odd_models.py"
STEPS = 40


def by_hand(qps, cap=None, backend="auto", start="candidate", model="batch_reactor"):
    system, observer, cost, scenario = qpmhe.models.catalogue()[model]()
    record = scenario.simulate(3, STEPS)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate,
        backend=backend, max_qps=qps, max_solver_iterations=cap, warm_start=start == "best",
    )
    estimates, covariances = [], []
    inputs = [None] * STEPS if record.inputs is None else record.inputs
    for y, u in zip(record.measurements, inputs, strict=True):
        estimates.append(mhe.update(y, u))
        covariances.append(mhe.covariances()[-1])
    found = np.array([scenario.initial_estimate, *(e.state for e in estimates)])
    return record.states, found, estimates, covariances


def row_of(qps=1, cap=None, backend="daqp", start="candidate", parts=ALL, seed=3,
           model="batch_reactor", timeout=60.0, horizon=10, **options):
    cell = Cell(model, backend, qps, cap, horizon, start, seed, STEPS)
    return compute(Task(cell, Source(find(model)), frozenset(parts), timeout, **options))


@pytest.mark.parametrize(
    ("qps", "cap", "backend", "start", "model"),
    [(0, None, OBSERVER, "candidate", "batch_reactor"), (2, 3, "osqp", "candidate", "cstr"),
     (None, 1, "osqp", "best", "batch_reactor")],
)
def test_a_cell_is_the_run_of_an_estimator_made_by_hand(qps, cap, backend, start, model):
    states, found, estimates, covariances = by_hand(
        qps, cap, "auto" if backend == OBSERVER else backend, start, model
    )
    row = row_of(qps, cap, backend, start=start, model=model, keep=True)
    assert (row.outcome, row.reason) == ("done", "")
    assert row.trajectory["estimates"] == pytest.approx(found, rel=1e-9, abs=1e-12)
    errors = found - states
    scenario = qpmhe.models.catalogue()[model]().scenario
    settled = round(scenario.settling_time / scenario.dt)
    assert 0 < settled < STEPS
    relative = (errors / np.sqrt(((states - found[0]) ** 2).mean(axis=0))) ** 2
    for suffix, first in (("", 0), ("_settled", settled)):
        whole = np.sqrt(relative[first:].mean())
        assert getattr(row, f"rmse{suffix}") == pytest.approx(whole, rel=1e-12)
        by_state = np.sqrt((errors[first:] ** 2).mean(axis=0))
        assert getattr(row, f"rmse{suffix}_states") == pytest.approx(by_state, rel=1e-12)
    iterations = [e.solver_iterations for e in estimates if e.solver_iterations is not None]
    _, _, converged, _ = by_hand(None, start=start, model=model)
    pairs = zip(estimates, converged, strict=True)
    for name, value in {
        "improved": np.mean([e.improved for e in estimates]),
        "cap_hits": np.mean([qpmhe.Status.SOLVER_STOPPED in e.status for e in estimates]),
        "qps_mean": np.mean([e.qps for e in estimates]),
        "solver_iterations_mean": np.mean(iterations) if iterations else np.nan,
        "cost": np.mean([e.cost for e in estimates]),
        "cost_ratio": np.mean([e.cost / c.cost for e, c in pairs]),
        "nees": np.mean([e @ np.linalg.inv(P) @ e
                         for e, P in zip(errors[1:], covariances, strict=True)]),
    }.items():
        assert getattr(row, name) == pytest.approx(value, rel=1e-9, nan_ok=True), name
    for flag in qpmhe.Status:
        assert row.reasons.get(flag.name, 0) == sum(flag in e.status for e in estimates)


def test_shares_of_steps_that_fail_are_fallback():
    status = qpmhe.Status
    flags = [
        status.IMPROVED | status.CONVERGED, status.CANDIDATE | status.CONVERGED,
        status.CANDIDATE | status.SOLVER_FAILED, status.CANDIDATE | status.NO_DECREASE
        | status.SOLVER_STOPPED, status.IMPROVED | status.SOLVER_FAILED,
        status.CANDIDATE | status.MODEL_FAILED, status.CANDIDATE | status.NO_QPS,
        status.CANDIDATE | status.MISSING | status.CONVERGED,
    ]
    ones = np.ones(8)
    found = metrics.outcomes(qpmhe.Run(
        states=np.zeros((9, 1)), filtered=ones[:, None], costs=ones, candidate_costs=ones,
        times=ones, solve_times=ones, qps=np.arange(8),
        solver_iterations=np.array([-1, 4] + [-1] * 6), observer_states=np.zeros((9, 1)),
        flags=np.array([flag.value for flag in flags]),
    ))
    assert (found["improved"], found["kept"], found["fallback"]) == (2 / 8, 3 / 8, 3 / 8)
    assert (found["cap_hits"], found["solver_iterations_mean"]) == (1 / 8, 4)


def test_costs_that_say_nothing_are_left_out_of_the_ratio():
    costs = np.array([2.0, np.inf, 3.0, 1.0, np.nan, 0.0])
    reference = np.array([1.0, 1.0, np.inf, 2.0, 1.0, 0.0])
    assert metrics.cost_ratio(costs, reference) == (2.0 + 0.5) / 2


def test_errors_of_different_units_are_summed_up_without_one():
    states, errors = np.random.default_rng(0).standard_normal((2, 30, 3))
    estimates, units = states + 0.1 * errors, np.array([2.0**-30, 1.0, 2.0**20])
    plain = metrics.accuracy(estimates, states, 5)
    scaled = metrics.accuracy(estimates * units, states * units, 5)
    for name in ("rmse", "rmse_settled"):
        assert scaled[name] == plain[name]
        assert scaled[f"{name}_states"] == (np.array(plain[f"{name}_states"]) * units).tolist()
    # States that never leave their initial estimate have a scale: of a constant to be found, the
    # initial error.
    states = np.array([[0.0, 4.0, 1.0], [0.0, 4.0, 3.0]])
    assert metrics.scales(states, np.array([0.0, 4.0, 1.0])).tolist() == [1.0, 4.0, 2.0**0.5]
    assert metrics.scales(states, np.array([0.0, 1.0, 1.0]))[1] == 3.0


def test_only_what_was_asked_for_is_measured():
    for part in ALL:
        row = row_of(None, parts=[part], horizon=3)
        for name, of in (("times", "time"), ("time_max", "time"), ("cost_ratio", "accuracy"),
                         ("nees", "covariance"), ("trajectory", None)):
            value = getattr(row, name)
            known = value is not None and not np.isnan(value).any()
            assert known == (part == of)
        if part == "accuracy":  # the reference has the cell's own horizon
            assert row.cost_ratio == pytest.approx(1, rel=1e-6)
        if part == "time":
            times = row.times
            assert (times.shape, times.dtype, (times > 0).all()) == ((STEPS,), np.float32, True)
            for name, share in (("median", 50), ("p95", 95), ("p99", 99), ("max", 100)):
                quantile = np.percentile(times, share)
                assert getattr(row, f"time_{name}") == pytest.approx(quantile, rel=1e-5)


def test_whatever_is_raised_becomes_a_row_unless_it_is_the_user(monkeypatch):
    for model, timeout, words in (
        (f"{ODD}:raises", 60.0, "ZeroDivisionError: division by zero"),
        (f"{ODD}:leaves", 60.0, "SystemExit: 3"),
        ("batch_reactor", 1e-9, "out of time: 1 of "),
    ):
        row = row_of(model=model, timeout=timeout, seed=1)
        assert (row.outcome, row.model) == ("failed", model)
        assert row.reason.startswith(words)
        assert row.environment["versions"]["numpy"] == np.__version__

    def ends(error):
        def function(*_):
            raise error
        return function

    monkeypatch.setattr(module, "_reference", ends(module.CellTimeoutError("3 of 30 steps.")))
    row = row_of()
    assert (row.outcome, np.isfinite(row.rmse)) == ("done", True)
    assert np.isnan(row.cost_ratio)
    assert "reference ran out of time" in row.reason
    monkeypatch.setattr(module, "experiment", ends(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        row_of()
