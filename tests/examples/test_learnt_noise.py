"""The noise that is learnt through the estimator: its derivatives, and the programs."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import qpmhe

FOLDER = Path(__file__).parents[2] / "examples" / "learnt_noise"


@pytest.fixture
def camera(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("camera")


def test_slopes_are_the_derivatives_of_the_estimates(camera, monkeypatch):
    made = camera.estimator()

    def estimator():
        return qpmhe.MovingHorizonEstimator(
            made.system, made.observer, made.cost, horizon=camera.HORIZON,
            initial_state=camera.START, max_qps=None, tolerance=1e-14,
        )

    monkeypatch.setattr(camera, "estimator", estimator)
    _, Y, light = camera.record(3)
    Y, variances = Y[:25], camera.deviation(light[:25]) ** 2
    states, slopes = camera.estimate_and_slopes(Y, variances)
    np.testing.assert_array_equal(states, camera.estimate(Y, variances))
    rng = np.random.default_rng(1)
    change, cotangents = variances * rng.normal(size=25), rng.normal(size=states.shape)
    ahead, behind = (camera.estimate(Y, variances + share * change) for share in (1e-3, -1e-3))
    expected = (cotangents * (ahead - behind)).sum() / 2e-3
    assert camera.pulled_back(cotangents, slopes) @ change == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("framework", ["jax", "torch"])
def test_the_program_learns(framework):
    pytest.importorskip(framework)
    answer = subprocess.run(
        [sys.executable, FOLDER / f"with_{framework}.py", "--steps", "4", "--records", "1",
         "--tests", "1"],
        capture_output=True, text=True, check=True, timeout=600,
    )
    for name in ("one learnt constant", "learnt from the brightness", "true"):
        assert name in answer.stdout


def test_jax_has_the_same_derivatives(camera, monkeypatch):
    jax = pytest.importorskip("jax")
    # The program sets the precision of its whole process.
    with jax.enable_x64(True) if hasattr(jax, "enable_x64") else jax.experimental.enable_x64():
        monkeypatch.setattr(jax.config, "update", lambda name, value: None)
        _check_derivatives(jax, importlib.import_module("with_jax"), camera)


def _check_derivatives(jax, program, camera):
    _, Y, light = camera.record(3)
    Y, variances = Y[:20], camera.deviation(light[:20]) ** 2
    cotangents = np.random.default_rng(1).normal(size=(20, 2))
    _, pull = jax.vjp(program.estimates, Y, variances)
    expected = camera.pulled_back(cotangents, camera.estimate_and_slopes(Y, variances)[1])
    np.testing.assert_allclose(pull(cotangents)[1], expected, rtol=1e-12)
    # Within a compiled program, too.
    slope = jax.jit(jax.grad(lambda v: (program.estimates(Y, v) * cotangents).sum()))
    np.testing.assert_allclose(slope(variances), expected, rtol=1e-12)
