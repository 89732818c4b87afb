import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.stats import ttest_1samp, ttest_rel

from qpmhe.errors import InvalidInputError, ShapeError
from qpmhe.studies.summary import CONFIGURATION, pareto_front, summarise

from .report_study import frame, spoilt

METRICS = ("rmse", "rmse_settled", "cost_ratio", "time_median", "time_p99", "qps_mean")


def cells_of(rows: pd.DataFrame, row: pd.Series) -> pd.DataFrame:
    for key in CONFIGURATION:
        rows = rows[rows[key].isna() if pd.isna(row[key]) else rows[key] == row[key]]
    return rows


def chosen(summary: pd.DataFrame, backend: str, cap: int | None, horizon: int) -> pd.Series:
    rows = summary[(summary.backend == backend) & (summary.horizon == horizon)]
    rows = rows[rows.solver_iterations.isna() if cap is None else rows.solver_iterations == cap]
    assert len(rows) == 1
    return rows.iloc[0]


def test_one_row_a_configuration():
    summary = summarise(frame())
    assert len(summary) == 7 + 3
    assert set(summary.seeds) == {3}
    assert not summary.failures.any()


def test_means_and_limits_are_students():
    rows = frame()
    for _, row in summarise(rows).iterrows():
        cells = cells_of(rows, row)
        assert len(cells) == 3
        for name in METRICS:
            values = cells[name].to_numpy(float)
            assert row[name] == pytest.approx(values.mean(), rel=1e-12)
            if np.ptp(values) > 1e-9 * abs(values.mean()):
                low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
                assert row[f"{name}_low"] == pytest.approx(max(0.0, low), rel=1e-9)
                assert row[f"{name}_high"] == pytest.approx(high, rel=1e-9)


def test_state_errors_have_means_and_limits():
    rows = frame()
    for _, row in summarise(rows).iterrows():
        lists = np.array([*cells_of(rows, row)["rmse_states"]])
        assert lists.shape == (3, 2)
        assert row.rmse_states == pytest.approx(lists.mean(axis=0))
        limits = ttest_1samp(lists, 0.0).confidence_interval(0.95)
        assert row.rmse_states_low == pytest.approx(np.maximum(limits.low, 0.0))
        assert row.rmse_states_high == pytest.approx(limits.high)
    (one, *_) = summarise(rows[rows.seed == 0]).to_dict("records")
    assert np.isnan(one["rmse_states_low"]).all()


def test_excess_is_paired_by_seed():
    rows = frame()
    summary = summarise(rows)
    for horizon, group in summary.groupby("horizon"):
        best = cells_of(rows, group.loc[group.rmse.idxmin()]).set_index("seed").rmse
        observer = cells_of(rows, chosen(summary, "observer", None, horizon))
        ratios = observer.rmse.to_numpy() / best.loc[observer.seed].to_numpy()
        row = chosen(summary, "observer", None, horizon)
        assert row.rmse_excess == pytest.approx(ratios.mean() - 1)
        limits = ttest_rel(ratios, np.ones(3)).confidence_interval(0.95)
        assert row.rmse_excess_low == pytest.approx(limits.low)
        assert row.rmse_excess_high == pytest.approx(limits.high)


def test_shares_stay_shares():
    rows = frame()
    rows.loc[rows.seed == 1, "improved"] = 0.0
    summary = summarise(rows[rows.backend != "observer"])
    assert ((summary.improved > 0.6) & (summary.improved < 0.7)).all()
    assert (summary.improved_low == 0).all()
    assert (summary.improved_high == 1).all()


def test_failed_cells_are_counted_and_left_out_of_means():
    rows = spoilt("osqp", 1, "out of time")
    summary = summarise(rows)
    row = chosen(summary, "osqp", None, 10)
    assert (row.failures, row.seeds) == (1, 3)
    assert row.rmse == pytest.approx(cells_of(rows, row).rmse.dropna().mean())
    assert not row.pareto
    assert chosen(summary, "daqp", None, 10).failures == 0


def test_a_configuration_that_always_failed_stays():
    rows = pd.concat([spoilt("osqp", 0, "crash").query("seed == 0"),
                      spoilt("osqp", 1, "crash").query("seed == 1")])
    row = chosen(summarise(rows), "osqp", 2, 10)
    assert (row.failures, row.seeds) == (2, 2)
    assert np.isnan(row.rmse)
    assert not row.pareto


def test_failed_steps_come_from_the_flags():
    rows = frame()
    rows["reasons"] = [{"IMPROVED": 30, "SOLVER_FAILED": 10}] * len(rows)
    summary = summarise(rows)
    assert summary.failed_steps.tolist() == pytest.approx([0.25] * len(summary))
    assert summary.reasons.iloc[0] == {"IMPROVED": 0.75, "SOLVER_FAILED": 0.25}


def test_one_seed_has_no_limits():
    rows = frame()
    summary = summarise(rows[rows.seed == 0])
    assert summary.rmse.notna().all()
    assert summary.rmse_low.isna().all()
    assert summary.time_median_high.isna().all()


def test_records_of_other_lengths_are_not_mixed():
    rows = frame()
    longer = rows.assign(steps=80, rmse=2 * rows.rmse)
    both, alone = summarise(pd.concat([rows, longer], ignore_index=True)), summarise(rows)
    assert len(both) == 2 * len(alone)
    short = both[both.steps == 40].reset_index(drop=True)
    pd.testing.assert_series_equal(short.rmse, alone.rmse)
    pd.testing.assert_series_equal(short.pareto, alone.pareto)


def test_accuracy_alone_has_no_front():
    rows = frame()
    rows[["time_median", "time_p95", "time_p99", "time_max"]] = np.nan
    assert not summarise(rows).pareto.any()


def test_the_front_is_of_one_problem_each():
    summary = summarise(frame())
    for _, group in summary.groupby("horizon"):
        times, errors = group.time_median.to_numpy(), group.rmse.to_numpy()
        assert group.pareto.to_numpy()[times.argmin()]
        assert group.pareto.any()
        for k in np.flatnonzero(group.pareto):
            better = (times < times[k]) & (errors < errors[k] * (1 + 1e-3))
            assert not better.any()


def test_missing_column_is_named():
    with pytest.raises(InvalidInputError, match="time_p99"):
        summarise(frame().drop(columns="time_p99"))


points = arrays.arrays(
    float, st.tuples(st.integers(0, 12), st.just(2)),
    elements=st.sampled_from([0.0, 1.0, 2.0, 3.0, 4.0, np.nan, np.inf]),
)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(points)
def test_front_against_its_definition(rows):
    finite = np.isfinite(rows).all(axis=1)
    expected = [
        bool(fine) and not any(
            other_fine and (other <= row).all() and (other < row).any()
            for other, other_fine in zip(rows, finite, strict=True)
        )
        for row, fine in zip(rows, finite, strict=True)
    ]
    assert pareto_front(rows[:, 0], rows[:, 1]).tolist() == expected


def test_front_tolerance():
    times, errors = [1.0, 2.0, 3.0, 4.0], [1.0, 0.9995, 0.998, 0.5]
    assert pareto_front(times, errors).all()
    assert pareto_front(times, errors, 1e-3).tolist() == [True, False, True, True]


def test_front_shapes():
    with pytest.raises(ShapeError, match=r"\(2,\) and \(3,\)"):
        pareto_front([1, 2], [1, 2, 3])
