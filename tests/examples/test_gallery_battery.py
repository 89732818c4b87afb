"""The battery of the gallery: its parameter file and its model without the data, and with them."""

import json
import os
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("QPMHE_BATTERY_DATA", ROOT.parent / "shared" / "data" / "samsung_30t"))
DT = 2.0

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no battery data at {DATA}")


@pytest.fixture(scope="module")
def parts(gallery):
    names = ("cell", "identify", "measurements", "model")
    return {name: import_module(f"gallery.battery.{name}") for name in names}


@pytest.fixture(scope="module")
def cell(parts):
    return parts["model"].Cell.read()


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


@pytest.mark.slow
def test_a_warming_cell_is_followed_in_spite_of_outliers_and_a_prior_too_sure(parts, cell):
    """A cell that is not quite the model: other resistances, which fall, another OCV."""
    rng, steps = np.random.default_rng(0), 500
    current = np.clip(-4.0 + 6.0 * rng.standard_normal(steps // 5).repeat(5), -30, 10)[:, None]
    offset, scale = 0.008 * rng.standard_normal(12), np.exp(0.1 * rng.standard_normal())
    system = parts["model"].system_of(cell, DT)
    x, soc, y = np.array([1.0, 0.0, 0.0, 1.0]), np.zeros((steps, 1)), np.zeros((steps, 1))
    for k, u in enumerate(current):
        x[3], soc[k] = scale * (1.0 - 0.3 * k / steps), x[0]
        error = np.interp(x[0], np.linspace(0, 1, 12), offset) + 0.002 * rng.standard_normal()
        y[k] = system.h(x, u) + error
        x = system.f(x, u)
    spoilt = np.where(rng.random((steps, 1)) < 0.02, 0.0, y)
    good, plain = (
        rmse(parts, cell, (y, current, soc), way) for way in ("MHE, Huber, 1 QP", "EKF"))
    assert good <= max(1.1 * plain, 0.5)
    for values, prior in ((spoilt, None), (y, parts["cell"].PRIORS["small"])):
        robust, plain = (
            rmse(parts, cell, (values, current, soc), way, prior)
            for way in ("MHE, Huber, 1 QP", "EKF")
        )
        assert robust < min(2.5, 0.5 * plain)


def test_a_folder_that_is_none_is_refused(parts, tmp_path, monkeypatch, capsys):
    main, given = import_module("gallery.command").main, ["--data", str(tmp_path)]
    assert main("battery", "It.", parts["cell"].problems, None, "There.", given) == 2
    assert "10.17632/9xyvy2njj3" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["identify", *given])
    assert parts["identify"].main() == 2
    assert "is not there" in capsys.readouterr().err
    (tmp_path / "fast.mat").write_bytes(b"not a MATLAB file")
    assert main("battery", "It.", parts["cell"].problems, None, "There.", given) == 2
    assert "fast.mat cannot be read" in capsys.readouterr().err


@needs_data
@pytest.mark.slow  # an identification, and a measured cycle of an hour
def test_the_parameter_file_and_the_target_follow_from_the_data(parts, cell):
    identify = parts["identify"]
    shipped = json.loads(parts["model"].PARAMETERS.read_text(encoding="utf-8"))
    assert (ROOT / shipped["provenance"]["script"]).is_file()
    capacity, *_ = identify.c20_discharge(DATA)
    assert capacity == pytest.approx(shipped["capacity_Ah"], abs=1e-3)
    pulses = identify.Pulses(DATA, capacity)
    pulses.scale(shipped["hppc_charge_factor"])
    ocv = cell.ocv(identify.GRID[:, None])[:, 0]
    assert np.all(np.diff(ocv) > 0.0)
    fit = pulses.fit(tuple(shipped["circuit"]["tau_s"]), ocv)
    assert fit.misfit == pytest.approx(shipped["misfit_V"]["weighted_rms"], abs=5e-4)
    record = parts["cell"].read(cell, DATA / "hwfet_25degC.mat", False)
    assert rmse(parts, cell, record, "MHE, Huber, 1 QP") < 2.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*reached but the optimization")
def test_a_network_learns_an_error_of_the_voltage(cell, gallery):
    """A record of the circuit plus a known error: what is left, and what the output becomes."""
    pytest.importorskip("sklearn")
    learnt, model = (import_module(f"gallery.battery.{name}") for name in ("learnt", "model"))
    current = -3.0 + 2.0 * np.sin(np.arange(400) / 7.0)[:, None]
    charge = DT * np.append(0.0, np.cumsum(current)[:-1]) / (3600.0 * cell.capacity)
    x, voltage = np.array([1.0, 0.0, 0.0, 1.0]), np.zeros((400, 1))
    system = model.system_of(cell, DT)
    for k, u in enumerate(current):
        x[0] = 1.0 + charge[k]
        voltage[k] = system.h(x, u) + 0.02 + 0.1 * x[2]
        x = system.f(x, u)
    cycle = voltage, current, 1.0 + charge[:, None]
    inputs, gap = learnt.left_over(cell, cycle)
    np.testing.assert_allclose(gap, 0.02 + 0.1 * inputs[:, 2], atol=1e-12)
    net = learnt.trained(inputs, gap)
    assert np.abs(gap - net(inputs)[:, 0]).max() < 0.1 * np.ptp(gap) + 1e-3
    corrected = model.system_of(cell, DT, net)
    found = corrected.h(np.append(inputs[200, :3], 1.0), current[200])
    np.testing.assert_allclose(found, voltage[200], atol=0.003)
