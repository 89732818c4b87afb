import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.stats import ttest_1samp

from qpmhe.errors import InvalidInputError, ShapeError
from qpmhe.studies.summary import CONFIGURATION, pareto_front, summarise

from .report_study import frame, spoilt

METRICS = ("rmse", "rmse_settled", "cost", "cost_ratio", "time_median", "time_p99", "qps_mean")


def cells_of(rows, row):
    for key in CONFIGURATION:
        rows = rows[rows[key].isna() if pd.isna(row[key]) else rows[key] == row[key]]
    return rows


def test_means_and_limits_are_students_and_the_excess_is_paired_by_seed():
    rows = frame()
    summary = summarise(rows)
    assert len(summary) == 7 + 3
    for _, row in summary.iterrows():
        cells = cells_of(rows, row)
        assert (len(cells), row.seeds, row.failures) == (3, 3, 0)
        group = summary[summary.horizon == row.horizon]
        best = cells_of(rows, group.loc[group.rmse.idxmin()]).set_index("seed").rmse
        cells = cells.assign(rmse_excess=cells.rmse / cells.seed.map(best) - 1.0)
        for name in (*METRICS, "rmse_excess"):
            values = cells[name].to_numpy(float)
            assert row[name] == pytest.approx(values.mean(), rel=1e-12)
            if np.ptp(values) > 1e-9 * abs(values.mean()):
                low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
                least = -np.inf if name == "rmse_excess" else 0.0
                assert row[f"{name}_low"] == pytest.approx(max(least, low), rel=1e-9)
                assert row[f"{name}_high"] == pytest.approx(high, rel=1e-9)
        lists = np.array([*cells["rmse_states"]])
        limits = ttest_1samp(lists, 0.0).confidence_interval(0.95)
        assert row.rmse_states == pytest.approx(lists.mean(axis=0))
        assert row.rmse_states_low == pytest.approx(np.maximum(limits.low, 0.0))
        assert row.rmse_states_high == pytest.approx(limits.high)
    alone = summarise(rows[rows.seed == 0])  # one seed has no limits
    assert alone.rmse.notna().all()
    assert alone[["rmse_low", "time_median_high"]].isna().all(axis=None)
    assert np.isnan(alone.rmse_states_low.iloc[0]).all()
    with pytest.raises(InvalidInputError, match="time_p99"):
        summarise(rows.drop(columns="time_p99"))


def test_shares_stay_shares():
    rows = frame()
    rows.loc[rows.seed == 1, "improved"] = 0.0
    rows["reasons"] = [{"IMPROVED": 30, "SOLVER_FAILED": 10}] * len(rows)
    summary = summarise(rows[rows.backend != "observer"])
    assert ((summary.improved > 0.6) & (summary.improved < 0.7)).all()
    assert (summary.improved_low == 0).all()
    assert (summary.improved_high == 1).all()
    assert summary.failed_steps.tolist() == pytest.approx([0.25] * len(summary))
    assert summary.reasons.iloc[0] == {"IMPROVED": 0.75, "SOLVER_FAILED": 0.25}


def test_failed_cells_are_counted_and_left_out_of_means():
    rows = spoilt("osqp", 1, "out of time")
    summary = summarise(rows)
    osqp = summary["backend"] == "osqp"
    assert (summary.failures == osqp).all()
    assert not summary.pareto[osqp].any()
    assert (summary.seeds == 3).all()
    row = summary[osqp].iloc[0]
    assert row.rmse == pytest.approx(cells_of(rows, row).rmse.dropna().mean())
    always = summarise(rows[rows.seed == 1])[osqp]
    assert (always.failures == 1).all()
    assert always.rmse.isna().all()


@pytest.mark.parametrize("key", ["steps", "noise_level"])
def test_other_problems_are_not_mixed(key):
    rows = frame()
    other = rows.assign(**{key: rows[key] * 2, "rmse": 2 * rows.rmse})
    both, alone = summarise(pd.concat([rows, other], ignore_index=True)), summarise(rows)
    assert len(both) == 2 * len(alone)
    same = both[both[key] == rows[key].iloc[0]].reset_index(drop=True)
    for name in ("rmse", "pareto", "rmse_excess"):
        pd.testing.assert_series_equal(same[name], alone[name])


def test_the_front_is_of_one_problem_each_by_the_error_or_without_truth_by_the_cost():
    for name in ("rmse", "cost_ratio"):
        rows = frame()
        if name != "rmse":
            rows[["rmse", "rmse_settled"]] = np.nan
        for _, group in summarise(rows).groupby("horizon"):
            times, errors = group.time_median.to_numpy(), group[name].to_numpy()
            assert group.pareto.to_numpy()[times.argmin()]
            for k in np.flatnonzero(group.pareto):
                assert not ((times < times[k]) & (errors < errors[k] * (1 + 1e-3))).any()
    rows[["time_median", "time_p95", "time_p99", "time_max"]] = np.nan
    assert not summarise(rows).pareto.any()


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
    times, errors = [1.0, 2.0, 3.0, 4.0], [1.0, 0.9995, 0.998, 0.5]
    assert pareto_front(times, errors, 1e-3).tolist() == [True, False, True, True]
    with pytest.raises(ShapeError, match=r"\(2,\) and \(3,\)"):
        pareto_front([1, 2], [1, 2, 3])
