"""What stands for a missing measurement, and what is no measurement at all."""

import subprocess
import sys
from datetime import datetime

import numpy as np
import pandas as pd
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError

from .same import assert_same
from .spoil import check, cost_of, estimator, system_of, unharmed

NAT = np.datetime64("NaT")
NOTHING = [
    None, [None, np.nan], [np.inf, -np.inf], np.array([1e200, -1e300]), [pd.NA] * 2, [NAT, NAT],
    pd.Series([pd.NaT, pd.NaT]), np.ma.masked_all(2, "M8[s]"), np.array(["NaT"] * 2, "m8[s]"),
]
PARTLY = [
    [None, 2.0], (pd.NA, 2.0), [pd.NaT, 2.0], [NAT, 2.0], [-np.inf, 2.0], [1e200, 2.0],
    pd.array([pd.NA, 2]), pd.Series([pd.NA, 2], dtype="Int64"), np.array([pd.NA, 2], object),
    np.ma.array([7.0, 2.0], mask=[True, False], dtype=object),
    pd.DataFrame({"a": pd.array([pd.NA]), "b": [2.0]}).loc[0],
]


def two(cost=None, initial_state=(1.0, 2.0), **sets):
    return estimator(
        system_of(h=lambda x: x, p=2, **sets), qpmhe.Luenberger(0.1 * np.eye(2)),
        cost or cost_of(2, 2), initial_state=initial_state, max_qps=3,
    )


@pytest.mark.parametrize(("ways", "plainly"), [(NOTHING, [np.nan] * 2), (PARTLY, [np.nan, 2.0])])
def test_every_way_of_saying_that_something_is_missing(ways, plainly):
    expected, found = two(), two()
    for way in ways:
        for t in range(4):
            one = found.update(way if t == 2 else [1.0, t])
            assert_same(one, expected.update(plainly if t == 2 else [1.0, t]))
            assert (Status.MISSING in one.status) is (t == 2)
        expected.reset()
        found.reset()
    frame = pd.DataFrame({"a": pd.array([1, pd.NA, 3]), "b": pd.array([pd.NA, 0.5, None])})
    other = expected.run([[1, np.nan], [np.nan, 0.5], [3, np.nan]])
    assert found.run(frame).states.tolist() == other.states.tolist()


DATE, DURATION = np.datetime64("2026-01-01T00:00:05"), np.timedelta64(5, "s")
TIMES = [
    np.array([DATE]), DURATION, [datetime(2026, 1, 1)], [pd.Timedelta(DURATION)],
    pd.Series([DATE]), np.array([DURATION], object), np.ma.array([DURATION], mask=[False]),
]


def test_times_are_no_measurements():
    calls, words = [], "not an array of real numbers"
    for y in TIMES:
        calls += [
            (InvalidInputError, ["y is ", words], lambda mhe, y=y: mhe.update(y)),
            (InvalidInputError, ["measurements is ", words], lambda mhe, y=y: mhe.run([y, y])),
        ]
    unharmed(estimator, calls, ([1.5],))
    text = ["dates or durations", "(t - t[0]) / numpy.timedelta64(1, 's')"]
    check(InvalidInputError, text, estimator().update, TIMES[0])
    check(InvalidInputError, ["gain is [nan, 1.0]", "finite"], qpmhe.Luenberger, [pd.NA, 1.0])


def test_neither_scipy_nor_pandas_is_imported_and_casadi_by_the_first_derivative():
    code = (
        "import sys, numpy as np, qpmhe.observers\n"
        "one = qpmhe.System(lambda x: 0.5 * x, lambda x: x, n=1, p=1)\n"
        "assert 'casadi' not in sys.modules\n"
        "assert one.derivatives['f'] == 'traced' and 'casadi' in sys.modules\n"
        "assert not [name for name in sys.modules if name.startswith('scipy')]\n"
        "system, observer, cost, scenario = qpmhe.models.batch_reactor()\n"
        "mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=3,\n"
        "    initial_state=[3.0, 0.0])\n"
        "mhe.update([None]), mhe.update(np.array([7.0], object))\n"
        "assert 'pandas' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
