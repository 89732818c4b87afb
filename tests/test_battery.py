"""The battery study: its parameter file and its model without the data, its figures with them."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import qpmhe

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples" / "battery_soc"
DATA = Path(os.environ.get("QPMHE_BATTERY_DATA", ROOT.parent / "shared" / "data" / "samsung_30t"))
sys.path.insert(0, str(FOLDER))

import identify  # noqa: E402
import measurements  # noqa: E402
import model  # noqa: E402
import study  # noqa: E402

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no battery data at {DATA}")
DT = study.DT


@pytest.fixture(scope="module")
def cell():
    return model.Cell.read()


def drive(cell, seed, seconds=1500, falling=0.35, outliers=""):
    """A drive of a cell that is not quite the model: other resistances, which fall, other OCV."""
    rng = np.random.default_rng(seed)
    steps = round(seconds / DT)
    current = np.clip(-4.0 + 6.0 * rng.standard_normal(steps // 5 + 1).repeat(5)[:steps], -30, 10)
    scale = np.exp(0.1 * rng.standard_normal(3))
    offset = 0.008 * rng.standard_normal(12)
    system = model.system_of(cell, DT)
    x, soc, voltage = np.array([1.0, 0.0, 0.0, 1.0]), [1.0], []
    for k in range(steps):
        x[3] = scale[0] * (1.0 - falling * k / steps)
        u = current[k : k + 1]
        error = np.interp(x[0], np.linspace(0, 1, 12), offset) + 0.002 * rng.standard_normal()
        voltage.append(system.h(x, u) + error)
        x = system.f(x, u)
        soc.append(x[0])
    y, hit = np.array(voltage), rng.random((steps, 1)) < 0.02
    if outliers:
        y = np.where(hit, 0.0, y)
    return study.Cycle("SIM", y, current[:, None], np.array(soc), 25.0)


def rmse(result):
    return result.figures()["rmse_percent"]


def test_the_parameter_file_is_small_and_tells_where_it_comes_from():
    text = model.PARAMETERS.read_text(encoding="utf-8")
    found = json.loads(text)
    assert len(text) < 10_000
    assert found["provenance"]["doi"] == "10.17632/9xyvy2njj3"
    assert found["provenance"]["files"] == [measurements.C20, measurements.HPPC]
    assert (ROOT / found["provenance"]["script"]).is_file()
    assert 2.8 < found["capacity_Ah"] < 3.2
    assert np.all(np.diff(found["ocv"]["V"]) > 0.0)
    assert found["ocv"]["V"][0] > 2.0
    assert found["ocv"]["V"][-1] < 4.25
    for name in ("R0_Ohm", "R1_Ohm", "R2_Ohm"):
        values = np.array(found["circuit"][name])
        assert values.shape == (len(found["circuit"]["soc"]),)
        assert np.all((values > 0.001) & (values < 0.1))
    fast, slow = found["circuit"]["tau_s"]
    assert 0.0 < fast < slow


def test_derivatives_are_those_of_the_functions(cell):
    system, rng, step = model.system_of(cell, DT), np.random.default_rng(1), 1e-6
    for soc in (0.0333, 0.2, 0.456, 0.81, 0.995):
        x = np.array([soc + 1e-4, *0.02 * rng.standard_normal(2), rng.uniform(0.5, 1.5)])
        u = rng.uniform(-20, 10, 1)
        for function, slopes in (
            (system.f, system.f_jacobian(x, u)), (system.h, system.h_jacobian(x, u))
        ):
            columns = [
                (function(x + step * e, u) - function(x - step * e, u)) / (2 * step)
                for e in np.eye(4)
            ]
            np.testing.assert_allclose(slopes, np.transpose(columns), rtol=1e-5, atol=1e-7)


def test_batches_are_as_single_states(cell):
    system, rng = model.system_of(cell, DT), np.random.default_rng(2)
    x, u = rng.uniform(0.1, 0.9, (7, 4)), rng.uniform(-9, 9, (7, 1))
    for function in (system.f, system.h, system.f_jacobian, system.h_jacobian):
        singly = np.array([function(a, b) for a, b in zip(x, u, strict=True)])
        np.testing.assert_allclose(function.batch(x, u), singly, rtol=1e-13, atol=1e-15)


def test_a_step_is_the_mean_of_many_small_ones(cell):
    coarse, fine = model.system_of(cell, 2.0), model.system_of(cell, 0.01)
    start, u = np.array([0.55, -0.01, 0.02, 0.9]), np.array([-5.0])
    x, outputs = start, []
    for _ in range(200):
        outputs.append(fine.h(x, u))
        x = fine.f(x, u)
    # OCV and resistances move by 0.1 % SOC, which the coarse step takes at its beginning.
    np.testing.assert_allclose(coarse.f(start, u), x, atol=1e-5)
    np.testing.assert_allclose(coarse.h(start, u), np.mean(outputs, axis=0), atol=1e-3)


def test_an_implausible_prior_is_scaled_back(cell):
    huge = model.robust_kalman(
        prior=100.0 * np.eye(4), disturbance=model.disturbance(cell, DT), noise=model.noise(DT)
    )
    assert np.all(np.sqrt(np.diag(huge.initial_covariance())) <= 0.3001)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_warming_cell_is_followed_in_spite_of_outliers(cell, seed):
    bench = study.Bench(cell, 0.6)
    cycle, spoilt = drive(cell, seed), drive(cell, seed, outliers="zero")
    np.testing.assert_array_equal(cycle.soc, spoilt.soc)
    kalman = study.kalman(cell, model.PRIOR)
    plain = bench.alone("EKF", kalman, cycle)
    assert rmse(bench.mhe("MHE", 1, cycle)) <= max(1.1 * rmse(plain), 0.5)
    robust, plain = bench.mhe("MHE", 1, spoilt), bench.alone("EKF", kalman, spoilt)
    assert rmse(robust) < 2.5
    assert rmse(robust) < 0.5 * rmse(plain)


def test_a_prior_that_is_too_sure_is_overcome(cell):
    bench, cycle = study.Bench(cell, 0.6), drive(cell, 3, seconds=700)
    wrong = study.PRIORS["prior too small"]
    robust = bench.mhe("MHE", 1, cycle, prior=wrong)
    plain = bench.alone("EKF", study.kalman(cell, wrong), cycle)
    assert rmse(robust) < 2.5
    assert rmse(robust) < 0.5 * rmse(plain)


def test_estimates_stay_within_the_state_set(cell):
    cycle = drive(cell, 4, seconds=400)
    run = model.estimator(cell, DT, max_qps=1).run(cycle.voltage, cycle.current)
    inside = ~np.array([qpmhe.Status.CANDIDATE_OUTSIDE in status for status in run.statuses])
    assert inside.mean() > 0.9
    soc = run.states[1:, 0][inside]
    assert np.all((soc >= -1e-6) & (soc <= 1.0 + 1e-6))


def test_means_keep_the_charge():
    time = np.cumsum(np.random.default_rng(5).uniform(0.05, 0.2, 4000))
    current = np.sin(time / 7.0) - 1.0
    charge = np.concatenate(
        [[0.0], np.cumsum(0.5 * (current[1:] + current[:-1]) * np.diff(time))]
    ) / 3600.0
    raw = measurements.Raw(time, 3.0 + 0.1 * current, current, charge, np.full(4000, 25.0))
    record = measurements.resample(raw, 2.0)
    counted = 2.0 * np.cumsum(record.current[:, 0]) / 3600.0
    np.testing.assert_allclose(counted, record.charge[1:], atol=1e-9)
    np.testing.assert_allclose(record.voltage, 3.0 + 0.1 * record.current, rtol=1e-9)


def test_without_data_it_says_where_to_get_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["study.py", "--data", str(tmp_path)])
    assert study.main() == 2
    assert "10.17632/9xyvy2njj3" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["identify.py", "--data", str(tmp_path)])
    assert identify.main() == 2
    assert "is not there" in capsys.readouterr().err
    (tmp_path / "fast.mat").write_bytes(b"not a MATLAB file")
    monkeypatch.setattr(sys, "argv", ["study.py", "--data", str(tmp_path)])
    assert study.main() == 2
    assert "fast.mat cannot be read" in capsys.readouterr().err


@needs_data
def test_the_parameter_file_follows_from_the_data(cell):
    shipped = json.loads(model.PARAMETERS.read_text(encoding="utf-8"))
    capacity, *_ = identify.c20_discharge(DATA)
    assert capacity == pytest.approx(shipped["capacity_Ah"], abs=1e-3)
    pulses = identify.Pulses(DATA, capacity)
    pulses.scale(shipped["hppc_charge_factor"])
    fit = pulses.fit(tuple(shipped["circuit"]["tau_s"]), cell.ocv(identify.GRID)[0])
    assert fit.misfit == pytest.approx(shipped["misfit_V"]["weighted_rms"], abs=5e-4)
    for row, name in zip(fit.tables, ("R0_Ohm", "R1_Ohm", "R2_Ohm"), strict=True):
        # Below SOC 0.15 they and the steep OCV take each other's place.
        np.testing.assert_allclose(row[2:], shipped["circuit"][name][2:], atol=1.5e-3)


@needs_data
@pytest.mark.slow  # two measured cycles of an hour each
@pytest.mark.parametrize("name", ["udds_25degC.mat", "hwfet_25degC.mat"])
def test_targets_on_the_measured_cycles(cell, name):
    bench, cycle = study.Bench(cell, 0.6), study.read(cell, DATA / name, None)
    robust = bench.mhe("MHE", 1, cycle)
    plain = bench.alone("EKF", study.kalman(cell, model.PRIOR), cycle)
    assert rmse(robust) < 2.5
    assert rmse(robust) <= 1.1 * rmse(plain)


@needs_data
@pytest.mark.slow  # all estimators of the study, the converged one too
def test_the_study_writes_table_and_picture(tmp_path, monkeypatch, capsys):
    arguments = ["--data", str(DATA), "--out", str(tmp_path), "--quick", "--cycles", "udds"]
    monkeypatch.setattr(sys, "argv", ["study.py", *arguments])
    monkeypatch.setattr(study, "QUICK", 400.0)
    assert study.main() == 0
    assert "MHE, converged" in capsys.readouterr().out
    found = json.loads((tmp_path / "battery_soc.json").read_text())
    assert {row["cycle"] for row in found["results"]} == {"UDDS"}
    assert all(np.isfinite(row["rmse_percent"]) for row in found["results"])
    assert (tmp_path / "battery_soc.png").read_bytes().startswith(b"\x89PNG")
