"""The claims of docs/explanation/fast-answers.md, from its own script on fewer records."""

import warnings

import numpy as np
import pytest

import qpmhe
from examples.studies import fast_answers as study

FEW = 0.1


@pytest.fixture(autouse=True)
def poor_on_purpose():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", qpmhe.ObserverWarning)
        warnings.simplefilter("ignore", qpmhe.PriorWarning)
        yield


@pytest.mark.slow
def test_a_bound_that_holds_helps_the_speed_and_harms_the_distance():
    short, long = study.bounds(FEW)
    for row in (short, long):
        assert row["speed, v ≥ 0"] < 0.9 * row["speed, without bound"]
    assert long["distance at the end, v ≥ 0"] > 1.5 * long["distance at the end, without"]


@pytest.mark.slow
def test_the_exact_map_is_worse_than_the_kalman_filter():
    for row in study.uniform(FEW):
        kalman = row["Kalman filter"]
        assert 0.97 * kalman < row["its cost, w bounded"] <= 1.001 * kalman
        if row["r"] >= 0.1:
            assert row["exact MAP"] > 1.02 * kalman
    assert row["exact MAP"] > 1.2 * kalman  # the noisiest


def test_the_nearest_point_is_nearer_in_its_own_metric_only():
    for row in study.projection(FEW):
        assert row["errors as P says"] < 1.05 < row["independent errors"]
        assert row["the same, cut off at 0"] < 0.8
        assert row["farther in P⁻¹"] == 0


@pytest.mark.slow
def test_a_vague_prior_is_worst_just_above_the_observability_index():
    rows = study.horizons(FEW)
    vague = {row["N"]: row["prior 100 P"] for row in rows}
    assert max(vague, key=vague.get) in (2, 3)
    assert max(vague.values()) > 3.0
    assert vague[1] < vague[2]
    assert vague[40] < 1.02
    sure = {row["N"]: row["prior P / 100"] for row in rows}
    assert max(sure.values()) < 1.35


@pytest.mark.slow
def test_a_smoothed_prior_wants_a_smaller_covariance():
    rows = study.smoothed(FEW)
    for N in ("N = 5", "N = 10"):
        errors = {row["prior"]: row[N] for row in rows}
        assert min(errors, key=errors.get) in ("0.1 P", "0.3 P")
        assert errors["10 P"] > 1.1 * errors["0.3 P"]


@pytest.mark.slow
def test_huber_and_gates_change_sides():
    slow, _, fast, fastest = study.outliers(FEW)
    assert slow["Huber over the first"] == pytest.approx(1.0, abs=0.1)
    assert fast["Huber over the first"] < 1.0 < 1.2 < fast["over the second"]
    assert fastest["Huber over the first"] < 0.2
    assert fastest["over the second"] < 0.9


@pytest.mark.slow
def test_missing_at_random_is_worse_than_regularly():
    ratios = [row["random over regular"] for row in study.missing(FEW)]
    assert ratios[0] < 1.1 < ratios[1] < 1.3 < ratios[2]


def test_the_unobservable_turn_is_claimed_to_be_known():
    (row,) = study.unobservable(FEW)
    least = row["least possible deviation (rad)"]
    # 5 m and 0.5 rad at 10 m: 1 / sqrt((10 / 5)^2 + 1 / 0.5^2)
    assert least == pytest.approx(1.0 / np.sqrt(8.0))
    assert row["along the true states"] == pytest.approx(least, rel=0.03)
    assert row["claimed (median)"] < 0.2 * least < 0.5 * row["error (rms)"]


@pytest.mark.slow
def test_the_mean_cost_tells_the_priors_apart():
    kalman, luenberger, smoothed = study.consistency(0.4 * FEW)
    for N in ("N = 5", "N = 10", "N = 20"):
        assert 0.9 < kalman[N] < 1.1
        assert smoothed[N] < 0.96 * kalman[N]
    assert smoothed["N = 5"] < smoothed["N = 20"]
    assert luenberger["N = 5"] > 1.05 * kalman["N = 5"]


def test_stages_lose_nothing_where_condensing_does():
    rows = study.condensing()
    for row in rows:
        assert float(row["by stages (qpmhe)"]) < 1e-13
    last = rows[-1]
    assert float(last["condensed, QR"]) > 1e-9
    assert last["condensed, Cholesky"] == "not positive definite"


def test_a_table_goes_between_its_markers_only():
    page = "a\n<!-- fast:x -->\nold\n<!-- end -->\nb\n"
    assert "| n |\n| --- |\n| 0.123 |" in study.filled(page, "x", study.table([{"n": 0.12345}]))
    with pytest.raises(ValueError, match="0 times"):
        study.filled(page, "y", "")
