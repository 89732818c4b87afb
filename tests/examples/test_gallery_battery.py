"""The battery of the gallery: its parameter file and its model without the data, and with them."""

import json
import os
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("QPMHE_BATTERY_DATA", ROOT.parent / "shared" / "data" / "samsung_30t"))

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no battery data at {DATA}")
DT = 2.0


@pytest.fixture(scope="module")
def parts(gallery):
    names = ("cell", "identify", "measurements", "model")
    return {name: import_module(f"gallery.battery.{name}") for name in names}


@pytest.fixture(scope="module")
def cell(parts):
    return parts["model"].Cell.read()


def drive(parts, cell, seed, seconds=1500, falling=0.35, outliers=False):
    """A drive of a cell that is not quite the model: other resistances, which fall, other OCV."""
    rng = np.random.default_rng(seed)
    steps = round(seconds / DT)
    current = np.clip(-4.0 + 6.0 * rng.standard_normal(steps // 5 + 1).repeat(5)[:steps], -30, 10)
    scale = np.exp(0.1 * rng.standard_normal(3))
    offset = 0.008 * rng.standard_normal(12)
    system = parts["model"].system_of(cell, DT)
    x, soc, voltage = np.array([1.0, 0.0, 0.0, 1.0]), [], []
    for k in range(steps):
        x[3] = scale[0] * (1.0 - falling * k / steps)
        u = current[k : k + 1]
        error = np.interp(x[0], np.linspace(0, 1, 12), offset) + 0.002 * rng.standard_normal()
        soc.append(x[0])
        voltage.append(system.h(x, u) + error)
        x = system.f(x, u)
    y, hit = np.array(voltage), rng.random((steps, 1)) < 0.02
    return np.where(hit, 0.0, y) if outliers else y, current[:, None], np.array(soc)[:, None]


def rmse(parts, cell, record, way, prior=None):
    """Of the SOC in % after 300 s, from 60 % where the cell is full."""
    model, (y, u, soc) = parts["model"], record
    weights = model.weights_of(cell, DT, model.PRIOR if prior is None else prior)
    problem = import_module("gallery.problem").Problem(
        "battery", "", model.system_of(cell, DT), [], weights, parts["cell"].error, "%", 10.0
    )
    ways = import_module("gallery.baselines").filters(problem, weights)
    mhe = (ways | parts["cell"].own(problem, weights))[way](np.array([0.6, 0.0, 0.0, 1.0]))
    error = parts["cell"].error(mhe.run(y, u).filtered, soc)
    return float(np.sqrt(np.mean(error[150:] ** 2)))


def test_the_parameter_file_is_small_and_tells_where_it_comes_from(parts):
    text = parts["model"].PARAMETERS.read_text(encoding="utf-8")
    found = json.loads(text)
    assert len(text) < 10_000
    assert found["provenance"]["doi"] == "10.17632/9xyvy2njj3"
    names = parts["measurements"].C20, parts["measurements"].HPPC
    assert tuple(found["provenance"]["files"]) == names
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


def test_tables_are_interpolated_and_go_on_straight(parts, cell):
    found = json.loads(parts["model"].PARAMETERS.read_text(encoding="utf-8"))
    circuit, soc = found["circuit"], np.linspace(-0.2, 1.2, 281)
    for k, name in enumerate(("R0_Ohm", "R1_Ohm", "R2_Ohm")):
        np.testing.assert_allclose(
            cell.resistance(soc[:, None], k)[:, 0], np.interp(soc, circuit["soc"], circuit[name]),
            rtol=1e-12,
        )
    voltage = cell.ocv(soc[:, None])[:, 0]
    table = np.array(found["ocv"]["V"])
    known = np.linspace(0.0, 1.0, table.size)
    # Where the cell is nearly empty, the slope changes from point to point by more than it is.
    np.testing.assert_allclose(np.interp(known, soc, voltage)[10:], table[10:], atol=5e-3)
    np.testing.assert_allclose(np.diff(voltage, 2)[soc[2:] <= 0.0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(voltage, 2)[soc[:-2] >= 1.0], 0.0, atol=1e-12)


def test_the_model_is_traced(parts, cell):
    assert parts["model"].system_of(cell, DT).explain().count("exact, by its trace") == 2


def test_a_step_is_the_mean_of_many_small_ones(parts, cell):
    coarse, fine = (parts["model"].system_of(cell, dt) for dt in (2.0, 0.01))
    start, u = np.array([0.55, -0.01, 0.02, 0.9]), np.array([-5.0])
    x, outputs = start, []
    for _ in range(200):
        outputs.append(fine.h(x, u))
        x = fine.f(x, u)
    # OCV and resistances move by 0.1 % SOC, which the coarse step takes at its beginning.
    np.testing.assert_allclose(coarse.f(start, u), x, atol=1e-5)
    np.testing.assert_allclose(coarse.h(start, u), np.mean(outputs, axis=0), atol=1e-3)


def test_an_implausible_prior_is_scaled_back(parts, cell):
    huge = parts["model"].robust_kalman(
        prior=100.0 * np.eye(4), disturbance=parts["model"].disturbance(cell, DT),
        noise=parts["model"].noise(DT),
    )
    assert np.all(np.sqrt(np.diag(huge.initial_covariance())) <= 0.3001)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_warming_cell_is_followed_in_spite_of_outliers(parts, cell, seed):
    record, spoilt = (drive(parts, cell, seed, outliers=some) for some in (False, True))
    np.testing.assert_array_equal(record[2], spoilt[2])
    good = rmse(parts, cell, record, "MHE, Huber, 1 QP")
    assert good <= max(1.1 * rmse(parts, cell, record, "EKF"), 0.5)
    robust = rmse(parts, cell, spoilt, "MHE, Huber, 1 QP")
    assert robust < min(2.5, 0.5 * rmse(parts, cell, spoilt, "EKF"))


def test_a_prior_that_is_too_sure_is_overcome(parts, cell):
    record, wrong = drive(parts, cell, 3, seconds=700), parts["cell"].PRIORS["small"]
    robust = rmse(parts, cell, record, "MHE, Huber, 1 QP", wrong)
    assert robust < min(2.5, 0.5 * rmse(parts, cell, record, "EKF", wrong))


def test_means_keep_the_charge(parts):
    measurements = parts["measurements"]
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


def test_a_folder_that_is_none_is_refused(parts, tmp_path, monkeypatch, capsys):
    command = import_module("gallery.command")

    def main():
        return command.main("battery", "It.", parts["cell"].problems, None, "There.",
                            ["--data", str(tmp_path)])

    assert main() == 2
    assert "10.17632/9xyvy2njj3" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["identify", "--data", str(tmp_path)])
    assert parts["identify"].main() == 2
    assert "is not there" in capsys.readouterr().err
    (tmp_path / "fast.mat").write_bytes(b"not a MATLAB file")
    assert main() == 2
    assert "fast.mat cannot be read" in capsys.readouterr().err


@needs_data
def test_the_parameter_file_follows_from_the_data(parts, cell):
    identify = parts["identify"]
    shipped = json.loads(parts["model"].PARAMETERS.read_text(encoding="utf-8"))
    capacity, *_ = identify.c20_discharge(DATA)
    assert capacity == pytest.approx(shipped["capacity_Ah"], abs=1e-3)
    pulses = identify.Pulses(DATA, capacity)
    pulses.scale(shipped["hppc_charge_factor"])
    ocv = cell.ocv(identify.GRID[:, None])[:, 0]
    fit = pulses.fit(tuple(shipped["circuit"]["tau_s"]), ocv)
    assert fit.misfit == pytest.approx(shipped["misfit_V"]["weighted_rms"], abs=5e-4)
    for row, name in zip(fit.tables, ("R0_Ohm", "R1_Ohm", "R2_Ohm"), strict=True):
        # Below SOC 0.15 they and the steep OCV take each other's place.
        np.testing.assert_allclose(row[2:], shipped["circuit"][name][2:], atol=1.5e-3)


@needs_data
@pytest.mark.slow  # a measured cycle of an hour
def test_targets_on_a_measured_cycle(parts, cell):
    record = parts["cell"].read(cell, DATA / "hwfet_25degC.mat", False)
    assert rmse(parts, cell, record, "MHE, Huber, 1 QP") < 2.0


@needs_data
@pytest.mark.slow  # all estimators, the converged one too, in Python
def test_the_command_writes_tables_and_a_picture(parts, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(parts["cell"], "QUICK", 400.0)
    assert import_module("gallery.command").main(
        "battery", "It.", parts["cell"].problems, parts["cell"].draw, "There.",
        ["--data", str(DATA), "--out", str(tmp_path), "--quick"],
    ) == 0
    assert "MHE, Huber, converged" in capsys.readouterr().out
    for name in ("battery", "battery_zeros", "battery_outliers", "battery_small_prior",
                 "battery_large_prior"):
        assert "EKF, gated" in (tmp_path / f"{name}.md").read_text()
    assert (tmp_path / "battery.png").read_bytes().startswith(b"\x89PNG")
