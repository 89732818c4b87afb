"""The controller on estimates: the program runs, and what it tells does not depend on its parts."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "examples" / "closed_loop.py"

pytest.importorskip("casadi")


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("closed_loop", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def parts(example):
    model = example.step()
    return model, example.qpmhe.from_casadi(model, lambda x: x[0], compiled=False)


def test_the_program_prints_its_table_and_draws(tmp_path):
    answer = subprocess.run(
        [sys.executable, PROGRAM, "--steps", "12", "--seeds", "1", "--out", tmp_path],
        capture_output=True, text=True, check=True, timeout=300,
    )
    for name in ("observer", "Kalman filter", "MHE", "full state"):
        assert name in answer.stdout
    for kind in ("png", "svg"):
        assert (tmp_path / f"closed_loop.{kind}").stat().st_size > 1000


def test_the_plan_obeys_model_and_limits(example, parts):
    model, system = parts
    controller = example.Controller(model)
    start = np.array([0.3, -0.2, 0.5])
    torque = controller(start)
    assert np.abs(torque).max() <= example.TORQUE
    # The plan that is kept has been shifted by one sample: x(2) follows x(1) under u(1).
    us, xs = np.split(controller._plan, [example.AHEAD])
    xs = xs.reshape(-1, 3)
    following = system.f(xs[:-2], us[1:-1, None])
    np.testing.assert_allclose(following, xs[1:-1], atol=1e-5)


def test_a_late_estimate_is_not_used(example, parts):
    model, system = parts
    mhe = example.estimators(system, 1.0)["observer"]
    loop = example.simulate(system, example.Controller(model), mhe, 6, seed=0, deadline=0.0)
    assert loop.late == 6
    predicted = [example.GUESS]
    for u in loop.torques:
        predicted.append(system.f(predicted[-1], u))
    np.testing.assert_array_equal(loop.used, predicted)


def test_estimates_in_time_are_used_and_mhe_is_the_better(example, parts):
    model, system = parts
    errors = {}
    for name, mhe in example.estimators(system, deadline=1e9).items():
        loop = example.simulate(system, example.Controller(model), mhe, 40, seed=0, deadline=1e9)
        assert loop.late == 0
        np.testing.assert_array_equal(loop.used, loop.run.states)
        errors[name] = np.sqrt(np.mean((loop.used - loop.states)[:, 1] ** 2))
    assert errors["MHE"] < 0.8 * errors["observer"]
