"""What stands for a missing measurement, and what is no measurement at all."""

import subprocess
import sys
from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError

from .spoil import check, cost_of, estimator, system_of, unharmed

DATE, DURATION = np.datetime64("2026-01-01T00:00:05"), np.timedelta64(5, "s")
TIMES = {
    "datetime64": np.array([DATE]), "timedelta64": np.array([DURATION]), "one": DATE,
    "one duration": DURATION, "list": [DURATION], "datetime": [datetime(2026, 1, 1)],
    "timedelta": [timedelta(seconds=5)], "Timestamp": [pd.Timestamp(DATE)],
    "Timedelta": [pd.Timedelta(DURATION)], "series": pd.Series([DATE]),
    "index": pd.DatetimeIndex([DATE]), "objects": np.array([DURATION], object),
    "masked": np.ma.array([DURATION], mask=[False]),
}


@pytest.mark.parametrize("y", TIMES.values(), ids=TIMES)
def test_times_are_no_measurements(y):
    def run(mhe):
        mhe.run([y, y] if np.ndim(y) else [[y], [y]])

    refused = InvalidInputError, ["y is ", "not an array of real numbers"]
    record = InvalidInputError, ["measurements is ", "not an array of real numbers"]
    unharmed(
        estimator,
        [(*refused, lambda mhe: mhe.update(y)), (*record, run)],
        ([1.5],),
    )


def test_the_remedy_for_times():
    check(
        InvalidInputError, ["dates or durations", "(t - t[0]) / numpy.timedelta64(1, 's')"],
        lambda: estimator().update(TIMES["datetime64"]),
    )


def two():
    return estimator(
        system_of(h=lambda x: x, p=2), qpmhe.Luenberger(0.1 * np.eye(2)), cost_of(2, 2)
    )


NAT = np.datetime64("NaT")
MISSING = {
    "NaN": [np.nan, 2.0], "None": [None, 2.0], "NA": [pd.NA, 2.0], "NaT": [pd.NaT, 2.0],
    "NumPy's NaT": [NAT, 2.0], "array": pd.array([pd.NA, 2.0]), "integers": pd.array([pd.NA, 2]),
    "series": pd.Series([pd.NA, 2], dtype="Int64"), "tuple": (pd.NA, 2.0),
    "objects": np.array([pd.NA, 2], object), "masked": np.ma.array([7.0, 2.0], mask=[True, False]),
    "masked objects": np.ma.array([7.0, 2.0], mask=[True, False], dtype=object),
    "row": pd.DataFrame({"a": pd.array([pd.NA]), "b": [2.0]}).loc[0],
}


@pytest.mark.parametrize("y", MISSING.values(), ids=MISSING)
def test_missing_in_part(y):
    expected, found = two(), two()
    for t in range(5):
        sample = (y, [np.nan, 2.0]) if t == 2 else ([1.0, t], [1.0, t])
        one, other = found.update(sample[0]), expected.update(sample[1])
        assert one.state.tolist() == other.state.tolist()
        assert one.status == other.status
        assert (Status.MISSING in one.status) is (t == 2)


@pytest.mark.parametrize(
    "y", [None, pd.NA, pd.NaT, NAT, [pd.NaT], np.array([NAT]), np.array(["NaT"], "m8[s]"),
          pd.Series([pd.NaT]), np.ma.masked_all(1, "M8[s]")], ids=repr,
)
def test_missing_altogether(y):
    estimate = estimator().update(y)
    assert Status.MISSING in estimate.status
    assert np.isnan(estimate.noises).all()


def test_records_with_gaps():
    frame = pd.DataFrame({"a": pd.array([1, pd.NA, 3]), "b": pd.array([pd.NA, 0.5, None])})
    found, expected = two().run(frame), two().run([[1, np.nan], [np.nan, 0.5], [3, np.nan]])
    assert found.states.tolist() == expected.states.tolist()
    batch = qpmhe.BatchEstimator(
        system_of(), qpmhe.Luenberger([[0.3], [0.1]]), cost_of(), members=2, horizon=3,
        initial_states=[1.0, 2.0],
    )
    run = batch.run([[1.0, pd.NA, 2.0], [1.0, np.nan, 2.0]])
    assert run.states[0].tolist() == run.states[1].tolist()


def test_what_is_missing_is_no_input_and_no_gain():
    check(InvalidInputError, ["gain is [nan, 1.0]", "finite"],
          lambda: qpmhe.Luenberger([pd.NA, 1.0]))


def test_pandas_is_not_imported():
    code = (
        "import sys, numpy as np, qpmhe\n"
        "system, observer, cost, scenario = qpmhe.models.batch_reactor()\n"
        "mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=3,\n"
        "    initial_state=[3.0, 0.0])\n"
        "mhe.update([None]), mhe.update(np.array([7.0], object))\n"
        "assert 'pandas' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
