"""Outputs that are not there: None, NaN, infinities, masked or absurdly large numbers."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .plain import Record, spd
from .untraced import untraced

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
GAIN = np.array([[0.3, 0.05], [0.1, 0.2]])
START = [0.5, 0.0]
MEASURED = 0.5 * np.random.default_rng(2).standard_normal((8, 2))


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], axis=-1)


def estimator(sets=None, **options):
    system = qpmhe.System(swing, seen, n=2, p=2, **(sets or {}))
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R),
        **{"horizon": 4, "initial_state": START} | options,
    )


NOTHING = {
    "None": None,
    "list of None": [None, None],
    "tuple of None": (None, None),
    "NaN": np.full(2, np.nan),
    "infinite": np.array([np.inf, -np.inf]),
    "None and NaN": [None, float("nan")],
    "masked": np.ma.masked_array([1.0, 2.0], mask=[True, True]),
    "large": np.array([1e200, -1e300]),
}
PARTLY = {
    "None": [None, 0.7],
    "NaN": np.array([np.nan, 0.7]),
    "infinite": [np.inf, 0.7],
    "masked": np.ma.masked_array([1.0, 0.7], mask=[True, False]),
    "large": [1e200, 0.7],
}


@pytest.mark.parametrize("way", NOTHING)
def test_every_way_of_saying_that_nothing_was_measured(way):
    mhe, kept = estimator(), Record(seen, GAIN, START, (P, Q, R), 4)
    for t, y in enumerate(MEASURED):
        missing = t in (0, 3, 4)
        estimate = mhe.update(NOTHING[way] if missing else y)
        kept.push(swing, [np.nan] * 2 if missing else y)
        assert (Status.MISSING in estimate.status) is missing
        np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-12)
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        gone = [time in (0, 3, 4) for time in range(kept.first, t + 1)]
        np.testing.assert_array_equal(np.isnan(estimate.noises), np.transpose([gone, gone]))


@pytest.mark.parametrize("way", PARTLY)
def test_every_way_of_saying_that_a_component_was_not_measured(way):
    mhe, kept = estimator(), Record(seen, GAIN, START, (P, Q, R), 4)
    for t, y in enumerate(MEASURED):
        missing = t in (0, 3, 4)
        estimate = mhe.update(PARTLY[way] if missing else y)
        kept.push(swing, [np.nan, 0.7] if missing else y)
        assert (Status.MISSING in estimate.status) is missing
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        assert np.isfinite(estimate.noises[:, 1]).all()


def test_nothing_is_one_and_the_same_bit_for_bit():
    states = []
    for nothing in (None, [None, None], np.full(2, np.nan), [np.inf, None]):
        mhe = estimator()
        for t, y in enumerate(MEASURED):
            estimate = mhe.update(nothing if t % 3 == 1 else y)
        states.append(estimate.trajectory)
    for other in states[1:]:
        np.testing.assert_array_equal(other, states[0])


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_every_backend_takes_missing_outputs(backend):
    mhe, kept = estimator(backend=backend, max_qps=2), Record(seen, GAIN, START, (P, Q, R), 4)
    for y in MEASURED * np.where(np.arange(16).reshape(8, 2) % 3 == 0, np.nan, 1.0):
        estimate = mhe.update(y)
        kept.push(swing, y)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        assert estimate.improved


def test_a_whole_record_without_measurements_is_the_simulation():
    x = [np.array(START)]
    for _ in range(12):
        x.append(swing(x[-1]))
    run = estimator().run(np.full((12, 2), np.nan))
    np.testing.assert_allclose(run.states, x, rtol=1e-12)
    np.testing.assert_array_equal(run.costs, np.zeros(12))


def test_a_missing_component_is_not_judged_against_its_set():
    # The noise that the state would have is far outside of V where y is not there.
    sets = {"noises": qpmhe.Box([-1.0, -1.0], [1.0, 1.0])}
    mhe = estimator(sets, initial_state=[40.0, 0.0], max_qps=3)
    for t in range(6):
        z = mhe.state
        estimate = mhe.update([None, z[1] + 0.2] if t % 2 else None)
        assert estimate.dropped == ()
        assert not estimate.status & (Status.CANDIDATE_OUTSIDE | Status.ROWS_DROPPED)
        noises = estimate.noises[:, 1]
        assert np.abs(noises[np.isfinite(noises)]).max(initial=0.0) <= 1.0 + 1e-8
    # The component that is there is judged.
    assert estimate.improved
    estimate = mhe.update([None, mhe.state[1] + 30.0])
    assert Status.CANDIDATE_OUTSIDE in estimate.status
    assert estimate.dropped == (("noises", 1, "upper", 6),)


@pytest.mark.parametrize("y", [np.full(2, np.nan), np.array([np.inf, 0.7])], ids=str)
def test_the_model_is_called_once_at_the_candidate_all_the_same(y):
    calls = []

    def counting(x):
        if x.ndim == 1:
            calls.append(x.tolist())
        return swing(x)

    jacobian = qpmhe.System(swing, seen, n=2, p=2).f_jacobian.direct
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(untraced(counting), seen, n=2, p=2, f_jacobian=jacobian),
        qpmhe.Luenberger(GAIN), qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R),
        horizon=4, initial_state=START,
    )
    mhe.update(MEASURED[0])
    calls.clear()
    mhe.update(y)
    assert len(calls) == 1
