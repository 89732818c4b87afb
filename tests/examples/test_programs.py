"""The programs run and draw, and what they print is what they say it is."""

import importlib
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import qpmhe

EXAMPLES = Path(__file__).parents[2] / "examples"

pytest.importorskip("casadi")


@pytest.fixture(scope="module")
def load():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        patch.syspath_prepend(EXAMPLES / "learnt_noise")
        yield importlib.import_module


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options", "words"), [
    ("closed_loop", ["--steps", "12", "--seeds", "1"], ["observer", "MHE", "full state"]),
    ("do_mpc_masses", ["--steps", "25", "--seeds", "1"],
     ["qpmhe, 2 QPs", "samples 20 to 24; none from 50 on, whose columns are left out"]),
    ("learnt_noise/with_jax", ["--steps", "4", "--records", "1", "--tests", "1"],
     ["one learnt constant", "learnt from the brightness", "true"]),
    ("learnt_noise/with_torch", ["--steps", "4", "--records", "1", "--tests", "1"],
     ["one learnt constant", "learnt from the brightness", "true"]),
])  # fmt: skip
def test_the_program_prints_its_table_and_draws(tmp_path, name, options, words):
    folder, _, framework = name.rpartition("with_")
    if folder:
        pytest.importorskip(framework)
    else:
        options = [*options, "--out", str(tmp_path)]
    answer = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", *options], capture_output=True, text=True,
        check=True, timeout=600,
    )
    text = " ".join(answer.stdout.split())
    assert [one for one in words if one not in text] == []
    assert "nan" not in text
    assert folder or (tmp_path / f"{name}.png").stat().st_size > 1000


def test_the_controllers_plan_obeys_model_and_limits_and_needs_estimates_in_time(load):
    example = load("closed_loop")
    model = example.step()
    system = qpmhe.from_casadi(model, lambda x: x[0], compiled=False)
    controller = example.Controller(model)
    assert np.abs(controller(np.array([0.3, -0.2, 0.5]))).max() <= example.TORQUE
    # The plan that is kept has been shifted by one sample: x(2) follows x(1) under u(1).
    us, xs = np.split(controller._plan, [example.AHEAD])
    xs = xs.reshape(-1, 3)
    np.testing.assert_allclose(system.f(xs[:-2], us[1:-1, None]), xs[1:-1], atol=1e-5)
    # A late estimate is not used.
    mhe = example.estimators(system, 1.0)["observer"]
    loop = example.simulate(system, example.Controller(model), mhe, 6, seed=0, deadline=0.0)
    assert loop.late == 6
    predicted = [example.GUESS]
    for u in loop.torques:
        predicted.append(system.f(predicted[-1], u))
    np.testing.assert_array_equal(loop.used, predicted)
    errors = {}
    for name, mhe in example.estimators(system, deadline=1e9).items():
        loop = example.simulate(system, example.Controller(model), mhe, 40, seed=0, deadline=1e9)
        assert loop.late == 0
        np.testing.assert_array_equal(loop.used, loop.run.states)
        errors[name] = np.sqrt(np.mean((loop.used - loop.states)[:, 1] ** 2))
    assert errors["MHE"] < 0.8 * errors["observer"]


def test_two_qps_find_speeds_and_inertia_of_the_masses(load, monkeypatch, capsys):
    example = load("do_mpc_masses")
    record = example.simulate(seed=4, steps=80)
    found = example.with_qpmhe(record, 2)
    # Differences of measured angles are good to 0.01 sqrt(2) / 0.1 = 0.14 rad/s at best.
    assert np.sqrt(np.mean((found.states - record.states[1:])[20:, 3:6] ** 2)) < 0.1
    assert np.sqrt(np.mean((found.inertias[20:] - 2.25) ** 2)) < 0.15
    for steps, columns in ((21, 5), (50, 5), (51, 8)):
        table, parts = example.error_table(steps, 1)
        assert len(table.columns) == columns
        assert all(np.arange(steps)[part].size for part in parts)
    monkeypatch.setattr(sys, "argv", ["program", "--steps", "20"])
    with pytest.raises(SystemExit, match="2"):
        example.main()
    assert "--steps is 20; expected more than 20" in " ".join(capsys.readouterr().err.split())


def test_slopes_of_the_learnt_noise_are_the_derivatives_of_the_estimates(load, monkeypatch):
    camera = load("camera")
    _, Y, light = camera.record(3)
    Y, variances = Y[:20], camera.deviation(light[:20]) ** 2
    rng = np.random.default_rng(1)
    change, cotangents = variances * rng.normal(size=20), rng.normal(size=(20, 2))
    expected = camera.pulled_back(cotangents, camera.estimate_and_slopes(Y, variances)[1])
    if find_spec("jax") is not None:
        import jax

        switch = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
        # The program sets the precision of its whole process.
        monkeypatch.setattr(jax.config, "update", lambda name, value: None)
        with switch(True):
            estimates = load("with_jax").estimates
            slope = jax.jit(jax.grad(lambda v: (estimates(Y, v) * cotangents).sum()))
            np.testing.assert_allclose(slope(variances), expected, rtol=1e-12)
    made = camera.estimator()
    monkeypatch.setattr(camera, "estimator", lambda: qpmhe.MovingHorizonEstimator(
        made.system, made.observer, made.cost, horizon=camera.HORIZON, initial_state=camera.START,
        max_qps=None, tolerance=1e-14,
    ))
    slopes = camera.estimate_and_slopes(Y, variances)[1]
    ahead, behind = (camera.estimate(Y, variances + share * change) for share in (1e-3, -1e-3))
    difference = (cotangents * (ahead - behind)).sum() / 2e-3
    assert camera.pulled_back(cotangents, slopes) @ change == pytest.approx(difference, rel=1e-3)
